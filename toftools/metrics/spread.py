"""How wide the errors are in units of the sigma that a method states: 1 is honest.

``make(truth, *, mask) -> run(answer) -> (rms, robust)``. The first is the root mean square of
z = error / sigma, which a few wrong turns can carry far away; the second is the median of |z| over
0.6745, its value for a normal error, which half of the pixels may be wrong without moving. The two
together tell a sigma that is too small everywhere from one that misses a few pixels by much.
"""

from collections.abc import Callable

import numpy as np

from toftools.metrics.error import check_shape, scored_pixels
from toftools.types import Bool, DepthMap, Truth

MEDIAN_ABSOLUTE = 0.6744897501960817
"""Median of the absolute value of a standard normal variable."""


def z_spread(
    truth: Truth, *, mask: Bool | None = None
) -> Callable[[DepthMap], tuple[float, float]]:
    """Spread of the errors in units of sigma.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> (rms, robust)``; NaN without an answered pixel that has a sigma, infinite
        where an error stands beside a sigma of zero.

    Examples
    --------
    >>> truth = Truth(np.full((1, 4), 2.0))
    >>> answer = DepthMap(np.array([[2.1, 1.9, 2.3, np.nan]]), sigma_m=np.full((1, 4), 0.1))
    >>> rms, robust = z_spread(truth)(answer)
    >>> round(rms, 2), round(robust, 2)
    (1.91, 1.48)
    """
    known = scored_pixels(truth, mask)
    wanted = truth.range_m[known].astype(np.float64)

    def run(depth: DepthMap) -> tuple[float, float]:
        check_shape(depth, known.shape)
        if depth.sigma_m is None:
            return float("nan"), float("nan")
        error = np.abs(depth.range_m[known] - wanted)
        sigma_m = depth.sigma_m[known].astype(np.float64)
        given = np.isfinite(error) & np.isfinite(sigma_m)
        if not given.any():
            return float("nan"), float("nan")
        error, sigma_m = error[given], sigma_m[given]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(error > 0, error / sigma_m, 0.0)
        return float(np.sqrt(np.mean(z**2))), float(np.median(z)) / MEDIAN_ABSOLUTE

    return run
