"""Error against coverage: how good the share of answers is that a method trusts most.

Answered pixels are taken in the order of the method's own confidence, or of growing sigma where it
gives none; pixels of equal confidence come together, so a method without either has a single
point. Shares are of all scored pixels, so a curve ends at the method's valid share.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.metrics.error import check_shape, scored_pixels
from toftools.types import F64, Bool, DepthMap, Truth


@dataclass(frozen=True, eq=False)
class CoverageCurve:
    """Errors of the most trusted answers, by growing coverage.

    Parameters
    ----------
    coverage : ndarray, (N,)
        Share of the scored pixels that is kept, growing to the valid share.
    mae_m, rmse_m : ndarray, (N,)
        Mean absolute and root mean square error of the kept answers, m.
    inlier_share, outlier_share : ndarray, (N,)
        Share of the scored pixels that is kept and right, and kept and wrong.
    threshold : ndarray, (N,)
        Least confidence kept (minus sigma in metres where sigma gives the order).
    """

    coverage: F64
    mae_m: F64
    rmse_m: F64
    inlier_share: F64
    outlier_share: F64
    threshold: F64


def coverage_curve(
    truth: Truth,
    depth: DepthMap,
    *,
    mask: Bool | None = None,
    limit_m: float = 0.3,
    max_points: int = 200,
) -> CoverageCurve:
    """Error, and right and wrong answers, as functions of the share of answers kept.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    depth : DepthMap
        Answer, with confidence or sigma if it has an order; a NaN of these comes last.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.
    limit_m : float
        Error under which an answer is right, m; 0.3 is that of the KDE evaluation.
    max_points : int
        Most points on the curve; longer curves are thinned evenly, the last point kept.

    Returns
    -------
    CoverageCurve
        Points by growing coverage; empty arrays without a scored answer.

    Raises
    ------
    ValueError
        If shapes differ, the limit is not positive or there are no points.

    References
    ----------
    Inlier and outlier rates over a swept confidence threshold: Jaremo Lawin, Forssen & Ovren,
    ECCV 2016, arXiv 1608.05209, evaluation section (recalled).

    Examples
    --------
    >>> truth = Truth(np.full((1, 4), 2.0))
    >>> answer = DepthMap(np.array([[2.0, 2.5, 2.1, np.nan]]), confidence=np.array([[3, 1, 2, 0]]))
    >>> curve = coverage_curve(truth, answer)
    >>> curve.coverage.tolist(), curve.outlier_share.tolist()
    ([0.25, 0.5, 0.75], [0.0, 0.0, 0.25])
    """
    if not (limit_m > 0 and max_points >= 1):
        msg = f"limit_m and max_points must be positive, got {limit_m} m and {max_points}"
        raise ValueError(msg)
    check_shape(depth, truth.range_m.shape)
    scored = scored_pixels(truth, mask)
    kept = scored & np.isfinite(depth.range_m)
    trust = _trust(depth)[kept]
    order = np.argsort(-trust, kind="stable")
    trust = trust[order]
    error = np.abs(depth.range_m[kept].astype(np.float64) - truth.range_m[kept])[order]

    last = _last_of_ties(trust, max_points)
    count = last + 1.0
    right = np.cumsum(error < limit_m, dtype=np.float64)[last]
    total = max(1, int(np.count_nonzero(scored)))
    return CoverageCurve(
        coverage=count / total,
        mae_m=np.cumsum(error)[last] / count,
        rmse_m=np.sqrt(np.cumsum(error * error)[last] / count),
        inlier_share=right / total,
        outlier_share=(count - right) / total,
        threshold=trust[last],
    )


def _trust(depth: DepthMap) -> F64:
    """Confidence, else minus sigma, else all the same; NaN is trusted least."""
    if depth.confidence is not None:
        trust = depth.confidence.astype(np.float64)
    elif depth.sigma_m is not None:
        trust = -depth.sigma_m.astype(np.float64)
    else:
        trust = np.zeros(depth.range_m.shape)
    return np.where(np.isnan(trust), -np.inf, trust)


def _last_of_ties(trust: F64, max_points: int) -> NDArray[np.intp]:
    """Position of the last pixel of each run of equal trust, thinned evenly."""
    if not trust.size:
        return np.zeros(0, dtype=np.intp)
    last = np.append(np.flatnonzero(trust[1:] != trust[:-1]), trust.size - 1)
    if last.size > max_points:
        # Counted from the end, so that the whole of the answers stays on the curve.
        keep = last.size - 1 - np.arange(max_points) * last.size // max_points
        last = last[keep[::-1]]
    return last.astype(np.intp)
