"""Whether the tolerance of `radiosity` holds: seeded scenes, actual errors, cost against pixels.

python benchmarks/radiosity_seeds.py --references REFS --out DIR [--count 200] [--quick]
    writes DIR/radiosity_seeds.{json,jsonl,png,svg} and DIR/radiosity.md

Every scene is asked for at 1 mm, and the error is taken over all lit pixels against a closed form
or against reference runs, made once and kept in REFS, whose own noise is taken off. One line per
scene goes to the .jsonl at once, and a run that was broken off or ran out of its --minutes goes on
where it was. If the engine has changed delete that file.
"""

import argparse
import json
import os
import sys
import time
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
from peers import measure, radiosity_page, references, seeded

from toftools.bench.run import machine, versions
from toftools.registry import SIMULATORS, find, parse_entry
from toftools.sensors import sensor as preset
from toftools.sim.analytic import analytic
from toftools.types import Scene, Shot

ENGINE = "radiosity"
TOL_MM = 1.0
REST_M = 1e-4  # what bounces of a reference may leave out
SIZES = ((80, 60), (160, 120), (320, 240), (640, 480))
SMALL = ((32, 24), (64, 48))
COSTS = {
    "cornell": ("cornell", "hfov_deg=39.3077"),
    "room 1": ("room:seed=1", "hfov_deg=70"),
}


def scene_of(text):
    return Scene(*parse_entry(text))


def phasors_of(capture):
    return np.asarray(capture.phasors.values[0], np.complex128)


def truth_of(sample, folder):
    """Two reference images with independent noise, (2, H, W), and the figures of that noise."""
    sensor = preset(sample.sensor)
    if sample.against == seeded.CLOSED:
        run = analytic(scene_of(sample.scene))
        exact = phasors_of(run(Shot(sensor, noisy=False, max_bounces=sample.bounces)))
        return (exact, exact), None
    folder.mkdir(parents=True, exist_ok=True)
    run = None

    def image(number):
        nonlocal run
        run = run or find(SIMULATORS, sample.against).build(scene_of(sample.scene))
        shot = Shot(
            sensor, noisy=False, max_bounces=sample.bounces, seed=references.FIRST_SEED + number,
            samples=sample.samples, tol_m=REST_M,
        )  # fmt: skip
        return phasors_of(run(shot))

    name = zlib.crc32(f"{sample.scene} {sample.sensor} {sample.bounces}".encode())
    file = folder / f"seeded-{sample.family}-{name:08x}-{sample.samples}.npz"
    images, seconds = references.images(file, seeded.RUNS, image)
    found = measure.Reference(images, sample.samples * seeded.RUNS, seconds)
    return found.halves, found


def judged(sample, folder):
    """One line: the actual error of a scene, and what the engine said of it."""
    sensor = preset(sample.sensor)
    run = find(SIMULATORS, ENGINE).build(scene_of(sample.scene))
    begin = time.perf_counter()
    capture = run(
        Shot(sensor, noisy=False, max_bounces=sample.bounces, tol_m=1e-3 * TOL_MM,
             seed=sample.number)
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    halves, noisy = truth_of(sample, folder)
    freq_hz, found = float(sensor.modulation.freqs_hz[0]), phasors_of(capture)
    lit = (np.abs(halves[0]) > 0) & (np.abs(halves[1]) > 0)
    square = 1e6 * measure.mean_square_m2(found, halves, freq_hz, lit)
    floor = 1e6 * measure.floor_m2(noisy, freq_hz, lit) if noisy else 0.0
    mean = (halves[0] + halves[1]) / 2
    rms = np.sqrt(max(square, 0.0))
    told = capture.provenance.get("standard_error_mm")
    return {
        **asdict(sample),
        "rms_mm": float(rms),
        # Of the rms to first order; where it is all noise, of the mean square itself.
        "se_mm": float(min(floor / (2 * rms) if rms > 0 else np.inf, np.sqrt(floor))),
        "bias_mm": 1e3 * float(np.mean(measure.range_error_m(found, mean, freq_hz)[lit])),
        "told_mm": told,
        "pixels": int(lit.sum()),
        "seconds": seconds,
        "lights": capture.provenance.get("virtual_lights"),
    }


def all_judged(chosen, file, folder, limit_s, log):
    """Lines of all samples that the time allows; those already in the file are not done again."""
    rows, begin = _read(file), time.perf_counter()
    done = {(r["number"], r["scene"], r["sensor"]) for r in rows}
    for sample in chosen:
        if (sample.number, sample.scene, sample.sensor) in done:
            continue
        if time.perf_counter() - begin > limit_s:
            break
        row = judged(sample, folder)
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(row) + "\n")
        rows.append(row)
        log(said(row))
    numbers = {sample.number for sample in chosen}
    return [r for r in rows if r["number"] in numbers]


