"""Light against path length: the transient of every pixel, and its phasor at any frequency.

The axis is the whole optical path from emitter to camera in metres, so a lone return at range r
lies at 2 r. A bin holds light (the energy in it, not a density), in the light convention of the
simulators: the sum over bins is the phasor at frequency zero. Pooling path lengths into bins
multiplies the phasor by ``sinc(f box / c)`` (a box convolved with the density, then sampled), which
`phasors` divides out: exact for light that is smooth over a bin. A lone return is not smooth: its
path stays uncertain by half a bin (a quarter of a bin in range), and only in the complex mean over
many pixels is the factor right for it. The factor is real, so it moves no phase either way. It
fails where a bin is half a wavelength or more.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toftools._arrays import expect_shape, frozen, frozen_mapping, set_fields
from toftools.types import F32, F64
from toftools.units import TWO_PI, path_to_phase

UNITS = ("relative", "e-")
MOST_VALUES = 1 << 29
"""More bins times pixels than any machine wants: a larger claim is a hostile header."""
_LIT = 0.1
"""A bin is lit from this share of the brightest bin of its pixel."""


class Samples(NamedTuple):
    """What paths brought, one entry per contribution.

    Parameters
    ----------
    pixel : ndarray, (N,), int
        Index of the pixel, row by row.
    path_m : ndarray, (N,)
        Optical path length from emitter to camera, m.
    weight : ndarray, (N,)
        Contribution, so that the weights of a pixel sum to an estimate of its light.
    """

    pixel: NDArray[np.integer[Any]]
    path_m: F64
    weight: F64


@dataclass(frozen=True, eq=False)
class Transient:
    """Light per bin of path length and pixel.

    Parameters
    ----------
    values : ndarray, (T, H, W)
        Light in each bin, float32, in `unit`.
    bin_m : float
        Width of a bin in whole optical path (not in one-way range), m.
    start_m : float or ndarray, () or (H, W)
        Path at the start of the first bin, m; an image if it differs from pixel to pixel.
    box_m : float or None
        Width over which path lengths were pooled, m; None is the bin, 0 a response sampled at the
        bin centres.
    unit : {"relative", "e-"}
        ``relative``: 1 is a white wall facing the camera at 1 m, that is `Noise.signal_e`
        electrons per tap; ``e-``: electrons per tap.
    missed : ndarray, (H, W), or None
        Light that fell outside the axis; None if nobody counted it.
    info : mapping
        How it was made: method, samples, samples outside, bandwidths (JSON values).
    """

    values: F32
    bin_m: float
    start_m: F64 = field(default_factory=lambda: np.zeros(()))
    box_m: float | None = None
    unit: str = "relative"
    missed: F32 | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        values = frozen(self.values, np.float32, "a transient", 3)
        _light(values, "a transient")
        box_m = self.bin_m if self.box_m is None else self.box_m
        widths = np.array([self.bin_m, box_m], dtype=np.float64)
        if not (np.isfinite(widths).all() and self.bin_m > 0 and box_m >= 0):
            msg = f"bin_m must be positive metres and box_m not negative, got {self.bin_m}, {box_m}"
            raise ValueError(msg)
        start = frozen(self.start_m, np.float64, "start_m", 2 if np.ndim(self.start_m) else 0)
        if start.ndim:
            expect_shape("start_m", start, values.shape[1:])
        if not np.isfinite(start).all():
            msg = "start_m must be finite metres, got nan or infinite ones; fill them in"
            raise ValueError(msg)
        if self.unit not in UNITS:
            msg = f"unit must be one of {UNITS}, got {self.unit!r}"
            raise ValueError(msg)
        if self.missed is not None:
            missed = frozen(self.missed, np.float32, "missed", 2)
            expect_shape("missed", missed, values.shape[1:])
            _light(missed, "missed")
            set_fields(self, missed=missed)
        set_fields(self, values=values, bin_m=float(self.bin_m), box_m=float(box_m))
        set_fields(self, start_m=start, info=frozen_mapping(self.info))

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape (height, width)."""
        height, width = self.values.shape[1:]
        return height, width

    @property
    def n_bins(self) -> int:
        """Number of bins T."""
        return int(self.values.shape[0])


