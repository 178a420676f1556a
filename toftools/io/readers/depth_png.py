"""16-bit grey PNG depth images, as most depth cameras and data sets store them.

Layout: one grey channel of 16 bits. Convention, all explicit: ``scale`` stored units per metre
(1000 for millimetres, 5000 for TUM), ``kind`` axial z or radial range, ``invalid`` codes,
``camera`` fx+fy+cx+cy in pixels or else ``hfov_deg``. Nothing of this is in the file.
Invalid: the given codes (0 unless told otherwise).
Source: PNG specification; scales as listed by the TUM RGB-D and Redwood data sets (recalled).
"""

from pathlib import Path

import numpy as np

from toftools.camera import pinhole
from toftools.io.readers._file import (
    depth_sensor,
    existing_file,
    metres,
    parsing,
    radial,
    read_bytes,
)
from toftools.io.readers._png16 import is_png16, read_png16
from toftools.types import Camera, Capture, DepthMap

_LIMIT = 1 << 28


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a 16-bit grey PNG.

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
    return is_png16(head)


def read(
    path: Path | str,
    *,
    scale: float = 1000.0,
    kind: str = "z",
    invalid: tuple[float, ...] = (0,),
    hfov_deg: float = 60.0,
    camera: tuple[float, ...] = (),
    freq: float = 2e6,
) -> Capture:
    """Read a depth image.

    Parameters
    ----------
    path : path
        PNG file.
    scale : float
        Stored units per metre.
    kind : {"z", "range"}
        Whether the stored depth is axial or radial.
    invalid : tuple of float
        Codes without an answer (joined by + on the command line).
    hfov_deg : float
        Horizontal field of view, degrees, if no camera is given.
    camera : tuple of 4 floats
        fx, fy, cx, cy, px.
    freq : float
        Nominal modulation frequency, Hz; its wrap (75 m) lies beyond what 16-bit mm hold.

    Returns
    -------
    Capture
        Depth.

    Raises
    ------
    ValueError
        If the file is not a whole 16-bit grey PNG, or a parameter makes no sense.
    """
    path = existing_file(path)
    if not scale > 0 or len(np.atleast_1d(camera)) not in (0, 4):
        msg = f"scale must be positive and camera fx+fy+cx+cy, got {scale} and {camera}"
        raise ValueError(msg)
    with parsing(path, "depth_png", OSError):
        stored = read_png16(read_bytes(path, limit=_LIMIT))
        optics = _camera(stored.shape[1], stored.shape[0], camera, hfov_deg)
        codes = np.atleast_1d(np.asarray(invalid, dtype=np.float64))
        range_m = radial(optics, metres(stored, 1 / scale, *codes.tolist()), kind)
        sensor = depth_sensor(optics, freq, "depth_png")
    return Capture(
        sensor=sensor,
        depth=DepthMap(range_m),
        provenance={
            "source": "16-bit PNG depth image",
            "format": "depth_png",
            "file": path.name,
            "camera": "given" if camera else f"pinhole, {hfov_deg} degrees assumed",
            "convention": {
                "distance": f"stored as {kind}, {scale:g} units per metre",
                "invalid": codes.tolist(),
                "modulation": "nominal; not in the file",
            },
        },
    )


def _camera(width: int, height: int, given: tuple[float, ...], hfov_deg: float) -> Camera:
    if not given:
        return pinhole(width, height, hfov_deg=hfov_deg)
    fx, fy, cx, cy = given
    return Camera(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