def said(row):
    return (
        f"{row['number']:3d} {row['scene']}: {row['rms_mm']:.3f} mm rms (s.e. {row['se_mm']:.3f}), "
        f"told {row['told_mm'] or 0:.3f}, {row['seconds']:.2f} s"
    )


def _read(file):
    if not file.is_file():
        return []
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def costs(sizes, repeats, log):
    """Time of a frame at the tolerance, by scene and size; the first of a scene is not timed."""
    found = []
    for name, (scene, camera) in COSTS.items():
        run = find(SIMULATORS, ENGINE).build(scene_of(scene))
        for number, size in enumerate(sizes):
            sensor = preset(f"deeptof:{camera},width={size[0]},height={size[1]}")
            times = []
            for turn in range(repeats + (number == 0)):
                begin = time.perf_counter()
                capture = run(Shot(sensor, noisy=False, tol_m=1e-3 * TOL_MM, seed=turn))
                times.append(time.perf_counter() - begin)
            told = capture.provenance
            found.append({
                "scene": name, "size": size, "seconds": min(times[-repeats:]), "first_s": times[0],
                "lights": told.get("virtual_lights", told["samples"]),
                "told_mm": told["standard_error_mm"],
            })  # fmt: skip
            log(f"{name} {size[0]}x{size[1]}: {found[-1]['seconds']:.2f} s")
    return found


def exponents(cost):
    found = {}
    for name in dict.fromkeys(c["scene"] for c in cost):
        some = [c for c in cost if c["scene"] == name]
        if len(some) > 1:
            pixels = [c["size"][0] * c["size"][1] for c in some]
            found[name] = seeded.exponent(pixels, [c["seconds"] for c in some])
    return found


def parsed(arguments):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--references", type=Path, required=True, help="folder to keep them in")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=600.0, help="for scenes; go on later")
    parser.add_argument("--repeats", type=int, default=2, help="frames timed of each size")
    parser.add_argument("--quick", action="store_true", help="4 scenes, small images")
    return parser.parse_args(arguments)


def main(arguments=None):
    given, begin = parsed(arguments), time.perf_counter()

    def log(text):
        print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    chosen = seeded.samples(4 if given.quick else given.count)
    if given.out is None:
        for sample in chosen:
            truth_of(sample, given.references)
            log(f"reference of {sample.scene}")
        return
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / "radiosity_seeds.jsonl"
    earlier = sum(r["number"] < len(chosen) for r in _read(file))
    rows = all_judged(chosen, file, given.references, 60 * given.minutes, log)
    cost = costs(SMALL if given.quick else SIZES, 1 if given.quick else given.repeats, log)
    about = {
        "versions": versions(),
        "machine": machine(os.cpu_count() or 1),
        "seconds": time.perf_counter() - begin,
        "earlier": earlier,
    }
    data = seeded.summary(rows, TOL_MM) | {"cost": cost, "exponents": exponents(cost)}
    radiosity_page.save(given.out, "seeds", {"about": about, **data})
    seeded.draw(rows, cost, TOL_MM, given.out / "radiosity_seeds")
    radiosity_page.write(given.out)
    print((given.out / "radiosity.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
