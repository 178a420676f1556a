"""ifm O3R frames: the chunk buffer of one 3D head.

Layout: 8 bytes, the last four ``star``, then chunks, then ``stop``. A chunk starts with nine
uint32 little endian: type, size with header, header size, header version, width, height, pixel
format, time, frame count; version 3 headers end in zero-terminated JSON at byte 48. Types used:
100 radial distance uint16 times DistanceResolution (m), 105 distance noise alike, 101 amplitude
uint16 times AmplitudeResolution, 420 calibration.
Calibration: 3 uint-float words, 3 factors, 6 extrinsic floats, then two blocks of a model id and
32 floats. The second block projects rays to pixels: fx fy mx my alpha k1..k5 with OpenCV's radial
terms (k1, k2, k5) and tangential terms (k3, k4) and pixel centres at one half, so cx = mx - 1/2.
Convention: distance radial, origin at the optical centre; the extrinsic offset is not applied.
Invalid: distance 0. Modulation frequencies are not in the frame.
Source: ifm/ifm3d, framegrabber test frame. Licence: Apache-2.0.
"""

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from toftools.camera import pinhole
from toftools.io.readers._file import (
    MAX_PIXELS,
    depth_sensor,
    existing_file,
    metres,
    parsing,
    read_bytes,
    single,
)
from toftools.types import Camera, Capture, DepthMap

_LEAD, _HEADER = 8, 48
_DISTANCE, _AMPLITUDE, _NOISE, _CALIBRATION = 100, 101, 105, 420
_LIMIT = 1 << 27


class Chunk(NamedTuple):
    """One chunk: image size, header metadata and content bytes."""

    width: int
    height: int
    meta: dict[str, Any]
    content: bytes


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file starts like a frame buffer.

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
    return head[4:_LEAD] == b"star"


def read(path: Path | str, *, freq: float = 10e6, hfov_deg: float = 60.0) -> Capture:
    """Read one frame buffer.

    Parameters
    ----------
    path : path
        Buffer as received from the device.
    freq : float
        Nominal modulation frequency, Hz; not in the frame. Its wrap (15 m) lies beyond the 10 m
        that the distance code holds.
    hfov_deg : float
        Horizontal field of view, degrees, used only if the frame holds no usable calibration.

    Returns
    -------
    Capture
        Depth with amplitude and the device's own standard deviation.

    Raises
    ------
    ValueError
        If the buffer is cut, damaged, or without a distance image.
    """
    path = existing_file(path)
    with parsing(path, "ifm_o3r", OSError, struct.error):
        chunks = _chunks(read_bytes(path, limit=_LIMIT))
        if _DISTANCE not in chunks:
            msg = f"it has chunks {sorted(chunks)}, wanted 100 (radial distance)"
            raise ValueError(msg)
        first = chunks[_DISTANCE]
        range_m = _image(first, "DistanceResolution", 0.0)
        camera, note = _camera(chunks.get(_CALIBRATION), first, hfov_deg)
        depth = DepthMap(
            range_m,
            sigma_m=_sigma(chunks.get(_NOISE), range_m),
            amplitude=_amplitude(chunks.get(_AMPLITUDE), range_m),
        )
        sensor = depth_sensor(camera, freq, "ifm_o3r")
    return Capture(
        sensor=sensor,
        depth=depth,
        provenance={
            "source": "ifm O3R frame buffer",
            "licence": "Apache-2.0",
            "format": "ifm_o3r",
            "file": path.name,
            "camera": note,
            "convention": {
                "distance": "radial, from the optical centre; extrinsic offset not applied",
                "modulation": "nominal; not in the file",
            },
        },
    )


