"""Coherence of an answer with a reference that may sit at a constant offset.

``|mean exp(2 pi j (answer - reference) / U)|`` is 1 if the two differ by a constant modulo the
ambiguity range U, and falls to 0 as the difference spreads over it. It tests sign, tap order and
frequency of a capture whose offset is not calibrated (docs/conventions.md); it says nothing about
bias, and nothing where the reference is nearly constant.
"""

from collections.abc import Callable

import numpy as np

from toftools.metrics.error import check_shape, scored_pixels
from toftools.types import Bool, DepthMap, Truth
from toftools.units import TWO_PI


def coherence(
    truth: Truth, *, ambiguity_m: float = 1.0, mask: Bool | None = None
) -> Callable[[DepthMap], float]:
    """Coherence of answer and reference modulo the ambiguity range; 1 up to a constant offset.

    Parameters
    ----------
    truth : Truth
        Reference range, (H, W).
    ambiguity_m : float
        Ambiguity range U, m.
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

    Examples
    --------
    >>> reference = Truth(np.array([[1.0, 2.0, 3.0]]))
    >>> round(coherence(reference, ambiguity_m=2.5)(DepthMap(np.array([[1.4, 2.4, 3.4]]))), 6)
    1.0
    """
    if not ambiguity_m > 0:
        msg = f"ambiguity_m must be positive metres, got {ambiguity_m}"
        raise ValueError(msg)
    scored = scored_pixels(truth, mask)

    def run(depth: DepthMap) -> float:
        check_shape(depth, truth.range_m.shape)
        kept = scored & np.isfinite(depth.range_m)
        if not kept.any():
            return float("nan")
        difference = depth.range_m[kept].astype(np.float64) - truth.range_m[kept]
        return float(np.abs(np.exp(1j * TWO_PI * difference / ambiguity_m).mean()))

    return run
