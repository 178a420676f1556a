"""Error against time: `radiosity` beside `path` and mitransient 1.3.1, in one run.

pip install -c constraints.txt -e '.[peers]'
python benchmarks/radiosity.py --references REFS --out DIR [--quick]
    writes DIR/radiosity_time.{json,png,svg} and DIR/radiosity.md

Every engine looks at the same geometry and materials under a flash at the camera, with the same
number of bounces, in a process of its own; they take turns, and the first call of every setting is
not timed, unless the setting before took so long that nothing can be left to prepare. Errors are
those of the centres of pixels away from depth edges, against runs of `path` that are made once and
kept in REFS (minutes), and are free of the reference's own noise. In the
living room some surfaces are not diffuse, where `radiosity` takes all bounces or leaves the image
to `path`: there all others have so many that the rest does not count.
"""

import argparse
import importlib.util
import os
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import numpy as np
from peers import measure, radiosity_page, reach, references
from peers.views import CORNELL, LIVING, ROOM, views
from peers.worker import start

from toftools.bench.run import machine, versions
from toftools.sensors import sensor as preset

TARGET_M = 1e-3
SAMPLES, TOL = "samples", "tol_mm"
RADIOSITY, PATH = "radiosity", "path"
BEST, PLAIN = "mitransient, multijitter", "mitransient"
# Engine: module, options, and its settings from coarse to fine.
ENGINES = {
    RADIOSITY: ("peers.ours", {"engine": "radiosity", "by": TOL}, (20, 10, 5, 2, 1)),
    PATH: ("peers.ours", {"engine": "path"}, (4, 16, 64)),
    BEST: ("peers.mitransient_peer", {"sampler": "multijitter"}, (16, 64, 256)),
    PLAIN: ("peers.mitransient_peer", {"sampler": "independent"}, (16, 64, 256)),
}
SLOW_S = 3.0
LIMIT_S = 30.0  # an engine that took longer for a frame is not asked for finer ones


def engines_of(view):
    """Those that take part: of the rooms only one sampler of the peer, the better."""
    return [name for name in ENGINES if not (name == PLAIN and view.name.startswith(ROOM))]


def run_view(view, folder, repeats, steps, log):
    """Points of every engine on one view at its first `steps` settings; its reference's figures."""
    truth, keep = references.kept(view, folder, log)
    workers = {}
    try:
        for name in engines_of(view):
            module, options, _ = ENGINES[name]
            every = view.solved and name == RADIOSITY
            bounces = {"max_bounces": None if every else view.bounces}
            workers[name] = start(
                name, module, scene=view.scene, sensor=view.sensor(), **bounces, **options
            )
        frames = take_turns(workers, view, repeats, steps, log)
    finally:
        for worker in workers.values():
            worker.close()
    freq_hz = float(preset(view.sensor()).modulation.freqs_hz[0])
    points = {
        name: points_of(found, truth, freq_hz, keep, repeats) for name, found in frames.items()
    }
    for name, found in points.items():
        errors = ", ".join(f"{1e3 * e:.2f}" for e in reach.curve(found)[1])
        log(f"{view.name}, {name}: {errors} mm rms")
    return {
        "view": view,
        "points": points,
        "reach": {name: reach.reach(found, TARGET_M) for name, found in points.items()},
        "pixels": int(keep.sum()),
        "reference": {
            "samples": truth.samples,
            "seconds": truth.seconds,
            "standard_error_mm": 1e3 * measure.standard_error_m(truth, freq_hz, keep),
        },
    }


def take_turns(workers, view, repeats, steps, log):
    """Frames per engine and setting, those that are timed last; seeds differ."""
    frames, slow, done = {name: {} for name in workers}, set(), set()
    for step in range(min(steps, max(len(ENGINES[name][2]) for name in workers))):
        for turn in range(repeats + 1):
            for name, worker in workers.items():
                settings = ENGINES[name][2]
                skipped = turn == 0 and name in slow
                if step < len(settings) and name not in done and not skipped:
                    frame = worker(settings[step], 1 + turn)
                    frames[name].setdefault(settings[step], []).append(frame)
        for name in workers:
            settings = ENGINES[name][2]
            if step >= len(settings) or name in done:
                continue
            seconds = min(f.seconds for f in frames[name][settings[step]][-repeats:])
            log(f"{view.name}, {name} at {settings[step]}: {seconds:.3f} s")
            if seconds > SLOW_S:
                slow.add(name)
            if seconds > LIMIT_S:
                done.add(name)
    return frames


