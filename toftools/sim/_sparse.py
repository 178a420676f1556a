"""Sparse gather with an error bound: irradiance at few pixels, and weights that give all others.

Irradiance is smooth over surfaces, so that its interpolation errs to second order in the size of
a cell. Cells of the image are split where that error weighs most. The second differences are taken
of what was gathered, visibility included, in place of the analytic Hessians of media radiance
there: the middles of a cell are compared with what its corners predict (eq. 2.20), a split leaves a
quarter of that, and cells are split until the sum of squares meets the tolerance. A random set of
pixels that were not sampled then audits the answer, which is refined where it is found wanting.

Fails where light changes between the samples of the first cells and the audit meets none of it:
the error is that of a stratified sample of a thousand pixels, no bound for each.

References
----------
J. Marco, "Transient Light Transport", PhD thesis, Universidad de Zaragoza, 2018, section 2.5.
"""

from dataclasses import dataclass, replace

import numpy as np

from toftools.sim._sparse_cells import (
    C128,
    Cells,
    Errors,
    Evaluate,
    Picked,
    added,
    bilinear,
    chosen,
    first_cells,
    nodes,
    split,
    strangers,
)
from toftools.sim._sparse_rows import Ground, Ints, Sparse, Surface, ground_of, rows
from toftools.types import F64, Bool

__all__ = ["Plan", "Surface", "place", "spread"]

AUDIT = 1024
"""Pixels of one audit: a third evenly, one where cells err, one where no cell serves."""
AUDITS = 6
"""Audits at most."""
SAFETY = 0.8
"""Share of the tolerance that cells may spend, since audits scatter."""
HASTE = 0.75
"""Smallest share of the budget that an audit leaves; what it hit is split in any case."""
HOPELESS_M = 1e3
"""What an infinite error counts for."""
LEAST_SIDE = 4
"""Smaller images, px, are sampled whole."""
SEED = 20180
"""Of the audits."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Sampled pixels, and the weights by which they give all others.

    Parameters
    ----------
    shape : tuple of int
        H, W.
    pixels : ndarray of int, (S,)
        Flat pixel numbers.
    matrix : csr_array, (H W, S)
        Weights; rows sum to 1, and are empty where invalid.
    error_m : float
        Estimated root mean square error over the valid pixels, m of range.
    values : ndarray, (C, S), complex
        Values at `pixels` of the run that placed them; (0, 0) if no pixel is valid.
    """

    shape: tuple[int, int]
    pixels: Ints
    matrix: Sparse
    error_m: float
    values: C128


def place(surface: Surface, evaluate: Evaluate, errors_m: Errors, tol_m: float) -> Plan:
    """Choose pixels from which all others follow with an error below a tolerance.

    Parameters
    ----------
    surface : Surface
        What each pixel sees, (H, W).
    evaluate : callable
        From pixel numbers (n,) to irradiance phasors (C, n); the same pixels, the same values.
    errors_m : callable
        From errors of such values (C, n) and their pixel numbers (n,) to errors of range (n,), m;
        NaN counts as none.
    tol_m : float
        Root mean square error over the valid pixels, m; 0 samples all.

    Returns
    -------
    Plan
        Samples, weights, and the error that the last audit found.

    References
    ----------
    Marco 2018, eq. (2.20), with second differences in place of the Hessian.
    """
    ground = ground_of(surface)
    valid = np.flatnonzero(ground.valid)
    slot = np.full(ground.valid.size, -1)
    nothing = Picked(np.zeros(0, np.int64), np.zeros((0, 0), np.complex128), slot)
    if tol_m <= 0 or min(ground.shape) < LEAST_SIDE or not len(valid):
        picked = added(nothing, evaluate, valid)
        return _plan(ground, picked, _identity(picked), 0.0)

    def error(delta: C128, pixels: Ints) -> F64:
        return np.nan_to_num(np.abs(errors_m(delta, pixels)), posinf=HOPELESS_M)

    tools = (evaluate, error)
    cells = first_cells(ground.shape)
    picked = added(nothing, evaluate, _first_pixels(ground, cells))
    budget, rng = (SAFETY * tol_m) ** 2 * len(valid), np.random.default_rng(SEED)
    for audit in range(AUDITS):
        while (choice := chosen(ground, cells, picked.slot, budget)).any():
            cells, picked = split(ground, cells, picked, choice, tools)
        picked, matrix, found_m, cells = _audited(ground, cells, picked, tools, rng)
        if found_m <= tol_m or audit == AUDITS - 1:
            break
        budget *= max(HASTE, (SAFETY * tol_m / found_m) ** 2)
    return _plan(ground, picked, matrix, found_m)


