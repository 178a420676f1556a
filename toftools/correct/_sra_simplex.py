"""The linear program of SRA for any number of frequencies, by the revised simplex method.

With the F phasors turned real and scaled to ``u_f``: minimise ``cost x`` subject to
``Phi x + residual = u`` and ``sum_f w_f gauge(residual_f) <= epsilon sum_f w_f u_f``, x >= 0.
Written with one column per grid cell, per corner of the F polygons and for the slack, that is
2 F + 1 rows and some thousand columns. The start, all residual and no return, breaks the bound;
its excess costs `PENALTY` per unit, so that one phase of the method is enough.

Reference: the revised simplex method with an explicit inverse (G. B. Dantzig, textbook). The best
match enters first, then every 16th cell is tried, then those near occupied ones, and at last all
that the bound of _sra_pricing.py does not exclude: the answer is that of the whole program.
Input: grid phasors; tested against scipy's HiGHS. A pixel without a solution gets no returns.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from toftools.correct._sra_grid import SIDES
from toftools.correct._sra_pricing import (
    TINY,
    Grid,
    best_match,
    enter_all,
    enter_coarse,
    enter_near,
    enter_residual,
    least_gain,
    unit_cost,
)
from toftools.types import F64

I64 = NDArray[np.int64]
C128 = NDArray[np.complex128]

COARSE, NEAR, ALL = range(3)
MOST_PIVOTS = 400
"""About 20 are the rule."""
PENALTY = 100.0
"""Cost of excess residual; must exceed what a unit of residual can save, which is about 1."""
EXCESS = -1
"""Mark of the excess in the basis; it has no column and never comes back."""
LANES = 8
"""Rows are padded to whole vectors."""


class Work(NamedTuple):
    """Arrays of one solver, used again for every pixel.

    Parameters
    ----------
    basis, value, cost : ndarray, (R,)
        Columns in the basis, their values and unit costs; R = 2 F + 1.
    inverse : ndarray, (R, R padded)
        Transposed inverse of their matrix.
    column : ndarray, (R padded,)
        Entering column in terms of the basis.
    price : ndarray, (R,)
        Multipliers.
    turned, mean : ndarray, (2 F,)
        Multipliers, and the amplitudes' shares, turned to the grid's own phases.
    coarse_cost, gain : ndarray, (ceil(N / 16),)
        Unit cost of every 16th cell, and what it would gain.
    """

    basis: I64
    value: F64
    cost: F64
    inverse: F64
    column: F64
    price: F64
    turned: F64
    mean: F64
    coarse_cost: F64
    gain: F64


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def make_work(grid: Grid) -> Work:
    """Arrays for one solver.

    Parameters
    ----------
    grid : Grid
        Unit returns.

    Returns
    -------
    Work
        Arrays whose content is of no importance.
    """
    two_f, n = grid.coarse.shape
    rows, padded = two_f + 1, -(-(two_f + 1) // LANES) * LANES
    return Work(
        np.empty(rows, np.int64), np.empty(rows), np.empty(rows), np.zeros((rows, padded)),
        np.zeros(padded), np.empty(rows), np.empty(two_f), np.empty(two_f), np.empty(n),
        np.empty(n),
    )  # fmt: skip


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def solve(
    grid: Grid, first: int, last: int, unit: F64, turn: C128, weights: F64,
    epsilon: float, work: Work,
) -> bool:  # fmt: skip
    """Solve one linear program; `read` gives the cells.

    Parameters
    ----------
    grid : Grid
        Unit returns.
    first, last : int
        Grid cells [first, last) that may be used.
    unit : ndarray, (F,)
        Amplitudes, the largest of them about one.
    turn : ndarray, (F,), complex
        Factor that turns the grid so that the measured phasors are real.
    weights : ndarray, (F,)
        Weight of each frequency in the residual bound.
    epsilon : float
        Bound of the residual.
    work : Work
        Arrays; `basis` and `value` hold the solution.

    Returns
    -------
    bool
        Whether an optimum was found.
    """
    # Arrays, not tuples of them, go into what is called often: each tuple counts references.
    cells, coarse, rise, corners = grid.cells, grid.coarse, grid.rise, grid.corners
    basis, value, cost, inverse, column = (
        work.basis, work.value, work.cost, work.inverse, work.column,
    )  # fmt: skip
    price, turned, mean, coarse_cost, gains = (
        work.price, work.turned, work.mean, work.coarse_cost, work.gain,
    )  # fmt: skip
    enter = best_match(cells, coarse, first, last, unit, turn, mean, coarse_cost)
    _start(grid, unit, turn, weights, epsilon, enter, work)
    reach = COARSE
    for _ in range(MOST_PIVOTS):
        if enter < 0 and reach == ALL:
            return True
        if enter < 0:
            reach += 1
        else:
            reach = min(reach, NEAR)
            _column(cells, corners, turn, weights, enter, inverse, column)
            each = unit_cost(cells, enter, mean) if enter < cells.shape[0] else 0.0
            if not _pivot(basis, value, cost, inverse, column, enter, each):
                return False
            _prices(turn, cost, inverse, price, turned)
        gain, enter = enter_residual(cells.shape[0], corners, weights, price)
        if reach == NEAR:
            gain_cell, cell = enter_near(cells, first, last, turned, mean, basis)
        else:
            gain_cell, cell = enter_coarse(coarse, first, last, turned, coarse_cost, gains)
        if reach == ALL:
            least = least_gain(rise, price)
            gain_cell, cell = enter_all(cells, first, last, turned, mean, gains, least)
        enter = cell if gain_cell > gain else enter
    return False


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _start(
    grid: Grid, unit: F64, turn: C128, weights: F64, epsilon: float, cell: int, work: Work
) -> None:
    """Basis, its values and its inverse where everything is residual.

    Of each frequency's two corners one points at the phasor, and one to where the residual goes
    once the cell is occupied.
    """
    rows, n_cells = work.basis.size, grid.cells.shape[0]
    work.inverse[:] = 0.0
    work.value[:] = 0.0
    work.cost[:] = 0.0
    for f in range(unit.size):
        i, k = 2 * f, 2 * f + 1
        ahead = (grid.cells[cell, i] * turn[f].imag + grid.cells[cell, k] * turn[f].real) <= 0
        side = 1 if ahead else SIDES - 1
        work.basis[i], work.basis[k] = n_cells + f * SIDES, n_cells + f * SIDES + side
        cos, sin = grid.corners[0, side], grid.corners[1, side]
        work.value[i] = unit[f]
        work.value[rows - 1] += (1 - epsilon) * weights[f] * unit[f]
        work.inverse[i, i] = 1.0
        work.inverse[k, i] = -cos / sin
        work.inverse[k, k] = 1 / sin
        work.inverse[i, rows - 1] = weights[f]
        work.inverse[k, rows - 1] = weights[f] * (1 - cos) / sin
    work.basis[rows - 1], work.cost[rows - 1] = EXCESS, PENALTY
    work.inverse[rows - 1, rows - 1] = -1.0


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _prices(turn: C128, cost: F64, inverse: F64, price: F64, turned: F64) -> None:
    """Simplex multipliers: cost of the basis times its inverse; and turned to the grid."""
    for i in range(price.size):
        price[i] = 0.0
        for k in range(price.size):
            price[i] += cost[k] * inverse[i, k]
    for f in range(turn.size):
        re, im = price[2 * f], price[2 * f + 1]
        turned[2 * f] = re * turn[f].real + im * turn[f].imag
        turned[2 * f + 1] = im * turn[f].real - re * turn[f].imag


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _column(
    cells: F64, corners: F64, turn: C128, weights: F64, enter: int, inverse: F64, column: F64
) -> None:
    """Entering column in terms of the basis."""
    n_cells, last = cells.shape[0], inverse.shape[0] - 1
    column[:] = 0.0
    if enter < n_cells:
        for f in range(turn.size):
            re, im = cells[enter, 2 * f], cells[enter, 2 * f + 1]
            _add(inverse, column, 2 * f, re * turn[f].real - im * turn[f].imag)
            _add(inverse, column, 2 * f + 1, re * turn[f].imag + im * turn[f].real)
        return
    f, s = (enter - n_cells) // SIDES, (enter - n_cells) % SIDES
    if f < turn.size:
        _add(inverse, column, 2 * f, corners[0, s])
        _add(inverse, column, 2 * f + 1, corners[1, s])
        _add(inverse, column, last, weights[f])
    else:
        _add(inverse, column, last, 1.0)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _add(inverse: F64, column: F64, i: int, factor: float) -> None:
    for k in range(column.size):
        column[k] += factor * inverse[i, k]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _pivot(
    basis: I64, value: F64, cost: F64, inverse: F64, column: F64, enter: int, each: float
) -> bool:
    """Exchange the entering column for the first basic value that it drives to zero."""
    leave, step = -1, np.inf
    for k in range(value.size):
        if column[k] > TINY and value[k] < step * column[k]:
            leave, step = k, value[k] / column[k]
    if leave < 0:
        return False
    for i in range(value.size):
        share = inverse[i, leave] / column[leave]
        for k in range(column.size):
            inverse[i, k] -= share * column[k]
        inverse[i, leave] = share
    for k in range(value.size):
        value[k] = max(value[k] - column[k] * step, 0.0)
    basis[leave], value[leave], cost[leave] = enter, step, each
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def read(work: Work, n_cells: int, cell: I64, amount: F64) -> int:
    """Occupied grid cells of an optimal basis; none if the bound is still exceeded.

    Parameters
    ----------
    work : Work
        As `solve` left it.
    n_cells : int
        Number of grid cells.
    cell, amount : ndarray, (R,)
        Filled with the occupied cells and their amplitudes.

    Returns
    -------
    int
        How many cells are occupied; 0 if there is no solution.
    """
    n = 0
    for k in range(work.basis.size):
        if work.basis[k] == EXCESS and work.value[k] > TINY:
            return 0
        if 0 <= work.basis[k] < n_cells and work.value[k] > TINY:
            cell[n], amount[n] = work.basis[k], work.value[k]
            n += 1
    return n
