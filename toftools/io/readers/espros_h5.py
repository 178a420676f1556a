"""ESPROS epc635 amplitude recordings: HDF5 with ``frames_0`` (N, H, W) and ``timestamps`` (N,).

Layout: float64 amplitude, DN, sqrt(I^2 + Q^2) of signed 12-bit components, so it clips at
2047.5 sqrt 2 = 2895.6; attributes hold the modulation frequency, exposure and chip identity.
Convention: amplitude only, so the range of every pixel is NaN. Clipped and zero pixels keep their
value; how many there are is recorded. The file holds no optics: ``hfov_deg`` is assumed.
Source: espros/epc-tofcam-toolkit example recording. Licence: MIT.
"""

from pathlib import Path
from typing import Any

import numpy as np

from toftools.camera import pinhole
from toftools.io._hdf5 import opened
from toftools.io.readers._file import (
    MAX_PIXELS,
    depth_sensor,
    existing_file,
    parsing,
    single,
)
from toftools.types import Capture, DepthMap

CLIP_DN = 2047.5 * np.sqrt(2.0)
_MAGIC = b"\x89HDF\r\n\x1a\n"
_H5_ERRORS = (OSError, RuntimeError, KeyError, TypeError, AttributeError, OverflowError)


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is HDF5 with a dataset ``frames_0`` and a modulation frequency.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes.

    Returns
    -------
    bool
        True if both are there.
    """
    if not head.startswith(_MAGIC):
        return False
    try:
        with opened(path) as file:
            return "frames_0" in file and "mod_frequency" in file.attrs
    except (*_H5_ERRORS, ValueError):
        return False


def read(path: Path | str, *, frame: int = 0, hfov_deg: float = 50.0) -> Capture:
    """Read one frame of an amplitude recording.

    Parameters
    ----------
    path : path
        Recording.
    frame : int
        Which frame, from 0.
    hfov_deg : float
        Horizontal field of view, degrees; the file does not hold it.

    Returns
    -------
    Capture
        Depth map without ranges, with amplitude.

    Raises
    ------
    ValueError
        If the file is damaged, not of amplitudes, or has no such frame.
    """
    path = existing_file(path)
    with parsing(path, "espros_h5", *_H5_ERRORS), opened(path) as file:
        return _capture(path, file, frame, hfov_deg)


def _capture(path: Path, file: Any, frame: int, hfov_deg: float) -> Capture:  # noqa: ANN401
    frames = file["frames_0"]
    shape: tuple[int, ...] = getattr(frames, "shape", None) or ()
    if len(shape) != 3 or frames.dtype.kind not in "uif":
        msg = f"frames_0 must be (N, H, W) real numbers, got shape {shape}"
        raise ValueError(msg)
    count, height, width = shape
    if not 0 < height * width <= MAX_PIXELS or not 0 <= frame < count:
        msg = f"it has {count} frames of {width} x {height}, got frame={frame}"
        raise ValueError(msg)
    image_type = file.attrs.get("image_type", "Amplitude")
    if image_type != "Amplitude":
        msg = f"its images are {image_type!r}, this reader knows Amplitude"
        raise ValueError(msg)
    amplitude = single(frames[frame])
    freq_hz = float(file.attrs["mod_frequency"])
    camera = pinhole(width, height, hfov_deg=hfov_deg)
    # Codes come in steps of 1 DN per component, so the last step below the clip is "near".
    clipped = float((amplitude >= CLIP_DN - 1.0).mean())
    return Capture(
        sensor=depth_sensor(camera, freq_hz, "epc635"),
        depth=DepthMap(np.full_like(amplitude, np.nan), amplitude=amplitude),
        provenance={
            "source": "ESPROS epc635 amplitude recording",
            "licence": "MIT",
            "format": "espros_h5",
            "file": path.name,
            "frame": frame,
            "frames": int(count),
            "camera": f"pinhole with {hfov_deg} degrees assumed; the file holds no optics",
            "clipped_share": clipped,
            "zero_share": float((amplitude == 0).mean()),
            "convention": {"amplitude": f"DN, clips at {CLIP_DN:.1f}", "distance": "none"},
        },
    )
