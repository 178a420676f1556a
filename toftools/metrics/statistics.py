"""How far two depth statistics differ: chi-squared error, Jensen-Shannon distance, correlation.

Thesis appendix 7.B (DeepToF) compares real and simulated range images this way; here they also
score an answer against the truth, over the same scored pixels. The histograms and their fixed bins
are in distributions.py. A histogram says nothing about where a range stands: an answer can agree
here and be wrong everywhere, so read these beside the errors. Windows that touch a pixel without
an answer are left out of the answer's histogram only, so leaving out the far wall shows.
"""

from collections.abc import Callable

import numpy as np

from toftools.metrics.distributions import counter, find, histogram, normalised
from toftools.metrics.error import Metric, check_shape, scored_pixels
from toftools.types import F64, Bool, DepthMap, Truth

__all__ = [
    "chi2",
    "chi2_error",
    "compare",
    "histogram",
    "js",
    "js_distance",
    "pearson",
    "pearson_correlation",
]


def _checked(p: F64, q: F64) -> tuple[F64, F64] | None:
    """Both histograms flat, or None where one is empty and there is nothing to compare."""
    p, q = np.asarray(p, dtype=np.float64), np.asarray(q, dtype=np.float64)
    if p.shape != q.shape:
        msg = f"histograms must have the same bins, got shapes {p.shape} and {q.shape}"
        raise ValueError(msg)
    return (p.ravel(), q.ravel()) if p.any() and q.any() else None


def chi2_error(p: F64, q: F64) -> float:
    """Chi-squared error of two histograms, ``1/2 sum (p - q)^2 / (p + q)``.

    Parameters
    ----------
    p, q : ndarray, same shape
        Shares that sum to one.

    Returns
    -------
    float
        0 (equal) to 1 (disjoint); unbounded for histograms that do not sum to one. NaN if one
        is empty.

    References
    ----------
    Pele & Werman, "The quadratic-chi histogram distance family", ECCV 2010 (recalled). That the
    thesis uses this form is inferred: all six of its printed pairs of chi-squared error and
    Jensen-Shannon distance obey ``chi2 / 2 <= js^2 <= ln(2) chi2`` (Topsoe, IEEE Trans. Inf.
    Theory 46, 2000, recalled), which fails for the form without 1/2 and for division by q.

    Examples
    --------
    >>> round(chi2_error(np.array([0.5, 0.5]), np.array([0.25, 0.75])), 6)
    0.066667
    """
    both = _checked(p, q)
    if both is None:
        return float("nan")
    difference, total = both[0] - both[1], both[0] + both[1]
    used = total > 0
    return float(0.5 * np.sum(difference[used] ** 2 / total[used]))


def js_distance(p: F64, q: F64) -> float:
    """Jensen-Shannon distance: root of the divergence, natural logarithm.

    Parameters
    ----------
    p, q : ndarray, same shape
        Shares that sum to one.

    Returns
    -------
    float
        0 (equal) to sqrt(ln 2) = 0.833 (disjoint); NaN if one is empty.

    References
    ----------
    Endres & Schindelin, "A new metric for probability distributions", IEEE Trans. Inf. Theory 49
    (2003): the root is a metric (recalled). Bound as printed in Marco, thesis 2018, 7.B.

    Examples
    --------
    >>> round(js_distance(np.array([1.0, 0.0]), np.array([0.0, 1.0])), 3)
    0.833
    """
    both = _checked(p, q)
    if both is None:
        return float("nan")
    middle = (both[0] + both[1]) / 2
    divergence = sum(float(np.sum(a[a > 0] * np.log(a[a > 0] / middle[a > 0]))) for a in both) / 2
    # Rounding may leave a divergence of equal histograms just below zero.
    return float(np.sqrt(max(divergence, 0.0)))


