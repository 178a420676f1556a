"""docs/stress: the stability matrix of a finished run of `stress`, and what it taught.

    toftools bench stress --out DIR && python benchmarks/stress_page.py DIR

Every finding is a sentence whose figures are read from the run; a finding that the run does not
bear out any more stops the page.
"""

import argparse
import json
import shutil
from collections import defaultdict
from pathlib import Path

from toftools.bench.figures import slug
from toftools.bench.rows import read_rows
from toftools.viz._axes import number

PAGE = Path(__file__).parent.parent / "docs" / "stress"
AUTO, PLAIN, NET, CRT = "auto", "auto:learned=none", "network", "crt:max_range_m=0"
FUCHS, SEMI, SRA = "fuchs2010:tol_mm=1", "semi_global:jump=16", "sra:grid_m=0.02"
TWO, RATIO = "dorrington2011:starts=4", "godbaz2012_ratio:first_share=0.05"
KEEPS = "smooth:radius_px=2 > crt:max_range_m=0 > flying_pixels:least_neighbours=3"
# Title, axis, sentence, what must hold. {setting@value} is the mean error there, cm.
FINDINGS = [
    (
        "Where least light bounces, the network errs most, and takes auto with it",
        "albedo",
        "In a corner of albedo 0.1 next to nothing has to be corrected: `crt` errs by "
        "{CRT@0.1} cm, `network` by {NET@0.1}. From albedo 0.3 on it is as good as or better than "
        "`crt` ({NET@0.3} and {CRT@0.3}). `auto` believes it ({AUTO@0.1} cm); told to do without, "
        "it has {PLAIN@0.1}.",
        lambda e: e(NET, 0.1) > 3 * e(CRT, 0.1) and e(NET, 0.5) < e(CRT, 0.5),
    ),
    (
        "More light can make a choice worse",
        "photons at 1 GHz",
        "At 1 GHz `auto` errs by {AUTO@200000} cm with 200 000 electrons, by {AUTO@50000} with "
        "50 000: with that much light 153 of its 3072 pixels seem to need two returns (`info`), "
        "with less light none. `fuchs2010` alone has {FUCHS@200000}.",
        lambda e: e(AUTO, 200000) > 3 * e(AUTO, 50000) and e(FUCHS, 200000) < 0.2 * e(AUTO, 200000),
    ),
    (
        "A waveform that is not a sine is a second return to who looks for two",
        "wiggling",
        "Uncalibrated, a trapezoid with edges of half a turn moves `crt` from {CRT@0} to {CRT@2} "
        "cm, and `dorrington2011`, which fits two returns, from {TWO@0} to {TWO@2}; "
        "with edges of a tenth of a turn to {TWO@10}.",
        lambda e: e(TWO, 2) > 10 * e(CRT, 2),
    ),
    (
        "A centimetre between light and lens undoes what correction gains",
        "emitter offset",
        "With the light at the lens `fuchs2010` takes {CRT@0} cm down to {FUCHS@0}; with the light "
        "1 cm away and not told, it is back at {FUCHS@0.01}, and at 3 cm nobody is below "
        "{KEEPS@0.03}. Its median error stays at 0.4 cm: what errs is the shadow of edges, which "
        "sees bounced light alone (at 10 cm 4 % of the pixels, by 3.8 m; the others by 1.5 cm). "
        "The chain that drops flying pixels has {KEEPS@0.1} cm there, `fuchs2010` {FUCHS@0.1}.",
        lambda e: e(FUCHS, 0.01) > 0.8 * e(CRT, 0) and e(KEEPS, 0.1) < 0.5 * e(FUCHS, 0.1),
    ),
    (
        "A wrong angle of view hardly matters to light transport",
        "wrong intrinsics",
        "Told 80 degrees instead of 70, `fuchs2010` errs by {FUCHS@10} cm instead of {FUCHS@0} "
        "(`crt`: {CRT@0}); only at 110 degrees is it worse than doing nothing ({FUCHS@40}).",
        lambda e: e(FUCHS, 10) < 0.3 * e(CRT, 0) < e(FUCHS, 40),
    ),
    (
        "With two frequencies auto leaves a factor of twenty to sparse methods",
        "distance of two returns, an octave",
        "Two returns 1.5 m apart at 40 and 80 MHz: `godbaz2012_ratio` and `dorrington2011` err by "
        "{RATIO@1.5} and {TWO@1.5} cm, `auto` by {AUTO@1.5}, as `crt` does ({CRT@1.5}): it asks "
        "for two returns from three frequencies on.",
        lambda e: e(AUTO, 1.5) > 10 * e(RATIO, 1.5),
    ),
]  # fmt: skip


