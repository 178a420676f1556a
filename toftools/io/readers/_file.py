"""What every reader needs before it trusts a file: existence, size, and errors in one sentence."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from toftools.sensors import resized
from toftools.sensors import sensor as make_sensor
from toftools.types import F32, Sensor

MAX_PIXELS = 1 << 26
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
        The sensor, and the note for the provenance.
    """
    sensor = make_sensor(name)
    camera = sensor.camera
    if (width, height) == (camera.width, camera.height):
        return sensor, f"camera of the preset {sensor.name}"
    note = (
        f"camera of the preset {sensor.name} ({camera.width}x{camera.height}) "
        f"rescaled to {width}x{height}, same field of view assumed"
    )
    return replace(sensor, camera=resized(camera, width, height)), note


def metres(values: ArrayLike, scale_m: float, *invalid: float) -> F32:
    """Range or z in metres; NaN for the invalid codes, infinities, negatives and nonsense.

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
        # Beyond 1e6 m it is not a range, and float32 would lose it anyway.
        bad = ~(result >= 0) | (result > 1e6) | np.isin(stored, invalid)
    return np.asarray(np.where(bad, np.nan, result), dtype=np.float32)
