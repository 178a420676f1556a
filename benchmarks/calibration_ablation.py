"""A whole virtual calibration, judged on single frames at held-out distances; stages left out.

Captures of the calibration are averages, as everybody takes them; the check set are single frames,
as the camera will be used. Each stage is left out once: the others are fitted without it.
"""

import io
import time
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
from calibration_workers import workers
from PIL import Image

from toftools.calib.chain import chain_for
from toftools.calib.fit import fit_plan
from toftools.calib.plan import plan
from toftools.calib.verdict import GOOD, verdict
from toftools.conditions import conditions_of
from toftools.sensors import sensor
from toftools.sim._rig_unit import unit_of
from toftools.sim.rig import PLANS, Errors, exposed, planned, rig
from toftools.viz._calibration_data import error_maps_mm, samples
from toftools.viz.calibration import Cyclic, cyclic_png, distance_png
from toftools.viz.figures import maps_png

SENSOR = "opt8241:width=160,height=120"
FRAMES = 16
LEFT_OUT = (
    "", "lens", "response", "wiggling", "common_phase", "fixed_pattern", "amplitude", "temperature",
)  # fmt: skip


@cache
def captures(seed):
    """Averaged captures of a calibration, and single frames to check it with."""
    device, errors = sensor(SENSOR), Errors(unit=seed)
    unit, full = unit_of(errors, device), PLANS["full"]
    fit = [c for _, c in rig(device, errors, plan=full, seed=seed, frames=FRAMES)
           if conditions_of(c).kind != "check"]  # fmt: skip
    takes = [t for t in planned(unit, full, seed=seed) if t.conditions.kind == "check"]
    check = [exposed(t, unit, np.random.default_rng((seed, 9, i))) for i, t in enumerate(takes)]
    return fit, check


def one(job):
    """Verdict of one calibration, with one stage left out or none; the first is drawn."""
    seed, slot, folder = job
    fit, check = captures(seed)
    start = time.process_time()
    skip = ("extrinsics", slot) if slot else ("extrinsics",)
    todo = plan([*fit, *check], skip=skip)
    chain, outcomes = fit_plan(todo, chain_for(fit[0].sensor))
    took = time.process_time() - start
    found = verdict(chain, check)
    if not slot and folder:
        draw(Path(folder), chain, fit, check, found)
    return {
        "seed": seed,
        "left_out": slot,
        "word": found.word,
        "sentence": found.sentence,
        "missing": [o.step.slot for o in outcomes if o.stage is None and o.step.slot not in skip],
        "cpu_s": took,
        "scores": [{**asdict(s), "ratio": s.ratio} for s in found.after],
        "before": [asdict(s) for s in found.before],
        "residuals": {s.slot: {**asdict(s.residual), "notes": ()} for s in chain.stages},
    }


def draw(folder, chain, fit, check, found):
    """Pictures of one calibration: cyclic error, error over distance, error maps."""
    delay = [c for c in fit if conditions_of(c).kind == "delay"]
    first, last = samples(chain.without("wiggling"), delay), samples(chain, delay)
    turn = np.linspace(0, 2 * np.pi, 361)
    stage, freqs = chain.stage("wiggling"), chain.freqs_hz
    curve = stage.error_rad(np.tile(turn, (freqs.size, 1))) * first.mm_per_rad[:, None]
    panels = [
        Cyclic(f"{freq / 1e6:g} MHz", first.phase_rad[f], first.error_mm[f], last.error_mm[f],
               curve[f])
        for f, freq in enumerate(freqs)
    ]  # fmt: skip
    (folder / "cyclic.png").write_bytes(cyclic_png(panels))
    spots = np.array([[s.distance_m, s.before_mm, s.rms_mm, s.noise_mm] for s in found.spots])
    (folder / "distance.png").write_bytes(distance_png(*spots.T, good=GOOD))
    middle = sorted(check, key=lambda c: conditions_of(c).distance_m)[len(check) // 2]
    maps = [
        (f"{freq / 1e6:g} MHz, {name}", layer / 1e3, "error")
        for name, used in (("before", chain_for(fit[0].sensor)), ("after", chain))
        for freq, layer in zip(freqs, error_maps_mm(used, middle), strict=True)
    ]
    picture = Image.open(io.BytesIO(maps_png(maps, columns=2, width_px=800))).convert("RGB")
    picture.save(folder / "maps.webp", "WEBP", quality=88, method=4)


def run(folder, seeds=1):
    jobs = [(seed, slot, str(folder) if seed == 0 else "") for seed in range(seeds)
            for slot in LEFT_OUT]  # fmt: skip
    with workers() as pool:
        return list(pool.map(one, jobs))
