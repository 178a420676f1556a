"""Fit of the amplitude error of one frequency, given how many functions it may have.

Weighted least squares on pixels of several brightnesses. Each pixel has an offset of its own, a
rest of the fixed pattern, which may hang together with the light that falls on it: brightnesses of
one pixel count against each other only. Each capture may have one as well, from a wrong distance:
it widens the standard deviations.
"""

from dataclasses import dataclass

import numpy as np

from toftools.calib._phase_errors import MAD_TO_SIGMA
from toftools.calib._phase_surface import design, roughness
from toftools.types import F64

HUBER, CUT = 2.0, 6.0
ROUNDS = 4
FREE_RAD = 1.0
"""Offsets of pixels are drawn to 0 with this standard deviation, which is as good as not."""
FILL = 1e-6
"""Weight of the penalty relative to the data of an average coefficient."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Pixels of one frequency.

    Parameters
    ----------
    error_rad, expected_rad, amplitude, weight : ndarray, (K, P)
        Phase error and expected phase, rad, amplitude, and weight 1 / rad^2 of pixel P in capture
        K; weight 0 for what is unusable.
    span : ndarray, (2,)
        Amplitudes between which functions are laid.
    """

    error_rad: F64
    expected_rad: F64
    amplitude: F64
    weight: F64
    span: F64


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations per capture of one model.

    Parameters
    ----------
    rows : ndarray, (K, P, n)
        Functions at all pixels.
    gram : ndarray, (K, n, n)
        Products of them.
    product : ndarray, (K, n)
        Products with the errors.
    fill : ndarray, (n, n)
        Penalty.
    """

    rows: F64
    gram: F64
    product: F64
    fill: F64


def normal(samples: Samples, shape: tuple[int, int], fitted_rad: F64 | float = 0.0) -> Normal:
    """Normal equations of a model.

    Parameters
    ----------
    samples : Samples
        Data.
    shape : tuple of int
        Numbers of functions over log amplitude and phase.
    fitted_rad : ndarray, (K, P)
        Amplitude error found so far: the noiseless measured phase is the expected one plus it.
        The measured phase itself would do worse, as its noise is that of the error.

    Returns
    -------
    Normal
        Per capture.
    """
    phase = samples.expected_rad + fitted_rad
    flat = design(samples.amplitude.ravel(), phase.ravel(), samples.span, shape)
    rows = flat.reshape(*phase.shape, -1)  # (K, P, n)
    heavy = rows * samples.weight[..., None]
    gram = heavy.transpose(0, 2, 1) @ rows
    product = np.einsum("kpn,kp->kn", heavy, samples.error_rad)
    fill = (
        FILL
        * np.trace(gram.sum(axis=0))
        / gram.shape[1]
        * (roughness(shape) + 1e-3 * np.eye(gram.shape[1]))
    )
    return Normal(rows, gram, product, fill)


def held_out(samples: Samples, shape: tuple[int, int] | None) -> tuple[F64, F64]:
    """Errors of each capture under a fit to all others, the offsets of the pixels taken off.

    The distance of a capture from the mean of all others is ``W / (W - w)`` times that from the
    mean of all, w being its weight and W that of all, and its variance ``1 / w`` likewise.

    Parameters
    ----------
    samples : Samples
        Data.
    shape : tuple of int, or None
        Model; None is no amplitude error at all.

    Returns
    -------
    losses : ndarray, (K,)
        Weighted squares of the errors.
    fitted_rad : ndarray, (K, P)
        The model at the data of each capture, fitted to all others, up to a constant.
    """
    weight = samples.weight
    total = weight.sum(axis=0)
    share = weight / np.where(total > 0, total, 1.0)
    alone = share > 1 - 1e-9
    apart = np.where(alone, 0.0, weight / np.where(alone, 1.0, 1 - share))  # w W / (W - w)
    error = samples.error_rad - (share * samples.error_rad).sum(axis=0)
    if shape is None:
        return (apart * error**2).sum(axis=1), np.zeros_like(error)
    parts = normal(samples, shape)
    rows = parts.rows - np.einsum("kp,kpn->pn", share, parts.rows)
    heavy = rows * apart[..., None]
    own = heavy.transpose(0, 2, 1) @ rows
    products = np.einsum("kpn,kp->kn", heavy, error)
    light = rows * weight[..., None]
    gram = (light.transpose(0, 2, 1) @ rows).sum(axis=0) + parts.fill
    product = np.einsum("kpn,kp->n", light, error)
    theta = np.linalg.solve(gram - own, (product - products)[..., None])[..., 0]  # (K, n)
    rest = error - (rows @ theta[..., None])[..., 0]
    return (apart * rest**2).sum(axis=1), (parts.rows @ theta[..., None])[..., 0]


def robust(samples: Samples, shape: tuple[int, int]) -> Samples:
    """The same data with less weight on outliers of a model that can follow them.

    Parameters
    ----------
    samples : Samples
        Data.
    shape : tuple of int
        Largest model.

    Returns
    -------
    Samples
        With Huber's weights, and 0 beyond six deviations; without sigma, weights in units of the
        scatter.
    """
    parts = normal(samples, shape)
    known = samples.weight > 0
    weight, usual = samples.weight, 1.0
    for _ in range(ROUNDS):
        heavy = parts.rows * weight[..., None]
        gram = (heavy.transpose(0, 2, 1) @ parts.rows).sum(axis=0)  # capture by capture is faster
        product = np.einsum("kpn,kp->n", heavy, samples.error_rad)
        rest = samples.error_rad - parts.rows @ np.linalg.solve(gram + parts.fill, product)
        away = np.abs(rest) * np.sqrt(samples.weight)
        usual = max(MAD_TO_SIGMA * float(np.median(away[known])), 1e-12)
        trust = np.where(away < CUT * usual, HUBER / np.maximum(away / usual, HUBER), 0.0)
        weight = samples.weight * trust
    return Samples(
        samples.error_rad, samples.expected_rad, samples.amplitude, weight / usual**2, samples.span
    )


def solved(samples: Samples, shape: tuple[int, int]) -> tuple[F64, F64, F64]:
    """Coefficients, their covariance, and the fitted errors.

    Parameters
    ----------
    samples : Samples
        Data with final weights.
    shape : tuple of int
        Model.

    Returns
    -------
    theta : ndarray, (n,)
        Coefficients, rad.
    covariance : ndarray, (n, n)
        Their covariance, rad^2.
    fitted_rad : ndarray, (K, P)
        The model at the data, rad.
    """
    parts = normal(samples, shape)
    theta = np.linalg.solve(parts.gram.sum(axis=0) + parts.fill, parts.product.sum(axis=0))
    covariance = np.zeros_like(parts.fill)
    for _ in range(2):
        fitted = parts.rows @ theta
        parts = normal(samples, shape, fitted)
        theta, covariance = _mixed(samples, parts, samples.error_rad - fitted)
    return theta, covariance, np.asarray(parts.rows @ theta)


def _mixed(samples: Samples, parts: Normal, rest: F64) -> tuple[F64, F64]:
    """Least squares with an offset per pixel, and the covariance, given residuals.

    With weights w and functions X of a pixel, ``A = diag(w) - s w w^T`` takes its weighted mean
    off. The noise has covariance ``diag(1 / w) + between``, so that of the coefficients is
    ``H^-1 (sum X^T A cov A X) H^-1`` with ``H = sum X^T A X``.
    """
    weight = samples.weight
    total = weight.sum(axis=0)
    s = FREE_RAD**2 / (1 + FREE_RAD**2 * total)
    sums = np.einsum("kp,kpn->pn", weight, parts.rows)
    errors = (weight * samples.error_rad).sum(axis=0)
    plain = parts.gram.sum(axis=0)
    inverse = np.linalg.inv(plain - (sums * s[:, None]).T @ sums + parts.fill)
    theta = inverse @ (parts.product.sum(axis=0) - sums.T @ (s * errors))
    between = _pixel_variance(weight, rest)
    taken = 2 * s - s**2 * total - between * (1 - s * total) ** 2
    covariance = inverse @ (plain - (sums * taken[:, None]).T @ sums) @ inverse
    # Influence of an offset of a whole capture, and its variance beyond what noise explains.
    offset = np.einsum("kpn,kp->kn", parts.rows, weight) - np.einsum(
        "pn,kp->kn", sums * s[:, None], weight
    )
    influence = offset @ inverse
    spread = _capture_variance(weight, samples.error_rad - parts.rows @ theta, theta.size)
    return np.asarray(theta), np.asarray(covariance + spread * influence.T @ influence)


def _pixel_variance(weight: F64, rest: F64) -> float:
    """Variance of the offsets of pixels beyond noise, rad^2."""
    total = weight.sum(axis=0)
    several = (weight > 0).sum(axis=0) > 1
    if several.sum() < 2:
        return 0.0
    mean = (weight * rest).sum(axis=0)[several] / total[several]
    scatter = (MAD_TO_SIGMA * float(np.median(np.abs(mean - np.median(mean))))) ** 2
    return max(0.0, scatter - float(np.median(1 / total[several])))


def _capture_variance(weight: F64, rest: F64, n: int) -> float:
    """Variance of the offsets of captures beyond noise, rad^2."""
    total = weight.sum(axis=1)
    used = total > 0
    mean = (weight * rest).sum(axis=1)[used] / total[used]
    freedom = max(1, mean.size - min(n, mean.size - 1))
    excess = float((mean**2).sum() - (1 / total[used]).sum())
    return float(max(0.0, excess / freedom))
