"""Second chances: where else to start a fit of L returns, given the fit of L - 1.

Proposals of the published methods are at times so poor that the fit ends in a false minimum, or
with a negative amplitude: roots meet when two returns happen to be a quarter turn apart, a grid
offers one return between two. Reference: ours; `add` is the next step of orthogonal matching
pursuit (Pati, Rezaiifar, Krishnaprasad, Asilomar 1993) after a fit instead of on a grid. Inputs:
phasors and the fit so far. Fails where the residual is noise.
"""

import numpy as np

from toftools.correct._spectral_fit import Fit
from toftools.correct._spectral_roots import Complexes
from toftools.types import F64

APART_RAD = 0.5
"""Half the distance of a return split in two, at the highest frequency."""
CELL_RAD = 0.5
"""Grid for the next return, at the highest frequency."""
MOST_CELLS = 4096
"""Longer ranges get a coarser grid."""
AT_ONCE = 2**20
"""Scores held at a time."""


def split(z: Complexes, noise: F64, k: F64, before: Fit, order: int, period_m: float) -> F64:
    """Ranges to start from: the strongest return so far, split in two.

    Parameters
    ----------
    z : ndarray, (F, P), complex
        Phasors.
    noise : ndarray, (F, P)
        Standard deviation of their components.
    k : ndarray, (F,)
        ``4 pi f / c``, rad/m.
    before : Fit
        Fit of ``order - 1`` returns, (>= order, P).
    order : int
        Number of returns wanted.
    period_m : float
        Range after which all phases repeat, m.

    Returns
    -------
    ndarray, (order, P)
        Ranges, m.
    """
    ranges_m = before.ranges_m[:order].copy()
    strongest = before.amplitudes[: order - 1].argmax(axis=0)[None]
    middle = np.take_along_axis(ranges_m, strongest, axis=0)
    np.put_along_axis(ranges_m, strongest, middle - APART_RAD / k.max(), axis=0)
    ranges_m[-1] = middle[0] + APART_RAD / k.max()
    return ranges_m


def add(z: Complexes, noise: F64, k: F64, before: Fit, order: int, period_m: float) -> F64:
    """Ranges to start from: the returns so far, and the one that agrees best with the residual.

    Parameters
    ----------
    z, noise, k, before, order, period_m
        As for `split`.

    Returns
    -------
    ndarray, (order, P)
        Ranges, m.
    """
    ranges_m = before.ranges_m[:order].copy()
    rest = z.copy()
    for d, a in zip(before.ranges_m[: order - 1], before.amplitudes[: order - 1], strict=True):
        rest -= a * np.exp(1j * k[:, None] * np.nan_to_num(d))
    rest /= noise**2
    parts = np.concatenate([rest.real, rest.imag])
    cells = int(min(np.ceil(period_m * k.max() / CELL_RAD), MOST_CELLS))
    grid = np.arange(cells) * (period_m / cells)
    table = np.concatenate([np.cos(k[:, None] * grid), np.sin(k[:, None] * grid)]).T
    step = max(AT_ONCE // cells, 1)
    for i in range(0, z.shape[1], step):
        ranges_m[-1, i : i + step] = grid[(table @ parts[:, i : i + step]).argmax(axis=0)]
    return ranges_m
