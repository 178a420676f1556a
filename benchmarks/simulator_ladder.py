"""How much simulation a scene needs: bounces, paths and virtual lights for a range within 1 mm.

``python benchmarks/simulator_ladder.py`` writes docs/simulator_ladder.{md,json,svg};
``--out DIR`` writes elsewhere, ``--only corner,cornell`` takes some scenes.

Truth is the mean of several path-traced images of all bounces that matter to a tenth of a
millimetre. Bounces: path-traced images that end after n bounces, against the same paths that end
after 48; the paths are the same up to where they end, so the difference has hardly any noise.
Samples: path tracing with N paths a pixel and radiosity with N virtual lights, root
mean square of the range over the image against the truth, whose own noise is taken off in squares.
Light carries no sensor noise. Ranges are those of all frequencies together, without wraps: what the
missing light turns the phasors by.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

from toftools.bench.run import machine, versions
from toftools.io.atomic import atomic_path
from toftools.registry import SIMULATORS, parse_entry
from toftools.sensors import sensor
from toftools.sim._stop import range_weights
from toftools.types import Scene, Shot
from toftools.units import phase_to_range
from toftools.viz._axes import log_axis, number
from toftools.viz._series import Chart, Series, draw

SENSOR = "kinect2_nominal:width={width},height={height},beam_deg=100"
SCENES = {
    "corner": "corner:angle=90,range=2,albedo=0.6",
    "V of 60 degrees": "vshape:range=1.5,angle=60,albedo=0.8",
    "Cornell box": "cornell:size=2",
    "prism": "prism:range=0.7",
    "room": "room:seed=7",
    "cavity": "cavity:radius=2,albedo=0.5",
}
BOUNCES = (0, 1, 2, 3, 4, 6, 8, 12, 16)
MOST_BOUNCES, PATHS = 48, 256
"""Of the ladder of bounces: what stands for all of them, and paths a pixel."""
GOAL_M, SHARE = 1e-3, 0.95
COUNTS = {"path": (4, 16, 64, 256), "radiosity": (16, 64, 256)}
TRUTH = {"path": (512, 3), "radiosity": (512, 2)}
"""Paths a pixel and virtual lights, and images, of a truth."""


def light(engine, scene, camera, *, samples, seed=0, max_bounces=None, tol_m=1e-3):
    """Noise-free phasors (F, H, W), seconds, provenance."""
    run = SIMULATORS[engine].build(Scene(*parse_entry(scene)))
    begin = time.perf_counter()
    capture = run(Shot(camera, seed=seed, noisy=False, samples=samples, max_bounces=max_bounces,
                       tol_m=tol_m))  # fmt: skip
    seconds = time.perf_counter() - begin
    truth = capture.truth
    return truth.direct + truth.one_bounce + truth.rest, seconds, capture.provenance


def moved_m(phasors, truth, freqs_hz):
    """By how much each pixel's range is off (H, W), m; NaN where no light is."""
    weights = range_weights(truth.astype(complex), freqs_hz)
    angle = np.angle(phasors * np.conj(truth))
    moved = (weights * phase_to_range(angle, freqs_hz[:, None, None])).sum(axis=0)
    return np.where((np.abs(truth) > 0).all(axis=0), moved, np.nan)


def enough(counts, off_m, goal_m=GOAL_M):
    """The first count from which on the error stays below a goal; None if it does not.

    >>> enough([0, 1, 2, 3], [9e-3, 4e-4, 2e-3, 1e-4]), enough([0, 1], [9e-3, 2e-3])
    (3, None)
    """
    above = np.flatnonzero(np.asarray(off_m) > goal_m)
    first = 0 if not above.size else int(above[-1]) + 1
    return counts[first] if first < len(counts) else None


def reached(counts, errors_m, figures, goal_m=GOAL_M):
    """A figure (a count, seconds) at which an error falls to a goal, on logarithms.

    Between two counts by interpolation; beyond the ladder by the square-root law from its nearest
    end, which is then named: ``measured``, ``below`` or ``beyond``.
    """
    error, figure = np.asarray(errors_m, float), np.asarray(figures, float)
    above = np.flatnonzero(error > goal_m)
    if not above.size:
        return float(figure[0]), "below"
    last = int(above[-1])
    if last == len(counts) - 1:
        return float(figure[-1] * (error[-1] / goal_m) ** 2), "beyond"
    part = np.log(error[last] / goal_m) / np.log(error[last] / max(error[last + 1], 1e-9))
    return float(figure[last] * (figure[last + 1] / figure[last]) ** part), "measured"


