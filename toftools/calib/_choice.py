"""Fit of the phase error of one frequency: robust weights, choice of size, uncertainty."""

from dataclasses import dataclass, replace

import numpy as np

from toftools.calib._grams import (
    Columns,
    held_out,
    held_out_mean,
    jackknife_sd,
    leftover,
    products,
    solved,
    total_only,
)
from toftools.calib._grams import Family as Family
from toftools.calib._wiggling_data import Samples, covered
from toftools.types import F64, Bool
from toftools.units import TWO_PI

BINS = 64
"""Parts of the turn that have data or not."""
PULL = 1e-2
"""Where the turn has no data, the curve is drawn to 0 with this weight relative to data."""
FEW = 40_000
"""Measurements that tell outliers from the rest."""
HUBER, CUT = 2.5, 6.0
"""Errors beyond HUBER deviations count linearly, beyond CUT not at all."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Model of one frequency and how good it is; mean squares are weighted as the data, rad^2.

    Parameters
    ----------
    size : int
        Chosen size.
    theta, sd : ndarray, (K,)
        Coefficients and their standard deviations, rad.
    before, after, held_out, noise : float
        Mean square error; NaN where unknown.
    n, dropped : int
        Measurements used, and taken for outliers.
    covered : ndarray, (BINS,), bool
        Which parts of the turn have data.
    parts : int
        Parts that were held out, one after another.
    """

    size: int
    theta: F64
    sd: F64
    before: float
    after: float
    held_out: float
    noise: float
    n: int
    dropped: int
    covered: Bool
    parts: int


def fitted(samples: Samples, family: Family, *, noisy_phase: bool) -> Fitted:
    """The smallest model of a family whose held-out error is as good as the best one's.

    Parameters
    ----------
    samples : Samples
        Measurements of one frequency.
    family : Family
        Models.
    noisy_phase : bool
        Whether the noise of the phase is in its error, too, as it is where the true range comes
        from elsewhere; then the coefficients are those of the phase without noise.

    Returns
    -------
    Fitted
        Coefficients and figures.
    """
    seen, family = covered(samples, BINS), _told(family, samples)
    kept, weight = robust_weights(samples, family.sized(family.sizes[-1]), seen)
    size = _chosen(samples, family, seen, weight, kept)
    columns, still = family.sized(size), samples
    # The largest model follows noise where captures are few, and calls the rest outliers.
    kept, weight = robust_weights(samples, columns, seen)
    pull = penalty(columns, seen, float(weight.sum()))
    unseen = held_out_mean(products(samples, columns, weight, kept), pull)
    theta = _solved(samples, columns, seen, weight)
    after = leftover(samples, weight, _curve(columns, theta, samples.phase_rad))
    for _ in range(2 if noisy_phase and size else 0):
        still = replace(samples, phase_rad=_noiseless(samples, weight, columns, theta))
        rest = leftover(still, weight, _curve(columns, theta, still.phase_rad))
        # Weights that see the noise through the bend of the curve would not be fair to both signs.
        _, weight = _trimmed(samples, rest)
        theta = _solved(still, columns, seen, weight)
    grams, pull = (
        products(still, columns, weight, kept),
        penalty(columns, seen, float(weight.sum())),
    )
    k = pull.shape[0]
    sigma = samples.sigma_rad
    return Fitted(
        size=size,
        theta=theta[:k],
        sd=jackknife_sd(grams, pull)[:k],
        before=_mean_square(leftover(samples, weight, np.zeros_like(kept)), kept),
        after=_mean_square(after, kept),
        held_out=unseen,
        noise=float("nan") if sigma is None else _mean_square(sigma, kept),
        n=int((kept > 0).sum()),
        dropped=int(((samples.weight > 0) & (kept == 0)).sum()),
        covered=seen,
        parts=grams.fit.shape[0],
    )


def _told(family: Family, samples: Samples) -> Family:
    """The sizes that positions can tell: a capture adds a cosine and a sine, pixels little."""
    most = 2 * samples.phase_rad.shape[0] if samples.by_capture else np.inf
    counts = [family.columns(np.zeros(1), size).shape[1] for size in family.sizes]
    kept = [size for size, count in zip(family.sizes, counts, strict=True) if count <= most]
    return replace(family, sizes=tuple(kept) or family.sizes[:1])


def robust_weights(samples: Samples, columns: Columns, seen: Bool) -> tuple[F64, F64]:
    """Weights without outliers, for figures and for the fit.

    Parameters
    ----------
    samples : Samples
        Measurements of one frequency.
    columns : callable
        A model that can follow the data.
    seen : ndarray, (B,), bool
        Which parts of the turn have data.

    Returns
    -------
    kept : ndarray, (C, P)
        Weights of the data; 0 beyond `CUT` deviations.
    weight : ndarray, (C, P)
        The same times ``min(1, HUBER / deviations)``.

    References
    ----------
    P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35
    (1964) 73-101; the scale is the median absolute deviation.
    """
    few = _thinned(samples)
    weight = few.weight
    for _ in range(5):
        theta = _solved(few, columns, seen, weight)
        _, weight = _trimmed(few, leftover(few, weight, _curve(columns, theta, few.phase_rad)))
    model = _curve(columns, _solved(few, columns, seen, weight), samples.phase_rad)
    kept = weight = samples.weight
    for _ in range(5):  # the constants of the pixels, too, must get rid of outliers
        kept, weight = _trimmed(samples, leftover(samples, weight, model))
    return kept, weight


