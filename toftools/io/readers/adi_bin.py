"""Analog Devices ToF frames: headerless ``*depth*.bin`` with ``*ir*.bin`` beside it.

Layout: height x width uint16 little endian, no header; 512 x 512 unless told otherwise. Depth in
mm; the other file is active brightness and becomes the amplitude.
Convention: whether depth is axial or radial is not stated by the source; ``kind`` says which and
is recorded. Invalid: 0.
Source: analogdevicesinc/ToF, http-server example frames. Licence: MIT.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.io.readers._file import (
    MAX_PIXELS,
    depth_sensor,
    existing_file,
    metres,
    parsing,
    radial,
    sensor_of_size,
)
from toftools.types import Capture, DepthMap

_SIDE = 512


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is named and sized like a 512 x 512 depth frame.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes; the format has no mark of its own.

    Returns
    -------
    bool
        True for ``*depth*.bin`` of 524 288 bytes.
    """
    named = path.suffix == ".bin" and "depth" in path.name
    return named and path.is_file() and path.stat().st_size == 2 * _SIDE * _SIDE


def read(
    path: Path | str,
    *,
    kind: str = "z",
    width: int = _SIDE,
    height: int = _SIDE,
    freq: float = 20e6,
) -> Capture:
    """Read a depth frame and the brightness beside it.

    Parameters
    ----------
    path : path
        The depth file.
    kind : {"z", "range"}
        Whether the stored depth is axial or radial.
    width, height : int
        Frame size, px.
    freq : float
        Nominal modulation frequency, Hz; the frame does not say its mode.

    Returns
    -------
    Capture
        Depth, with brightness as amplitude where its file exists.

    Raises
    ------
    ValueError
        If the size does not fit.
    """
    path = existing_file(path)
    with parsing(path, "adi_bin", OSError):
        depth_m = metres(_frame(path, width, height), 1e-3, 0.0)
        preset, camera_note = sensor_of_size("adtf3175", width, height)
        range_m = radial(preset.camera, depth_m, kind)
        sensor = depth_sensor(preset.camera, freq, preset.name)
    return Capture(
        sensor=sensor,
        depth=DepthMap(range_m, amplitude=_brightness(path, width, height)),
        provenance={
            "source": "Analog Devices ToF SDK frame",
            "licence": "MIT",
            "format": "adi_bin",
            "file": path.name,
            "camera": camera_note,
            "convention": {
                "distance": f"stored as {kind} (not stated by the source)",
                "offset_m": 0.0,
                "modulation": "nominal; not in the file",
            },
        },
    )


def _brightness(path: Path, width: int, height: int) -> NDArray[Any] | None:
    before, depth, after = path.name.rpartition("depth")
    beside = path.with_name(f"{before}ir{after}")
    if not depth or not beside.is_file():
        return None
    with parsing(beside, "adi_bin", OSError):
        return _frame(beside, width, height)


def _frame(path: Path, width: int, height: int) -> NDArray[Any]:
    wanted, size = 2 * width * height, path.stat().st_size
    if min(width, height) < 1 or width * height > MAX_PIXELS or size != wanted:
        msg = f"it has {size} bytes, {width} x {height} uint16 are {wanted}; give width and height"
        raise ValueError(msg)
    return np.fromfile(path, "<u2").reshape(height, width)
