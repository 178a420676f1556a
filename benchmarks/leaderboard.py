"""The leaderboard: finished runs kept small in benchmarks/results, and docs/leaderboard.md.

python benchmarks/leaderboard.py                               rewrite the page
python benchmarks/leaderboard.py --take out/core out/stress    first take over finished runs

A run replaces what the same suite held for the same class of machine.
"""

import argparse
import json
import math
import re
import subprocess
from pathlib import Path

from leaderboard_page import page

from toftools.bench.table import groups, summarise, unsuited
from toftools.io.atomic import atomic_path

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "leaderboard.md"
METRICS = ("mae_m", "p95_m", "wrap_share", "valid_share")


def rows_of(folder):
    """Rows of a finished run."""
    path = folder / "results.jsonl"
    if not path.is_file():
        raise ValueError(f"{path} is missing; give the folder of a finished `toftools bench` run")
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    left = sum(row["status"] == "missing" for row in rows)
    if left or not any(row.get("machine") for row in rows):
        raise ValueError(
            f"{path} holds a run that is not finished ({left} of {len(rows)} points are missing); "
            "run `toftools bench SUITE --out DIR` to its end first"
        )
    return rows


def machine_class(machine):
    """Folder of a kind of machine: what makes times comparable.

    >>> machine_class({"cpu": "Intel(R) Xeon(R) CPU @ 2.20GHz", "threads": 2})
    'intel-xeon-2.20ghz-2-threads'
    """
    cpu = re.sub(r"\((R|TM)\)|\b(CPU|Processor)\b|@", " ", machine["cpu"], flags=re.IGNORECASE)
    name = re.sub(r"[^a-z0-9.]+", "-", cpu.lower()).strip("-")
    return f"{name}-{machine['threads']}-threads"


def rounded(value):
    return None if value is None or not math.isfinite(value) else float(f"{value:.5g}")


def group_rows(rows):
    """One small row per group and method setting, and one per method that does not apply."""
    for group, mine in groups(r for r in rows if not {"axis", "ladders"} & set(r)).items():
        for line in summarise(mine):
            figures = {name: rounded(line.metrics.get(name)) for name in METRICS}
            told = {"group": group, "against": mine[0]["against"], "method": line.method}
            yield {**told, "label": line.label, **figures,
                   "ms": rounded(line.ms), "peak_mb": rounded(line.peak_mb), "timed": line.timed,
                   "complete": line.complete, "note": line.note}  # fmt: skip
        yield from ({"group": group, "unsuited": sentence} for sentence in unsuited(mine))


def stress_rows(folder):
    """One small row per method setting: what becomes of it on each stress axis."""
    path = folder / "stability.json"
    if not path.is_file():
        return
    by_label = {}
    for told in json.loads(path.read_text(encoding="utf-8")):
        by_label.setdefault(told["label"], []).append(told)
    for label, mine in by_label.items():
        flags = {f: [t["axis"] for t in mine if f in t["flags"]]
                 for f in ("unstable", "overconfident", "fails")}  # fmt: skip
        yield {"stress": label,
               "breaks_at": {t["axis"]: rounded(t["breaks_at"]) for t in mine},
               "survives": {t["axis"]: rounded(t["share"]) for t in mine}, **flags}  # fmt: skip


def commit_at_hand():
    """Commit of the sources, with a plus if they were changed since."""

    def git(*words):
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True,
                              check=False)  # fmt: skip
        return done.stdout.strip()

    commit = git("rev-parse", "--short", "HEAD") or "unknown"
    return commit + ("+" if git("status", "--porcelain", "--", "toftools") else "")


def take(folder, commit, results=RESULTS):
    """Keep the small rows of a run; the file they went to."""
    rows = rows_of(folder)
    known = [row for row in rows if row.get("machine")]
    if len({json.dumps(row["machine"], sort_keys=True) for row in known}) > 1:
        msg = f"{folder} holds times of several machines; take runs of one machine each"
        raise ValueError(msg)
    about = {"suite": rows[0]["suite"], "commit": commit, "machine": known[0]["machine"],
             "versions": known[0]["versions"], "points": len(rows),
             "captures": len({row["capture_id"] for row in rows})}  # fmt: skip
    path = results / machine_class(about["machine"]) / f"{about['suite']}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [about, *group_rows(rows), *stress_rows(folder)]
    with atomic_path(path) as made:
        made.write_text("\n".join(map(json.dumps, lines)) + "\n", encoding="utf-8")
    return path


def boards(results=RESULTS):
    """All that is kept: class of machine, then suite, then (about, rows)."""
    found = {}
    for path in sorted(results.glob("*/*.jsonl")):
        about, *rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        found.setdefault(path.parent.name, {})[path.stem] = (about, rows)
    return found


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--take", type=Path, nargs="+", default=[], metavar="DIR",
                        help="folders of finished runs")  # fmt: skip
    parser.add_argument("--commit", help="commit that was run; that of the sources at hand if not")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args(arguments)
    try:
        for folder in args.take:
            print(take(folder, args.commit or commit_at_hand(), args.results))
    except ValueError as error:
        parser.error(str(error))
    with atomic_path(args.page) as made:
        made.write_text(page(boards(args.results)), encoding="utf-8")
    print(args.page)


if __name__ == "__main__":
    main()