def _thinned(samples: Samples) -> Samples:
    """About `FEW` measurements of evenly chosen pixels."""
    step = max(1, samples.phase_rad.size // FEW)
    parts = samples.parts if samples.by_capture else ((None, slice(None)),)
    return replace(
        samples,
        phase_rad=samples.phase_rad[:, ::step],
        error_rad=samples.error_rad[:, ::step],
        weight=samples.weight[:, ::step],
        sigma_rad=None,
        parts=parts,
    )


def _trimmed(samples: Samples, rest: F64) -> tuple[F64, F64]:
    """Weights without and with Huber's factor, from what a fit leaves."""
    away = np.abs(rest) * np.sqrt(samples.weight)
    usual = 1.4826 * float(np.median(away[samples.weight > 0])) + 1e-12
    kept = np.where(away < CUT * usual, samples.weight, 0)
    return kept, kept * (HUBER * usual / np.maximum(away, HUBER * usual))


def penalty(columns: Columns, seen: Bool, weight: float) -> F64:
    """What keeps the curve near 0 where the turn has no data.

    Parameters
    ----------
    columns : callable
        Model.
    seen : ndarray, (B,), bool
        Which parts of the turn have data.
    weight : float
        Weight of all data.

    Returns
    -------
    ndarray, (K, K)
        Addition to the normal equations: measurements of 0 in the empty parts, each with `PULL`
        times the weight that a part with data has on average.
    """
    count = seen.size
    middles = np.asarray((np.flatnonzero(~seen) + 0.5) * (TWO_PI / count), dtype=np.float64)
    rows = columns(middles)
    return np.asarray(rows.T @ rows * (PULL * weight / max(int(seen.sum()), 1)))


def _solved(samples: Samples, columns: Columns, seen: Bool, weight: F64) -> F64:
    """Coefficients, and the shared constant where there is one."""
    pull = penalty(columns, seen, float(weight.sum()))
    return solved(total_only(samples, columns, weight), pull)


def _chosen(samples: Samples, family: Family, seen: Bool, weight: F64, kept: F64) -> int:
    """Size by the rule of one standard error."""
    total, losses = float(weight.sum()), []
    big = products(samples, family.sized(family.sizes[-1]), weight, kept) if family.nested else None
    for size in family.sizes:
        columns = family.sized(size)
        pull = penalty(columns, seen, total)
        grams = big.cut(pull.shape[0]) if big else products(samples, columns, weight, kept)
        losses.append(held_out(grams, pull))
        shares = grams.weight
    return family.sizes[smallest(np.array(losses), shares)]


def smallest(losses: F64, shares: F64) -> int:
    """The first model that is not worse than the best by more than one standard error.

    Parameters
    ----------
    losses : ndarray, (S, G)
        Held-out sums of squares of every model, from small to large, in every part.
    shares : ndarray, (G,)
        Weight of the parts.

    Returns
    -------
    int
        Index of the model. The error is that of the difference between two models, which see the
        same noise.

    Examples
    --------
    >>> smallest(np.array([[9.0, 9.2, 9.1], [5.1, 4.9, 5.2], [5.0, 5.0, 5.1]]), np.ones(3))
    1
    """
    parts = shares.size
    if parts < 2:
        return 0
    best = int(np.argmin(losses.sum(axis=1)))
    for index in range(best):
        worse = losses[index] - losses[best]
        mean = worse.sum() / shares.sum()
        error = np.sqrt(parts / (parts - 1) * ((worse - shares * mean) ** 2).sum()) / shares.sum()
        if mean <= error:
            return index
    return best


def _curve(columns: Columns, theta: F64, phase: F64) -> F64:
    """Model at phases (C, P)."""
    return np.stack([(rows := columns(line)) @ theta[: rows.shape[1]] for line in phase])


def _noiseless(samples: Samples, weight: F64, columns: Columns, theta: F64) -> F64:
    """Phases that the pixels would have measured without noise.

    Measured = expected + constant + curve(measured) without noise, and the right-hand side is free
    of it; solved by repetition, as the slope of a wiggling stays well under 1.
    """
    model = _curve(columns, theta, samples.phase_rad)
    expected = samples.phase_rad - leftover(samples, weight, model) - model
    phase = samples.phase_rad
    for _ in range(6):
        phase = expected + _curve(columns, theta, phase)
    return np.where(weight > 0, phase, samples.phase_rad)


def _mean_square(values: F64, weight: F64) -> float:
    return float((weight * values**2).sum() / max(float(weight.sum()), 1e-300))
