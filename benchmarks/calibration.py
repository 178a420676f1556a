"""Calibration against what was planted: one run, one page.

python benchmarks/calibration.py [--out docs/calibration] [--seeds 100] [--only SECTION ...]

Writes index.md, results.json and pictures. Sections: coverage (are the intervals honest), ablation
(a whole calibration on held-out distances, stages left out one by one), speed. Beside it stand the
pages of calibration_lens.py and calibration_real.py. With --only, other sections stay as an
earlier run left them.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from toftools.bench.run import machine

ROOT = Path(__file__).parents[1]
SECTIONS = ("ablation", "coverage", "speed")
WANTED = 0.9


def measured(section, args):
    start = time.perf_counter()
    if section == "coverage":
        import calibration_coverage

        found = {"seeds": args.seeds, "rows": calibration_coverage.run(args.seeds)}
    elif section == "ablation":
        import calibration_ablation

        found = {"sensor": calibration_ablation.SENSOR, "frames": calibration_ablation.FRAMES,
                 "jobs": calibration_ablation.run(args.out)}  # fmt: skip
    else:
        import calibration_speed

        found = calibration_speed.measured()
    return {**found, "took_s": time.perf_counter() - start, "machine": machine(2)}


def table(head, rows):
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def ablation_md(found):
    jobs = found["jobs"]
    whole = jobs[0]
    rows = []
    for job in jobs:
        together = job["scores"][-1]
        per = ", ".join(f"{s['rms_mm']:.1f} / {s['noise_mm']:.1f}" for s in job["scores"][:-1])
        rows.append((job["left_out"] or "none", per, f"{together['rms_mm']:.2f}",
                     f"{together['noise_mm']:.2f}", f"{together['ratio']:.2f}",
                     job["word"]))  # fmt: skip
    raw = ", ".join(f"{s['rms_mm']:.0f} mm at {s['name']}" for s in whole["before"][:-1])
    residuals = [
        (slot, r["unit"], *(f"{r[k]:.2f}" for k in ("before", "after", "held_out", "noise")))
        for slot, r in whole["residuals"].items()
    ]
    return "\n\n".join([
        "## A whole calibration",
        f"`{found['sensor']}`, the full plan of `toftools rig`: lens, square waves, fixed pattern, "
        "common phase, drift with two temperatures, amplitude error, response, bad pixels. "
        f"Captures of the calibration are averages of {found['frames']} frames; the check set are "
        "12 single frames at distances, tilts, brightnesses and temperatures that no stage saw. "
        f"Before any calibration they err by {raw} rms.",
        f"> {whole['sentence']}",
        table(("stage left out", "rms / noise per frequency, mm", "together, mm", "noise, mm",
               "ratio", "verdict"), rows),
        "Each row is a calibration of its own: the other stages are fitted without the one left "
        "out, and make up for it where they can.",
        "Residuals of the fits:",
        table(("stage", "unit", "before", "after", "held out", "noise"), residuals),
        "![cyclic error before and after](cyclic.png)",
        "![range error of the check set over distance](distance.png)",
        "![error maps of one frame of the check set](maps.webp)",
        f"One such fit takes {whole['cpu_s']:.0f} s of CPU time.",
    ])  # fmt: skip


def kind_of(name):
    for start in ("wiggling", "common", "drift", "amplitude", "pixels"):
        if name.startswith(start):
            return start
    raise ValueError(name)


def coverage_md(found):
    kinds = {"wiggling": "wiggling harmonics", "common": "common phase", "drift": "drift",
             "amplitude": "amplitude error", "pixels": "fixed pattern"}  # fmt: skip
    rows, low = [], []
    for kind, words in kinds.items():
        mine = [row for row in found["rows"] if kind_of(row[0]) == kind]
        shares = np.array([row[1] for row in mine])
        rows.append((words, len(mine), f"{shares.mean():.3f}", f"{shares.min():.2f}",
                     f"{(shares >= WANTED - 1e-9).mean():.0%}"))  # fmt: skip
        low += [row for row in mine if row[1] < WANTED - 1e-9]
    worst = [(row[0], f"{row[1]:.2f}", f"{row[2]:+.2f}", f"{row[3]:.2f}", row[4])
             for row in sorted(low, key=lambda row: row[1])]  # fmt: skip
    parts = [
        "## Are the intervals honest?",
        f"{found['seeds']} virtual cameras of 32 x 24 px, each with patterns, offsets and noise of "
        "its own, calibrated with averages of 16 frames and refined as `calibrate all` does. "
        "Counted is how often the planted value lies inside its 95 % interval; planted wiggling, "
        "common phase and amplitude error are brought to the gauge of the fit without any fit "
        "(benchmarks/calibration_truth.py). For the fixed pattern it is the share of pixels.",
        table(("what", "coefficients", "mean share inside", "lowest", "at 0.90 or above"), rows),
    ]
    if worst:
        parts += [
            "Below 0.90, with the mean and the spread of what they are off, in standard "
            "deviations of the fit:",
            table(("coefficient", "share", "mean", "spread", "runs"), worst),
        ]
    parts.append("Intervals of the lens: [lens.md](lens.md).")
    return "\n\n".join(parts)


def speed_md(found):
    rows = [(name, f"{r['min_ms']:.2f}", f"{r['median_ms']:.2f}", r["runs"])
            for name, r in found["rows"].items()]  # fmt: skip
    return "\n\n".join([
        "## Speed",
        "Phasors of a Kinect v2 frame (3 x 424 x 512) with sigma, random phases and amplitudes, "
        "ms; making the pass, compilation included, took "
        f"{found['made_s']:.1f} s. It differs from stage by stage by at most "
        f"{1e3 * found['largest_difference_rad']:.3f} mrad.",
        table(("what", "least", "median", "runs"), rows),
    ])  # fmt: skip


def page(results):
    parts = [
        "# Calibration, measured",
        "Made by `python benchmarks/calibration.py`; do not edit. How to take the captures: "
        "[directory.md](directory.md). Lens against truth: [lens.md](lens.md). Real cameras: "
        "[real.md](real.md).",
    ]
    makers = {"ablation": ablation_md, "coverage": coverage_md, "speed": speed_md}
    parts += [makers[name](results[name]) for name in SECTIONS if name in results]
    one = next(iter(results.values()))["machine"]
    parts.append(f"{one['cpu']}, {one['threads']} threads.")
    return "\n\n".join(parts) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "calibration")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--redraw", action="store_true", help="measure nothing, write the page")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "results.json"
    results = json.loads(kept.read_text()) if kept.exists() else {}
    for section in () if args.redraw else args.only:
        print(section, file=sys.stderr)
        results[section] = measured(section, args)
        kept.write_text(json.dumps(results, indent=1) + "\n")
    (args.out / "index.md").write_text(page(results))


if __name__ == "__main__":
    main()
