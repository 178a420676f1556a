"""Do runs of a suite agree: two whole ones, or a whole one and one that is killed again and again.

    python benchmarks/reruns.py twice core --out DIR     metrics bit-equal, ranks equal, times close
    python benchmarks/reruns.py killed full --out DIR --kills 10 [-- --jobs 2]

Every run starts in a folder of its own, captures included. A folder that holds results already is
taken as it is. What follows ``--`` goes to `toftools bench`. Exit code 1 if they differ.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from toftools.bench.table import groups, summarise

TIMED = ("setup_s", "first_call_s", "ms", "ms_iqr", "peak_mb")
"""What a clock or a meter says: no two runs agree on it."""


def command(suite, out, more):
    return [sys.executable, "-m", "toftools", "bench", suite, "--out", str(out), *more]


def whole(suite, out, more):
    """Run to the end, unless there are results; seconds."""
    began = time.monotonic()
    if not (out / "results.jsonl").is_file():
        subprocess.run(command(suite, out, more), check=False, stdout=subprocess.DEVNULL)
    return time.monotonic() - began


def killed(suite, out, more, kills, longest_s, seed=0):
    """Kill at random moments, then let it end; points that were finished at each kill."""
    draw, counts = random.Random(seed), []
    for _ in range(0 if (out / "results.jsonl").is_file() else kills):
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(command(suite, out, more), start_new_session=True, **quiet)
        try:
            process.wait(draw.uniform(1, longest_s))
        except subprocess.TimeoutExpired:
            # Now and then all of its processes at once, as a power cut would.
            if draw.random() < 0.5:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            process.wait()
        counts.append(len(list((out / "runs").glob("[!.]*.json"))) if out.is_dir() else 0)
        print(f"killed, {counts[-1]} points finished", flush=True)
    whole(suite, out, more)
    return counts


def rows_of(out):
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


def untimed(row):
    return {key: value for key, value in row.items() if key not in TIMED}


def ranks(rows):
    """Per group, labels from the smallest error to the largest."""
    return {
        name: [line.label for line in sorted(summarise(mine), key=lambda li: (
            li.metrics.get("mae_m", float("inf")), li.label))]
        for name, mine in groups(rows).items()
    }  # fmt: skip


def differing(first, second):
    """Keys of rows whose untimed figures differ."""
    if len(first) != len(second):
        return [f"{len(first)} rows and {len(second)}"]
    return [
        f"{a['capture']} {a['method']} {sorted(k for k in untimed(a) if a[k] != b.get(k))}"
        for a, b in zip(first, second, strict=True)
        if untimed(a) != untimed(b)
    ]


def times(first, second):
    """Share of the timed points whose medians differ by no more than the larger IQR; ratios."""
    pairs = [(a, b) for a, b in zip(first, second, strict=True) if a.get("ms") and b.get("ms")]
    near = [abs(a["ms"] - b["ms"]) <= max(a["ms_iqr"], b["ms_iqr"]) for a, b in pairs]
    ratios = sorted(b["ms"] / a["ms"] for a, b in pairs)
    middle = {f"{q}%": round(ratios[int(q / 100 * (len(ratios) - 1))], 3) for q in (5, 50, 95)}
    return {"timed": len(pairs), "within_iqr": sum(near) / len(pairs), "ratio": middle}


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("twice", "killed"))
    parser.add_argument("suite")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=10)
    given, more = parser.parse_known_args(arguments)
    more = [text for text in more if text != "--"]
    given.out.mkdir(parents=True, exist_ok=True)
    one, two = given.out / "whole", given.out / given.what
    told = {"suite": given.suite, "seconds": round(whole(given.suite, one, more), 1)}
    if given.what == "killed":
        longest_s = max(told["seconds"] / given.kills * 1.6, 2.0)
        told["finished_at_kills"] = killed(given.suite, two, more, given.kills, longest_s)
    else:
        told["seconds_again"] = round(whole(given.suite, two, more), 1)
    first, second = rows_of(one), rows_of(two)
    told |= {
        "points": len(first),
        "status": {s: sum(r["status"] == s for r in first) for s in {r["status"] for r in first}},
        "differ": differing(first, second),
        "ranks_equal": ranks(first) == ranks(second),
        "times": times(first, second),
    }
    print(json.dumps(told, indent=1))
    return int(bool(told["differ"]) or not told["ranks_equal"])


if __name__ == "__main__":
    sys.exit(main())
