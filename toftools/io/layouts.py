"""Foreign transients and phasor tensors into ours: every convention a parameter, none guessed.

Known layouts: mitransient 1.3.1 histograms, ``axes="hwtc"`` in whole path, light summed per bin,
and its phasors (H, W, F, 2) with sign -1, counted from ``start_opl``; both start at the near
plane of the camera (`with_near_clip`). FLAT (Guo et al., ECCV 2018) keeps lists of (row, column,
time) indices with values, time of the whole way in picoseconds, bin t standing at t times the
bin width (``at=0``); its files are pickles, which nothing here opens: save the two arrays as .npz.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toftools.camera import rays
from toftools.transient import MOST_VALUES, Transient
from toftools.types import F32, Camera
from toftools.units import path_to_phase

WAYS = {"round": 1.0, "one": 2.0}
"""Whole optical path per unit of the axis: the axis counts the round trip, or one way."""


def from_array(
    values: NDArray[Any],
    *,
    axes: str,
    bin_m: float,
    start_m: float = 0.0,
    way: str = "round",
    at: float = 0.5,
    channel: int = 0,
    scale: float = 1.0,
    unit: str = "relative",
) -> Transient:
    """A transient out of a dense array.

    Parameters
    ----------
    values : ndarray
        Light per bin, 3 axes, or 4 with channels.
    axes : str
        What they are, in order: ``t`` bins, ``h`` rows, ``w`` columns, ``c`` channels, such as
        ``thw`` or ``hwtc``.
    bin_m, start_m : float
        Width of a bin and start of the first, m; for time use `units.time_to_path`.
    way : {"round", "one"}
        Whether the axis counts the whole path or the range one way.
    at : float
        Where in its bin the light stands, 0..1: 0.5 for pooled paths, 0 if bin t means t bins.
    channel : int
        Which channel to take.
    scale : float
        What one unit of the array is in `unit`.
    unit : {"relative", "e-"}
        Unit of the result: see `Transient`.

    Returns
    -------
    Transient
        The same light in our layout.

    Raises
    ------
    ValueError
        If the axes do not fit the array, there is no such channel, or the numbers are no light.

    Examples
    --------
    >>> from_array(np.ones((2, 3, 5, 1)), axes="hwtc", bin_m=0.01).values.shape
    (5, 2, 3)
    """
    letters = sorted(axes)
    if letters not in (sorted("thw"), sorted("thwc")) or len(axes) != values.ndim:
        msg = (
            f"got axes={axes!r} for an array of shape {values.shape}; wanted one letter per axis: "
            "t bins, h rows, w columns and, if there are channels, c"
        )
        raise ValueError(msg)
    if values.dtype.kind not in "buif":
        msg = f"a transient holds real numbers, got {values.dtype.name}"
        raise ValueError(msg)
    ordered = values.transpose([axes.index(letter) for letter in "cthw" if letter in axes])
    if "c" in axes:
        if not 0 <= channel < ordered.shape[0]:
            msg = f"got channel={channel}, the array has {ordered.shape[0]}; they count from 0"
            raise ValueError(msg)
        ordered = ordered[channel]
    start, bin_m = _axis(bin_m, start_m, way, at)
    return Transient(_scaled(ordered, scale), bin_m, np.asarray(start), unit=unit)


def from_sparse(
    index: NDArray[Any],
    values: NDArray[Any],
    *,
    shape: tuple[int, int],
    bin_m: float,
    way: str = "round",
    at: float = 0.0,
    scale: float = 1.0,
    unit: str = "relative",
) -> Transient:
    """A transient out of lists of indices and values, as FLAT keeps them.

    Parameters
    ----------
    index : ndarray, (3, N) or (N, 3), int
        Row, column and bin of each entry.
    values : ndarray, (N,)
        Light of each entry; entries of the same place add up.
    shape : tuple of int
        Image shape (height, width).
    bin_m : float
        Width of a bin, m; for time use `units.time_to_path`.
    way, at, scale, unit
        As in `from_array`; FLAT's bin t stands at t bins.

    Returns
    -------
    Transient
        Dense, from the first bin that is used to the last.

    Raises
    ------
    ValueError
        If an index lies outside the image or before zero, or the bins take too much room.
    """
    index, values = np.asarray(index), np.asarray(values)
    if index.ndim == 2 and index.shape[0] != 3 and index.shape[1] == 3:
        index = index.T
    whole = index.ndim == 2 and index.shape[0] == 3 and index.dtype.kind in "iu"
    if not whole or values.shape != (index.shape[1],) or not values.size:
        msg = f"wanted whole index (3, N) with values (N,), got {index.shape} and {values.shape}"
        raise ValueError(msg)
    low, high = index.min(axis=1), index.max(axis=1)
    if (low < 0).any() or (high[:2] >= shape).any():
        msg = f"indices run from {low.tolist()} to {high.tolist()}, beyond the image {shape}"
        raise ValueError(msg)
    n_bins = int(high[2]) - int(low[2]) + 1
    if n_bins * shape[0] * shape[1] > MOST_VALUES:
        msg = f"{n_bins} bins of {shape[1]} x {shape[0]} px take too much room; use fewer bins"
        raise ValueError(msg)
    dense = np.zeros((n_bins, *shape), np.float32)
    np.add.at(dense, (index[2] - low[2], index[0], index[1]), _scaled(values, scale))
    start, bin_m = _axis(bin_m, bin_m * int(low[2]), way, at)
    return Transient(dense, bin_m, np.asarray(start), unit=unit)


def _axis(bin_m: float, start_m: float, way: str, at: float) -> tuple[float, float]:
    """Start and width of the bins in whole path, the light standing at their centres."""
    if way not in WAYS or not 0 <= at <= 1:
        msg = f"way must be one of {', '.join(WAYS)} and at 0..1, got {way!r} and {at}"
        raise ValueError(msg)
    return WAYS[way] * (start_m + (at - 0.5) * bin_m), WAYS[way] * bin_m


def _scaled(values: NDArray[Any], scale: float) -> F32:
    if not (np.isfinite(scale) and scale > 0):
        msg = f"scale must be a positive number, got {scale}"
        raise ValueError(msg)
    with np.errstate(over="ignore"):  # infinite light is refused later
        light = values.astype(np.float32, copy=False)
        return light if scale == 1 else light * np.float32(scale)


def with_near_clip(transient: Transient, camera: Camera, near_clip_m: float) -> Transient:
    """The same transient with paths counted from the camera centre, not from the near plane.

    Parameters
    ----------
    transient : Transient
        Transient whose paths start on the near plane, as those of Mitsuba's cameras do.
    camera : Camera
        Camera, which gives the angle of every ray.
    near_clip_m : float
        Distance of the near plane along the axis, m.

    Returns
    -------
    Transient
        With ``near_clip_m / cos`` added to the path of every pixel.

    Raises
    ------
    ValueError
        If the distance is negative or the camera is of another size.
    """
    start_m = transient.start_m + near_path_m(camera, near_clip_m, transient.shape)
    return replace(transient, start_m=start_m)


def near_path_m(camera: Camera, near_clip_m: float, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Way from the camera centre to its near plane along every ray.

    Parameters
    ----------
    camera : Camera
        Camera.
    near_clip_m : float
        Distance of the near plane along the axis, m.
    shape : tuple of int
        Image shape (height, width) that the camera must have.

    Returns
    -------
    ndarray, (H, W)
        Length, m.

    Raises
    ------
    ValueError
        If the distance is negative or the camera is of another size.
    """
    if not (np.isfinite(near_clip_m) and near_clip_m >= 0):
        msg = f"near_clip_m must be 0 or more metres, got {near_clip_m}"
        raise ValueError(msg)
    if camera.shape != shape:
        msg = f"the camera must be of the size of the image {shape}, got {camera.shape}"
        raise ValueError(msg)
    forward = rays(camera)[..., 2]
    if (forward <= 0).any():
        msg = "a near clipping plane needs rays that look forward, and this fisheye looks aside too"
        raise ValueError(msg)
    return np.asarray(near_clip_m / forward)


