"""Whether sigma is honest: how many answers lie within the interval that it promises.

``make(truth, *, level, mask) -> run(answer) -> float``. A method that knows its errors has 68 % of
the truth within one sigma and 95 % within 1.96; fewer is overconfident, more is timid. Errors that
are not normal (multipath, wrong turns) show as a 95 % interval that misses more than the 68 % one.
"""

from collections.abc import Callable
from statistics import NormalDist

import numpy as np

from toftools.metrics.error import check_shape, scored_pixels
from toftools.types import Bool, DepthMap, Truth


def inside_interval(
    truth: Truth, *, level: float = 0.68, mask: Bool | None = None
) -> Callable[[DepthMap], float]:
    """Share of the answers whose truth lies within the central interval of a normal error.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    level : float
        What the interval promises, between 0 and 1.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, 0..1; NaN without an answered pixel that has a sigma.

    Raises
    ------
    ValueError
        If the level is no probability.

    Examples
    --------
    >>> truth = Truth(np.array([[1.0, 2.0, 3.0, 4.0]]))
    >>> answer = DepthMap(np.array([[1.1, 2.3, 3.0, np.nan]]), sigma_m=np.full((1, 4), 0.2))
    >>> round(inside_interval(truth, level=0.68)(answer), 3)
    0.667
    """
    if not 0 < level < 1:
        msg = f"level must be a probability between 0 and 1, got {level}"
        raise ValueError(msg)
    reach = NormalDist().inv_cdf(0.5 + level / 2)
    known = scored_pixels(truth, mask)
    wanted = truth.range_m[known].astype(np.float64)

    def run(depth: DepthMap) -> float:
        check_shape(depth, known.shape)
        if depth.sigma_m is None:
            return float("nan")
        error, sigma_m = np.abs(depth.range_m[known] - wanted), depth.sigma_m[known]
        given = np.isfinite(error) & np.isfinite(sigma_m)
        return float((error <= reach * sigma_m)[given].mean()) if given.any() else float("nan")

    return run
