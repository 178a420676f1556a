"""Peaks of a transient: where the fit of `heide2013` starts.

Maxima between which the transient falls to half of the lower one, and what lies around each.
Reference: the code released with Heide et al. 2013 starts its fit from all local maxima above a
threshold (read); the valley is ours, since noise makes ripples on the plateaus of a total
variation. Inputs: one transient. Fails where two returns share a peak: they count as one.
"""

import numpy as np
from numba import njit

from toftools.types import F32, F64

MOST = 4
"""Returns a pixel can have."""
VALLEY = 0.5
"""Two maxima are two peaks if the transient falls to this share of the lower one between them."""


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def peaks(x: F32, cell_m: float, cyclic: bool, share: float, p: F64) -> int:
    """Amplitudes and centroids of the highest peaks of one transient, nearest first.

    Parameters
    ----------
    x : ndarray, (N,)
        Transient.
    cell_m : float
        Grid cell, m.
    cyclic : bool
        Whether the ends meet.
    share : float
        Least height relative to the highest.
    p : ndarray, (2 MOST + 2,)
        Out: amplitude and range of each peak in turn.

    Returns
    -------
    int
        Number of peaks, at most `MOST`.
    """
    n = x.size
    start, found = np.argmin(x) if cyclic else 0, 0
    base = np.median(x)  # a constant has no phasor: the data leave it free
    floor = share * (x.max() - base)
    high, low, total, moment = 0.0, 0.0, 0.0, 0.0
    rising = True
    heights = np.zeros(MOST + 1)
    for i in range(n + 1):
        here = max(x[(start + i) % n] - base, 0.0) if i < n else 0.0
        if rising and here < VALLEY * high:
            rising, low = False, here
        if i == n or (not rising and here * VALLEY > low):
            if high > floor:
                found = _keep(p, heights, found, high, total, moment / total * cell_m)
            rising, high, total, moment = True, 0.0, 0.0, 0.0
        low, high = min(low, here), max(high, here)
        if here > floor:
            total += here
            moment += here * (start + i)
    return found


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _keep(p: F64, heights: F64, n: int, high: float, amplitude: float, range_m: float) -> int:
    """Append a peak, or put it in the place of the lowest one, keeping their order."""
    if n == MOST:
        lowest = 0
        for s in range(1, n):
            lowest = s if heights[s] < heights[lowest] else lowest
        if heights[lowest] >= high:
            return n
        for s in range(lowest, n - 1):
            heights[s] = heights[s + 1]
            p[2 * s], p[2 * s + 1] = p[2 * s + 2], p[2 * s + 3]
        n -= 1
    heights[n], p[2 * n], p[2 * n + 1] = high, amplitude, range_m
    return n + 1