def _light(values: F32, what: str) -> None:
    low, high = float(values.min()), float(values.max())  # nan comes through both
    if not (low >= 0 and high < np.inf):
        msg = f"{what} must hold light of 0 or more, got values from {low:g} to {high:g}"
        raise ValueError(msg)


def phasors(transient: Transient, freqs_hz: ArrayLike) -> NDArray[np.complex128]:
    """Phasors of a transient, the box of its bins divided out.

    Parameters
    ----------
    transient : Transient
        Light along path length.
    freqs_hz : array_like, (F,)
        Any frequencies, Hz; 0 gives the light in all bins.

    Returns
    -------
    ndarray, (F, H, W), complex
        ``sum_t v_t exp(+j 2 pi f l_t / c) / sinc(f box / c)``, l_t the bin centre, in the unit of
        the transient.

    Raises
    ------
    ValueError
        If a frequency is negative, not finite, or so high that a bin is half a wavelength.

    Examples
    --------
    >>> wall = np.zeros((3, 1, 1), np.float32)
    >>> wall[1] = 1
    >>> z = phasors(Transient(wall, bin_m=0.1, start_m=3.85, box_m=0.0), [20e6])
    >>> from toftools.units import phase_to_range
    >>> round(float(phase_to_range(np.angle(z[0, 0, 0]), 20e6)), 6)
    2.0
    """
    freqs = np.atleast_1d(np.asarray(freqs_hz, dtype=np.float64))
    assert transient.box_m is not None
    turns = path_to_phase(max(transient.bin_m, transient.box_m), freqs) / TWO_PI
    if not ((freqs >= 0).all() and (turns < 0.5).all()):
        msg = (
            f"got bins of {transient.bin_m:g} m, which cannot hold {freqs.max() / 1e6:g} MHz; "
            "wanted frequencies of 0 or more and bins under half a wavelength"
        )
        raise ValueError(msg)
    centres = (np.arange(transient.n_bins) + 0.5) * transient.bin_m
    angle = path_to_phase(centres, freqs[:, None])  # (F, T)
    waves = np.concatenate([np.cos(angle), np.sin(angle)])  # (2 F, T)
    parts = np.empty((len(waves), *transient.shape))
    for row in range(transient.shape[0]):  # one row at a time: float64 copies stay small
        parts[:, row] = waves @ transient.values[:, row].astype(np.float64)
    box = np.sinc(path_to_phase(transient.box_m, freqs) / TWO_PI)
    turn = np.exp(1j * path_to_phase(transient.start_m, freqs[:, None, None]))
    turn = turn / box[:, None, None]
    return np.asarray((parts[: freqs.size] + 1j * parts[freqs.size :]) * turn)


def samples_phasor(
    samples: Samples, shape: tuple[int, int], freq_hz: float
) -> NDArray[np.complex128]:
    """The phasor straight from path samples, which needs no bins.

    Parameters
    ----------
    samples : Samples
        Contributions of paths.
    shape : tuple of int
        Image shape (height, width).
    freq_hz : float
        Frequency, Hz.

    Returns
    -------
    ndarray, (H, W), complex
        ``sum w exp(+j 2 pi f path / c)`` per pixel.
    """
    angle = path_to_phase(samples.path_m, freq_hz)
    count = shape[0] * shape[1]
    parts = [
        np.bincount(samples.pixel, samples.weight * wave, count)
        for wave in (np.cos(angle), np.sin(angle))
    ]
    return np.asarray((parts[0] + 1j * parts[1]).reshape(shape))


