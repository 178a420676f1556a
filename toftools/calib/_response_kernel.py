"""Raw taps to linear ones in one pass; the slow twin is in tests/test_response.py."""

import numpy as np
from numba import njit, prange

from toftools.types import F32, Bool


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def linearise(
    taps: F32,
    offset: F32,
    inverse_gain: F32,
    curve: F32,
    step: float,
    limits: tuple[float, float],
    valid: Bool,
) -> tuple[F32, Bool]:
    """Curve, dark level and gain of every tap, and which pixels keep all taps inside the limits.

    Parameters
    ----------
    taps : ndarray, (T, H, W)
        Raw taps; tap t is of node t modulo N.
    offset, inverse_gain : ndarray, (N, H, W)
        Dark level after the curve, and 1 / gain.
    curve : ndarray, (M,)
        Values at 0, `step`, 2 `step` ...; straight lines in between and beyond both ends.
    step : float
        Distance of the knots.
    limits : tuple of 2 floats
        Raw level below which, and from which on, a tap cannot be read.
    valid : ndarray, (H, W), bool
        Pixels to be trusted.

    Returns
    -------
    tuple of ndarray (T, H, W) and ndarray (H, W)
        Linear taps, and the pixels whose taps are all finite and inside the limits.
    """
    n_taps, height, width = taps.shape
    nodes, last = offset.shape[0], curve.size - 2
    out = np.empty_like(taps)
    good = np.empty((height, width), np.bool_)
    scale = np.float32(1.0 / step)
    for y in prange(height):
        for x in range(width):
            good[y, x] = valid[y, x]
        for t in range(n_taps):
            n = t % nodes
            for x in range(width):
                raw = taps[t, y, x]
                if not (raw >= limits[0] and raw < limits[1] and raw - raw == 0):
                    good[y, x] = False
                    out[t, y, x] = raw
                    continue
                at = raw * scale
                i = np.int64(min(max(at, np.float32(0)), np.float32(last)))
                low = curve[i]
                value = low + (at - np.float32(i)) * (curve[i + 1] - low)
                out[t, y, x] = (value - offset[n, y, x]) * inverse_gain[n, y, x]
    return out, good
