"""What every reader needs before it trusts a file: existence, size, and errors in one sentence."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from toftools.camera import z_to_range
from toftools.sensors import resized
from toftools.sensors import sensor as make_sensor
from toftools.types import F32, Camera, Modulation, Sensor

MAX_PIXELS = 1 << 24
"""More pixels than any ToF frame has: a larger claim is a hostile header."""


def one_sentence(error: BaseException) -> str:
    """First line of an error message, without quotes; its type if it has none.

    Parameters
    ----------
    error : exception
        Any exception.

    Returns
    -------
    str
        One line.
    """
    lines = str(error).strip("\"' \n").splitlines()
    return lines[0].strip() if lines and lines[0].strip() else type(error).__name__


@contextlib.contextmanager
def parsing(path: Path, format_name: str, *errors: type[Exception]) -> Iterator[None]:
    """Turn what a parser raises on a damaged file into a ValueError of one sentence.

    Parameters
    ----------
    path : Path
        The file being read, for the message.
    format_name : str
        Reader name, for the message.
    *errors : exception types
        What the parser library of this reader raises on bad input, besides ValueError.

    Yields
    ------
    None
        Nothing.

    Raises
    ------
    ValueError
        Instead of any of the listed errors.
    """
    caught: tuple[type[Exception], ...] = (ValueError, *errors)
    try:
        yield
    except caught as error:
        msg = f"{path.name} is not readable as {format_name}: {one_sentence(error)}"
        raise ValueError(msg) from error


def existing_file(path: Path | str) -> Path:
    """The path, if it is a file that holds something.

    Parameters
    ----------
    path : path
        File to read.

    Returns
    -------
    Path
        The same path.

    Raises
    ------
    ValueError
        If it is missing, a folder, or empty.
    """
    path = Path(path)
    if path.is_dir():
        msg = f"{path} is a folder, wanted a file; name a file inside it"
        raise ValueError(msg)
    if not path.is_file():
        msg = f"no such file: {path}"
        raise ValueError(msg)
    if path.stat().st_size == 0:
        msg = f"{path} is empty, wanted a recording; copy it again"
        raise ValueError(msg)
    return path


def read_bytes(path: Path, *, limit: int) -> bytes:
    """All bytes of a file that is not larger than its format can be.

    Parameters
    ----------
    path : Path
        File.
    limit : int
        Largest plausible size, bytes.

    Returns
    -------
    bytes
        Content.

    Raises
    ------
    ValueError
        If the file is larger.
    """
    size = path.stat().st_size
    if size > limit:
        msg = f"it has {size} bytes, a frame of this format has at most {limit}"
        raise ValueError(msg)
    return path.read_bytes()


def sensor_of_size(name: str, width: int, height: int) -> tuple[Sensor, str]:
    """A sensor preset on the grid of the frame, and a note on what was done to its camera.

    Parameters
    ----------
    name : str
        Sensor text, such as ``opt8241:freqs=20e6``.
    width, height : int
        Frame size, px.

    Returns
    -------
    tuple of Sensor and str
        The sensor, and the note for the provenance. Another width rescales the preset; rows
        that do not follow are taken as cut off or added evenly at both edges, since pixels are
        square.
    """
    sensor = make_sensor(name)
    camera = sensor.camera
    if (width, height) == (camera.width, camera.height):
        return sensor, f"camera of the preset {sensor.name}"
    scaled = resized(camera, width, max(1, round(camera.height * width / camera.width)))
    K = np.array(scaled.K)
    K[1, 2] += (height - scaled.height) / 2
    note = (
        f"camera of the preset {sensor.name} ({camera.width}x{camera.height}) brought to "
        f"{width}x{height}: same horizontal field of view, square pixels, centred rows (assumed)"
    )
    return replace(sensor, camera=replace(camera, width=width, height=height, K=K)), note


def depth_sensor(camera: Camera, freq_hz: float, name: str) -> Sensor:
    """Sensor of a camera that reports distances only: one nominal frequency.

    Parameters
    ----------
    camera : Camera
        Optics.
    freq_hz : float
        Nominal modulation frequency, Hz; files of distances do not hold the real ones.
    name : str
        Label.

    Returns
    -------
    Sensor
        The sensor.
    """
    return Sensor(camera, Modulation(np.array([freq_hz], dtype=np.float64)), name=name)


def radial(camera: Camera, distance_m: F32, kind: str) -> F32:
    """Radial range of stored distances of either kind.

    Parameters
    ----------
    camera : Camera
        Camera.
    distance_m : ndarray, (H, W)
        Stored distance, m.
    kind : {"range", "z"}
        Whether it is radial or axial.

    Returns
    -------
    ndarray, (H, W), float32
        Radial range, m.

    Raises
    ------
    ValueError
        If the kind is unknown.
    """
    if kind not in ("range", "z"):
        msg = f"kind must be range (radial) or z (axial), got {kind!r}"
        raise ValueError(msg)
    return distance_m if kind == "range" else z_to_range(camera, distance_m)


def single(values: ArrayLike, limit: float = 1e15) -> F32:
    """Values as float32, NaN where they are not finite or beyond what float32 squares.

    Parameters
    ----------
    values : array_like
        Real numbers.
    limit : float
        Largest magnitude kept; its square must stay finite.

    Returns
    -------
    ndarray, float32
        The values.
    """
    stored = np.asarray(values, dtype=np.float64)
    return np.where(np.abs(stored) <= limit, stored, np.nan).astype(np.float32)


def metres(values: ArrayLike, scale_m: float, *invalid: float) -> F32:
    """Range or z in metres; NaN for the invalid codes and for what is not 1 um to 1000 km.

    Parameters
    ----------
    values : array_like
        Stored numbers.
    scale_m : float
        Metres per stored unit.
    *invalid : float
        Codes that mean "no answer".

    Returns
    -------
    ndarray, float32
        Metres.
    """
    stored = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        result = stored * scale_m
        # Less than a micrometre or more than a thousand kilometres is no range of a camera.
        bad = ~((result >= 1e-6) & (result <= 1e6)) | np.isin(stored, invalid)
    return np.asarray(np.where(bad, np.nan, result), dtype=np.float32)
