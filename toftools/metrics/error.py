"""Per-pixel errors of an answer against the truth.

``make(truth, *, mask) -> run(answer) -> float``. Scored pixels are those of the mask whose truth
is known; an error is answer minus truth in float64, over the scored pixels that were answered.
What was not answered shows in `valid_share` and `share_under`, so read an error beside them.
A score over no pixel is NaN.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from toftools.types import F64, Bool, DepthMap, Truth

Metric: TypeAlias = Callable[[DepthMap], float]


def scored_pixels(truth: Truth, mask: Bool | None = None) -> Bool:
    """Pixels that count: those of the mask whose truth is known.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    ndarray of bool, (H, W)
        Mask and finite truth.

    Raises
    ------
    ValueError
        If the mask has another shape or another type.
    """
    known = np.isfinite(truth.range_m)
    if mask is None:
        return known
    mask = np.asarray(mask)
    if mask.shape != known.shape or mask.dtype != np.bool_:
        msg = f"mask must be bool {known.shape} like the truth, got {mask.dtype} {mask.shape}"
        raise ValueError(msg)
    return np.asarray(mask & known)


def check_shape(depth: DepthMap, shape: tuple[int, ...]) -> None:
    """Refuse an answer whose image shape is not that of the truth.

    Parameters
    ----------
    depth : DepthMap
        Answer.
    shape : tuple of int
        Shape of the truth, (H, W).

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    if depth.range_m.shape != shape:
        msg = f"the answer must have the shape of the truth {shape}, got {depth.range_m.shape}"
        raise ValueError(msg)


def _scored_errors(truth: Truth, mask: Bool | None) -> Callable[[DepthMap], F64]:
    """Function from an answer to its errors on all scored pixels, NaN where not answered."""
    shape = truth.range_m.shape
    index = np.flatnonzero(scored_pixels(truth, mask))
    wanted = truth.range_m.ravel()[index].astype(np.float64)

    def errors(depth: DepthMap) -> F64:
        check_shape(depth, shape)
        return np.asarray(depth.range_m.ravel()[index] - wanted)  # (N,)

    return errors


def _over_answered(
    truth: Truth, mask: Bool | None, reduce: Callable[[F64], np.floating | float]
) -> Metric:
    """Metric that reduces the errors of the answered pixels to one number."""
    errors = _scored_errors(truth, mask)

    def run(depth: DepthMap) -> float:
        error = errors(depth)
        error = error[np.isfinite(error)]
        return float(reduce(error)) if error.size else float("nan")

    return run


def bias_m(truth: Truth, *, mask: Bool | None = None) -> Metric:
    """Mean signed error, answer minus truth.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, m.
    """
    return _over_answered(truth, mask, np.mean)


def mae_m(truth: Truth, *, mask: Bool | None = None) -> Metric:
    """Mean absolute error.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, m; NaN without an answered pixel.

    Examples
    --------
    >>> truth = Truth(np.array([[1.0, 2.0, np.nan]]))
    >>> round(mae_m(truth)(DepthMap(np.array([[1.1, 1.7, 5.0]]))), 6)
    0.2
    """
    return _over_answered(truth, mask, lambda error: np.mean(np.abs(error)))


def rmse_m(truth: Truth, *, mask: Bool | None = None) -> Metric:
    """Root of the mean squared error.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, m.
    """
    return _over_answered(truth, mask, lambda error: np.sqrt(np.mean(error * error)))


def percentile_m(truth: Truth, *, q: float = 50.0, mask: Bool | None = None) -> Metric:
    """Percentile of the absolute error, linear between samples.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    q : float
        Percentile, 0..100.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, m; NaN without an answered pixel.

    Raises
    ------
    ValueError
        If `q` is not a percentile.
    """
    if not 0 <= q <= 100:
        msg = f"q must be a percentile 0..100, got {q}"
        raise ValueError(msg)
    return _over_answered(truth, mask, lambda error: np.percentile(np.abs(error), q))


def share_under(truth: Truth, *, limit_m: float = 0.05, mask: Bool | None = None) -> Metric:
    """Share of the scored pixels whose absolute error is under a limit; no answer is not under.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    limit_m : float
        Limit, m.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, 0..1; NaN without a scored pixel.

    Raises
    ------
    ValueError
        If the limit is not positive.

    Examples
    --------
    >>> truth = Truth(np.full((1, 4), 2.0))
    >>> share_under(truth, limit_m=0.05)(DepthMap(np.array([[2.0, 2.04, 2.06, np.nan]])))
    0.5
    """
    if not limit_m > 0:
        msg = f"limit_m must be positive metres, got {limit_m}"
        raise ValueError(msg)
    errors = _scored_errors(truth, mask)
    return lambda depth: _share(np.abs(errors(depth)) < limit_m)


def r2(truth: Truth, *, mask: Bool | None = None) -> Metric:
    """Coefficient of determination, 1 - sum(error^2) / sum((truth - mean truth)^2).

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, at most 1; NaN where the answered pixels have one range only.
    """
    errors = _scored_errors(truth, mask)
    wanted = truth.range_m[scored_pixels(truth, mask)].astype(np.float64)

    def run(depth: DepthMap) -> float:
        error = errors(depth)
        answered = np.isfinite(error)
        target = wanted[answered]
        # Compared, not subtracted: rounding of the mean can leave equal ranges a variance.
        if target.size == 0 or target.max() == target.min():
            return float("nan")
        return 1.0 - float(np.mean(error[answered] ** 2) / np.var(target))

    return run


def valid_share(truth: Truth, *, mask: Bool | None = None) -> Metric:
    """Share of the scored pixels that have an answer.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, 0..1; NaN without a scored pixel.
    """
    errors = _scored_errors(truth, mask)
    return lambda depth: _share(np.isfinite(errors(depth)))


def wrap_share(truth: Truth, *, ambiguity_m: float = 1.0, mask: Bool | None = None) -> Metric:
    """Share of the answered pixels that are off by more than half an ambiguity range.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    ambiguity_m : float
        Smallest step that a wrong wrap count makes, m; the default is that of 150 MHz.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, 0..1; NaN without an answered pixel.

    Raises
    ------
    ValueError
        If the ambiguity range is not positive.
    """
    if not ambiguity_m > 0:
        msg = f"ambiguity_m must be positive metres, got {ambiguity_m}"
        raise ValueError(msg)
    return _over_answered(truth, mask, lambda error: _share(np.abs(error) > ambiguity_m / 2))


def _share(part: Bool) -> float:
    return int(np.count_nonzero(part)) / part.size if part.size else float("nan")