def first_return_m(transient: Transient, *, least_share: float = 0.2, widest_m: float = 0.1) -> F64:
    """Range of the first return where it stands apart from the light behind it.

    The return is the first run of bins that hold a tenth of the brightest one or more, single
    darker bins forgiven: a lone return in one bin or two, a sloping surface in as many as its
    pixel spans. It stands apart if the run is short and holds enough of the pixel's light. Half
    the path is a range only if the emitter sits at the camera.

    Parameters
    ----------
    transient : Transient
        Light along path length.
    least_share : float
        Least share of a pixel's light in its first return.
    widest_m : float
        Longest run, m of whole path (bins of more than half of it count singly or in pairs).

    Returns
    -------
    ndarray, (H, W)
        Range of the run's centroid, m, uncertain by a quarter of a bin and drawn back by light
        that follows within the run; NaN where nothing stands apart.

    Examples
    --------
    >>> bins = np.zeros((50, 1, 1), np.float32)
    >>> bins[20], bins[30:] = 1, 0.02
    >>> first_return_m(Transient(bins, bin_m=0.1)).round(3).item()
    1.025
    """
    total = transient.values.sum(axis=0, dtype=np.float64)
    if transient.missed is not None:
        total = total + transient.missed
    light, middle = np.empty(transient.shape), np.empty(transient.shape)
    most = max(2, int(np.ceil(widest_m / transient.bin_m)))
    for row in range(transient.shape[0]):
        light[row], middle[row] = _first_run(transient.values[:, row].astype(np.float64), most)
    path_m = transient.start_m + middle * transient.bin_m
    apart = (light > 0) & (light >= least_share * total) & (path_m > 0)
    return np.where(apart, path_m / 2, np.nan)


def _first_run(values: F64, most: int) -> tuple[F64, F64]:
    """Light and centroid, in bins, of the first run of lit bins (T, W); 0 light if too long."""
    bins = np.arange(len(values))[:, None]
    lit = (values >= _LIT * values.max(axis=0)) & (values > 0)
    first = np.argmax(lit, axis=0)
    ends = ~lit & ~np.concatenate([lit[1:], np.zeros_like(lit[:1])]) & (bins > first)
    end = np.where(ends.any(axis=0), np.argmax(ends, axis=0), len(values))
    run = np.where((bins >= first) & (bins < end), values, 0.0)
    light = run.sum(axis=0)
    middle = ((bins + 0.5) * run).sum(axis=0) / np.maximum(light, np.finfo(np.float64).tiny)
    return np.where(end - first <= most, light, 0.0), middle


def cut_share(transient: Transient) -> float:
    """Share of the light that lies outside the axis: as counted, or else as its end suggests.

    Without a count, the light in the last fiftieth of the bins is continued with the decay it has
    had since an eighth of the axis before; light that does not decay there has no bound. Light in
    the first bin tells of light before it, unless the axis starts at zero.

    Parameters
    ----------
    transient : Transient
        Light along path length.

    Returns
    -------
    float
        Share, 0..1; 1 if the light does not decay at the end of the axis.

    Examples
    --------
    >>> decay = np.exp(-np.arange(400) / 40).astype(np.float32)[:, None, None]
    >>> bool(cut_share(Transient(decay, 0.01)) < 1e-4 < cut_share(Transient(decay[:160], 0.01)))
    True
    """
    per_bin = transient.values.sum(axis=(1, 2), dtype=np.float64)
    total = float(per_bin.sum())
    if transient.missed is not None:
        missed = float(transient.missed.sum(dtype=np.float64))
        return missed / (missed + total) if missed > 0 else 0.0
    if total == 0:
        return 0.0
    early = per_bin[0] if np.max(transient.start_m) > 0 else 0.0
    width, lag = max(1, per_bin.size // 50), max(1, per_bin.size // 8)
    end = per_bin[-width:].sum()
    if end == 0:
        return float(early / (early + total))
    before = per_bin[-width - lag : -lag].sum() if per_bin.size > width + lag else 0.0
    if before <= end:
        return 1.0
    decay = (end / before) ** (width / lag)  # per `width` bins
    outside = early + end * decay / (1 - decay)
    return float(outside / (outside + total))
