"""Unwrapping beside scikit-image and OpenCV, which unwrap one frequency across the image.

pip install -c constraints.txt -e '.[peers]'     what is not installed is left out, and said
python benchmarks/unwrapping_peers.py --out DIR [--quick]
    writes DIR/unwrapping_peers.{md,json}, DIR/unwrapping_noise.svg and DIR/unwrapping_jump.svg

All get the same frames of 40 and 70 MHz: planted lone returns of known range, so wraps and noise
are the only errors. Contestants take turns on every frame; the least time of many is shown.
"""

import argparse
import json
import math
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from peers.unwrappers import PLAIN, contestants, error_m

from toftools._native import limit_threads
from toftools.bench.machine import machine, versions
from toftools.bench.render import number
from toftools.registry import SIMULATORS
from toftools.sensors import sensor as preset
from toftools.types import Phasors, Scene, Shot
from toftools.units import ambiguity_m, range_to_phase
from toftools.viz.stress import Strain, stress_svg

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from reference_unwrapping import numpy_crt

SENSOR = "opt8241"  # 40 and 70 MHz: 70 MHz repeats every 2.14 m
NEAR_M, FAR_M = 1.5, 9.0
SNR = 30.0
NOISES = (100.0, 30.0, 10.0, 6.0, 4.0, 3.0, 2.0)
JUMPS_M = (0.0, 0.3, 0.6, 0.9, 1.0, 1.2, 1.5, 2.0, 3.0, 4.0)
PACKAGES = ("scikit-image", "opencv-contrib-python-headless")


def slope(sensor):
    """A smooth plane through three and a half turns of 70 MHz."""
    height, width = sensor.camera.shape
    across = np.add.outer(np.linspace(0, 0.3, height), np.linspace(0, 0.7, width))
    return NEAR_M + (FAR_M - NEAR_M) * across


