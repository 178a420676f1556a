"""The table behind the fast SRA: one small linear program per cell, by revised simplex.

Per cell, with the phasors of two frequencies turned real to (a, b): minimise ``cost x`` subject to
``Phi x + residual = (a, 0, b, 0)`` and ``gauge(residual) <= epsilon (a + b)``, x >= 0. Written with
one column per grid cell, per corner of the two polygons and for the slack, that is 5 rows and
some thousand columns. The start, all residual and no return, breaks the bound; its excess costs
`PENALTY` per unit, so that one phase of the simplex method is enough.

Reference: the revised simplex method with an explicit inverse (G. B. Dantzig, textbook). Pricing
looks at every 16th, then every 4th, then every grid cell: the reduced costs are a trigonometric
polynomial of the range, so the coarse steps do most of the walking. Input: grid phasors and
cells; tested against scipy's HiGHS. A cell without a solution stays empty.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct._sra_grid import MERGE_CELLS, SIDES, TIE
from toftools.types import F32, F64

I64 = NDArray[np.int64]

ROWS = 5
MOST_RETURNS = 4
"""Five rows, of which at least one is taken by the slack or the residual."""
STRIDES = (16, 4, 1)
MOST_PIVOTS = 200
"""Per stride; some 20 are the rule."""
PENALTY = 100.0
"""Cost of excess residual; must exceed what a unit of residual can save, which is about 1."""
EXCESS = -1
"""Mark of the excess in the basis; it has no column and never comes back."""
TINY = 1e-9


def residual_columns() -> F64:
    """Columns of the residual and the slack, which follow those of the grid.

    Returns
    -------
    ndarray, (5, 2 SIDES + 1)
        Real and imaginary part per frequency, then the share in the gauge.
    """
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    columns = np.zeros((ROWS, 2 * SIDES + 1))
    for f in range(2):
        own = slice(f * SIDES, (f + 1) * SIDES)
        columns[2 * f, own], columns[2 * f + 1, own] = np.cos(angle), np.sin(angle)
    columns[4] = 1.0
    return columns


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def solve_cells(
    atoms: NDArray[np.complex128], first: I64, last: I64, ratio_rad: F64, phase_rad: F64,
    epsilon: float, residual: F64, cyclic: bool,
) -> tuple[F32, F32]:  # fmt: skip
    """Returns of every cell of the table.

    Parameters
    ----------
    atoms : ndarray, (2, N)
        Phasors of a unit return in each grid cell.
    first, last : ndarray, (S,)
        Grid cells [first, last) that each window may use.
    ratio_rad : ndarray, (A,)
        Amplitude ratios as angles, ``atan2(b, a)``.
    phase_rad : ndarray, (B,)
        Phases of the second frequency where the first one's is zero.
    epsilon : float
        Bound of the residual.
    residual : ndarray, (5, 2 SIDES + 1)
        From `residual_columns`.
    cyclic : bool
        Whether the last grid cell is a neighbour of the first.

    Returns
    -------
    position : ndarray, (S, A, B, 4), float32
        Returns in grid cells from the first, ascending.
    share : ndarray, (S, A, B, 4), float32
        Their shares of the total amplitude; 0 where there is no further return.
    """
    n_atoms = atoms.shape[1]
    shape = (first.size, ratio_rad.size, phase_rad.size, MOST_RETURNS)
    position, share = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for b in prange(phase_rad.size):
        columns = np.empty((ROWS, n_atoms + residual.shape[1]))
        columns[:, n_atoms:] = residual
        _turn(atoms, phase_rad[b], columns)
        cell, amount = np.empty(ROWS, np.int64), np.empty(ROWS)
        for s in range(first.size):
            for a in range(ratio_rad.size):
                goal = (np.cos(ratio_rad[a]), np.sin(ratio_rad[a]))
                n = solve(columns, n_atoms, first[s], last[s], goal, epsilon, cell, amount)
                period = n_atoms if cyclic else 0
                group(cell[:n], amount[:n], period, position[s, a, b], share[s, a, b])
    return position, share


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _turn(atoms: NDArray[np.complex128], phase_rad: float, columns: F64) -> None:
    """Write the columns of the grid, the second frequency turned by minus the phase."""
    cos, sin = np.cos(phase_rad), np.sin(phase_rad)
    for j in range(atoms.shape[1]):
        columns[0, j], columns[1, j] = atoms[0, j].real, atoms[0, j].imag
        columns[2, j] = atoms[1, j].real * cos + atoms[1, j].imag * sin
        columns[3, j] = atoms[1, j].imag * cos - atoms[1, j].real * sin
        columns[4, j] = 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def solve(
    columns: F64, n_atoms: int, first: int, last: int, goal: tuple[float, float],
    epsilon: float, cell: I64, amount: F64,
) -> int:  # fmt: skip
    """Solve one linear program.

    Parameters
    ----------
    columns : ndarray, (5, N + 2 SIDES + 1)
        Grid, residual and slack.
    n_atoms : int
        Number N of grid cells.
    first, last : int
        Grid cells [first, last) that may be used.
    goal : tuple of 2 floats
        Amplitudes (a, b) of the turned phasors.
    epsilon : float
        Bound of the residual.
    cell, amount : ndarray, (5,)
        Filled with the occupied cells and their amplitudes.

    Returns
    -------
    int
        How many cells are occupied; 0 if there is no solution.
    """
    basis, value, inverse = _start(n_atoms, goal, epsilon)
    cost = _costs(columns, n_atoms, goal)
    price, column = np.empty(ROWS), np.empty(ROWS)
    for stride in STRIDES:
        optimal = False
        for _ in range(MOST_PIVOTS):
            _prices(basis, inverse, cost, price)
            enter = _enter(columns, price, cost, first, last, stride)
            if enter < 0:
                optimal = True
                break
            for k in range(ROWS):
                column[k] = 0.0
                for i in range(ROWS):
                    column[k] += inverse[k, i] * columns[i, enter]
            if not _pivot(basis, value, inverse, column, enter):
                return 0
    return _read(basis, value, n_atoms, cell, amount) if optimal else 0


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _start(n_atoms: int, goal: tuple[float, float], epsilon: float) -> tuple[I64, F64, F64]:
    """Basis, its values and its inverse where everything is residual."""
    quarter = SIDES // 4
    basis = np.array([0, quarter, SIDES, SIDES + quarter, EXCESS])
    basis[:4] += n_atoms
    inverse = np.eye(ROWS)
    inverse[4] = 1.0
    inverse[4, 4] = -1.0
    total = goal[0] + goal[1]
    return basis, np.array([goal[0], 0.0, goal[1], 0.0, (1 - epsilon) * total]), inverse


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _costs(columns: F64, n_atoms: int, goal: tuple[float, float]) -> F64:
    """Cost of a unit of each grid cell: nearly one, a little less where the phases agree."""
    a, b = goal[0] / (goal[0] + goal[1]), goal[1] / (goal[0] + goal[1])
    cost = np.empty(n_atoms)
    for j in range(n_atoms):
        agreement = a * columns[0, j] + b * columns[2, j]
        cost[j] = 1 - TIE * agreement * agreement
    return cost


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _prices(basis: I64, inverse: F64, cost: F64, price: F64) -> None:
    """Simplex multipliers: cost of the basis times its inverse."""
    price[:] = 0.0
    for k in range(ROWS):
        unit = cost[basis[k]] if 0 <= basis[k] < cost.size else 0.0
        unit = PENALTY if basis[k] == EXCESS else unit
        for i in range(ROWS):
            price[i] += unit * inverse[k, i]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _enter(columns: F64, price: F64, cost: F64, first: int, last: int, stride: int) -> int:
    """Column that lowers the cost most per unit, or -1 if none does."""
    p0, p1, p2, p3, p4 = price[0], price[1], price[2], price[3], price[4]
    best, enter = TINY, -1
    for j in range(first, last, stride):
        worth = p0 * columns[0, j] + p1 * columns[1, j] + p2 * columns[2, j] + p3 * columns[3, j]
        if worth - cost[j] > best:
            best, enter = worth - cost[j], j
    for j in range(cost.size, columns.shape[1]):  # residual and slack cost nothing
        worth = p0 * columns[0, j] + p1 * columns[1, j] + p2 * columns[2, j] + p3 * columns[3, j]
        if worth + p4 > best:
            best, enter = worth + p4, j
    return enter


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _pivot(basis: I64, value: F64, inverse: F64, column: F64, enter: int) -> bool:
    """Exchange the entering column for the first basic value that it drives to zero."""
    leave, step = -1, np.inf
    for k in range(ROWS):
        if column[k] > TINY and value[k] < step * column[k]:
            leave, step = k, value[k] / column[k]
    if leave < 0:
        return False
    for i in range(ROWS):
        inverse[leave, i] /= column[leave]
    for k in range(ROWS):
        if k == leave:
            continue
        value[k] = max(value[k] - column[k] * step, 0.0)
        for i in range(ROWS):
            inverse[k, i] -= column[k] * inverse[leave, i]
    basis[leave], value[leave] = enter, step
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _read(basis: I64, value: F64, n_atoms: int, cell: I64, amount: F64) -> int:
    """Occupied grid cells of an optimal basis; none if the bound is still exceeded."""
    n = 0
    for k in range(ROWS):
        if basis[k] == EXCESS and value[k] > TINY:
            return 0
        if 0 <= basis[k] < n_atoms and value[k] > TINY:
            cell[n], amount[n] = basis[k], value[k]
            n += 1
    return n


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def group(cell: I64, amount: F64, period: int, position: F32, share: F32) -> None:
    """Join neighbouring occupied cells to returns, as `group_returns` does.

    Parameters
    ----------
    cell, amount : ndarray, (n,)
        Occupied cells and their amplitudes.
    period : int
        Cells of a cyclic grid, 0 for one with ends.
    position, share : ndarray, (4,)
        Filled with the returns' positions in cells and their shares of the total.
    """
    total, count, before = amount.sum(), -1, -MERGE_CELLS - 1
    for k in np.argsort(cell):
        if cell[k] - before > MERGE_CELLS:
            count += 1
        before = cell[k]
        weight = amount[k] / total
        position[count] += weight * cell[k]
        share[count] += weight
    for k in range(count + 1):
        position[k] /= share[k]
    if period > 0 and count > 0 and cell.min() + period - cell.max() <= MERGE_CELLS:
        both = share[0] + share[count]
        end = share[count] * (position[count] - period)
        position[0], share[0] = (share[0] * position[0] + end) / both, both
        position[count], share[count] = 0.0, 0.0