def from_phasors(
    values: NDArray[Any],
    freqs_hz: ArrayLike,
    *,
    axes: str,
    sign: int,
    start_m: ArrayLike = 0.0,
    scale: float = 1.0,
) -> NDArray[np.complex128]:
    """Phasors (F, H, W) of our convention out of another renderer's tensor.

    Parameters
    ----------
    values : ndarray
        Complex numbers with 3 axes, or real ones with real and imaginary part as a fourth.
    freqs_hz : array_like, (F,)
        Their frequencies, Hz: turns per metre times `units.C_M_S`.
    axes : str
        ``f`` frequencies, ``h`` rows, ``w`` columns, ``p`` the two parts, such as ``hwfp``.
    sign : {1, -1}
        Sign of the exponent: -1 for ``exp(-j 2 pi f l / c)``, as mitransient has it.
    start_m : array_like, () or (H, W)
        Path that its phases leave out, m: ``start_opl`` and `near_path_m`.
    scale : float
        What one unit of the tensor is in ours.

    Returns
    -------
    ndarray, (F, H, W), complex
        ``scale * z exp(+j 2 pi f start / c)``.

    Raises
    ------
    ValueError
        If the axes do not fit the tensor, or the sign is neither 1 nor -1.
    """
    freqs = np.atleast_1d(np.asarray(freqs_hz, dtype=np.float64))
    wanted = sorted("fhw") if values.dtype.kind == "c" else sorted("fhwp")
    if sorted(axes) != wanted or len(axes) != values.ndim or sign not in (1, -1):
        msg = (
            f"got axes={axes!r} and sign={sign} for {values.dtype.name} of shape {values.shape}; "
            "wanted one letter per axis (f, h, w, and p unless complex) and 1 or -1"
        )
        raise ValueError(msg)
    ordered = values.transpose([axes.index(letter) for letter in "pfhw" if letter in axes])
    if "p" in axes and ordered.shape[0] == 2:
        ordered = ordered[0] + 1j * ordered[1].astype(np.float64)
    if ordered.ndim != 3 or ordered.shape[0] != freqs.size:
        msg = f"{freqs.size} frequencies need a tensor of as many, got shape {values.shape}"
        raise ValueError(msg)
    z = ordered if sign > 0 else np.conj(ordered)
    return np.asarray(scale * z * np.exp(1j * path_to_phase(start_m, freqs[:, None, None])))
