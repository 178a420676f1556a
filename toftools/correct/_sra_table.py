"""The table of the fast SRA for two frequencies, one linear program per node: see sra.py.

Reference: the reduction to two numbers is that of Freedman et al., ECCV 2014 (recalled). Inputs:
frequencies and the parameters of `sra`. Fails where the range grid cannot be made.
"""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct._sra_grid import range_grid
from toftools.correct._sra_pricing import Grid, make_grid
from toftools.correct._sra_simplex import make_work, read, solve
from toftools.correct._sra_small import join
from toftools.types import F32, F64
from toftools.units import TWO_PI, ambiguity_m, range_to_phase

CELLS_CIRCLE, CELLS_LIMITED = (128, 512), (64, 256)
"""Cells along the amplitude ratio, even so that equal amplitudes are a node, and the phase."""
WINDOW_M = 0.125
"""Step of the moved distance where the range is limited, and how far past the limits the returns
of a cell may lie: at 40/70 MHz false returns sit just past 4 m."""
MOST_RETURNS = 4
"""Occupied grid cells of two frequencies: five rows, one taken by the slack or the residual."""


class Table(NamedTuple):
    """The returns of every node, and how to find the node of a pixel.

    Parameters
    ----------
    range_m, share : ndarray, (S, A, B, 4)
        Returns relative to the moved distance, m, and their shares; 0 for no further return.
    turn_phase_rad : ndarray, (n,)
        Phase that the second frequency gains in 0..n-1 turns of the first, rad.
    turn_m : float
        Range of one turn of the first frequency, m.
    span_rad : float
        Phase covered by the B nodes.
    window_m : float
        Step of the S windows, m; infinite for one window.
    period_m : float
        Joint ambiguity, m; 0 where the range is limited.
    limit_m : float
        Range limit, m; infinite if none.
    ratio : float
        Second over first frequency.
    """

    range_m: F32
    share: F32
    turn_phase_rad: F64
    turn_m: float
    span_rad: float
    window_m: float
    period_m: float
    limit_m: float
    ratio: float


def make_table(freqs_hz: F64, *, grid_m: float, epsilon: float, max_range_m: float) -> Table:
    """Solve the linear program at every node.

    Parameters
    ----------
    freqs_hz : ndarray, (2,)
        Frequencies, Hz.
    grid_m, epsilon, max_range_m : float
        As in `sra`.

    Returns
    -------
    Table
        Returns of all nodes.
    """
    ranges_m, period_m = range_grid(freqs_hz, grid_m, max_range_m)
    ratio = float(freqs_hz[1] / freqs_hz[0])
    n_ratios, n_phases = CELLS_CIRCLE if period_m > 0 else CELLS_LIMITED
    turn_m, step_m = float(ambiguity_m(freqs_hz[0])), float(ranges_m[1] - ranges_m[0])
    if period_m > 0:
        n_turns, window_m, limit_m = round(period_m / turn_m), np.inf, np.inf
        first, last = np.array([0]), np.array([ranges_m.size])
    else:
        n_turns, window_m, limit_m = 1, min(WINDOW_M, turn_m), max_range_m
        # Lone returns must be nodes: between them the program finds small false returns.
        lone = Fraction(ratio).limit_denominator(n_phases // 4).denominator
        n_phases = lone * -(-n_phases // lone)
        start = window_m * np.arange(np.ceil(turn_m / window_m))  # d in [start, start + window_m)
        first = np.floor(-(start + window_m) / step_m).astype(np.int64)
        last = np.ceil((max_range_m - start) / step_m).astype(np.int64) + 1
        ranges_m = step_m * np.arange(first.min(), last.max())
    offset = round(ranges_m[0] / step_m)
    turn_phase = np.mod(range_to_phase(turn_m * np.arange(n_turns), freqs_hz[1]), TWO_PI)
    # The largest gap between neighbours on the circle: 2 pi / n if the frequencies fit exactly.
    span = np.diff(np.r_[np.sort(turn_phase), TWO_PI]).max()
    position, share = solve_nodes(
        make_grid(freqs_hz, ranges_m),
        np.stack([first - offset, last - offset]),
        np.linspace(0, np.pi / 2, n_ratios + 1),
        np.linspace(0, span, n_phases + 1),
        epsilon,
        period_m > 0,
    )
    range_m = np.where(share > 0, (position + offset) * step_m, 0).astype(np.float32)
    return Table(
        range_m,
        share,
        turn_phase,
        turn_m,
        float(span),
        window_m,
        period_m,
        limit_m,
        ratio,
    )


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def solve_nodes(
    grid: Grid, windows: NDArray[np.int64], ratio_rad: F64, phase_rad: F64, epsilon: float,
    cyclic: bool,
) -> tuple[F32, F32]:  # fmt: skip
    """Returns of every node of the table.

    Parameters
    ----------
    grid : Grid
        Unit returns.
    windows : ndarray, (2, S)
        Grid cells [first, last) that each window may use.
    ratio_rad : ndarray, (A,)
        Amplitude ratios as angles, ``atan2(b, a)``.
    phase_rad : ndarray, (B,)
        Phases of the second frequency where the first one's is zero.
    epsilon : float
        Bound of the residual.
    cyclic : bool
        Whether the last grid cell is a neighbour of the first.

    Returns
    -------
    position : ndarray, (S, A, B, 4), float32
        Returns in grid cells from the first, ascending.
    share : ndarray, (S, A, B, 4), float32
        Their shares of the total amplitude; 0 where there is no further return.
    """
    n_cells = grid.cells.shape[0]
    shape = (windows.shape[1], ratio_rad.size, phase_rad.size, MOST_RETURNS)
    position, share = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for b in prange(phase_rad.size):
        work, unit, weights = make_work(grid), np.empty(2), np.ones(2)
        turn = np.array([1.0 + 0.0j, np.exp(-1j * phase_rad[b])])
        cell, amount = np.empty(5, np.int64), np.empty(5)
        at, strength = np.empty(5), np.empty(5)
        for s in range(windows.shape[1]):
            for a in range(ratio_rad.size):
                unit[0], unit[1] = np.cos(ratio_rad[a]), np.sin(ratio_rad[a])
                found = 0
                if solve(grid, windows[0, s], windows[1, s], unit, turn, weights, epsilon, work):
                    found = read(work, n_cells, cell, amount)
                period = n_cells if cyclic else 0
                found = join(cell[:found], amount[:found], period, at, strength)
                for k in range(found):
                    position[s, a, b, k] = at[k]
                    share[s, a, b, k] = strength[k] / strength[:found].sum()
    return position, share
