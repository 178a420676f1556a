"""A method of your own in the benchmark: ten lines, no registration.

Run: toftools bench quick --method your_method:make --out out/mine
(this file shows the method and runs it on one capture; save `make` as your_method.py)
"""

import numpy as np

from toftools import DepthMap, Phasors, Scene, Sensor, Shot
from toftools.phasor import wrapped_range_m
from toftools.registry import METRICS
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.units import ambiguity_m


def make(device: Sensor, *, window_m: float = 0.5):
    """Lowest frequency to find the wrap, highest to measure: breaks beyond c / 2 f_min."""
    freqs = device.modulation.freqs_hz
    low, high = int(np.argmin(freqs)), int(np.argmax(freqs))
    period = float(ambiguity_m(freqs[high]))

    def run(phasors: Phasors) -> DepthMap:
        coarse, fine = wrapped_range_m(phasors.values[[low, high]], freqs[[low, high]])
        answer = fine + period * np.round((coarse - fine) / period)
        keep = phasors.valid & (np.abs(answer - coarse) < window_m) & (answer >= 0)
        return DepthMap(np.where(keep, answer, np.nan))

    return run


device = sensor("opt8241:width=64,height=48")
capture = analytic(Scene("wall", {"range": 2.0}))(Shot(device, seed=3))
answer = make(device)(capture.phasors)
for name in ("mae_m", "valid_share"):
    print(f"{name}: {METRICS[name].build(capture.truth)(answer):.4f}")
assert METRICS["mae_m"].build(capture.truth)(answer) < 0.01  # noise alone: 6 mm at 70 MHz
assert METRICS["valid_share"].build(capture.truth)(answer) > 0.99
