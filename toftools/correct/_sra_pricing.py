"""Pricing of SRA's linear program: which grid cell or corner lowers the cost most per unit.

The gain of a cell is a trigonometric polynomial of the range, so every 16th cell tells how high
it can rise between them: its second derivative is bounded. Reference: the bound is Taylor's at a
peak, the rest Dantzig's rule. Inputs: multipliers of the simplex method, turned to the phases of
the grid. Fails on nothing of its own.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from toftools._turns import FAST
from toftools.correct._sra_grid import SIDES, TIE
from toftools.types import F64
from toftools.units import range_to_phase

I64 = NDArray[np.int64]
C128 = NDArray[np.complex128]

STRIDE = 16
"""Cells between the first looks."""
STEPS = (-8, -4, -2, -1, 1, 2, 4, 8)
"""The second looks, cells from an occupied one."""
TINY = 1e-9
"""Gains and amounts below this are rounding."""


class Grid(NamedTuple):
    """Unit returns of the grid cells.

    Parameters
    ----------
    cells : ndarray, (N, 2 F)
        Real and imaginary part per frequency.
    coarse : ndarray, (2 F, ceil(N / 16))
        Every 16th of them.
    rise : ndarray, (F,)
        How much a unit phasor can rise above the nearest of these: half the squared phase of
        half their distance.
    corners : ndarray, (2, SIDES)
        Corners of the polygon that stands for the circle.
    """

    cells: F64
    coarse: F64
    rise: F64
    corners: F64


def make_grid(freqs_hz: F64, ranges_m: F64) -> Grid:
    """Lay the unit returns out for pricing.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    ranges_m : ndarray, (N,)
        Equidistant ranges of the grid cells, m.

    Returns
    -------
    Grid
        Their phasors.
    """
    atoms = np.exp(1j * range_to_phase(ranges_m, freqs_hz[:, None]))
    cells = np.stack([atoms.real, atoms.imag], axis=1).reshape(-1, ranges_m.size).T
    reach_m = STRIDE / 2 * (ranges_m[1] - ranges_m[0])
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    return Grid(
        np.ascontiguousarray(cells),
        np.ascontiguousarray(cells[::STRIDE].T),
        np.asarray(range_to_phase(reach_m, freqs_hz)) ** 2 / 2,
        np.stack([np.cos(angle), np.sin(angle)]),
    )


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def best_match(
    cells: F64, coarse: F64, first: int, last: int, unit: F64, turn: C128, mean: F64, cost: F64
) -> int:
    """Cell that agrees best with the phasors, which enters first; prepares the costs."""
    total = unit.sum()
    cost[:] = 0.0
    for f in range(unit.size):
        mean[2 * f] = unit[f] / total * turn[f].real
        mean[2 * f + 1] = -unit[f] / total * turn[f].imag
    for i in range(mean.size):
        for j in range(cost.size):
            cost[j] += mean[i] * coarse[i, j]
    low, high = -(-first // STRIDE), -(-last // STRIDE)
    near = first if high <= low else STRIDE * (low + _largest(cost[low:high]))
    for j in range(cost.size):
        cost[j] = 1 - TIE * cost[j] * cost[j]
    best, cell = -np.float64(2), near
    for j in range(max(near - STRIDE // 2, first), min(near + STRIDE // 2 + 1, last)):
        agreement = _dot(cells, j, mean)
        if agreement > best:
            best, cell = agreement, j
    return cell


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _dot(cells: F64, j: int, factors: F64) -> float:
    total = 0.0
    for i in range(factors.size):
        total += factors[i] * cells[j, i]
    return total


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def unit_cost(cells: F64, j: int, mean: F64) -> float:
    """Cost of a unit of a grid cell: nearly one, a little less where the phases agree."""
    return float(1 - TIE * _dot(cells, j, mean) ** 2)


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _largest(values: F64) -> int:
    """Index of the largest value; four chains, since a single one waits for itself."""
    best0 = best1 = best2 = best3 = values[0]
    whole = values.size // 4
    for i in range(whole):
        j = 4 * i
        best0, best1 = max(best0, values[j]), max(best1, values[j + 1])
        best2, best3 = max(best2, values[j + 2]), max(best3, values[j + 3])
    best = max(max(best0, best1), max(best2, best3))
    for j in range(4 * whole, values.size):
        best = max(best, values[j])
    for j in range(values.size):
        if values[j] == best:
            return j
    return 0


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def enter_residual(n_cells: int, corners: F64, weights: F64, price: F64) -> tuple[float, int]:
    """Gain and column of the best corner or slack, which cost nothing; -1 if none gains."""
    bound = price[2 * weights.size]
    best, enter = TINY, -1
    if bound > best:
        best, enter = bound, n_cells + weights.size * SIDES
    for f in range(weights.size):
        a, b, c = price[2 * f], price[2 * f + 1], weights[f] * bound
        if best > c and a * a + b * b <= (best - c) ** 2:
            continue
        for s in range(SIDES):
            gain = a * corners[0, s] + b * corners[1, s] + c
            if gain > best:
                best, enter = gain, n_cells + f * SIDES + s
    return best, enter


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def enter_coarse(
    coarse: F64, first: int, last: int, turned: F64, cost: F64, gains: F64
) -> tuple[float, int]:
    """Gain of every 16th cell; the largest and its cell, -1 if none gains."""
    for j in range(gains.size):
        gains[j] = -cost[j]
    for i in range(turned.size):
        for j in range(gains.size):
            gains[j] += turned[i] * coarse[i, j]
    low, high = -(-first // STRIDE), -(-last // STRIDE)
    if high <= low:
        return TINY, -1
    j = low + _largest(gains[low:high])
    return gains[j], STRIDE * j if gains[j] > TINY else -1


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def enter_near(
    cells: F64, first: int, last: int, turned: F64, mean: F64, basis: I64
) -> tuple[float, int]:
    """Gain and column of the best grid cell near the occupied ones; -1 if none gains."""
    best, enter = TINY, -1
    for k in range(basis.size):
        if not 0 <= basis[k] < cells.shape[0]:
            continue
        for step in STEPS:
            j = basis[k] + step
            if first <= j < last:
                gain = _dot(cells, j, turned) - unit_cost(cells, j, mean)
                if gain > best:
                    best, enter = gain, j
    return best, enter


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def least_gain(rise: F64, price: F64) -> float:
    """What every 16th cell gains at least if one up to half way to the next gains anything."""
    least = -4 * TIE * rise.max()  # the costs' own part: (m^2)'' <= 4 k^2 for |m| <= 1
    for f in range(rise.size):
        least -= rise[f] * np.hypot(price[2 * f], price[2 * f + 1])
    return float(least)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def enter_all(
    cells: F64, first: int, last: int, turned: F64, mean: F64, gains: F64, least: float
) -> tuple[float, int]:
    """Gain and column of the best of all grid cells; -1 if none gains.

    The ends of the grid, where the best need not be a peak, are always looked at.
    """
    low, high, half = -(-first // STRIDE), -(-last // STRIDE), STRIDE // 2
    best, enter = TINY, -1
    for k in range(low - 1, high + 1):
        begin, end = STRIDE * k - half, STRIDE * k + half + 1
        if k == low - 1:
            begin, end = first, first + STRIDE
        elif k == high:
            begin, end = last - STRIDE, last
        elif gains[k] < least:
            continue
        for j in range(max(begin, first), min(end, last)):
            gain = _dot(cells, j, turned) - unit_cost(cells, j, mean)
            if gain > best:
                best, enter = gain, j
    return best, enter
