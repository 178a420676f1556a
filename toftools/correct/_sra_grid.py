"""What all forms of SRA share: the range grid, returns on it, what is refused.

Reference: Freedman et al., ECCV 2014, has the grid; joining neighbouring cells at their mean is
ours. Inputs: see each function. Fails on nothing of its own; what SRA fails on: see sra_lp.py.
"""

import numpy as np
from numpy.typing import NDArray

from toftools.correct._wraps import longest_m
from toftools.types import F64, Phasors
from toftools.units import ambiguity_m

SIDES = 16
"""Corners of the polygon that stands for the circle of the complex modulus; a multiple of 4."""

MERGE_CELLS = 2
"""Occupied grid cells at most this far apart are one return between them."""

TIE = 1e-3
"""Rebate on returns that agree with all phases, which picks one of several equal optima."""

MAX_CELLS = 10_000
"""More grid cells than this are refused: the linear programs would take minutes."""


def range_grid(freqs_hz: F64, grid_m: float, max_range_m: float) -> tuple[F64, float]:
    """Grid of one pixel, relative to the range that its first frequency reads without wraps.

    A grid that starts at the pixel's own phase moves with the surface: the answer does not depend
    on where a surface lies between the cells of a fixed grid.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    grid_m : float
        Wanted step, m.
    max_range_m : float
        Longest range, m; 0, or anything from an exact joint ambiguity up, means the joint
        ambiguity.

    Returns
    -------
    ranges_m : ndarray, (N,)
        Equidistant relative ranges, m, a whole number for each turn of the first frequency, so
        that lone returns lie on the grid. The joint ambiguity is a circle; with a limit they go
        from minus one turn to the limit, and a pixel may use those that its own range takes to
        [0, max_range_m].
    period_m : float
        Joint ambiguity range, m; 0 where the range is limited.

    Raises
    ------
    ValueError
        If the grid has fewer than 2 or more than `MAX_CELLS` cells.

    Examples
    --------
    >>> ranges_m, period_m = range_grid(np.array([40e6, 70e6]), 0.01, 0.0)
    >>> ranges_m.size, round(period_m, 3)
    (1500, 14.99)
    >>> ranges_m, period_m = range_grid(np.array([40e6, 70e6]), 0.01, 2.0)
    >>> ranges_m[[0, -1]].round(2).tolist(), period_m
    ([-3.75, 2.0], 0.0)
    """
    longest = longest_m(freqs_hz, max_range_m)
    cyclic = max_range_m == 0 or longest_m(freqs_hz, 2 * max_range_m) <= max_range_m
    turn_m = float(ambiguity_m(freqs_hz[0]))
    per_turn = max(round(turn_m / grid_m), 1)
    if cyclic:
        begin, end = 0, per_turn * round(longest / turn_m)
        step_m = longest / end
    else:
        step_m = turn_m / per_turn
        begin, end = -per_turn, int(longest / step_m + 1e-9) + 1
    if not 2 <= end - begin <= MAX_CELLS:
        msg = (
            f"grid_m={grid_m} makes {end - begin} range cells, wanted 2..{MAX_CELLS}; "
            "change grid_m or limit max_range_m"
        )
        raise ValueError(msg)
    return np.asarray(step_m * np.arange(begin, end)), longest if cyclic else 0.0


def group_returns(amounts: F64, step_m: float, *, cyclic: bool) -> tuple[F64, F64]:
    """Returns of a solution on the grid: neighbouring occupied cells are one, at their mean.

    Parameters
    ----------
    amounts : ndarray, (N,)
        Amplitude per grid cell, not all zero.
    step_m : float
        Grid step, m.
    cyclic : bool
        Whether the last cell is a neighbour of the first.

    Returns
    -------
    ranges_m : ndarray, (L,)
        Ranges in ascending order, m; a return across the end of a cyclic grid comes first and
        may be slightly negative.
    strengths : ndarray, (L,)
        Amplitudes.

    Examples
    --------
    >>> group_returns(np.array([0, 1.0, 3.0, 0, 0, 0, 2.0]), 0.1, cyclic=False)
    (array([0.175, 0.6  ]), array([4., 2.]))
    """
    cells = np.flatnonzero(amounts > 1e-9 * amounts.sum())
    groups = np.split(cells, np.flatnonzero(np.diff(cells) > MERGE_CELLS) + 1)
    gap_across_end = groups[0][0] + amounts.size - groups[-1][-1]
    if cyclic and len(groups) > 1 and gap_across_end <= MERGE_CELLS:
        groups = [np.r_[groups[-1] - amounts.size, groups[0]], *groups[1:-1]]
    strengths = np.array([amounts[group].sum() for group in groups])
    moments = np.array([group @ amounts[group] for group in groups])
    return step_m * moments / strengths, strengths


def check_parameters(grid_m: float, epsilon: float, first_share: float) -> None:
    """Refuse parameters that no linear program can use.

    Parameters
    ----------
    grid_m, epsilon, first_share : float
        As in `sra_lp`.

    Raises
    ------
    ValueError
        If one is out of range.
    """
    if not 0 < grid_m < np.inf:
        msg = f"grid_m must be a positive number of metres, got {grid_m}"
        raise ValueError(msg)
    if not (0 < epsilon < 1 and 0 <= first_share <= 1):
        msg = f"epsilon must lie in (0, 1) and first_share in [0, 1], got {epsilon, first_share}"
        raise ValueError(msg)


def usable_pixels(phasors: Phasors, n_freqs: int) -> NDArray[np.bool_]:
    """Pixels that are valid and have light at every frequency.

    Parameters
    ----------
    phasors : Phasors
        Measurement.
    n_freqs : int
        Frequencies of the sensor.

    Returns
    -------
    ndarray, (H, W), bool
        True where an answer can be tried.

    Raises
    ------
    ValueError
        If the phasors have another number of frequencies than the sensor.
    """
    if phasors.values.shape[0] != n_freqs:
        msg = f"phasors must have {n_freqs} frequencies, got {phasors.values.shape[0]}"
        raise ValueError(msg)
    return np.asarray(phasors.valid & (phasors.values != 0).all(axis=0))
