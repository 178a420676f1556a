"""Returns of every pixel by one linear program each: SRA for three and more frequencies.

Reference: see sra.py; the program is that of _sra_simplex.py, what is done with its solution is
that of `group_returns` and `first_return` in _sra_grid.py. Inputs: phasors and the range grid.
Fails where sra_lp fails.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct._sra_grid import range_grid
from toftools.correct._sra_pricing import Grid, make_grid
from toftools.correct._sra_simplex import make_work, read, solve
from toftools.correct._sra_small import C128, join, sort_strong, unwrapped
from toftools.types import F32, F64
from toftools.units import range_to_phase

BLOCK = 64
"""Pixels that share the arrays of a solver."""


class Plan(NamedTuple):
    """What can be worked out before a frame arrives.

    Parameters
    ----------
    n_cells : int
        Number of grid cells.
    rad_per_m : ndarray, (F,)
        Phase per range, rad/m.
    start_m, step_m : float
        First range of the grid relative to the pixel's own, and its step, m.
    period_m : float
        Joint ambiguity, m; 0 where the range is limited.
    limit_m : float
        Range limit, m; infinite if none.
    epsilon, first_share : float
        As in `sra`.
    """

    n_cells: int
    rad_per_m: F64
    start_m: float
    step_m: float
    period_m: float
    limit_m: float
    epsilon: float
    first_share: float


def make_plan(
    freqs_hz: F64, *, grid_m: float, epsilon: float, first_share: float, max_range_m: float
) -> tuple[Grid, Plan]:
    """Lay out the linear program of a pixel.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    grid_m, epsilon, first_share, max_range_m : float
        As in `sra`.

    Returns
    -------
    Grid, Plan
        The program but for the pixel.
    """
    ranges_m, period_m = range_grid(freqs_hz, grid_m, max_range_m)
    return make_grid(freqs_hz, ranges_m), Plan(
        ranges_m.size,
        np.asarray(range_to_phase(1.0, freqs_hz)),
        float(ranges_m[0]),
        float(ranges_m[1] - ranges_m[0]),
        period_m,
        np.inf if period_m > 0 else max_range_m,
        epsilon,
        first_share,
    )


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def solve_pixels(
    values: NDArray[np.complex64], sigma: F32, usable: NDArray[np.bool_], grid: Grid, plan: Plan
) -> tuple[F32, F32]:
    """Returns of every pixel.

    Parameters
    ----------
    values : ndarray, (F, P)
        Phasors.
    sigma : ndarray, (F, P) or (F, 1)
        Noise, whose inverse weighs the frequencies in the residual bound.
    usable : ndarray, (P,), bool
        Pixels to answer.
    grid, plan
        The program.

    Returns
    -------
    ranges_m, amplitudes : ndarray, (2 F, P)
        Returns that are strong enough, in ascending range; NaN and 0 for none.
    """
    n_freqs, n = values.shape
    most = 2 * n_freqs  # 2 F + 1 rows, one taken by the slack or the residual
    ranges_m = np.full((most, n), np.nan, np.float32)
    amplitudes = np.zeros((most, n), np.float32)
    for block in prange((n + BLOCK - 1) // BLOCK):
        work, z, w = make_work(grid), np.empty(n_freqs, np.complex128), np.empty(n_freqs)
        unit, turn = np.empty(n_freqs), np.empty(n_freqs, np.complex128)
        cell, amount = np.empty(work.basis.size, np.int64), np.empty(work.basis.size)
        at, strength = np.empty(work.basis.size), np.empty(work.basis.size)
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not usable[p]:
                continue
            for f in range(n_freqs):
                z[f] = values[f, p]
            weigh(sigma, p if sigma.shape[1] > 1 else 0, w)
            moved_m, scale = turned(z, plan.rad_per_m, unit, turn)
            first, last = window(moved_m, plan)
            if not solve(grid, first, last, unit, turn, w, plan.epsilon, work):
                continue
            found = read(work, plan.n_cells, cell, amount)
            period = plan.n_cells if plan.period_m > 0 else 0
            found = join(cell[:found], amount[:found], period, at, strength)
            for k in range(found):
                at[k] = unwrapped(moved_m + plan.start_m + plan.step_m * at[k], plan.period_m)
            found = sort_strong(at, strength, found, plan.first_share)
            for k in range(found):
                ranges_m[k, p], amplitudes[k, p] = max(at[k], 0.0), scale * strength[k]
    return ranges_m, amplitudes


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def weigh(sigma: F32, p: int, weights: F64) -> None:
    """Weight of each frequency in the residual: 1 / sigma, of mean 1; 1 where it is unknown."""
    known = True
    for f in range(weights.size):
        known = known and 0 < sigma[f, p] < np.inf
    for f in range(weights.size):
        weights[f] = 1 / np.float64(sigma[f, p]) if known else 1.0
    weights /= weights.mean()


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def turned(z: C128, rad_per_m: F64, unit: F64, turn: C128) -> tuple[float, float]:
    """Turn a pixel's phasors real, the grid starting at the range that the first one reads.

    Parameters
    ----------
    z : ndarray, (F,), complex
        Phasors, none zero.
    rad_per_m : ndarray, (F,)
        Phase per range, rad/m.
    unit, turn : ndarray, (F,)
        Filled with the amplitudes, the largest one, and the factors that turn the grid.

    Returns
    -------
    moved_m, scale : float
        Range that the first frequency reads, m, and the amplitude that became one.
    """
    scale = np.abs(z).max()
    phase = np.arctan2(z[0].imag, z[0].real)
    moved_m = (phase if phase >= 0 else phase + 2 * np.pi) / rad_per_m[0]
    for f in range(z.size):
        unit[f] = abs(z[f]) / scale
        turn[f] = np.exp(1j * rad_per_m[f] * moved_m) * np.conj(z[f]) / abs(z[f])
    return moved_m, scale


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def window(moved_m: float, plan: Plan) -> tuple[int, int]:
    """Grid cells [first, last) whose ranges lie within the limits."""
    n = plan.n_cells
    if plan.period_m > 0:
        return 0, n
    first = int(np.ceil((-moved_m - plan.start_m) / plan.step_m))
    last = int(np.ceil((plan.limit_m - moved_m + 1e-9 - plan.start_m) / plan.step_m))
    return max(first, 0), min(last, n)
