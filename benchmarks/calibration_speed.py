"""Milliseconds of a whole chain on a Kinect v2 frame: in one pass, and stage by stage."""

import time
from dataclasses import replace

import numpy as np

from toftools.calib.amplitude import Amplitude
from toftools.calib.chain import applied, chain_for, extended
from toftools.calib.common_phase import CommonPhase
from toftools.calib.fixed_pattern import FixedPattern
from toftools.calib.fused import fused
from toftools.calib.stage import Residual
from toftools.calib.temperature import Temperature
from toftools.calib.wiggling import Wiggling
from toftools.sensors import sensor
from toftools.types import Capture, Phasors

RUNS = 200


def frame():
    """A frame of all phases and four decades of amplitude: the worst for caches."""
    rng = np.random.default_rng(2)
    shape = (3, 424, 512)
    values = 10 ** rng.uniform(1, 5, shape) * np.exp(2j * np.pi * rng.random(shape))
    return Phasors(values.astype(np.complex64), np.ones(shape, np.float32))


def stages():
    rng = np.random.default_rng(1)
    shape, wave = (3, 424, 512), rng.normal(size=(2, 3, 16)) * 0.01
    sd, knots = np.full((3, 16), 1e-4), rng.normal(size=(3, 4, 6)) * 0.01
    freqs = np.asarray(sensor("kinect2").modulation.freqs_hz)
    covered = np.ones((3, 64), bool)
    return (
        Wiggling(freqs, wave[0], wave[1], sd, sd, 30, covered, Residual()),
        CommonPhase(np.ones(3), np.full(3, 1e-4), np.full(2, 25.0)),
        FixedPattern(rng.normal(size=shape) * 0.1, np.full(shape, 1e-3)),
        Amplitude(knots, np.zeros((3, 24, 24)), np.tile([10.0, 1e5], (3, 1)), np.full(3, 1e3)),
        Temperature(np.full((3, 2), 1e-3), np.full((3, 2), 1e-5), np.full(2, 25.0),
                    np.tile([20.0, 60.0], (2, 1)), sensor_c=30.0, light_c=35.0),
    )  # fmt: skip


def timed(run, runs):
    run()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - start))
    return {"min_ms": min(times), "median_ms": float(np.median(times)), "runs": runs}


def measured():
    """Times of the whole chain, of its parts, and of the readable way."""
    device, measured = sensor("kinect2"), frame()
    empty = chain_for(device)
    chain = empty
    for stage in stages():
        chain = extended(chain, stage)
    told = {"kind": "wall", "sensor_c": 30.0, "light_c": 35.0}
    capture = Capture(device, phasors=measured, provenance={"conditions": told})
    start = time.perf_counter()
    run = fused(chain)
    made_s = time.perf_counter() - start
    quick, slow = run(measured), applied(chain, capture).phasors
    turn = np.abs(np.angle(quick.values * slow.values.conj()))
    rows = {
        "fused, all five stages": timed(lambda: run(measured), RUNS),
        "fused, without sigma": timed(lambda: run(replace(measured, sigma=None)), RUNS),
        "stage by stage": timed(lambda: applied(chain, capture), 5),
    }
    for stage in chain.stages:
        alone = fused(extended(empty, stage))
        rows[f"fused, {stage.slot} alone"] = timed(lambda run=alone: run(measured), RUNS)
    return {"rows": rows, "made_s": made_s, "largest_difference_rad": float(turn.max()),
            "typical_difference_rad": float(np.median(turn))}  # fmt: skip