def bounces_of(scene, camera, counts=BOUNCES, paths=PATHS):
    """95th percentile of what the bounces left out move range by, per number of bounces, m."""
    freqs_hz = camera.modulation.freqs_hz
    whole, _, _ = light("path", scene, camera, samples=paths, max_bounces=MOST_BOUNCES)
    off = []
    for count in counts:
        some, _, _ = light("path", scene, camera, samples=paths, max_bounces=count)
        off.append(float(np.nanquantile(np.abs(moved_m(some, whole, freqs_hz)), SHARE)))
    return off


def truth_of(engine, scene, camera, samples, images):
    """Mean phasors of some images, and the standard error of their range over the image, m."""
    freqs_hz = camera.modulation.freqs_hz
    found = [light(engine, scene, camera, samples=samples, seed=1000 + i, tol_m=1e-4)[0]
             for i in range(images)]  # fmt: skip
    mean = np.mean(found, axis=0)
    square = [np.nanmean(moved_m(one, mean, freqs_hz) ** 2) for one in found]
    return mean, float(np.sqrt(np.sum(square) / (images - 1) / images))


def samples_of(engine, scene, camera, truth, floor_m, counts):
    """Root mean square error, m, and seconds of a frame per count, kernels compiled before."""
    freqs_hz = camera.modulation.freqs_hz
    light(engine, scene, camera, samples=counts[0])
    errors, seconds = [], []
    for count in counts:
        found, took, _ = light(engine, scene, camera, samples=count, seed=1)
        square = float(np.nanmean(moved_m(found, truth, freqs_hz) ** 2)) - floor_m**2
        errors.append(float(np.sqrt(max(square, 0.0))))
        seconds.append(took)
    return errors, seconds


def measured(scene, camera, *, bounces=BOUNCES, counts=COUNTS, truths=TRUTH, paths=PATHS):
    """Everything of one scene, as plain data."""
    left_m = bounces_of(scene, camera, bounces, paths)
    found = {"scene": scene, "bounces": list(bounces), "left_m": left_m,
             "needed_bounces": enough(bounces, left_m), "engines": {}}  # fmt: skip
    means = {name: truth_of(name, scene, camera, *truths[name]) for name in counts}
    freqs_hz = camera.modulation.freqs_hz
    off = moved_m(means["radiosity"][0], means["path"][0], freqs_hz)
    found["truths_differ_m"] = float(np.sqrt(np.nanmean(off**2)))
    truth, floor_m = means["path"]
    found["truth_error_m"] = floor_m
    for name, ladder in counts.items():
        errors, seconds = samples_of(name, scene, camera, truth, floor_m, ladder)
        count, how = reached(ladder, errors, ladder)
        found["engines"][name] = {
            "samples": list(ladder), "rms_m": errors, "seconds": seconds, "needed": count,
            "needed_how": how, "needed_seconds": reached(ladder, errors, seconds)[0],
        }  # fmt: skip
    _, _, told = light("path", scene, camera, samples=4)
    found["path_says"] = {"max_bounces": told["max_bounces"], "why": told["max_bounces_why"]}
    return found


def chart(results):
    """SVG: what the bounces that are left out move range by."""
    shown = {name: found for name, found in results.items() if max(found["left_m"]) > 0}
    bounces = next(iter(shown.values()))["bounces"]
    every = 1e3 * np.concatenate([np.maximum(f["left_m"], 1e-5) for f in shown.values()])
    y = log_axis(np.append(every, 1.0), name="95th percentile of what range moves by, mm")
    x = log_axis(np.asarray(bounces, float) + 1, name="bounces modelled + 1", horizontal=True)
    series = [
        Series(name, np.stack([x(np.asarray(bounces) + 1.0),
                               y(1e3 * np.maximum(f["left_m"], 1e-5))], axis=1),
               [f"{name}, {b} bounces: {number(1e3 * m)} mm"
                for b, m in zip(bounces, f["left_m"], strict=True)], look)
        for look, (name, f) in enumerate(shown.items())
    ]  # fmt: skip
    at = float(y(1.0))
    line = [f'<path d="M{x.start:.1f},{at:.1f}H{x.end:.1f}" stroke="#777" stroke-dasharray="6 4"/>']
    note = "What light after so many bounces moves the range by, in 95 % of the pixels at most."
    return draw(Chart("Bounces that a simulation needs", note, x, y, series, under=line))


