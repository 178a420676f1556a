"""What both forms of SRA share: the range grid, returns on it, and the first of them.

Reference: the first tap above a share of the largest is the answer, as in ``scripts/SRA.m`` of the
release of Su et al., CVPR 2018; joining neighbouring cells at their mean is ours. Inputs: see each
function. Fails on nothing of its own; what SRA itself fails on is said in sra_lp.py.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.correct import INVALID, OK, REJECTED
from toftools.correct._wraps import longest_m
from toftools.types import F64, DepthMap, Phasors
from toftools.units import ambiguity_m

SIDES = 16
"""Corners of the polygon that stands for the circle of the complex modulus; a multiple of 4."""

GUARD_M = 0.05
"""A return up to this far below zero (that is, below a whole joint ambiguity) is one at zero."""

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


def first_return(
    ranges_m: F64, strengths: F64, first_share: float, period_m: float
) -> tuple[float, float, int]:
    """The nearest return that is strong enough, its share of the total, and their number.

    Parameters
    ----------
    ranges_m, strengths : ndarray, (L,)
        Returns.
    first_share : float
        Least strength, relative to the strongest.
    period_m : float
        Joint ambiguity range, m, or 0 if ranges do not repeat.

    Returns
    -------
    range_m : float
        Range, m; one within `GUARD_M` below zero counts as the first and is set to zero, since
        otherwise noise would send near objects to the far end.
    share : float
        Its share of the total strength.
    count : int
        Returns that are strong enough.

    Examples
    --------
    >>> first_return(np.array([2.0, 5.0, 14.98]), np.array([1.0, 0.5, 0.5]), 0.1, 15.0)
    (0.0, 0.25, 3)
    """
    strong = strengths >= first_share * strengths.max()
    unwrapped = ranges_m
    if period_m > 0:
        unwrapped = np.mod(ranges_m + GUARD_M, period_m) - GUARD_M
    k = int(np.argmin(np.where(strong, unwrapped, np.inf)))
    share = float(strengths[k] / strengths.sum())
    return max(float(unwrapped[k]), 0.0), share, int(strong.sum())


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


def depth_map(
    range_m: NDArray[Any],
    confidence: NDArray[Any],
    returns: NDArray[Any],
    usable: NDArray[np.bool_],
) -> DepthMap:
    """Answer of either SRA, with the state of every pixel.

    Parameters
    ----------
    range_m, confidence, returns : ndarray, (H, W)
        Range or NaN, share of the first return, number of returns.
    usable : ndarray, (H, W), bool
        Pixels for which an answer was tried.

    Returns
    -------
    DepthMap
        The answer; ``info["status"]`` is OK, INVALID, or REJECTED where no returns on the grid
        explain the phasors, ``info["status_counts"]`` how many there are of each.
    """
    answered = np.isfinite(range_m)
    status = np.where(answered, OK, np.where(usable, REJECTED, INVALID)).astype(np.uint8)
    names = {"ok": OK, "invalid": INVALID, "rejected": REJECTED}
    counts = {name: int((status == code).sum()) for name, code in names.items()}
    return DepthMap(
        range_m=range_m.astype(np.float32),
        confidence=confidence.astype(np.float32),
        info={"status": status, "status_counts": counts, "returns": returns},
    )
