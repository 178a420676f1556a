"""Several returns per pixel: which of them is the first, and the answer that says so.

Reference: the direct light is the shortest path, so the nearest return that is strong enough is
the surface (the rule of every sparse method here; the threshold keeps noise from winning). Inputs:
returns of any method, in any order. Fails where the first surface is weaker than the threshold,
and, like all that counts wraps, where the range repeats.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.correct import INVALID, OK, REJECTED
from toftools.types import F32, F64, Bool, DepthMap

GUARD_M = 0.05
"""A return up to this far below zero (that is, below a whole period) is one at zero."""


def sorted_returns(
    ranges_m: F64, amplitudes: F64, *, first_share: float, period_m: float
) -> tuple[F64, F64]:
    """Returns in ascending range; those too weak to count come last, as NaN of amplitude 0.

    Parameters
    ----------
    ranges_m : ndarray, (L, ...)
        Ranges, m; NaN for no return.
    amplitudes : ndarray, (L, ...)
        Amplitudes; zero, negative and NaN ones are no returns.
    first_share : float
        Least amplitude, relative to the strongest.
    period_m : float
        Range after which all phases repeat, m, into which ranges are taken; 0 takes none.

    Returns
    -------
    ranges_m, amplitudes : ndarray, (L, ...)
        The returns that count. One up to `GUARD_M` below zero is set to zero, since otherwise
        noise would send near objects to the far end.

    Examples
    --------
    >>> ranges_m, amplitudes = sorted_returns(
    ...     np.array([5.0, 14.98, 2.0]), np.array([1.0, 0.5, 0.01]), first_share=0.1, period_m=15.0
    ... )
    >>> ranges_m.tolist(), amplitudes.tolist()
    ([0.0, 5.0, nan], [0.5, 1.0, 0.0])
    """
    strength = np.where(np.isfinite(ranges_m) & (amplitudes > 0), amplitudes, 0.0)
    kept = (strength > 0) & (strength >= first_share * strength.max(axis=0))
    moved = ranges_m
    if period_m > 0:
        with np.errstate(invalid="ignore"):
            moved = np.mod(ranges_m + GUARD_M, period_m) - GUARD_M
    moved = np.where(kept, np.maximum(moved, 0.0), np.inf)
    order = np.argsort(moved, axis=0, kind="stable")
    moved, strength = (np.take_along_axis(a, order, axis=0) for a in (moved, strength))
    none = np.isinf(moved)
    return np.where(none, np.nan, moved), np.where(none, 0.0, strength)


def answer(
    ranges_m: F64,
    amplitudes: F64,
    usable: Bool,
    *,
    sigma_m: NDArray[Any] | None,
    confidence: NDArray[Any] | None = None,
) -> DepthMap:
    """The first return of every pixel as an answer.

    Parameters
    ----------
    ranges_m, amplitudes : ndarray, (L, H, W)
        As `sorted_returns` gives them.
    usable : ndarray, (H, W), bool
        Pixels with a signal; the others are INVALID.
    sigma_m : ndarray, (H, W), or None
        Standard deviation of the first return, m; None if the noise is unknown.
    confidence : ndarray, (H, W), or None
        Higher is better; None is the share of the first return in the total amplitude.

    Returns
    -------
    DepthMap
        ``info``: `status`; `returns` (H, W), how many count; `ranges_m` and `amplitudes`
        (L, H, W) of all of them, nearest first, NaN and 0 where there are fewer.
    """
    first = np.where(usable, ranges_m[0], np.nan).astype(np.float32)
    answered = np.isfinite(first)
    status = np.where(answered, OK, np.where(usable, REJECTED, INVALID)).astype(np.uint8)
    total = amplitudes.sum(axis=0)
    if confidence is None:
        confidence = np.divide(amplitudes[0], total, out=np.zeros_like(total), where=total > 0)
    return DepthMap(
        range_m=first,
        sigma_m=None if sigma_m is None else _where(answered, sigma_m, np.nan),
        confidence=_where(answered, confidence, 0.0),
        info={
            "status": status,
            "returns": (amplitudes > 0).sum(axis=0).astype(np.uint8),
            "ranges_m": ranges_m.astype(np.float32),
            "amplitudes": amplitudes.astype(np.float32),
        },
    )


def _where(answered: Bool, values: NDArray[Any], otherwise: float) -> F32:
    return np.where(answered, values, otherwise).astype(np.float32)