def spread(plan: Plan, values: C128) -> C128:
    """Values at all pixels from values at the sampled ones.

    Parameters
    ----------
    plan : Plan
        Of `place`.
    values : ndarray, (C, S)
        At `plan.pixels`.

    Returns
    -------
    ndarray, (C, H, W)
        Zero where invalid.
    """
    return np.asarray((plan.matrix @ values.T).T.reshape(len(values), *plan.shape))


def _first_pixels(ground: Ground, cells: Cells) -> Ints:
    """Corners of the first cells, and what they would miss."""
    corners = np.unique(nodes(cells, ground.shape)[0][:, ::2, ::2])
    corners = corners[ground.valid[corners]]
    slot = np.full(ground.valid.size, -1)
    slot[corners] = 0
    return np.append(corners, strangers(ground, cells, slot, ground.valid))


def _audited(
    ground: Ground,
    cells: Cells,
    picked: Picked,
    tools: tuple[Evaluate, Errors],
    rng: np.random.Generator,
) -> tuple[Picked, Sparse, float, Cells]:
    """Interpolate all pixels, sample what nothing serves, and measure the error of the rest."""
    open_ = np.flatnonzero(ground.valid & (picked.slot < 0))
    corners, weights = bilinear(cells, cells.home[open_], open_, ground.shape)
    matrix, served = rows(ground, open_, corners, weights, picked.slot)
    fitted = np.diff(matrix.indptr) > 4
    tried, share = _drawn((cells.error_m[cells.home[open_]], fitted), served, rng)
    pixels = open_[tried]
    guess = (matrix[tried] @ picked.values.T).T
    picked = added(picked, tools[0], np.concatenate([pixels, open_[~served]]))
    wrong = tools[1](picked.values[:, picked.slot[pixels]] - guess, pixels)
    found = float(np.sum(wrong**2 / share))
    worst = cells.error_m.copy()
    np.maximum.at(worst, cells.home[pixels], wrong)
    cells = replace(cells, error_m=worst)
    whole = _identity(picked) + _scattered(matrix, open_, picked)
    return picked, whole, float(np.sqrt(found / ground.valid.sum())), cells


def _drawn(
    suspicions: tuple[F64, Bool], served: Bool, rng: np.random.Generator
) -> tuple[Ints, F64]:
    """Pixels for an audit, a share evenly and one by each suspicion, and how many are expected."""
    among = np.flatnonzero(served)
    if not len(among):
        return among, np.zeros(0)
    count, odds = min(AUDIT, len(among)), np.full(len(among), 1.0 / len(among))
    for suspicion in suspicions:
        heavy = np.where(np.isfinite(suspicion), suspicion, 0.0)[among]
        odds += heavy / heavy.sum() if heavy.any() else 1.0 / len(among)
    odds /= odds.sum()
    ticks = (np.arange(count) + rng.random(count)) / count
    drawn = np.searchsorted(np.cumsum(odds), ticks).clip(max=len(among) - 1)
    return among[drawn], count * odds[drawn]


def _scattered(matrix: Sparse, pixels: Ints, picked: Picked) -> Sparse:
    """Rows of some pixels as rows of the image, without those that are samples by now."""
    from scipy.sparse import coo_array

    entries = matrix.tocoo()
    row, column = entries.coords
    keep = picked.slot[pixels[row]] < 0
    at = (pixels[row[keep]], column[keep])
    size = (picked.slot.size, len(picked.pixels))
    return coo_array((entries.data[keep], at), size).tocsr()


def _identity(picked: Picked) -> Sparse:
    """Rows of the samples themselves."""
    from scipy.sparse import coo_array

    count = len(picked.pixels)
    at = (picked.pixels, np.arange(count))
    return coo_array((np.ones(count), at), (picked.slot.size, count)).tocsr()


def _plan(ground: Ground, picked: Picked, matrix: Sparse, error_m: float) -> Plan:
    return Plan(ground.shape, picked.pixels, matrix, error_m, picked.values)
