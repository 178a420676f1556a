"""Small kernels that the forms of SRA share: returns of a pixel, and a symmetric system.

References: Cholesky's method is textbook; joining and choosing returns is that of `group_returns`
and `sorted_returns`, which tests hold against these. Inputs: arrays of a few numbers. Fails on
nothing of its own.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from toftools.correct._returns import GUARD_M
from toftools.correct._sra_grid import MERGE_CELLS
from toftools.types import F64

I64 = NDArray[np.int64]
C128 = NDArray[np.complex128]
SINGULAR = 1e-9
"""Share of a diagonal that must be left of it."""


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def unwrapped(range_m: float, period_m: float) -> float:
    """Range taken into one period that starts `GUARD_M` below zero.

    Parameters
    ----------
    range_m, period_m : float
        Range and period, m; a period of 0 changes nothing.

    Returns
    -------
    float
        Range, m.
    """
    if period_m == 0:
        return range_m
    moved_m = range_m + GUARD_M
    return float(moved_m - period_m * np.floor(moved_m / period_m) - GUARD_M)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def join(cell: I64, amount: F64, period: int, at: F64, strength: F64) -> int:
    """Join neighbouring occupied cells to returns, as `group_returns` does.

    Parameters
    ----------
    cell, amount : ndarray, (n,)
        Occupied cells and their amplitudes.
    period : int
        Cells of a cyclic grid, 0 for one with ends.
    at, strength : ndarray, (n or more,)
        Filled with the returns' positions in cells, ascending, and their amplitudes.

    Returns
    -------
    int
        Number of returns.
    """
    count, before = -1, -MERGE_CELLS - 1
    for k in np.argsort(cell):
        if count < 0 or cell[k] - before > MERGE_CELLS:
            count += 1
            at[count], strength[count] = 0.0, 0.0
        before = cell[k]
        at[count] += amount[k] * cell[k]
        strength[count] += amount[k]
    for k in range(count + 1):
        at[k] /= strength[k]
    if period > 0 and count > 0 and cell.min() + period - cell.max() <= MERGE_CELLS:
        both = strength[0] + strength[count]
        end = strength[count] * (at[count] - period)
        at[0], strength[0] = (strength[0] * at[0] + end) / both, both
        count -= 1
    return count + 1


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def sort_strong(range_m: F64, strength: F64, n: int, first_share: float) -> int:
    """Bring the returns that are strong enough to the front, nearest first.

    Parameters
    ----------
    range_m, strength : ndarray, (n or more,)
        Returns, rearranged in place.
    n : int
        Number of returns.
    first_share : float
        Least strength, relative to the strongest.

    Returns
    -------
    int
        How many are strong enough.
    """
    strongest = 0.0
    for k in range(n):
        strongest = max(strongest, strength[k])
    kept = 0
    for k in range(n):
        if strength[k] < first_share * strongest:
            continue
        r, s, j = range_m[k], strength[k], kept
        while j > 0 and range_m[j - 1] > r:
            range_m[j], strength[j] = range_m[j - 1], strength[j - 1]
            j -= 1
        range_m[j], strength[j] = r, s
        kept += 1
    return kept


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def cholesky(matrix: F64, n: int) -> bool:
    """Cholesky factor of the leading block, in place.

    Parameters
    ----------
    matrix : ndarray, (n or more, n or more)
        Symmetric; only the lower triangle is read and written.
    n : int
        Size of the block.

    Returns
    -------
    bool
        False where it is singular to working accuracy.
    """
    for i in range(n):
        scale = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total / matrix[j, j]
            elif total > SINGULAR * scale:
                matrix[i, i] = np.sqrt(total)
            else:
                return False
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def substitute(factor: F64, right: F64, n: int) -> None:
    """Solve with a Cholesky factor, in place.

    Parameters
    ----------
    factor : ndarray, (n or more, n or more)
        From `cholesky`.
    right : ndarray, (n or more,)
        Right-hand side; becomes the solution.
    n : int
        Size of the system.
    """
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]