def _chunks(data: bytes) -> dict[int, Chunk]:
    """Chunks by type; each claimed size is held against the bytes that are there."""
    if data[4:_LEAD] != b"star":
        msg = "it does not start with 'star'"
        raise ValueError(msg)
    found: dict[int, Chunk] = {}
    at = _LEAD
    while data[at : at + 4] != b"stop":
        if at + _HEADER > len(data):
            msg = "it ends before its 'stop' mark"
            raise ValueError(msg)
        kind, size, header, version, width, height = struct.unpack_from("<6I", data, at)
        if not _HEADER <= header <= size <= len(data) - at:
            msg = f"chunk {kind} claims {size} bytes with a header of {header}"
            raise ValueError(msg)
        meta = data[at + _HEADER : at + header] if version >= 3 else b""
        found[kind] = Chunk(width, height, _meta(meta), data[at + header : at + size])
        at += size
    return found


def _meta(text: bytes) -> dict[str, Any]:
    text = text.split(b"\0", 1)[0].strip()
    try:
        meta = json.loads(text) if text else {}
    except RecursionError as error:
        msg = "a chunk header is nested too deeply"
        raise ValueError(msg) from error
    if not isinstance(meta, dict):
        msg = "a chunk header must be a JSON object"
        raise ValueError(msg)
    return meta


def _counts(chunk: Chunk) -> NDArray[Any]:
    count = chunk.width * chunk.height
    if not 0 < count <= MAX_PIXELS or len(chunk.content) < 2 * count:
        msg = f"an image claims {chunk.width} x {chunk.height} in {len(chunk.content)} bytes"
        raise ValueError(msg)
    return np.frombuffer(chunk.content, "<u2", count).reshape(chunk.height, chunk.width)


def _resolution(chunk: Chunk, key: str) -> float:
    value = chunk.meta.get(key)
    if not isinstance(value, int | float) or not 0 < value < 1e3:
        msg = f"a chunk header must give {key} as a positive number, got {value!r}"
        raise ValueError(msg)
    return float(value)


def _image(chunk: Chunk, key: str, *invalid: float) -> NDArray[np.float32]:
    return metres(_counts(chunk), _resolution(chunk, key), *invalid)


def _same_shape(image: NDArray[np.float32], like: NDArray[np.float32]) -> NDArray[np.float32]:
    if image.shape != like.shape:
        msg = f"its images have shapes {like.shape} and {image.shape}"
        raise ValueError(msg)
    return image


def _sigma(chunk: Chunk | None, range_m: NDArray[np.float32]) -> NDArray[np.float32] | None:
    if chunk is None:
        return None
    sigma_m = _same_shape(_image(chunk, "DistanceResolution"), range_m)
    return np.where(np.isfinite(range_m), sigma_m, np.float32(np.nan))


def _amplitude(chunk: Chunk | None, range_m: NDArray[np.float32]) -> NDArray[np.float32] | None:
    if chunk is None:
        return None
    counts = _same_shape(single(_counts(chunk)), range_m)
    return counts * np.float32(_resolution(chunk, "AmplitudeResolution"))


def _camera(chunk: Chunk | None, image: Chunk, hfov_deg: float) -> tuple[Camera, str]:
    """Camera of the calibration chunk where its model is OpenCV's, else an assumed pinhole."""
    start = 12 + 12 + 24 + 132  # three words, three factors, six extrinsics, the first block
    if chunk is not None and len(chunk.content) >= start + 132:
        (model,) = struct.unpack_from("<I", chunk.content, start)
        fx, fy, mx, my, alpha, k1, k2, k3, k4, k5 = struct.unpack_from(
            "<10f", chunk.content, start + 4
        )
        if model in (0, 1):
            K = np.array([[fx, fx * alpha, mx - 0.5], [0, fy, my - 0.5], [0, 0, 1.0]])
            dist = np.array([k1, k2, k3, k4, k5])
            return Camera(image.width, image.height, K, dist), "from the frame (chunk 420)"
    note = f"pinhole, {hfov_deg} degrees assumed; no OpenCV-like calibration in the frame"
    return pinhole(image.width, image.height, hfov_deg=hfov_deg), note