def points_of(frames, truth, freq_hz, keep, repeats):
    """One `measure.Point` per setting."""
    found = []
    for setting, runs in frames.items():
        images = [f.phasors[0] for f in runs]
        found.append(measure.Point(
            setting,
            [f.seconds for f in runs[-repeats:]],
            [measure.mean_square_m2(image, truth.halves, freq_hz, keep) for image in images],
            [measure.median_m(image, truth.mean, freq_hz, keep) for image in images],
            runs[0].seconds,
            runs[-1].peak_mb,
            measure.floor_m2(truth, freq_hz, keep),
        ))  # fmt: skip
    return found


def speedups(result):
    """How many times later every other engine reaches the target than `radiosity`."""
    own = result["reach"][RADIOSITY]
    return {
        name: other.seconds / own.seconds
        for name, other in result["reach"].items()
        if name != RADIOSITY and own is not None and other is not None
    }


def panels(results):
    """One panel for each single view, one for all rooms together."""
    found = []
    for name in (CORNELL, LIVING, ROOM):
        some = [r for r in results if r["view"].name.startswith(name)]
        if not some:
            continue
        ratios = [speedups(r)[BEST] for r in some if BEST in speedups(r)]
        note = f"{some[0]['pixels']} pixels" if len(some) == 1 else f"{len(some)} rooms"
        if ratios:
            mean = np.exp(np.mean(np.log(ratios)))
            note += f"; 1 mm {mean:.0f} times sooner than {BEST}"
        curves = {}
        for result in some:
            for engine, points in result["points"].items():
                curves.setdefault(engine, []).append(points)
        title = some[0]["view"].name if len(some) == 1 else f"{len(some)} seeded rooms"
        found.append((title, note, curves))
    return found


def plain(result):
    """A result as data for JSON; a file is told by its name alone."""
    view = asdict(result["view"]) | {"sensor": result["view"].sensor()}
    scene = view["scene"]
    head, mark, tail = scene.partition(".xml")
    view["scene"] = Path(head + mark).name + tail if mark else scene
    return {**result, "view": view, "speedup": speedups(result)}


def publish(folder, about, results):
    """All files of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {"about": about, "views": [plain(r) for r in results]}
    radiosity_page.save(folder, "time", data)
    reach.draw(panels(results), TARGET_M, folder / "radiosity_time")
    radiosity_page.write(folder)


def parsed(arguments):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--references", type=Path, required=True, help="folder to keep them in")
    parser.add_argument(
        "--quick", action="store_true", help="small images, one room, coarse settings"
    )
    parser.add_argument("--only", default="", help="views whose name begins so")
    given = parser.parse_args(arguments)
    if given.out is not None and importlib.util.find_spec("mitransient") is None:
        parser.error("mitransient is missing; do pip install -c constraints.txt -e '.[peers]'")
    return given


def main(arguments=None):
    given, begin = parsed(arguments), time.perf_counter()

    def log(text):
        print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    found, missing = views(quick=given.quick)
    chosen = [view for view in found if view.name.startswith(given.only)]
    if given.out is None:
        for view in chosen:
            references.kept(view, given.references, log)
        return
    # Rooms are ten: their errors are known well enough from fewer frames each.
    steps = 2 if given.quick else 99
    results = [
        run_view(view, given.references, 1 if view.name.startswith(ROOM) else 2, steps, log)
        for view in chosen
    ]
    about = {
        "versions": versions() | {n: version(n) for n in ("mitsuba", "drjit", "mitransient")},
        "machine": machine(os.cpu_count() or 1),
        "missing": missing,
        "seconds": time.perf_counter() - begin,
    }
    publish(given.out, about, results)
    print((given.out / "radiosity.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
