"""Captures per minute of a data set: `path` before, `radiosity` after, at 5 and 1 mm.

python benchmarks/radiosity_throughput.py --out DIR [--captures 3] [--full] [--quick]
    writes DIR/radiosity_throughput.json and DIR/radiosity.md

The recipe is that of DeepToF as far as the engines are concerned: 256 x 256 pixels, 20 MHz,
albedos of 0.3 to 0.8, up to 20 bounces, here of seeded rooms; each capture is another room, so that
whatever is built once per scene counts. The very first capture of an engine is not timed. At 1 mm
`path` takes minutes for one capture: without --full its time is 25 times that at 5 mm, as
1/sqrt(samples) wants, or that of its limit of samples if it is shorter.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from peers import radiosity_page

from toftools.bench.run import machine, versions
from toftools.registry import SIMULATORS, find
from toftools.sensors import sensor as preset
from toftools.types import Scene, Shot

BOUNCES = 20
TOLERANCES_MM, QUICK_MM = (5.0, 1.0), (20.0, 10.0)
FIRST_ROOM = 1000
PATH, RADIOSITY = "path", "radiosity"
PATH_LIMIT, PROBE = 4096, 64  # its default limit of samples; samples that tell the time of one


def capture(engine, room, sensor, **wish):
    """One noisy capture as a data set has it: its seconds, and what the engine told."""
    begin = time.perf_counter()
    run = find(SIMULATORS, engine).build(Scene("room", {"seed": FIRST_ROOM + room}))
    made = run(Shot(sensor, seed=room, max_bounces=BOUNCES, **wish))
    return time.perf_counter() - begin, made.provenance


def timed(engine, sensor, tol_mm, count, log):
    """A row of the table: mean over `count` rooms."""
    seconds, told = [], []
    for room in range(1, count + 1):
        took, provenance = capture(engine, room, sensor, tol_m=1e-3 * tol_mm)
        log(f"{engine} at {tol_mm:g} mm, room {room}: {took:.2f} s")
        seconds.append(took)
        told.append(provenance["standard_error_mm"])
    return row(engine, tol_mm, seconds, max(told), within=max(told) <= tol_mm)


def row(engine, tol_mm, seconds, told_mm, *, within, measured=True):
    return {
        "engine": engine, "tol_mm": tol_mm, "seconds": float(np.mean(seconds)), "all_s": seconds,
        "count": len(seconds) if measured else 0, "told_mm": told_mm, "within": within,
        "measured": measured,
    }  # fmt: skip


def path_at_fine(coarse, fine_mm, sensor, log):
    """What `path` takes at the fine tolerance, out of what it takes at the coarse one."""
    probe = capture(PATH, 1, sensor, samples=PROBE)[0]
    most = probe * PATH_LIMIT / PROBE
    seconds = coarse["seconds"] * (coarse["tol_mm"] / fine_mm) ** 2
    log(f"{PATH}: {PROBE} samples take {probe:.1f} s; {fine_mm:g} mm would take {seconds:.0f} s, "
        f"its limit of samples {most:.0f} s")  # fmt: skip
    found = min(seconds, most)
    return row(PATH, fine_mm, [found], None, within=seconds <= most, measured=False)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--captures", type=int, default=3, help="of radiosity; path makes one")
    parser.add_argument("--full", action="store_true", help="path at 1 mm too: many minutes")
    parser.add_argument("--quick", action="store_true", help="24 x 24 pixels, 20 and 10 mm")
    given, begin = parser.parse_args(arguments), time.perf_counter()

    def log(text):
        print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    side, count = (24, 1) if given.quick else (256, given.captures)
    coarse_mm, fine_mm = QUICK_MM if given.quick else TOLERANCES_MM
    sensor = preset(f"deeptof:width={side},height={side}")
    rows = []
    for engine, many in ((RADIOSITY, count), (PATH, 1)):
        took, _ = capture(engine, 0, sensor, samples=16)
        log(f"{engine}, first call: {took:.1f} s")
        rows.append(timed(engine, sensor, coarse_mm, many, log))
        if engine == RADIOSITY or given.full:
            rows.append(timed(engine, sensor, fine_mm, many, log))
        else:
            rows.append(path_at_fine(rows[-1], fine_mm, sensor, log))
    speed = {(r["engine"], r["tol_mm"]): r["seconds"] for r in rows}
    data = {
        "about": {
            "versions": versions(),
            "machine": machine(os.cpu_count() or 1),
            "seconds": time.perf_counter() - begin,
        },
        "recipe": f"Seeded rooms, {side} x {side} pixels, 20 MHz, albedos of 0.3 to 0.8, up to "
        f"{BOUNCES} bounces.",
        "rows": rows,
        "gain": {f"{t:g}": speed[PATH, t] / speed[RADIOSITY, t] for t in (coarse_mm, fine_mm)},
    }
    radiosity_page.save(given.out, "throughput", data)
    radiosity_page.write(given.out)
    print((given.out / "radiosity.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