def before(sensor, jump_m):
    """A square that stands before a slanted wall, a given jump nearer."""
    height, width = sensor.camera.shape
    range_m = np.linspace(5.0, 6.0, width) * np.ones((height, 1))
    range_m[height // 4 : -height // 4, width // 4 : -width // 4] -= jump_m
    return range_m


def room(sensor):
    """What a camera sees of a furnished room: occlusions and thin things."""
    shot = Shot(sensor, max_bounces=0, noisy=False, samples=1)
    truth = SIMULATORS["path"].build(Scene("room", {"seed": 8}))(shot).truth
    return np.asarray(truth.range_m, np.float64)


def frame(sensor, range_m, snr, seed):
    """Unit phasors with noise of 1 / snr per part; pixels that see nothing are noise."""
    freqs = sensor.modulation.freqs_hz[:, None, None]
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((2, freqs.size, *range_m.shape)) / snr
    lit = np.isfinite(range_m)
    values = np.where(lit, np.exp(1j * range_to_phase(np.where(lit, range_m, 0), freqs)), 0)
    values = (values + noise[0] + 1j * noise[1]).astype(np.complex64)
    return Phasors(values, np.full(values.shape, 1 / snr, np.float32))


def measured(sensor, players, truth_m, frames, repeats):
    """Errors over all frames and the least and median time of each contestant, by turns."""
    freqs = sensor.modulation.freqs_hz
    times, errors = {p.name: [] for p in players}, {p.name: [] for p in players}
    for repeat in range(repeats + 1):  # the first round compiles and warms up
        for player in players:
            phasors = frames[repeat % len(frames)]
            start = time.perf_counter()
            range_m = player.run(phasors)
            times[player.name].append(1e3 * (time.perf_counter() - start))
            if repeat < len(frames):
                errors[player.name].append(
                    error_m(range_m, truth_m, freqs, free_turns=player.spatial)
                )
    lit = np.isfinite(truth_m)
    return {p.name: figures(np.array(errors[p.name]), times[p.name][1:], freqs, lit)
            for p in players}  # fmt: skip


def figures(error, times, freqs_hz, lit):
    """Figures of the pixels that are lit and answered; NaN where that is less than half of them."""
    answered = np.isfinite(error) & lit
    valid = float(answered.sum() / (lit.sum() * len(error)))
    some = np.abs(error[answered]) if valid >= 0.5 else np.array([np.nan])
    wrong = float((some > ambiguity_m(np.max(freqs_hz)) / 2).mean()) if valid >= 0.5 else np.nan
    return {"mae_m": float(some.mean()), "median_m": float(np.median(some)), "wrong": wrong,
            "valid": valid, "ms": min(times), "median_ms": float(np.median(times)),
            "calls": len(times)}  # fmt: skip


def sweep(sensor, players, truths, snrs, seeds):
    """Mean absolute error (value, seed) of each contestant along an axis."""
    found = {p.name: np.zeros((len(truths), seeds)) for p in players}
    for at, (truth_m, snr) in enumerate(zip(truths, snrs, strict=True)):
        for seed in range(seeds):
            told = measured(sensor, players, truth_m, [frame(sensor, truth_m, snr, seed)], 1)
            for name, row in told.items():
                found[name][at, seed] = row["mae_m"]
    return found


def run(*, quick=False, log=lambda text: None):
    """Everything that is measured, as plain data."""
    size = "width=80,height=60" if quick else "width=320,height=240"
    sensor = preset(f"{SENSOR}:{size}")
    limit_threads(1)  # the peers have one
    players, missing = contestants(sensor, numpy_crt)
    scenes = {
        "smooth slope, SNR 30": (slope(sensor), SNR),
        "smooth slope, SNR 3": (slope(sensor), 3.0),
        "square 1.5 m before a wall": (before(sensor, 1.5), SNR),
        "furnished room": (room(sensor), SNR),
    }
    results = {}
    for name, (truth_m, snr) in scenes.items():
        log(name)
        frames = [frame(sensor, truth_m, snr, seed) for seed in range(2 if quick else 5)]
        results[name] = measured(sensor, players, truth_m, frames, 2 if quick else 25)
    seeds = 2 if quick else 3
    log("sweeps")
    noise = sweep(sensor, players, [slope(sensor)] * len(NOISES), NOISES, seeds)
    jump = sweep(sensor, players, [before(sensor, j) for j in JUMPS_M], [SNR] * len(JUMPS_M), seeds)
    return {
        "about": {"sensor": f"{SENSOR}:{size}", "machine": machine(1),
                  "versions": versions() | installed(), "missing": missing},
        "scenes": results,
        "noise": {"snr": list(NOISES), "mae_m": {k: v.tolist() for k, v in noise.items()}},
        "jump": {"jump_m": list(JUMPS_M), "mae_m": {k: v.tolist() for k, v in jump.items()}},
    }  # fmt: skip


def installed():
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


HEAD = ("method", "wrong wraps %", "answered %", "MAE mm", "median mm", "ms, least", "ms, median")


def scene_table(rows):
    lines = [f"| {' | '.join(HEAD)} |", f"|---|{'---:|' * (len(HEAD) - 1)}"]
    for name, row in rows.items():
        cells = [name, number(row["wrong"], 100), number(row["valid"], 100, ".1f"),
                 number(row["mae_m"], 1e3, ".1f"), number(row["median_m"], 1e3, ".1f"),
                 number(row["ms"]), number(row["median_ms"])]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def plain(thing):
    """The same with null for what is no number: JSON has no NaN."""
    if isinstance(thing, dict):
        return {key: plain(value) for key, value in thing.items()}
    if isinstance(thing, list):
        return [plain(value) for value in thing]
    return None if isinstance(thing, float) and not math.isfinite(thing) else thing


def page(result):
    about = result["about"]
    names = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    calls = next(iter(next(iter(result["scenes"].values())).values()))["calls"]
    parts = [
        "# Unwrapping beside spatial phase unwrapping",
        "Made by `python benchmarks/unwrapping_peers.py`; do not edit. Planted lone returns, "
        f"`{about['sensor']}` (40 and 70 MHz), phasor noise of amplitude / SNR. The peers get the "
        "phase of 70 MHz and are right up to a whole number of turns (2.14 m) of the frame, which "
        "is taken away before their error is counted; ours get both frequencies and no help. "
        "*Wrong wraps*: more than half a turn off.",
        f"{names}; {about['machine']['cpu']}, {about['machine']['cores']} cores shared with "
        f"other work: contestants take turns, {calls} calls each, all in one thread.",
        *(f"{text}." for text in about["missing"]),
    ]
    for name, rows in result["scenes"].items():
        parts.append(f"## {name[0].upper()}{name[1:]}\n\n{scene_table(rows)}")
    parts.append(
        "## Against noise\n\n![error against SNR](unwrapping_noise.svg)\n\nA smooth slope: "
        "neighbours hold a spatial method up where two frequencies of a single pixel no longer do. "
        "Drawn where a method answers at least half of the pixels."
    )
    parts.append(
        "## Against the height of a jump\n\n![error against the jump](unwrapping_jump.svg)\n\n"
        "A square before a wall: beyond half a turn, 1.07 m, the nearest turn is the wrong one."
    )
    return "\n\n".join(parts) + "\n"


def write(result, folder):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "unwrapping_peers.json").write_text(json.dumps(plain(result), indent=1) + "\n")
    (folder / "unwrapping_peers.md").write_text(page(result), encoding="utf-8")
    for name, key, title, axis in (
        ("noise", "snr", "Smooth slope, error against noise", "SNR of a phasor"),
        ("jump", "jump_m", "Square before a wall, error against its distance", "jump, m"),
    ):
        # Plain numpy has the errors of crt, and would lie upon it.
        drawn = {n: e for n, e in result[name]["mae_m"].items() if n != PLAIN}
        strains = [Strain(n, np.array(e, float)) for n, e in drawn.items()]
        svg = stress_svg(result[name][key], strains, title=title, name=axis)
        (folder / f"unwrapping_{name}.svg").write_text(svg, encoding="utf-8")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="small frames, few calls")
    given = parser.parse_args(arguments)
    write(run(quick=given.quick, log=lambda text: print(text, file=sys.stderr)), given.out)
    print((given.out / "unwrapping_peers.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
