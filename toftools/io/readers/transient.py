"""Transients, light against path length per pixel, as noiseless phasors of a chosen sensor.

Files: our own (``write_transient``: .npz or .h5, recognised), which say all of this themselves;
and arrays of other programs (.npz, .npy, HDF5; only with ``--format transient:...``), which say
nothing, so that ``axes`` and a bin width must be given: mitransient ``axes=hwtc,bin_m=...`` with
the ``near_clip_m`` of its camera, FLAT's lists as a .npz of ``index`` (3, N) and ``values`` (N,)
with ``axes=sparse,bin_s=...,at=0,width=...,height=...``.
Convention: path length is the whole optical path; z = A exp(+j phi). Phasors are those of the
sensor's taps without noise, electrons. Truth is ``truth_range_m`` of the file, else the first
return where it stands apart. A transient whose end cuts off more than ``cut_share`` of the light is
refused.
Source: this project.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.camera import pinhole
from toftools.io.layouts import from_array, from_sparse, with_near_clip
from toftools.io.readers._file import MAX_PIXELS, existing_file, metres, parsing, sensor_of_size
from toftools.io.stored import ERRORS, stored_arrays
from toftools.io.transients import is_transient, read_transient
from toftools.transient import Transient, cut_share, first_return_m, phasors
from toftools.types import C64, F32, Capture, Modulation, Phasors, Sensor, Truth
from toftools.units import time_to_path

_OWN: dict[str, Any] = {
    "key": "values", "axes": "", "bin_m": 0.0, "bin_s": 0.0, "start_m": 0.0, "start_s": 0.0,
    "way": "round", "at": 0.5, "channel": 0, "scale": 1.0, "width": 0, "height": 0,
}  # fmt: skip
"""Conventions that a file of our own states itself, with their defaults."""


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a transient file of our own; others must be named.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes.

    Returns
    -------
    bool
        True if so.
    """
    return is_transient(path, head)


def read(
    path: Path | str,
    *,
    sensor: str = "deeptof",
    freqs: tuple[float, ...] = (),
    hfov_deg: float = 0.0,
    near_clip_m: float = 0.0,
    cut: float = 1e-3,
    apart: float = 0.2,
    key: str = "values",
    axes: str = "",
    bin_m: float = 0.0,
    bin_s: float = 0.0,
    start_m: float = 0.0,
    start_s: float = 0.0,
    way: str = "round",
    at: float = 0.5,
    channel: int = 0,
    scale: float = 1.0,
    width: int = 0,
    height: int = 0,
) -> Capture:
    """Read a transient.

    Parameters
    ----------
    path : path
        Transient file or array.
    sensor : str
        Sensor preset, brought to the size of the transient.
    freqs : tuple of float
        Frequencies instead of the preset's, Hz.
    hfov_deg : float
        Horizontal field of view, degrees; 0 keeps that of the preset.
    near_clip_m : float
        Near plane from which the program counted its paths, m; 0 for the camera centre.
    cut : float
        Largest share of the light that may lie outside the axis.
    apart : float
        Share of a pixel's light that makes its first return its range; above 1 for no truth.
    key : str
        Name of the array in the file.
    axes : str
        Axes of the array, such as ``thw`` or ``hwtc``, or ``sparse``.
    bin_m, bin_s : float
        Width of a bin, in m or in s.
    start_m, start_s : float
        Start of the first bin, in m or in s.
    way : {"round", "one"}
        Whether the axis counts the whole path or the range one way.
    at : float
        Where in its bin the light stands, 0..1.
    channel : int
        Which channel of the axis ``c``.
    scale : float
        Light of a white wall at 1 m per unit of the array: pi / I for radiance under a point
        light of intensity I.
    width, height : int
        Image size of ``axes=sparse``.

    Returns
    -------
    Capture
        Phasors, electrons, with truth where there is any.

    Raises
    ------
    ValueError
        If the file is damaged, a convention is missing, or too much light is cut off.
    """
    path = existing_file(path)
    told = {"key": key, "axes": axes, "bin_m": bin_m, "bin_s": bin_s, "start_m": start_m,
            "start_s": start_s, "way": way, "at": at, "channel": channel, "scale": scale,
            "width": width, "height": height}  # fmt: skip
    with parsing(path, "transient", *ERRORS):
        transient, truth_m, told = _transient(path, told)
        device, note = _device(sensor, freqs, hfov_deg, transient.shape)
        if near_clip_m:
            transient = with_near_clip(transient, device.camera, near_clip_m)
        share = cut_share(transient)
        if share > cut:
            msg = (
                f"its axis leaves out about {100 * share:.3g} % of the light, which bends the "
                "phase; give it more bins, or accept that with cut=1"
            )
            raise ValueError(msg)
        if truth_m is None and apart <= 1:
            truth_m = first_return_m(transient, least_share=apart).astype(np.float32)
        known = truth_m is not None and bool(np.isfinite(truth_m).any())
        told |= {"phasor": "z = A exp(+j phi)", "near_clip_m": near_clip_m}
        return Capture(
            sensor=device,
            phasors=Phasors(_electrons(transient, device)),
            truth=Truth(truth_m) if known and truth_m is not None else None,
            provenance={"source": "transient", "format": "transient", "file": path.name,
                        "camera": note, "bins": transient.n_bins, "bin_m": transient.bin_m,
                        "cut_share": share, "convention": told},
        )  # fmt: skip


