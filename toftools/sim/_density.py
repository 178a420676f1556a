"""Compiled scatter of path samples into bins: a box (histogram) or a kernel per sample.

The kernel is Epanechnikov's, ``3 / (4 T) (1 - (x / T)^2)`` on [-T, T]; each bin gets the kernel's
integral over it, so a sample's weights sum to one whatever bandwidth and bin are. Where the kernel
crosses an end of the axis, the part outside is mirrored back. Samples outside the axis leave no
light in it; they are counted. The slow twin stands in tests/test_transients.py.
"""

import numpy as np
from numba import njit, prange

from toftools.types import F64


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _below(x: float) -> float:
    """Integral of the kernel of bandwidth 1 from minus infinity to x."""
    if x <= -1.0:
        return 0.0
    if x >= 1.0:
        return 1.0
    return 0.5 + 0.75 * x - 0.25 * x * x * x


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _spread(bins: F64, at: float, half: float, weight: float) -> None:
    """Add one sample, at and half its kernel in bins, to the bins of its pixel."""
    n_bins = bins.size
    if half <= 0.0:
        bins[int(at)] += weight
        return
    for image in (at, -at, 2.0 * n_bins - at):  # the sample, and its mirror images at both ends
        first = max(0, int(np.floor(image - half)))
        last = min(n_bins - 1, int(np.floor(image + half)))
        left = _below((first - image) / half)
        for t in range(first, last + 1):
            right = _below((t + 1 - image) / half)
            bins[t] += weight * (right - left)
            left = right


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def scatter(
    values: F64, missed: F64, pixel: F64, position: F64, weight: F64, half: float, workers: int
) -> None:
    """Add samples to bins, each worker to its own pixels, so that sums do not depend on how many.

    Parameters
    ----------
    values : ndarray, (P, T)
        Light per pixel and bin; added to.
    missed : ndarray, (P, 2)
        Light before and beyond the axis; added to.
    pixel : ndarray, (N,), int64
        Pixel of each sample.
    position : ndarray, (N,)
        Path of each sample in bins from the start of the axis.
    weight : ndarray, (N,)
        Light of each sample.
    half : float
        Bandwidth in bins, at most T; 0 for a histogram.
    workers : int
        Number of parallel workers.
    """
    n_bins = values.shape[1]
    for worker in prange(workers):
        for i in range(pixel.size):
            p = pixel[i]
            if p % workers != worker:
                continue
            if position[i] < 0.0:
                missed[p, 0] += weight[i]
            elif position[i] >= n_bins:
                missed[p, 1] += weight[i]
            else:
                _spread(values[p], position[i], half, weight[i])
