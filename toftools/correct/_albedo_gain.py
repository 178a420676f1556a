"""The factor between radiometric and true albedo, fitted where the camera's scale is unknown.

Reference: ours. Interreflection shifts every frequency by another distance, all in proportion to
the albedo's scale, so the right scale is the one at which the corrected frequencies agree. Inputs:
measured phasors, ratio of indirect to direct light at gain 1. Fails where nothing in the frame
reflects onto anything else: then any gain will do, and none matters.
"""

import numpy as np

from toftools.types import C64, F32, F64
from toftools.units import range_to_phase

BRIGHT = 0.8
"""Albedo of the 99th percentile of a frame where only brightness can tell."""
PIXELS = 4096


def fitted_gain(values: C64, ratio: C64, flash: F32, range_m: F32, freqs_hz: F64) -> float:
    """Gain of the albedo at which the frequencies agree best; from brightness if there is one.

    Parameters
    ----------
    values, ratio : ndarray, (F, H, W), complex64
        Measured phasors, zero where invalid, and indirect over direct light at gain 1.
    flash : ndarray, (F, H, W)
        Light of the flash on a pixel's surface.
    range_m : ndarray, (H, W)
        Range, m.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.

    Returns
    -------
    float
        The gain. Of several frequencies: least mean absolute disagreement between the ranges of
        the lowest and the highest, weighted by what a pixel has to say, |h|.
    """
    strength = np.abs(values[0])
    bright = np.flatnonzero((strength > 0) & (flash[0] > 0) & np.isfinite(range_m))
    if not bright.size:
        return 1.0
    albedo = strength.ravel()[bright] / flash[0].ravel()[bright]
    scale = BRIGHT / float(np.percentile(albedo, 99))
    if freqs_hz.size < 2:
        return scale
    pick = bright[:: 1 + bright.size // PIXELS]
    ends = [int(np.argmin(freqs_hz)), int(np.argmax(freqs_hz))]
    m, h = (a[ends].reshape(2, -1)[:, pick] for a in (values, ratio))
    k = range_to_phase(1.0, freqs_hz[ends])[:, None]
    at_range = m * np.exp(-1j * k * range_m.ravel()[pick])
    weight = np.abs(h).sum(axis=0)

    def disagreement(gain: float) -> float:
        low, high = np.angle(at_range / (1 + gain * h)) / k
        return float(np.sum(weight * np.abs(high - low)))

    best, step = scale, scale * 0.05
    tried = step * np.arange(1, 41)
    for _ in range(2):
        best = float(tried[int(np.argmin([disagreement(gain) for gain in tried]))])
        tried = np.maximum(best + step * np.linspace(-1, 1, 11), 1e-3 * scale)
    return best
