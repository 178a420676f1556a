"""Simulate a corner, see what multipath does to it, and how far the noise goes.

Run: python examples/01_simulate_and_correct.py
"""

import numpy as np

from toftools import Scene, Shot
from toftools.correct.crt import crt
from toftools.sensors import sensor
from toftools.sim.analytic import analytic

camera = sensor("opt8241:width=96,height=72")
scene = Scene("corner", {"range": 2.0, "angle": 90.0, "albedo": 0.8})
capture = analytic(scene)(Shot(camera, seed=1))  # taps, phasors and truth

depth = crt(camera)(capture.phasors)  # make once, run per frame
error = depth.range_m - capture.truth.range_m
print(f"a 90 degree corner reads {1e3 * np.nanmedian(error):+.0f} mm at the median")
print(f"noise alone would be {1e3 * np.nanmedian(depth.sigma_m):.1f} mm")

direct_only = analytic(scene)(Shot(camera, seed=1, max_bounces=0))
clean = crt(camera)(direct_only.phasors).range_m - capture.truth.range_m
print(f"without the bounce: {1e3 * np.nanmedian(clean):+.1f} mm")

assert np.nanmedian(error) > 10 * np.nanmedian(depth.sigma_m)
assert abs(np.nanmedian(clean)) < np.nanmedian(depth.sigma_m)