def _device(
    text: str, freqs: tuple[float, ...], hfov_deg: float, shape: tuple[int, int]
) -> tuple[Sensor, str]:
    """The sensor of the size of the transient, and a note on its camera."""
    height, width = shape
    device, note = sensor_of_size(text, width, height)
    wanted = np.atleast_1d(np.asarray(freqs, dtype=np.float64))  # one number comes without a tuple
    if wanted.size:
        steps = device.modulation.steps_rad
        steps = steps if wanted.size == len(steps) else steps[0]
        device = replace(device, modulation=Modulation(wanted, steps))
    if hfov_deg:
        camera = pinhole(width, height, hfov_deg=hfov_deg)
        return replace(device, camera=camera), f"pinhole, {hfov_deg} degrees as told"
    return device, note


def _transient(path: Path, told: dict[str, Any]) -> tuple[Transient, F32 | None, dict[str, Any]]:
    """The transient, the truth beside it, and the conventions it was read with."""
    with path.open("rb") as file:
        head = file.read(4096)
    if is_transient(path, head):
        extra = [name for name, default in _OWN.items() if told[name] != default]
        if extra:
            msg = f"the file states {extra[0]} itself; leave out {', '.join(extra)}"
            raise ValueError(msg)
        return read_transient(path), None, {"axes": "thw", "way": "round"}
    key = told["key"]
    arrays = stored_arrays(path, (key, "index", "truth_range_m"))
    if key not in arrays:
        msg = f"it holds no array {key!r}; name it with key=..."
        raise ValueError(msg)
    truth = arrays.get("truth_range_m")
    made = _dense(arrays[key], told) if told["axes"] != "sparse" else _sparse(arrays, told)
    kept = {name: value for name, value in told.items() if value != _OWN[name]}
    return made, None if truth is None else metres(truth, 1.0, 0.0), kept


def _dense(values: NDArray[Any], told: dict[str, Any]) -> Transient:
    if not told["axes"]:
        msg = f"an array of shape {values.shape} does not say its axes; give axes=, such as hwt"
        raise ValueError(msg)
    shared = {name: told[name] for name in ("axes", "way", "at", "channel", "scale")}
    start_m = told["start_m"] + float(time_to_path(told["start_s"]))
    return from_array(values, bin_m=_bin_m(told), start_m=start_m, **shared)


def _sparse(arrays: dict[str, NDArray[Any]], told: dict[str, Any]) -> Transient:
    shape = (told["height"], told["width"])
    if "index" not in arrays or min(shape) < 1 or shape[0] * shape[1] > MAX_PIXELS:
        msg = f"axes=sparse needs an array index (3, N), width= and height=, got {shape[::-1]} px"
        raise ValueError(msg)
    if told["start_m"] or told["start_s"]:
        msg = "bins of axes=sparse count from zero; leave out start_m and start_s"
        raise ValueError(msg)
    shared = {name: told[name] for name in ("way", "at", "scale")}
    values = arrays[told["key"]]
    return from_sparse(arrays["index"], values, shape=shape, bin_m=_bin_m(told), **shared)


def _bin_m(told: dict[str, Any]) -> float:
    """Width of a bin on the file's own axis, m."""
    width = told["bin_m"] + float(time_to_path(told["bin_s"]))
    if told["bin_m"] * told["bin_s"] != 0 or not width > 0:
        got = f"bin_m={told['bin_m']:g} and bin_s={told['bin_s']:g}"
        msg = f"the file does not say how wide a bin is: got {got}; give one of them"
        raise ValueError(msg)
    return float(width)


def _electrons(transient: Transient, sensor: Sensor) -> C64:
    """Phasors as the sensor's taps would give them without noise and harmonics, electrons."""
    freqs = sensor.modulation.freqs_hz
    unit = sensor.noise.signal_e if transient.unit == "relative" else 1.0
    depth = unit * np.broadcast_to(sensor.noise.contrast, freqs.shape)[:, None, None]
    with np.errstate(over="ignore"):  # infinite phasors are invalid pixels
        return np.asarray(depth * phasors(transient, freqs), dtype=np.complex64)
