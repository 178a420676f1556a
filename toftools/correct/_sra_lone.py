"""Pixels that one return explains, which need no linear program.

The fit of _sra_fit.py keeps as few returns as the noise asks for. Where one is enough, all that
the program would give is its start, and the best match on the range grid is as good a one.
Reference: ours. Inputs: phasors and the range grid. Fails where the best match is not near the
strongest return of the program: then the program answers, or a pixel that two lone returns explain
gets the one of the better match.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct._sra_fit import BLOCK, Bounds, fit_pixel, settle, weigh_pixel
from toftools.correct._sra_pixels import Plan, turned, window
from toftools.correct._sra_pricing import Grid, best_match
from toftools.types import F32


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def lone_returns(
    values: NDArray[np.complex64], sigma: F32, known: bool, usable: NDArray[np.bool_],
    grid: Grid, plan: Plan, bounds: Bounds,
) -> tuple[F32, F32]:  # fmt: skip
    """The return of every pixel that one explains.

    Parameters
    ----------
    values : ndarray, (F, P)
        Phasors.
    sigma : ndarray, (F, P) or (F, 1)
        Standard deviation of the real and of the imaginary part.
    known : bool
        Whether it is known.
    usable : ndarray, (P,), bool
        Pixels to answer.
    grid, plan, bounds
        The program and the limits of the fit.

    Returns
    -------
    range_m, amplitude : ndarray, (P,)
        Range and amplitude; NaN and 0 where one return is not enough.
    """
    n_freqs, n = values.shape
    range_m, amplitude = np.full(n, np.nan, np.float32), np.zeros(n, np.float32)
    for block in prange((n + BLOCK - 1) // BLOCK):
        z, turn = np.empty(n_freqs, np.complex128), np.empty(n_freqs, np.complex128)
        unit, weight = np.empty(n_freqs), np.empty(n_freqs)
        mean, cost = np.empty(2 * n_freqs), np.empty(grid.coarse.shape[1])
        matrix, right, rows = np.empty((2, 2)), np.empty(2), np.empty((2, 2))
        d, a = np.empty(1), np.empty(1)
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not usable[p]:
                continue
            weigh_pixel(values, sigma, known, p, bounds.epsilon, z, weight)
            moved_m, scale = turned(z, plan.rad_per_m, unit, turn)
            first, last = window(moved_m, plan)
            if last <= first:
                continue
            cell = best_match(grid.cells, grid.coarse, first, last, unit, turn, mean, cost)
            d[0] = moved_m + plan.start_m + plan.step_m * cell
            a[0] = scale * unit.mean()
            if not fit_pixel(z, weight, plan.rad_per_m, d, a, matrix, right, rows):
                continue
            _, excess = settle(z, weight, plan.rad_per_m, bounds, d, a, matrix, right, rows)
            if excess <= 1:
                range_m[p], amplitude[p] = max(d[0], 0.0), a[0]
    return range_m, amplitude
