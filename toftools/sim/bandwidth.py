"""Bandwidths of the temporal kernel: the first, how they shrink, and what they do to phasors.

Inputs: a pass of path samples, or the bandwidths used. Source: thesis section 5.4 and B. W.
Silverman's rule of thumb. The rule is too wide for densities of several humps or long tails; the
shrinking mends that in time. Kernels are Epanechnikov's, of half width T.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from toftools.transient import Samples
from toftools.types import F64
from toftools.units import path_to_phase

ALPHA = 4 / 5
"""Balances variance and squared bias: both fall as n^-4/5 (thesis eq. 5.8)."""


def bandwidths_m(first_m: float, alpha: float = ALPHA) -> Iterator[float]:
    """Bandwidths of successive passes, without end (thesis section 5.4).

    Parameters
    ----------
    first_m : float
        Bandwidth of the first pass, m.
    alpha : float
        Shrinking, 0..1.

    Yields
    ------
    float
        Bandwidth, m.

    Examples
    --------
    >>> from itertools import islice
    >>> [round(t, 4) for t in islice(bandwidths_m(1.0), 3)]
    [1.0, 0.9, 0.84]
    """
    width, j = first_m, 1
    while True:
        yield width
        width *= (j + alpha) / (j + 1)
        j += 1


def kernel_gain(widths_m: ArrayLike, freqs_hz: ArrayLike) -> F64:
    """What the kernels of all passes multiply the phasor by: a real number below one.

    The Fourier transform of Epanechnikov's kernel, ``3 (sin x - x cos x) / x^3`` with
    ``x = 2 pi f T / c``, averaged over passes; divide by it for an unbiased phasor.

    Parameters
    ----------
    widths_m : array_like, (n,)
        Bandwidths of the passes, m, such as ``info["bandwidths_m"]``.
    freqs_hz : array_like, (F,)
        Frequencies, Hz.

    Returns
    -------
    ndarray, (F,)
        Gain; 1 at frequency zero.

    Examples
    --------
    >>> kernel_gain([0.5], [0.0, 20e6]).round(5).tolist()
    [1.0, 0.99561]
    """
    x = path_to_phase(np.asarray(widths_m), np.reshape(freqs_hz, (-1, 1)))  # (F, n)
    # Below 0.01 the two terms cancel to rounding; the series is good to x^4 / 280 there.
    safe = np.where(x > 0.01, x, 1.0)
    exact = 3 * (np.sin(safe) - safe * np.cos(safe)) / safe**3
    return np.asarray(np.where(x > 0.01, exact, 1 - x**2 / 10).mean(axis=1))


def rule_of_thumb_m(samples: Samples, shape: tuple[int, int]) -> float:
    """Half the bandwidth that suits a normal density: ``1.17 sigma n^-1/5``, to start from.

    Light of many bounces has humps narrower than its whole spread, and a kernel that is too wide
    costs more (bias, with the fourth power) than one that is too narrow (noise, with the first).

    Parameters
    ----------
    samples : Samples
        One pass.
    shape : tuple of int
        Image shape (height, width).

    Returns
    -------
    float
        Bandwidth, m, from the spread of path within pixels and their mean number of samples; a
        millimetre if all paths of a pixel are the same.

    References
    ----------
    B. W. Silverman, "Density estimation for statistics and data analysis" (1986), section 3.4.2:
    2.34 for Epanechnikov's kernel (recalled).
    """
    count = shape[0] * shape[1]
    weight = np.maximum(samples.weight, 0)
    total, sums = (np.bincount(samples.pixel, w, count) for w in (weight, weight * samples.path_m))
    mean = np.divide(sums, total, out=np.zeros(count), where=total > 0)
    square = float((weight * (samples.path_m - mean[samples.pixel]) ** 2).sum())
    sigma_m = float(np.sqrt(square / max(float(total.sum()), np.finfo(np.float64).tiny)))
    lit = max(1, int(np.count_nonzero(total)))
    per_pixel = max(1.0, samples.pixel.size / lit)
    return max(1e-3, 1.17 * sigma_m * float(per_pixel**-0.2))
