"""Histograms of range images: single pixel, derivative, bivariate and joint Haar statistics.

The distributions of thesis appendix 7.B, after Huang, Lee & Mumford (CVPR 2000), of x = ln(range)
as in their paper: a scene twice as large and twice as far has the same differences of x. Neither
the base nor the bins are printed in the thesis; they are fixed here, whatever the images hold, so
that histograms can be compared with one another, though not digit by digit with the thesis.

Bins: x from ln 0.05 m to ln 50 m in steps of 0.05 (range) or 0.1 (co-occurrence); differences
of x on an asinh scale, linear below 1 % (about the noise of a ToF pixel) and logarithmic above,
with one bin centred on zero, in steps of 0.2 (gradients) or 0.4 (Haar). Values beyond the base
count in the outermost bin.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from toftools.metrics.error import scored_pixels
from toftools.types import F32, F64, Bool, Truth

RANGE_BASE_M = (0.05, 50.0)
SLOPE_UNIT = 0.01
"""Difference of ln(range) at which the difference bins turn from linear to logarithmic."""
SEPARATION_PX = 8
"""Distance of the two pixels of a co-occurrence pair."""

Offset = tuple[int, int]
Image = F32 | F64


@dataclass(frozen=True)
class Distribution:
    """A histogram of ln(range) over small windows.

    Parameters
    ----------
    windows : tuple of tuple of (row, column)
        Pixel offsets of each kind of window; all kinds fill the same histogram.
    bin_of : callable
        From one array of x = ln(range) per offset to one array of bin numbers per axis, as
        floats; NaN where a pixel of the window is NaN.
    shape : tuple of int
        Number of bins per axis.
    """

    windows: tuple[tuple[Offset, ...], ...]
    bin_of: Callable[..., tuple[F64, ...]]
    shape: tuple[int, ...]


def _range_bins(step: float) -> tuple[Callable[[F64], F64], int]:
    low, high = np.log(RANGE_BASE_M)
    n = int(np.ceil((high - low) / step))
    return lambda x: np.clip(np.floor((x - low) * (1 / step)), 0, n - 1), n


def _slope_bins(step: float) -> tuple[Callable[[F64], F64], int]:
    """Bins of a difference of x; their number is odd, so zero lies mid-bin, not on a border."""
    n = int(np.ceil(np.arcsinh(1.0 / SLOPE_UNIT) / step))
    return (
        lambda d: np.clip(np.rint(np.arcsinh(d * (1 / SLOPE_UNIT)) * (1 / step)), -n, n) + n,
        2 * n + 1,
    )


def _distributions() -> Mapping[str, Distribution]:
    fine, n_fine = _range_bins(0.05)
    coarse, n_coarse = _range_bins(0.1)
    slope, n_slope = _slope_bins(0.2)
    haar, n_haar = _slope_bins(0.4)
    here, right, below, diagonal = (0, 0), (0, 1), (1, 0), (1, 1)
    pairs = ((here, (0, SEPARATION_PX)), (here, (SEPARATION_PX, 0)))
    square = ((here, right, below, diagonal),)

    def haar_hv(a: F64, b: F64, c: F64, d: F64) -> tuple[F64, F64]:
        return haar((a - b + c - d) / 2), haar((a + b - c - d) / 2)

    def haar_hd(a: F64, b: F64, c: F64, d: F64) -> tuple[F64, F64]:
        return haar((a - b + c - d) / 2), haar((a - b - c + d) / 2)

    return MappingProxyType(
        {
            "range": Distribution(((here,),), lambda x: (fine(x),), (n_fine,)),
            "gradient_h": Distribution(((here, right),), lambda a, b: (slope(b - a),), (n_slope,)),
            "gradient_v": Distribution(((here, below),), lambda a, b: (slope(b - a),), (n_slope,)),
            "cooccurrence": Distribution(
                pairs, lambda a, b: (coarse(a), coarse(b)), (n_coarse, n_coarse)
            ),
            "haar_hv": Distribution(square, haar_hv, (n_haar, n_haar)),
            "haar_hd": Distribution(square, haar_hd, (n_haar, n_haar)),
        }
    )


DISTRIBUTIONS = _distributions()
"""Statistic name to its windows and bins.

