"""Light transport at equal time: the path engine against mitransient 1.3.1, in one run.

pip install -c constraints.txt -e '.[peers]'
python benchmarks/transport.py --out DIR [--quick]     writes DIR/transport.{json,md,png,svg}

Both engines get the same loaded geometry and materials, a flash at the camera and the same number
of bounces. Each lives in a process of its own and they take turns; the first call of every setting
is kept apart. The peer integrates over the pixel, ours by default looks at its centre, so there are
two questions: what the whole pixel sees (ours antialiased), against references of the peer; and
what its centre sees, where each engine has its own reference and depth edges are left out.
The living room is looked for beside TOFTOOLS_DATA, in scenes/living-room.
"""

import argparse
import importlib.util
import os
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from peers import chart, measure, report
from peers.worker import start

from toftools.bench.run import machine, versions
from toftools.sensors import sensor as preset

MAX_BOUNCES = 8
# The file's camera stands 17 mm before a wall, which its flash would light 3500 times as brightly
# as from 1 m, so that a few chance hits there drown all other errors: 0.6 m forward. Lamps are off,
# since the peer would take them for modulated.
POSE = "lamps=0,camera=4.53+0.776+-2.16,target=3.57+0.85+-1.897"
PIXEL, CENTRE = "whole pixel", "pixel centre"
THEIRS, BEST = "mitransient", "mitransient, multijitter"
OURS, SMOOTH = "toftools", "toftools, antialiased"
CONTESTANTS = {
    THEIRS: ("peers.mitransient_peer", {"sampler": "independent"}),
    BEST: ("peers.mitransient_peer", {"sampler": "multijitter"}),
    OURS: ("peers.ours", {}),
    SMOOTH: ("peers.ours", {"antialias": 4}),
}
# Question: who takes part, and whose reference each is held against.
QUESTIONS = {
    PIXEL: {THEIRS: BEST, BEST: BEST, SMOOTH: BEST},
    CENTRE: {THEIRS: BEST, BEST: BEST, OURS: OURS},
}


@dataclass(frozen=True)
class Case:
    """A scene and a camera; an engine goes up the `counts` while a frame takes below `limit_s`.

    `runs` frames at its highest count make the engine's reference.
    """

    name: str
    scene: str
    camera: str
    size: tuple[int, int]
    counts: tuple[int, ...]
    limit_s: float
    runs: int

    def sensor(self, finer=1):
        width, height = (finer * n for n in self.size)
        return f"deeptof:{self.camera},width={width},height={height}"


def cases(*, quick):
    """The scenes that are there, and sentences about those that are not."""
    # The counts must not run out before the time does, or the engines' times would not meet.
    limits = ((4, 16, 64, 256, 1024), *((0.5, 8) if quick else (1.5, 12)))
    size = (64, 64) if quick else (128, 128)
    box = "hfov_deg=39.3077"
    found = [
        Case("Cornell box", "cornell", box, size, *limits),
        Case("Cornell box, 3 frequencies", "cornell", f"{box},freqs=20e6+50e6+70e6", size, *limits),
    ]
    room = Path(os.environ.get("TOFTOOLS_DATA", "")).parent / "scenes/living-room/scene.xml"
    if not room.is_file():
        return found, ["the living room is left out: no scenes/living-room beside TOFTOOLS_DATA"]
    size = (64, 48) if quick else (128, 96)
    return [*found, Case("Living room", f"{room}:{POSE}", "hfov_deg=70", size, *limits)], []


def run_case(case, truths, log):
    """Everything measured on one case: points per question and engine, references, memory."""
    engines = {}
    for name, (module, options) in CONTESTANTS.items():
        settings = {"max_bounces": MAX_BOUNCES, **options}
        engines[name] = start(name, module, scene=case.scene, sensor=case.sensor(), **settings)
    log(f"{case.name}: {len(engines)} engines are up")
    try:
        frames = take_turns(engines, case, log)
        same = case.name.partition(",")[0]  # other frequencies have the same truth at the first
        if same not in truths:
            truths[same] = {
                name: long_run(engines[name], max(frames[name]), case, log)
                for name in (BEST, OURS, SMOOTH)
            }
    finally:
        for engine in engines.values():
            engine.close()
    return score(case, engines, frames, truths[same])


def take_turns(engines, case, log, repeats=3):
    """Frames per engine and count; the engines alternate, and the first round warms up."""
    frames = {name: {} for name in engines}
    left = dict(engines)
    for samples in case.counts:
        for turn in range(repeats + 1):
            for name, engine in left.items():
                frames[name].setdefault(samples, []).append(engine(samples, 1 + turn))
        times = {name: min(f.seconds for f in frames[name][samples][1:]) for name in left}
        told = ", ".join(f"{name} {seconds:.3f} s" for name, seconds in times.items())
        log(f"{case.name}, {samples} samples: {told}")
        left = {name: engine for name, engine in left.items() if times[name] < case.limit_s}
        if not left:
            break
    return frames


