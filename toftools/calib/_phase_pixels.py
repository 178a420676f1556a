"""Phase errors of several captures as a number per capture plus a pattern over pixels.

``error[k, f, i] = capture[k, f] + pixel[f, i] + noise``, by weighted least squares with Huber's
weights from three captures on; the pattern has zero `centre` over its pixels.
"""

from dataclasses import dataclass

import numpy as np

from toftools.calib._phase_errors import MAD_TO_SIGMA, Errors, centre
from toftools.types import F64

HUBER = 3.0
ROUNDS = 8
SETTLED_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class TwoWay:
    """Numbers per capture and a pattern over pixels.

    Parameters
    ----------
    capture_rad : ndarray, (K, F)
        Mean error of each capture over the pixels of the pattern, rad.
    pixel_rad : ndarray, (F, H, W)
        Pattern, rad; NaN where no capture sees a pixel.
    weight : ndarray, (K, F, H, W)
        Weights 1 / rad^2, 0 for what is unusable.
    scale : ndarray, (F,)
        Scatter of the captures about the fit relative to their sigma; 1 for one capture.
    """

    capture_rad: F64
    pixel_rad: F64
    weight: F64
    scale: F64


def two_way(errors: Errors) -> TwoWay:
    """Fit both, robustly.

    Parameters
    ----------
    errors : Errors
        Errors of K captures.

    Returns
    -------
    TwoWay
        The fit.
    """
    usable = np.isfinite(errors.error_rad)
    error = np.where(usable, errors.error_rad, 0.0)
    basic = np.where(usable, 1 / np.where(usable, errors.sigma_rad, 1.0) ** 2, 0.0)
    parts = [_one(error[:, f], basic[:, f]) for f in range(error.shape[1])]
    stack = [np.stack([part[i] for part in parts], axis=axis) for i, axis in ((0, 1), (1, 0))]
    weight = np.stack([part[2] for part in parts], axis=1)
    return TwoWay(stack[0], stack[1], weight, np.array([part[3] for part in parts]))


def _one(error: F64, basic: F64) -> tuple[F64, F64, F64, float]:
    """One frequency: numbers (K,), pattern (H, W), weights (K, H, W), scatter."""
    count = error.shape[0]
    seen = basic > 0
    masked = np.where(seen, error, np.nan)
    offset = np.array([np.nanmedian(x) for x in masked])
    weight = basic if count < 3 else basic * _trust(_first_residual(masked, offset), basic)[0]
    scale = 1.0
    pixel = np.zeros(error.shape[1:])
    for _ in range(ROUNDS):
        pixel = _pattern(error, offset, weight)
        left = np.where(seen, error - pixel, np.nan)
        moved = np.array([centre(x) for x in left])
        change = float(np.abs(moved - offset).max())
        offset = moved
        if count > 1:
            trust, scale = _trust(np.where(seen, left - offset[:, None, None], np.nan), basic)
            weight = basic * trust if count > 2 else basic
        if change < SETTLED_RAD:
            break
    return offset, pixel, weight, scale


def _first_residual(masked: F64, offset: F64) -> F64:
    """Distance from the median over captures, which one bad capture does not move."""
    level = masked - offset[:, None, None]
    blind = np.isnan(level).all(axis=0)
    level = np.where(blind, 0.0, level)
    return np.asarray(level - np.nanmedian(level, axis=0))


def _pattern(error: F64, offset: F64, weight: F64) -> F64:
    """Weighted mean over captures per pixel with zero centre, NaN where there is none."""
    total = weight.sum(axis=0)
    mean = (weight * (error - offset[:, None, None])).sum(axis=0)
    pixel = np.where(total > 0, mean / np.where(total > 0, total, 1.0), np.nan)
    return np.asarray(pixel - centre(pixel))


def _trust(left: F64, basic: F64) -> tuple[F64, float]:
    """Huber's weights of residuals, and their scatter relative to sigma."""
    known = np.isfinite(left) & (basic > 0)
    several = known & (known.sum(axis=0) > 1)
    count = np.maximum(known.sum(axis=0), 2)
    # A residual about the mean of n captures is smaller by sqrt(1 - 1/n).
    ratio = np.abs(np.where(known, left, 0.0)) * np.sqrt(basic / (1 - 1 / count))
    if not several.any():
        return np.ones(left.shape), 1.0
    scale = max(MAD_TO_SIGMA * float(np.median(ratio[several])), 1e-12)
    return np.asarray(HUBER / np.maximum(ratio / scale, HUBER)), scale
