"""Raw taps to linear ones in one pass; the slow twin is in tests/test_response.py."""

import numpy as np
from numba import njit, prange

from toftools.types import F32, Bool

MOST = 3e38
"""Taps beyond are not finite."""


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def linearise(
    taps: F32,
    offset: F32,
    inverse_gain: F32,
    intercept: F32,
    slope: F32,
    step: float,
    limits: tuple[float, float, float],
    valid: Bool,
) -> tuple[F32, Bool]:
    """Curve, dark level and gain of every tap, and which pixels keep all taps inside the limits.

    Parameters
    ----------
    taps : ndarray, (T, H, W)
        Raw taps; tap t is of node t modulo N.
    offset, inverse_gain : ndarray, (N, H, W)
        Dark level after the curve, and 1 / gain.
    intercept, slope : ndarray, (M,)
        The curve as straight lines, one per `step` from 0 on; the ends go on.
    step : float
        Width of a line, raw units.
    limits : tuple of 3 floats
        Raw level below which, and from which on, a tap cannot be read; and a code that means the
        same, or NaN.
    valid : ndarray, (H, W), bool
        Pixels to be trusted.

    Returns
    -------
    tuple of ndarray (T, H, W) and ndarray (H, W)
        Linear taps, and the pixels whose taps are all finite and inside the limits.
    """
    n_taps, height, width = taps.shape
    nodes, last, zero = offset.shape[0], np.float32(intercept.size - 1), np.float32(0)
    out = np.empty_like(taps)
    good = np.empty((height, width), np.bool_)
    scale = np.float32(1.0 / step)
    low, high = np.float32(max(limits[0], -MOST)), np.float32(min(limits[1], MOST))
    lost = np.float32(limits[2])
    for y in prange(height):
        for x in range(width):
            good[y, x] = valid[y, x]
        for t in range(n_taps):
            n = t % nodes
            for x in range(width):  # no branch, so that it vectorises; NaN fails the comparisons
                raw = taps[t, y, x]
                inside = raw >= low and raw < high
                i = np.int32(min(max(raw * scale, zero), last)) if inside else np.int32(0)
                value = (intercept[i] + slope[i] * raw - offset[n, y, x]) * inverse_gain[n, y, x]
                out[t, y, x] = value if inside else raw
            for x in range(width):
                raw = taps[t, y, x]
                if not (raw >= low and raw < high and raw != lost):
                    good[y, x] = False
    return out, good
