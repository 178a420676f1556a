"""Which of the likeliest ranges the neighbourhood prefers: `semi_global` on few pixels.

What one pixel's phases leave open, smoothness and the lean of multipath decide for a cell of
pixels; every pixel then puts first the likeliest of its candidates that agrees with its own cell or
one beside it. Reference: `semi_global` (after H. Hirschmueller, IEEE TPAMI 30 (2008)); on a grid of
`COLUMNS` columns its cost does not grow with the image. Inputs: two or more frequencies. Fails
where a thing is smaller than a cell and metres from what is around it: the likeliest stays first.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.camera import resized
from toftools.correct import kernel_input
from toftools.correct._net_coarse import MIDDLE_ALBEDO, grid
from toftools.correct.semi_global import semi_global
from toftools.types import C64, F32, Bool, DepthMap, Phasors, Sensor

COLUMNS = 80
AGREES_M = 0.3
"""Distance, in metres of the trained frequencies, up to which a candidate agrees with a cell."""


@dataclass(frozen=True, eq=False)
class Guide:
    """The coarse unwrapping.

    Parameters
    ----------
    run : callable
        Phasors of the cells to ranges.
    rows, columns : ndarray
        First row of every row of cells, and the end; the same of columns.
    agrees_m : float
        Distance up to which a candidate agrees, m.
    """

    run: Callable[[Phasors], DepthMap]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    agrees_m: float


def guide_of(sensor: Sensor, metre: float, max_range_m: float) -> Guide:
    """Prepare for a sensor.

    Parameters
    ----------
    sensor : Sensor
        Two frequencies or more.
    metre : float
        Ratio of its frequencies to those trained.
    max_range_m : float
        Longest range, m.

    Returns
    -------
    Guide
        For frames of the camera's shape.
    """
    height, width = sensor.camera.shape
    rows, columns = grid(sensor.camera.shape, COLUMNS)
    small = replace(sensor, camera=resized(sensor.camera, columns, rows), maps=None)
    run = semi_global(small, max_range_m=max_range_m)
    return Guide(run, _edges(rows, height), _edges(columns, width), AGREES_M / metre)


def _edges(cells: int, pixels: int) -> NDArray[np.int64]:
    """First pixel of every cell, and the end."""
    return np.arange(cells + 1, dtype=np.int64) * pixels // cells


def prefer(candidates_m: F32, values: C64, lit: Bool, dim: F32, guide: Guide) -> None:
    """Put the candidate first that the neighbourhood prefers; the others keep their order.

    Parameters
    ----------
    candidates_m : ndarray, (K, H, W)
        Ranges, likeliest first, m; reordered in place.
    values : ndarray, (F, H, W)
        Phasors, in any unit, complex64.
    lit : ndarray, (H, W), bool
        Pixels with a signal.
    dim : ndarray, (H, W)
        One over the amplitude of a white surface facing the camera at 1 m.
    guide : Guide
        Of the sensor.
    """
    thin = (slice(None, None, 4), slice(None, None, 4))
    if not lit[thin].any():
        thin = (slice(None), slice(None))
    lit_px = lit[thin]
    bright = np.abs(values[0][thin][lit_px]) * candidates_m[0][thin][lit_px] ** 2
    bright *= dim[thin][lit_px]
    middle = float(np.median(bright)) if bright.size else 1.0
    shape = (values.shape[0], guide.rows.size - 1, guide.columns.size - 1)
    cells = np.empty(shape, np.complex64)
    gain = np.float32(MIDDLE_ALBEDO / max(middle, 1e-20))
    _means(kernel_input(values), kernel_input(lit), guide.rows, guide.columns, gain, cells)
    known = np.abs(cells).min(axis=0) > 0
    around = guide.run(Phasors(cells, valid=known)).range_m
    _order(candidates_m, kernel_input(around), guide.rows, guide.columns,
           np.float32(guide.agrees_m))  # fmt: skip


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _means(
    values: C64, lit: Bool, rows: NDArray[np.int64], columns: NDArray[np.int64], gain: np.float32,
    out: C64,
) -> None:  # fmt: skip
    """Mean phasor of every cell; zero without any pixel that is lit."""
    for r in prange(rows.size - 1):
        for c in range(columns.size - 1):
            for f in range(values.shape[0]):
                total, count = np.complex64(0), 0
                for v in range(rows[r], rows[r + 1]):
                    for u in range(columns[c], columns[c + 1]):
                        if lit[v, u]:
                            total += values[f, v, u]
                            count += 1
                out[f, r, c] = total * gain / np.float32(max(count, 1))


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _order(
    candidates: F32, around: F32, rows: NDArray[np.int64], columns: NDArray[np.int64],
    agrees: np.float32,
) -> None:  # fmt: skip
    """Put the first candidate in front that agrees with the cell or one of the four beside it."""
    for r in prange(rows.size - 1):
        for v in range(rows[r], rows[r + 1]):
            for c in range(columns.size - 1):
                own = around[r, c]
                for u in range(columns[c], columns[c + 1]):
                    if abs(candidates[0, v, u] - own) < agrees:
                        continue
                    chosen = _chosen(candidates[:, v, u], around, r, c, agrees)
                    first = candidates[chosen, v, u]
                    for k in range(chosen, 0, -1):
                        candidates[k, v, u] = candidates[k - 1, v, u]
                    candidates[0, v, u] = first


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _chosen(mine: F32, around: F32, r: int, c: int, agrees: np.float32) -> int:
    """Index of the likeliest candidate that agrees with a cell nearby; 0 if none does."""
    for own in (True, False):
        for k in range(mine.size):
            for dr, dc in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
                if own != (dr == 0 and dc == 0):
                    continue
                row, col = r + dr, c + dc
                inside = 0 <= row < around.shape[0] and 0 <= col < around.shape[1]
                if inside and abs(mine[k] - around[row, col]) < agrees:
                    return k
    return 0