def errors(rows):
    """Mean error, m, by axis, setting and value: over the seeds that have one."""
    from toftools.bench.table import label_of

    found = defaultdict(list)
    for row in rows:
        if row["metrics"].get("mae_m") is not None:
            found[row["axis"], label_of(row), float(row["value"])].append(row["metrics"]["mae_m"])
    return {key: sum(values) / len(values) for key, values in found.items()}


def said(text, axis, known):
    """The sentence with its figures."""
    import re

    def figure(match):
        name, _, value = match.group(1).partition("@")
        return f"{100 * known[axis, globals()[name], float(value)]:.2f}"

    return re.sub(r"\{([A-Z]+@[0-9.]+)\}", figure, text)


def matrix(folder):
    told = json.loads((folder / "stability.json").read_text(encoding="utf-8"))
    axes = list(dict.fromkeys(one["axis"] for one in told))
    cell = {(one["axis"], one["label"]): one for one in told}
    yield f"| | {' | '.join(axes)} |\n|{'---|' * (len(axes) + 1)}"
    for label in dict.fromkeys(one["label"] for one in told):
        mine = [field(cell.get((axis, label))) for axis in axes]
        yield f"| `{label}` | {' | '.join(mine)} |"


def field(told):
    if told is None:
        return "–"
    marks = "".join(flag[0] for flag in told["flags"] if flag != "unfinished")
    value = "holds" if told["breaks_at"] is None else number(told["breaks_at"])
    benign = "–" if told["benign_m"] is None else f"{100 * told['benign_m']:.2f}"
    return f"{value} ({benign}){' ' + marks if marks else ''}"


def page(folder, out):
    rows = [row for row in read_rows(folder) if "axis" in row]
    known, machine = errors(rows), next(r["machine"] for r in rows if r.get("machine"))
    parts = [
        "# Where methods break",
        "Made by `toftools bench stress --out DIR` and `python benchmarks/stress_page.py DIR`; do "
        f"not edit. {len({r['capture_id'] for r in rows})} captures, {len(rows)} points, "
        f"{machine['cpu']}. What an axis is and when a method counts as broken: "
        "[benchmark.md](../benchmark.md#stress-axes).",
        "## Findings",
    ]
    for title, axis, text, holds in FINDINGS:
        if not holds(lambda setting, value, axis=axis: known[axis, setting, float(value)]):
            msg = f"the run in {folder} does not bear out: {title}"
            raise ValueError(msg)
        name = f"axis-{slug(axis)}.svg"
        shutil.copyfile(folder / "figures" / name, out / name)
        parts += [f"### {title}", said(text, axis, known), f"![{axis}]({name})"]
    parts += [
        "## All axes",
        "The value at which a method breaks, and in brackets its error at the easy end, cm: who "
        "errs much from the start has little to break. u: unstable, o: overconfident, f: fails.",
        "\n".join(matrix(folder)),
    ]
    return "\n\n".join(parts) + "\n"


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="finished run of the suite stress")
    parser.add_argument("--out", type=Path, default=PAGE)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "index.md").write_text(page(given.folder, given.out), encoding="utf-8")
    shutil.copyfile(given.folder / "stability.csv", given.out / "stability.csv")


if __name__ == "__main__":
    main()
