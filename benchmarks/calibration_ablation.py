"""A whole virtual calibration, judged on single frames at held-out distances; stages left out.

Captures of the calibration are averages, as everybody takes them; the check set are single frames,
as the camera will be used. Each stage is left out once: the others are fitted without it.
"""

import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache

import numpy as np

from toftools.calib.chain import chain_for
from toftools.calib.fit import fit_plan
from toftools.calib.plan import plan
from toftools.calib.verdict import verdict as judged
from toftools.conditions import conditions_of
from toftools.sensors import sensor
from toftools.sim._rig_unit import unit_of
from toftools.sim.rig import PLANS, Errors, exposed, planned, rig

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
    """Verdict of one calibration, with one stage left out or none."""
    seed, slot = job
    fit, check = captures(seed)
    start = time.process_time()
    skip = ("extrinsics", slot) if slot else ("extrinsics",)
    todo = plan([*fit, *check], skip=skip)
    chain, outcomes = fit_plan(todo, chain_for(fit[0].sensor))
    took = time.process_time() - start
    found = judged(chain, check)
    missing = [o.step.slot for o in outcomes if o.stage is None and o.step.slot not in skip]
    return {
        "seed": seed,
        "left_out": slot,
        "word": found.word,
        "sentence": found.sentence,
        "missing": missing,
        "cpu_s": took,
        "scores": [
            {"name": s.name, "rms_mm": s.rms_mm, "bias_mm": s.bias_mm, "noise_mm": s.noise_mm,
             "ratio": s.ratio}
            for s in found.scores
        ],
        "residuals": {
            s.slot: [s.residual.unit, s.residual.before, s.residual.after, s.residual.held_out,
                     s.residual.noise]
            for s in chain.stages
        },
    }  # fmt: skip


def run(seeds=1, workers=2):
    jobs = [(seed, slot) for seed in range(seeds) for slot in LEFT_OUT]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(one, jobs))
