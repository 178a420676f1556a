"""A method of your own in the benchmark: no base class, no registration.

cp examples/your_method.py .
toftools bench quick --method your_method:make --out out/mine
"""

import numpy as np

from toftools import DepthMap
from toftools.phasor import wrapped_range_m
from toftools.units import ambiguity_m


def make(sensor, *, window_m=0.5):  # once per sensor: tables, compilation, networks
    freqs = sensor.modulation.freqs_hz
    period_m = ambiguity_m(freqs.max())

    def run(phasors):  # once per frame: this is what is timed
        each_m = wrapped_range_m(phasors.values, freqs)
        rough_m, fine_m = each_m[freqs.argmin()], each_m[freqs.argmax()]
        range_m = fine_m + period_m * np.round((rough_m - fine_m) / period_m)
        agree = phasors.valid & (abs(range_m - rough_m) < window_m) & (range_m >= 0)
        return DepthMap(np.where(agree, range_m, np.nan))  # NaN: no answer

    return run