def long_run(engine, samples, case, log):
    """Reference of an engine, out of seeds that no measured frame has."""
    frames = [engine(samples, 1000 + i) for i in range(case.runs)]
    seconds = sum(f.seconds for f in frames)
    log(f"{case.name}, reference of {engine.name}: {case.runs} x {samples} in {seconds:.1f} s")
    images = np.asarray([f.phasors[0] for f in frames], np.complex128)
    return measure.Reference(images, samples * case.runs, seconds)


def score(case, engines, frames, truths):
    """Frames against references, as plain data and points."""
    sensor = preset(case.sensor())
    freq_hz = float(sensor.modulation.freqs_hz[0])
    lit = (np.abs(truths[BEST].mean) > 0) & (np.abs(truths[OURS].mean) > 0)
    inner = lit & smooth_pixels(case)
    keep = {PIXEL: lit, CENTRE: inner}
    points = {
        question: {
            name: points_of(frames[name], truths[against], freq_hz, keep[question])
            for name, against in who.items()
        }
        for question, who in QUESTIONS.items()
    }
    return {
        "case": case,
        "points": points,
        "ratios": {q: ratios(points[q]) for q in points},
        "slopes": {q: {n: measure.slope(p) for n, p in points[q].items()} for q in points},
        "agreement": {
            "all pixels": measure.agreement(truths[SMOOTH], truths[BEST], lit),
            "away from edges": measure.agreement(truths[SMOOTH], truths[BEST], inner),
            "at edges": measure.agreement(truths[SMOOTH], truths[BEST], lit & ~inner),
        },
        "reference": {
            name: {"samples": t.samples, "seconds": t.seconds,
                   "standard_error_mm": 1e3 * measure.standard_error_m(t, freq_hz, lit)}
            for name, t in truths.items()
        },
        "engines": {n: {"setup_s": e.setup_s, "idle_mb": e.idle_mb} for n, e in engines.items()},
    }  # fmt: skip


def smooth_pixels(case, finer=4):
    """Pixels without an edge, seen on a finer grid: what is thinner than a pixel is an edge too."""
    module, _ = CONTESTANTS[OURS]
    engine = start("edges", module, scene=case.scene, sensor=case.sensor(finer), max_bounces=0)
    try:
        range_m = engine(1, 0).range_m
    finally:
        engine.close()
    smooth = measure.away_from_edges(preset(case.sensor(finer)).camera, range_m)
    width, height = case.size
    return smooth.reshape(height, finer, width, finer).all(axis=(1, 3))


def points_of(frames, truth, freq_hz, keep):
    return [
        measure.Point(
            samples,
            [f.seconds for f in runs[1:]],
            [measure.mean_square_m2(f.phasors[0], truth.halves, freq_hz, keep)
             for f in runs],
            [measure.median_m(f.phasors[0], truth.mean, freq_hz, keep) for f in runs],
            runs[0].seconds,
            runs[-1].peak_mb,
            measure.floor_m2(truth, freq_hz, keep),
        )
        for samples, runs in frames.items()
    ]  # fmt: skip


def ratios(curves):
    """Ratio at equal time of every peer over every engine of ours."""
    pairs = [(t, o) for t in (THEIRS, BEST) for o in (OURS, SMOOTH) if t in curves and o in curves]
    return [{"theirs": t, "ours": o, "ratio": measure.equal_time(curves[t], curves[o])}
            for t, o in pairs]  # fmt: skip


def faults():
    """What both engines read of a wall at 2 m, out of a process that holds both."""
    engine = start("faults", "peers.faults")
    try:
        return engine(0, 0).phasors
    finally:
        engine.close()


def publish(folder, about, results, wrong):
    """All files of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    report.write(folder, about, results, wrong)
    shown = [r for r in results if "frequencies" not in r["case"].name]
    panels = [[(r["case"].name, report.note(r, q), r["points"][q]) for r in shown]
              for q in QUESTIONS]  # fmt: skip
    chart.draw(panels, folder / "transport")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="smaller images, fewer samples")
    parser.add_argument("--only", default="", help="cases whose name begins so")
    given = parser.parse_args(arguments)
    if importlib.util.find_spec("mitransient") is None:
        parser.error(
            "mitransient is not installed; do pip install -c constraints.txt -e '.[peers]'"
        )
    begin = time.perf_counter()

    def log(text):
        print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    found, missing = cases(quick=given.quick)
    results, truths = [], {}
    for case in found:
        if case.name.startswith(given.only):
            results.append(run_case(case, truths, log))
    about = {
        "versions": versions() | {n: version(n) for n in ("mitsuba", "drjit", "mitransient")},
        "machine": machine(os.cpu_count() or 1),
        "max_bounces": MAX_BOUNCES,
        "missing": missing,
        "seconds": time.perf_counter() - begin,
    }
    publish(given.out, about, results, faults())
    print((given.out / "transport.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