def pearson_correlation(p: F64, q: F64) -> float:
    """Pearson correlation of two histograms over all bins of the fixed base.

    Parameters
    ----------
    p, q : ndarray, same shape
        Shares that sum to one.

    Returns
    -------
    float
        -1..1; NaN if one is empty or flat. Bins that are empty in both count, so it stays close
        to the cosine between the histograms.

    Examples
    --------
    >>> round(pearson_correlation(np.array([0.2, 0.3, 0.5]), np.array([0.3, 0.4, 0.3])), 4)
    -0.189
    """
    both = _checked(p, q)
    if both is None:
        return float("nan")
    a, b = both[0] - both[0].mean(), both[1] - both[1].mean()
    norm = np.sqrt(np.sum(a * a) * np.sum(b * b))
    return float(np.sum(a * b) / norm) if norm > 0 else float("nan")


def compare(p: F64, q: F64) -> dict[str, float]:
    """All three comparisons of two histograms.

    Parameters
    ----------
    p, q : ndarray, same shape
        Histograms from `histogram`.

    Returns
    -------
    dict of str to float
        ``chi2``, ``js`` and ``pearson``.

    Examples
    --------
    >>> near, far = np.full((9, 9), 2.0), np.full((9, 9), 4.0)
    >>> {k: round(v, 2) for k, v in compare(histogram([near, far]), histogram([near])).items()}
    {'chi2': 0.33, 'js': 0.46, 'pearson': 0.7}
    """
    return {
        "chi2": chi2_error(p, q),
        "js": js_distance(p, q),
        "pearson": pearson_correlation(p, q),
    }


def chi2(truth: Truth, *, distribution: str = "range", mask: Bool | None = None) -> Metric:
    """Chi-squared error between the depth statistics of answer and truth.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    distribution : str
        One of `toftools.metrics.distributions.DISTRIBUTIONS`.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, 0 (equal) to 1 (disjoint);
        NaN without a window on either side.

    Raises
    ------
    ValueError
        If the distribution is unknown.

    References
    ----------
    Marco, thesis 2018, appendix 7.B; formula in `chi2_error`.
    """
    return _against(truth, distribution, mask, chi2_error)


def js(truth: Truth, *, distribution: str = "range", mask: Bool | None = None) -> Metric:
    """Jensen-Shannon distance between the depth statistics of answer and truth.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    distribution : str
        One of `toftools.metrics.distributions.DISTRIBUTIONS`.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, 0 (equal) to sqrt(ln 2) (disjoint);
        NaN without a window on either side.

    Raises
    ------
    ValueError
        If the distribution is unknown.

    References
    ----------
    Marco, thesis 2018, appendix 7.B; formula in `js_distance`.
    """
    return _against(truth, distribution, mask, js_distance)


def pearson(truth: Truth, *, distribution: str = "range", mask: Bool | None = None) -> Metric:
    """Pearson correlation between the depth statistics of answer and truth.

    Parameters
    ----------
    truth : Truth
        Range to score against, (H, W).
    distribution : str
        One of `toftools.metrics.distributions.DISTRIBUTIONS`.
    mask : ndarray of bool, (H, W), or None
        Pixels to score; None for all.

    Returns
    -------
    callable
        ``run(DepthMap) -> float``, -1 to 1 (equal);
        NaN without a window on either side.

    Raises
    ------
    ValueError
        If the distribution is unknown.

    References
    ----------
    Marco, thesis 2018, appendix 7.B; formula in `pearson_correlation`.
    """
    return _against(truth, distribution, mask, pearson_correlation)


def _against(
    truth: Truth, distribution: str, mask: Bool | None, measure: Callable[[F64, F64], float]
) -> Metric:
    """Metric that compares the answer's histogram with that of the truth."""
    shape = truth.range_m.shape
    counts = counter(find(distribution), scored_pixels(truth, mask))
    wanted = normalised(counts(truth.range_m))

    def run(depth: DepthMap) -> float:
        check_shape(depth, shape)
        return measure(normalised(counts(depth.range_m)), wanted)

    return run
