"""Returns of pixels from the table of SRA for two frequencies: see sra.py.

A pixel looks its node up, interpolates its returns linearly between the four nodes around it where
these agree, and moves them back. Reference: that look-up is Freedman et al.'s, ECCV 2014
(recalled), the interpolation ours. Inputs: phasors and a table. Fails near the end of a window,
where a node holds returns of other pixels only.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct._returns import GUARD_M
from toftools.correct._sra_small import sort_strong
from toftools.correct._sra_table import MOST_RETURNS, Table
from toftools.types import C64, F32, F64
from toftools.units import TWO_PI

SAME_M = 0.1
"""Returns of neighbouring nodes this close are one return, and are interpolated."""
BLOCK = 64
"""Pixels that share the arrays of a look-up."""


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def look_up(
    values: C64, usable: NDArray[np.bool_], table: Table, first_share: float
) -> tuple[F32, F32]:
    """Returns of every pixel.

    Parameters
    ----------
    values : ndarray, (2, P)
        Phasors.
    usable : ndarray, (P,), bool
        Pixels to answer.
    table : Table
        Solved nodes.
    first_share : float
        Least strength, relative to the strongest.

    Returns
    -------
    ranges_m, amplitudes : ndarray, (4, P)
        Returns that are strong enough, nearest first; NaN and 0 for none. The
        amplitudes are shares of the stronger phasor's.
    """
    n = values.shape[1]
    ranges_m = np.full((MOST_RETURNS, n), np.nan, np.float32)
    amplitudes = np.zeros((MOST_RETURNS, n), np.float32)
    windows, ratios, phases = table.share.shape[:3]
    for block in prange((n + BLOCK - 1) // BLOCK):
        at, strength = np.empty(MOST_RETURNS), np.empty(MOST_RETURNS)
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not usable[p]:
                continue
            a, b = abs(values[0, p]), abs(values[1, p])
            moved_m, phase = _canonical(values[0, p], values[1, p], table)
            s = min(int(moved_m / table.window_m), windows - 1)
            x = np.arctan2(b, a) / (np.pi / 2) * (ratios - 1)
            y = min(phase / table.span_rad, 1.0) * (phases - 1)
            found = _gather(table, s, x, y, moved_m, at, strength)
            found = sort_strong(at, strength, found, first_share)
            for k in range(found):
                ranges_m[k, p], amplitudes[k, p] = max(at[k], 0.0), max(a, b) * strength[k]
    return ranges_m, amplitudes


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _canonical(z0: complex, z1: complex, table: Table) -> tuple[float, float]:
    """Distance a pixel is moved, and the phase of its second frequency after that."""
    phase0 = _mod(np.arctan2(z0.imag, z0.real), TWO_PI)
    phase1 = np.arctan2(z1.imag, z1.real) - table.ratio * phase0
    least, turns = TWO_PI, 0
    for k in range(table.turn_phase_rad.size):
        phase = _mod(phase1 - table.turn_phase_rad[k], TWO_PI)
        if phase < least:
            least, turns = phase, k
    return (phase0 / TWO_PI + turns) * table.turn_m, least


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _gather(
    table: Table, s: int, x: float, y: float, moved_m: float, at: F64, strength: F64
) -> int:
    """Returns of the nearest node that lie within the limits, moved to the pixel; their number."""
    range_m, share = table.range_m[s], table.share[s]
    i, j, found = round(x), round(y), 0
    for k in range(MOST_RETURNS):
        unwrapped = _unwrapped(range_m[i, j, k] + moved_m, table)
        if share[i, j, k] > 0 and unwrapped <= table.limit_m:
            at[found] = unwrapped + _interpolate(range_m, share, x, y, range_m[i, j, k])
            strength[found] = share[i, j, k]
            found += 1
    return found


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _unwrapped(range_m: float, table: Table) -> float:
    """Range of a return, from `GUARD_M` below zero up; infinite below that where nothing wraps."""
    if table.period_m > 0:
        return float(_mod(range_m + GUARD_M, table.period_m)) - GUARD_M
    return range_m if range_m >= -GUARD_M else np.inf


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _mod(x: float, period: float) -> float:
    """Remainder in [0, period], faster than the exact one."""
    return float(x - period * np.floor(x / period))


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _interpolate(range_m: F32, share: F32, x: float, y: float, node_m: float) -> float:
    """Bilinear change of a return from the nearest node; 0 unless all four nodes have it."""
    a, b = min(int(x), share.shape[0] - 2), min(int(y), share.shape[1] - 2)
    change = 0.0
    for corner in range(4):
        i, j = a + corner // 2, b + corner % 2
        weight = (1 - abs(x - i)) * (1 - abs(y - j))
        closest = np.inf
        for k in range(MOST_RETURNS):
            off = range_m[i, j, k] - node_m
            if share[i, j, k] > 0 and abs(off) < abs(closest):
                closest = off
        if weight > 0 and abs(closest) > SAME_M:
            return 0.0
        if weight > 0:
            change += weight * closest
    return change