``range``: single pixel. ``gradient_h``, ``gradient_v``: x(right) - x(here), x(below) - x(here).
``cooccurrence``: x of two pixels `SEPARATION_PX` apart along a row or a column. ``haar_hv``,
``haar_hd``: of the 2 x 2 window (a b; c d), every one of them, the orthonormal Haar responses
horizontal (a-b+c-d)/2, vertical (a+b-c-d)/2 and diagonal (a-b-c+d)/2.
"""


def find(distribution: str) -> Distribution:
    """Windows and bins of a statistic.

    Parameters
    ----------
    distribution : str
        One of `DISTRIBUTIONS`.

    Returns
    -------
    Distribution
        Its windows and bins.

    Raises
    ------
    ValueError
        If there is no such statistic.
    """
    if distribution not in DISTRIBUTIONS:
        known = ", ".join(DISTRIBUTIONS)
        msg = f"distribution must be one of {known}; got {distribution!r}"
        raise ValueError(msg)
    return DISTRIBUTIONS[distribution]


def _window_pixels(valid: Bool, offsets: tuple[Offset, ...]) -> NDArray[np.intp]:
    """Flat pixel indices (n_offsets, N) of all windows that lie wholly on valid pixels."""
    height, width = valid.shape
    rows = max(0, height - max(dv for dv, _ in offsets))
    cols = max(0, width - max(du for _, du in offsets))
    whole = np.ones((rows, cols), dtype=bool)
    for dv, du in offsets:
        whole &= valid[dv : dv + rows, du : du + cols]
    v, u = np.nonzero(whole)
    return np.stack([(v + dv) * width + (u + du) for dv, du in offsets])  # (n_offsets, N)


def counter(distribution: Distribution, valid: Bool) -> Callable[[F32], F64]:
    """Function from a range image to its counts, with the windows found beforehand.

    Parameters
    ----------
    distribution : Distribution
        Windows and bins.
    valid : ndarray of bool, (H, W)
        Pixels that a window may touch.

    Returns
    -------
    callable
        ``counts(range_m) -> ndarray`` of the shape of the distribution; windows with a NaN do
        not count.
    """
    windows = [_window_pixels(valid, offsets) for offsets in distribution.windows]
    pixels = np.concatenate(windows, axis=1)  # (n_offsets, N)
    size = int(np.prod(distribution.shape))

    def counts(range_m: F32) -> F64:
        # A range of zero has no logarithm; below the base it counts in the lowest bin anyway.
        x = np.log(np.maximum(range_m.ravel().astype(np.float64), 1e-3))
        axes = distribution.bin_of(*(x[i] for i in pixels))
        flat = axes[0] if len(axes) == 1 else axes[0] * distribution.shape[1] + axes[1]
        flat = flat[~np.isnan(flat)].astype(np.intp)
        return np.bincount(flat, minlength=size).reshape(distribution.shape).astype(np.float64)

    return counts


def histogram(
    range_m: Image | Sequence[Image],
    distribution: str = "range",
    mask: Bool | Sequence[Bool] | None = None,
) -> F64:
    """Distribution of one statistic over a range image or a set of them.

    Parameters
    ----------
    range_m : ndarray, (H, W), or sequence of such
        Radial range, m; windows that touch a NaN are left out.
    distribution : str
        One of `DISTRIBUTIONS`.
    mask : ndarray of bool, (H, W), sequence of such, or None
        Pixels to use, one mask per image; None for all.

    Returns
    -------
    ndarray, (bins,) or (bins, bins)
        Shares that sum to one; all zero without a single window.

    Raises
    ------
    ValueError
        If the distribution is unknown, or images and masks do not match.

    References
    ----------
    Huang, Lee & Mumford, "Statistics of range images", CVPR 2000 (log range, derivative,
    bivariate and Haar statistics; recalled); Marco, thesis 2018, appendix 7.B.

    Examples
    --------
    >>> ramp = np.exp(0.1 * np.arange(12.0))[None]
    >>> p = histogram(ramp, "gradient_h")  # equal ratios fall in one bin
    >>> float(p.max()), int(np.count_nonzero(p))
    (1.0, 1)
    """
    wanted = find(distribution)
    images = [range_m] if isinstance(range_m, np.ndarray) else list(range_m)
    masks: Sequence[Bool | None]
    if mask is None:
        masks = [None] * len(images)
    else:
        masks = [mask] if isinstance(mask, np.ndarray) else list(mask)
    if len(masks) != len(images):
        msg = f"mask must be one per image, got {len(masks)} for {len(images)} images"
        raise ValueError(msg)
    total = np.zeros(wanted.shape)
    for image, pixels in zip(images, masks, strict=True):
        truth = Truth(np.asarray(image, dtype=np.float32))
        total += counter(wanted, scored_pixels(truth, pixels))(truth.range_m)
    return normalised(total)


def normalised(counts: F64) -> F64:
    """Counts as shares that sum to one, or zeros where nothing was counted.

    Parameters
    ----------
    counts : ndarray
        Counts.

    Returns
    -------
    ndarray, same shape
        Shares.
    """
    mass = counts.sum()
    return counts / mass if mass > 0 else counts
