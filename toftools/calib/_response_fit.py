"""The curve, gain and photon transfer of the response stage.

A tap reads x; ``L(x) = x + sum_j c_j (x (x / top)^j - x)`` is linear in charge and meets x at 0 and
at `top`, the brightest level of the flats. Per pixel p and flat i the offsets obey
``<L(x)>_pi - <L(x)>_dark,p = s_p e_i`` with the known exposure e_i: linear in c and s.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib._response_data import ORDERS, Level
from toftools.types import F64, Bool

MOST_TERMS = ORDERS - 1
EXACT = 1e-4
"""Relative error below which models count as equally good: no lamp or shutter is known better."""
KNOTS = 257
"""Knots of a curve with terms: straight lines in between err by 2e-6 of the top for a curve that
bends by a tenth of it."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Terms of the curve and how well they hold.

    Parameters
    ----------
    terms, sd : ndarray, (J,)
        Coefficients c_j and their standard deviations.
    held_out : float
        Root mean square relative error of exposures that the fit did not see; NaN without any.
    """

    terms: F64
    sd: F64
    held_out: float = float("nan")


def linear_moment(moments: F64, terms: F64) -> F64:
    """Offset of the linearised taps from the offsets of their powers.

    Parameters
    ----------
    moments : ndarray, (ORDERS, ...)
        Offsets of the powers of x / top.
    terms : ndarray, (J,)
        Coefficients of the curve.

    Returns
    -------
    ndarray, (...)
        Offset of L(x), in units of top.
    """
    out = moments[0].copy()
    for j, term in enumerate(terms, start=1):
        out += term * (moments[j] - moments[0])
    return np.asarray(out)


def fit_curve(dark: Sequence[Level], lit: Sequence[Level], good: Bool) -> Curve:
    """Curve with as many terms as exposures that were left out ask for.

    Exposures between the lowest and the highest are left out in turn, since the curve claims
    nothing beyond them. Of all models that rise, the smallest wins that lies within one standard
    error of the best (T. Hastie, R. Tibshirani, J. Friedman, "The Elements of Statistical
    Learning", 2nd ed., section 7.10) or is exact to `EXACT`; fewer than four exposures leave none
    to spare: a straight line.

    Parameters
    ----------
    dark, lit : sequence of Level
        Levels.
    good : ndarray, (H, W), bool
        Pixels to average.

    Returns
    -------
    Curve
        The choice, fitted to all exposures.
    """
    use = good & np.logical_and.reduce([level.ok for level in lit])
    base = np.mean([_mean(level, use) for level in dark], axis=0)  # (ORDERS, N)
    rows = np.stack([_mean(level, use) - base for level in lit])  # (L, ORDERS, N)
    exposure = np.array([level.exposure for level in lit])
    inner = np.unique(exposure)[1:-1]
    if inner.size < 2:
        return _solved(rows, exposure, 0)
    errors = []
    for n_terms in range(min(MOST_TERMS, inner.size - 1) + 1):
        per_exposure = [_missed(rows, exposure, e, n_terms) for e in inner]
        rising = _rises(_solved(rows, exposure, n_terms).terms)
        errors.append(per_exposure if rising else [np.inf] * inner.size)
    squares = np.square(errors)  # (models, inner)
    mean = squares.mean(axis=1)
    best = int(np.argmin(mean))
    limit = max(mean[best] + squares[best].std(ddof=1) / np.sqrt(inner.size), EXACT**2)
    chosen = int(np.flatnonzero(mean <= limit)[0])
    found = _solved(rows, exposure, chosen)
    return Curve(found.terms, found.sd, float(np.sqrt(mean[chosen])))


def _mean(level: Level, use: Bool) -> F64:
    return np.asarray(level.moments[:, :, use].mean(axis=-1))  # (ORDERS, N)


def _missed(rows: F64, exposure: F64, left_out: float, n_terms: int) -> float:
    """Relative error of an exposure that is left out of the fit."""
    kept = exposure != left_out
    terms = _solved(rows[kept], exposure[kept], n_terms).terms
    linear = linear_moment(np.moveaxis(rows, 1, 0), terms)  # (L, N)
    weight = _weights(rows[kept])[:, None]
    e = exposure[:, None]
    slope = (weight * e[kept] * linear[kept]).sum(0) / (weight * e[kept] ** 2).sum(0)
    wrong = linear[~kept] / (slope * left_out) - 1
    return float(np.sqrt(np.mean(wrong**2)))


def _weights(rows: F64) -> F64:
    """Inverse variance up to a factor: relative errors of lamps and shutters come first."""
    return np.asarray(1 / rows[:, 0].mean(axis=-1) ** 2)


def _solved(rows: F64, exposure: F64, n_terms: int) -> Curve:
    """Least squares for the terms, the slope of every node taken out first."""
    root = np.sqrt(_weights(rows))[:, None]
    features = rows[:, 1 : 1 + n_terms] - rows[:, :1]  # (L, J, N)
    e = exposure[:, None] * root  # (L, 1)
    unit = e / np.linalg.norm(e)

    def without_slope(values: F64) -> F64:
        scaled = values * root
        return np.asarray(scaled - unit * (unit * scaled).sum(axis=0))

    target = without_slope(rows[:, 0]).ravel()  # (L N)
    columns = [without_slope(features[:, j]).ravel() for j in range(n_terms)]
    if not columns:
        return Curve(np.zeros(0), np.zeros(0))
    matrix = np.stack(columns, axis=1)
    terms = np.linalg.lstsq(matrix, -target, rcond=None)[0]
    spare = max(target.size - rows.shape[2] - n_terms, 1)
    scatter = float(np.sum((target + matrix @ terms) ** 2)) / spare
    sd = np.sqrt(scatter * np.diag(np.linalg.pinv(matrix.T @ matrix)))
    return Curve(np.asarray(terms, np.float64), np.asarray(sd, np.float64))


def _rises(terms: F64) -> bool:
    at = np.linspace(0, 1, KNOTS)
    return bool((np.diff(curve_values(terms, at)) > 0).all())


def curve_values(terms: F64, at: F64) -> F64:
    """The curve at levels in units of top.

    Parameters
    ----------
    terms : ndarray, (J,)
        Coefficients.
    at : ndarray
        Levels / top.

    Returns
    -------
    ndarray
        L / top.
    """
    return linear_moment(np.stack([at ** (j + 1) for j in range(ORDERS)]), terms)


def fit_gain(dark: Sequence[Level], lit: Sequence[Level], terms: F64) -> tuple[F64, F64, F64, F64]:
    """Dark level and response per unit exposure of every node and pixel.

    Parameters
    ----------
    dark, lit : sequence of Level
        Levels.
    terms : ndarray, (J,)
        Curve.

    Returns
    -------
    tuple of ndarray, (N, H, W)
        Dark level; response; its standard deviation by the scatter about the straight line; all in
        units of top; and by how much an error of the dark level moves the response. Responses are
        NaN where no flat can be used, deviations from one flat alone.
    """
    offset = np.asarray(np.mean([linear_moment(x.moments, terms) for x in dark], axis=0))
    top, bottom, total, pull = (np.zeros(offset.shape) for _ in range(4))
    count = np.zeros(offset.shape[1:])
    for level in lit:
        signal = linear_moment(level.moments, terms) - offset
        weight = level.ok / max(float(np.median(signal[:, level.ok])), 1e-12)  # shot noise
        top += weight * level.exposure * signal
        bottom += weight * level.exposure**2
        total += weight * signal**2
        pull += weight * level.exposure
        count += level.ok
    with np.errstate(divide="ignore", invalid="ignore"):
        response = np.where(bottom > 0, top / bottom, np.nan)
        spare = ((total - response**2 * bottom) / (count - 1))[:, count > 1]
        scatter = trimmed_mean(spare) if len(lit) > 1 else np.nan
        response_sd = np.sqrt(scatter / bottom)
        pull /= bottom
    return offset, np.asarray(response), np.asarray(response_sd), pull


def trimmed_mean(values: F64) -> float:
    """Mean without the largest hundredth and what is not finite; NaN of nothing.

    Parameters
    ----------
    values : ndarray
        Numbers.

    Returns
    -------
    float
        Their mean.
    """
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return float("nan")
    return float(finite[finite <= np.percentile(finite, 99)].mean())
