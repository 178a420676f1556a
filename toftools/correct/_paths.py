"""Costs of hypotheses summed along straight paths through the image (semi-global matching).

Reference: H. Hirschmüller, "Stereo processing by semi-global matching and mutual information", IEEE
TPAMI 30 (2008) 328-341, equation 13. Inputs: hypotheses and costs of every pixel. Fails where a
region borders nothing of the same range.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools._turns import FAST
from toftools.types import F32, Bool

DEAREST = np.float32(20.0)
"""No hypothesis costs more: a whole neighbourhood can overrule any pixel."""
FAR_M = np.float32(1e6)


def aggregate(range_m: F32, cost: F32, valid: Bool, jump: float) -> F32:
    """Costs summed over straight paths through the image.

    Parameters
    ----------
    range_m, cost : ndarray, (T, H, W)
        Hypotheses, m, and their own costs.
    valid : ndarray, (H, W), bool
        Other pixels take no part.
    jump : float
        Cost of a step of 1 m or more.

    Returns
    -------
    ndarray, (T, H, W)
        ``sum_r L_r``, L_r the least cost of a path that comes along r and ends in the hypothesis.
    """
    with np.errstate(invalid="ignore"):
        ranges = np.where(np.isfinite(range_m), range_m, FAR_M).astype(np.float32)
    own = np.where(valid, cost, np.float32(0))
    total = np.zeros_like(own)
    # Rows first, and pixels of a row together: columns are the rows of the transposed image.
    for axes, aside in (((1, 0, 2), np.array([0, 1, -1])), ((2, 0, 1), np.array([0]))):
        # Copies, always: a read-only view of one pixel would be another flavour to the compiler.
        rows, costs = (a.transpose(axes).copy(order="C") for a in (ranges, own))
        mask = (valid if axes[0] == 1 else valid.T).copy(order="C")
        summed = np.zeros((2, *costs.shape), np.float32)
        _sweeps(rows, costs, mask, summed, aside, np.float32(jump))
        back = np.argsort(axes)
        total += summed[0].transpose(back)
        total += summed[1].transpose(back)
    return total


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _sweeps(
    range_m: F32, own: F32, valid: Bool, total: F32, aside: NDArray[np.int64], jump: np.float32
) -> None:
    """Paths down the rows into the first total, paths up into the second, side by side."""
    for way in prange(2):
        for dx in aside:
            _sweep(range_m, own, valid, total[way], 1 - 2 * way, dx, jump)


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _extend(
    here: F32, own: F32, there: F32, before: F32, jump: np.float32, best: F32, out: F32
) -> None:
    """Equation 13 for a row: own costs plus the cheapest way from the row before."""
    n = own.shape[0]
    base = before[0].copy()
    for s in range(1, n):
        for x in range(base.size):
            base[x] = min(base[x], before[s, x])
    for t in range(n):
        best[:] = DEAREST * jump
        for s in range(n):
            for x in range(base.size):
                step = min(abs(here[t, x] - there[s, x]), np.float32(1.0))
                best[x] = min(best[x], before[s, x] - base[x] + jump * step)
        for x in range(base.size):
            out[t, x] = own[t, x] + best[x]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _sweep(
    range_m: F32, own: F32, valid: Bool, total: F32, dy: int, dx: int, jump: np.float32
) -> None:
    """Add the costs along one direction, row by row; invalid pixels are stepped over."""
    height, n, width = own.shape
    # What the paths bring into a row: hypotheses and costs of the last valid pixel of each.
    there, before = np.zeros((n, width), np.float32), np.zeros((n, width), np.float32)
    began = np.zeros(width, np.bool_)
    out, best = np.empty((n, width), np.float32), np.empty(width, np.float32)
    for row in range(height):
        y = row if dy > 0 else height - 1 - row
        _extend(range_m[y], own[y], there, before, jump, best, out)
        for x in range(width):
            if valid[y, x]:
                for t in range(n):
                    before[t, x] = out[t, x] if began[x] else own[y, t, x]
                    there[t, x] = range_m[y, t, x]
                    total[y, t, x] += before[t, x]
                began[x] = True
        if dx != 0:
            _shift(there, before, began, dx)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _shift(there: F32, before: F32, began: Bool, dx: int) -> None:
    """Move the paths sideways; new ones enter at the border."""
    width = began.size
    for i in range(width):
        x = width - 1 - i if dx > 0 else i
        inside = 0 <= x - dx < width
        began[x] = began[x - dx] if inside else False
        for t in range(there.shape[0]):
            there[t, x] = there[t, x - dx] if inside else np.float32(0)
            before[t, x] = before[t, x - dx] if inside else np.float32(0)
