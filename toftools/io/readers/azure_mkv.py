"""Azure Kinect recordings (.mkv): depth and active infrared as big-endian uint16 tracks.

Layout: Matroska; tracks titled DEPTH and IR are uncompressed 16-bit images, depth in mm; the
factory calibration is attached as ``calibration.json`` (or lies beside the file).
Calibration: the depth camera's 14 parameters are cx cy fx fy k1..k6 codx cody p2 p1 (p2 before
p1), normalised to the 1024 x 1024 sensor with (0, 0) at the outer image corner. Modes scale and
crop it: NFOV unbinned is 640 x 576 from (192, 180), binned half of that, WFOV is uncropped; half a
pixel is then taken off cx and cy (Azure Kinect Sensor SDK, mode_specific_calibration.c). The
model is OpenCV's rational one. Without a calibration the nominal field of view is assumed.
Convention: stored depth is axial z; it becomes radial range through the camera. Invalid: 0.
Source: etiennedub/pyk4a test recording. Licence: MIT.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.camera import pinhole, z_to_range
from toftools.io.readers._file import (
    MAX_PIXELS,
    depth_sensor,
    existing_file,
    metres,
    parsing,
)
from toftools.types import Camera, Capture, DepthMap

MODES = {(640, 576): (1024, 192, 180), (320, 288): (512, 96, 90),
         (512, 512): (512, 0, 0), (1024, 1024): (1024, 0, 0)}  # fmt: skip
"""Frame size (width, height) to sensor side after binning and crop offset x, y, px."""

NOMINAL_HFOV_DEG = {640: 75.0, 320: 75.0, 512: 120.0, 1024: 120.0}
_MAX_JSON = 1 << 20


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is Matroska.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes.

    Returns
    -------
    bool
        True if it starts with the EBML mark and its document type.
    """
    return head.startswith(b"\x1a\x45\xdf\xa3") and b"matroska" in head[:64]


def read(path: Path | str, *, frame: int = 0, freq: float = 20e6) -> Capture:
    """Read one frame of a recording.

    Parameters
    ----------
    path : path
        Recording.
    frame : int
        Which depth frame, from 0.
    freq : float
        Nominal modulation frequency, Hz; not in the file.

    Returns
    -------
    Capture
        Depth with infrared as amplitude.

    Raises
    ------
    ValueError
        If the file is damaged or has no such depth frame.
    """
    import av

    path = existing_file(path)
    with (
        parsing(path, "azure_mkv", av.FFmpegError, OSError),
        av.open(str(path), format="matroska") as container,
    ):
        images, calibration = _images(container, frame), _attached(container)
    with parsing(path, "azure_mkv"):
        z_m = metres(images["DEPTH"], 1e-3, 0.0)
        camera, note = _camera(z_m.shape[1], z_m.shape[0], calibration, path)
        amplitude = images.get("IR")
        if amplitude is not None and amplitude.shape != z_m.shape:
            msg = f"its depth is {z_m.shape} but its infrared {amplitude.shape}"
            raise ValueError(msg)
        sensor = depth_sensor(camera, freq, "azure_kinect")
    return Capture(
        sensor=sensor,
        depth=DepthMap(z_to_range(camera, z_m), amplitude=amplitude),
        provenance={
            "source": "Azure Kinect recording",
            "format": "azure_mkv",
            "file": path.name,
            "frame": frame,
            "camera": note,
            "convention": {
                "distance": "stored as z in mm, turned into range through the camera",
                "modulation": "nominal; not in the file",
            },
        },
    )


def _images(container: Any, frame: int) -> dict[str, NDArray[Any]]:  # noqa: ANN401
    """The frame-th depth image and the infrared image of the same exposure."""
    tracks = {
        stream.index: stream.metadata.get("title", "")
        for stream in container.streams.video
        if stream.metadata.get("title") in ("DEPTH", "IR")
    }
    if "DEPTH" not in tracks.values():
        msg = "it has no track titled DEPTH, as Azure Kinect recordings have"
        raise ValueError(msg)
    wanted = [stream for stream in container.streams.video if stream.index in tracks]
    latest: dict[str, Any] = {}
    count = 0
    for packet in container.demux(wanted):
        if packet.size == 0:  # the end mark of a stream
            continue
        title = tracks[packet.stream.index]
        if title == "IR" or count <= frame:
            latest[title] = packet
        count += title == "DEPTH"
        # The two images of one exposure carry the same time, in either order.
        complete = count > frame and len(latest) == len(set(tracks.values()))
        if complete and len({each.pts for each in latest.values()}) == 1:
            return {name: _pixels(each) for name, each in latest.items()}
    msg = f"it has {count} depth frames; frame {frame} or its infrared image is missing"
    raise ValueError(msg)


def _pixels(packet: Any) -> NDArray[Any]:  # noqa: ANN401
    codec = packet.stream.codec_context
    if codec is None or codec.name != "rawvideo":
        msg = "its depth or infrared track is not of uncompressed images"
        raise ValueError(msg)
    width, height = codec.width, codec.height
    if not 0 < width * height <= MAX_PIXELS or packet.size != 2 * width * height:
        msg = f"a frame of {width} x {height} has {packet.size} bytes, wanted uint16 pixels"
        raise ValueError(msg)
    return np.frombuffer(bytes(packet), ">u2").reshape(height, width)


def _attached(container: Any) -> bytes | None:  # noqa: ANN401
    for stream in container.streams.attachments:
        if stream.name == "calibration.json":
            return bytes(stream.data)
    return None


def _camera(width: int, height: int, attached: bytes | None, path: Path) -> tuple[Camera, str]:
    beside = path.with_name("calibration.json")
    text, where = attached, "attached"
    if text is None and beside.is_file() and beside.stat().st_size <= _MAX_JSON:
        text, where = beside.read_bytes(), "beside the file"
    mode = MODES.get((width, height))
    if text is None or mode is None:
        hfov_deg = NOMINAL_HFOV_DEG.get(width, 75.0)
        why = "no calibration" if text is None else f"no known mode of {width} x {height}"
        note = f"pinhole, nominal {hfov_deg} degrees assumed: {why}"
        return pinhole(width, height, hfov_deg=hfov_deg), note
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = _parameters(text)
    side, left, top = mode
    K = np.array(
        [[fx * side, 0, cx * side - left - 0.5], [0, fy * side, cy * side - top - 0.5], [0, 0, 1.0]]
    )
    note = f"factory calibration {where}; {side} px sensor, crop from ({left}, {top})"
    return Camera(width, height, K, np.array([k1, k2, p1, p2, k3, k4, k5, k6])), note


def _parameters(text: bytes) -> list[float]:
    """The 14 parameters of the depth camera."""
    try:
        tree = json.loads(text.rstrip(b"\0"))
        cameras = tree.get("CalibrationInformation", tree)["Cameras"]
        depth = next(
            camera["Intrinsics"] for camera in cameras if camera["Purpose"].endswith("PurposeDepth")
        )
        parameters = [float(value) for value in depth["ModelParameters"]]
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        StopIteration,
        RecursionError,
    ) as error:
        msg = "its calibration.json has no depth camera; remove or replace it"
        raise ValueError(msg) from error
    if len(parameters) != 14 or not all(map(math.isfinite, parameters)):
        msg = f"its calibration.json has {len(parameters)} depth parameters, wanted 14 finite ones"
        raise ValueError(msg)
    return parameters