def page(results, about):
    """Markdown of all scenes."""
    names = ("path", "radiosity")
    head = [
        "scene", "bounces for 1 mm", "1 left, mm", "3 left, mm", "`path` takes",
        "paths a pixel for 1 mm", "s", "virtual lights for 1 mm", "s", "truths differ, mm",
    ]  # fmt: skip
    rows = []
    for name, f in results.items():
        left = dict(zip(f["bounces"], f["left_m"], strict=True))
        cells = [name, f["needed_bounces"] if f["needed_bounces"] is not None
                 else f"over {f['bounces'][-1]}"]  # fmt: skip
        cells += [number(1e3 * left[b]) if b in left else "–" for b in (1, 3)]
        cells.append(f["path_says"]["max_bounces"])
        for engine in names:
            one = f["engines"][engine]
            if engine == "radiosity" and one["needed_how"] == "beyond":
                # Interpolation is part of its error: no law says what more lights would do.
                cells += [f"over {one['samples'][-1]}", "–"]
                continue
            mark = {"measured": "", "below": "at most ", "beyond": "about "}[one["needed_how"]]
            cells += [mark + number(one["needed"]), number(one["needed_seconds"])]
        cells.append(number(1e3 * f["truths_differ_m"]))
        rows.append(cells)
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    table = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1), *lines]
    return TEXT.format(table="\n".join(table), **about)


TEXT = """# How much simulation a scene needs

Made by `python benchmarks/simulator_ladder.py` at {width} x {height} px and 80, 16 and 120 MHz;
times on {threads} threads of {cpu}, frames after the first, without compilation.

![Range left out against bounces](simulator_ladder.svg)

- **Bounces for 1 mm**: from this number on, all further light moves the range of 95 % of the
  pixels by less than 1 mm (tried: 0 to 4, 6, 8, 12, 16). *1 left* and *3 left*: what ending after
  one and three bounces moves it by. **`path` takes**: what the engine decides on for itself at a
  tolerance of 1 mm, by a bound that holds whatever way the left-out light comes.
- **Paths a pixel**, **virtual lights** (of each of the four estimates of `radiosity`) for a root
  mean square error of 1 mm over the image, all bounces in it, interpolated between the counts
  {counts}; *about*: beyond them, by the square-root law; *at most*: the first of them was enough;
  *over*: not reached, and as part of the error of `radiosity` is that of interpolation, no law says
  what more lights would do. Seconds are for a whole frame, on a machine that others used as well.
- **Truths differ**: root mean square between the means of the largest images of both engines, the
  noise of both in it.

{table}
"""


def publish(folder, results, about):
    """All files of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "md": page(results, about),
        "json": json.dumps({"about": about, "scenes": results}, indent=1) + "\n",
        "svg": chart(results),
    }
    for suffix, text in texts.items():
        with atomic_path(folder / f"simulator_ladder.{suffix}") as path:
            path.write_text(text, encoding="utf-8")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs")
    parser.add_argument("--only", default="", help="scenes, joined by commas")
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--height", type=int, default=48)
    given = parser.parse_args(arguments)
    names = given.only.split(",") if given.only else list(SCENES)
    if unknown := [name for name in names if name not in SCENES]:
        parser.error(f"unknown scenes {unknown}; known: {', '.join(SCENES)}")
    camera = sensor(SENSOR.format(width=given.width, height=given.height))
    here = machine(os.cpu_count() or 1)
    about = {"width": given.width, "height": given.height, "cpu": here["cpu"],
             "threads": here["threads"], "versions": versions(),
             "counts": "; ".join(f"{', '.join(map(str, c))} of {n}"
                                 for n, c in COUNTS.items())}  # fmt: skip
    results = {}
    for name in names:
        begin = time.perf_counter()
        results[name] = measured(SCENES[name], camera)
        print(f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
        publish(given.out, results, about)  # minutes of work do not hang on the last scene


if __name__ == "__main__":
    main()
