"""Answers out: archive, 16-bit PNG, point cloud, capture.

Everything is written whole or not at all. Invalid pixels are NaN in archives, 0 in PNG, and left
out of clouds.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.camera import points, range_to_z
from toftools.io.atomic import atomic_path
from toftools.io.native import write_capture
from toftools.types import F32, Camera, Capture, DepthMap

PNG_LIMIT_M = 65.535
"""Farthest z that 16-bit millimetres hold."""


def write_answer(path: Path | str, depth: DepthMap, capture: Capture) -> None:
    """Write a depth map in the form its file name asks for.

    Parameters
    ----------
    path : path
        ``.npz`` (all maps), ``.png`` (z, 16-bit mm), ``.ply`` (cloud), or ``.h5`` (the capture
        with this answer as its depth; the camera's own depth moves to ``reported``).
    depth : DepthMap
        The answer.
    capture : Capture
        What it was made from; gives the camera.

    Raises
    ------
    ValueError
        If the suffix is another, or the answer does not fit the format.
    """
    path = Path(path)
    camera, suffix = capture.sensor.camera, path.suffix.lower()
    if suffix == ".npz":
        write_npz(path, depth, camera)
    elif suffix == ".png":
        write_png16(path, depth, camera)
    elif suffix == ".ply":
        write_ply(path, depth, camera)
    elif suffix == ".h5":
        write_capture(path, _with_answer(capture, depth))
    else:
        msg = f"got the suffix {suffix or 'none'!r} in {path.name}; wanted .npz, .png, .ply or .h5"
        raise ValueError(msg)


def _with_answer(capture: Capture, depth: DepthMap) -> Capture:
    reported = dict(capture.reported)
    if capture.depth is not None and np.isfinite(capture.depth.range_m).any():
        reported.setdefault("camera", capture.depth.range_m)
    provenance = {**capture.provenance, "depth": "answer of a correction, not the camera's own"}
    return replace(capture, depth=depth, reported=reported, provenance=provenance)


def write_npz(path: Path | str, depth: DepthMap, camera: Camera) -> None:
    """Write all maps of an answer as a NumPy archive.

    Parameters
    ----------
    path : path
        Target.
    depth : DepthMap
        The answer.
    camera : Camera
        Its camera.

    Notes
    -----
    Keys, all (H, W): range_m, z_m, sigma_m, confidence (float32, NaN where unknown), status
    (uint8: 0 answered, 1 no usable input, 2 rejected by the method); amplitude where there is
    one; model and models, the map of chosen models and their names, where the method chose; and
    the camera as K (3, 3) px and dist (and fisheye, true, where it is one).
    """
    unknown = np.full(depth.range_m.shape, np.nan, np.float32)
    maps: dict[str, Any] = {
        "range_m": depth.range_m,
        "z_m": range_to_z(camera, depth.range_m),
        "sigma_m": unknown if depth.sigma_m is None else depth.sigma_m,
        "confidence": unknown if depth.confidence is None else depth.confidence,
        "status": _status(depth),
        "K": camera.K,
        "dist": camera.dist,
        **({} if camera.model == "pinhole" else {"fisheye": np.bool_(True)}),
    }
    if depth.amplitude is not None:
        maps["amplitude"] = depth.amplitude
    if "model" in depth.info and "models" in depth.info:
        maps["model"] = np.asarray(depth.info["model"])
        maps["models"] = np.asarray(depth.info["models"], dtype=np.str_)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **maps)


def _status(depth: DepthMap) -> NDArray[np.uint8]:
    """Why a pixel has no answer: the method's own codes, or 0 and 1."""
    given = np.asarray(depth.info.get("status", ""))
    if given.shape == depth.range_m.shape and given.dtype.kind in "biu":
        return given.astype(np.uint8)
    return np.isnan(depth.range_m).astype(np.uint8)


def write_png16(path: Path | str, depth: DepthMap, camera: Camera) -> None:
    """Write axial z in whole millimetres as a 16-bit grey PNG; 0 means no answer.

    Parameters
    ----------
    path : path
        Target.
    depth : DepthMap
        The answer; z below half a millimetre becomes 0 as well.
    camera : Camera
        Its camera.

    Raises
    ------
    ValueError
        If a z does not fit 16-bit millimetres.
    """
    write_z16(path, range_to_z(camera, depth.range_m))


def write_z16(path: Path | str, z_m: F32) -> None:
    """Write axial z as a 16-bit PNG in millimetres, 0 where there is none.

    Parameters
    ----------
    path : path
        Target.
    z_m : ndarray, (H, W)
        Distance along the axis, m; NaN where unknown.

    Raises
    ------
    ValueError
        If a z does not fit 16-bit millimetres.
    """
    import cv2

    # np.round(z * 1000) in float64: float32 millimetres are exact only below 16.7 m.
    millimetres = np.round(np.nan_to_num(z_m.astype(np.float64), nan=0.0) * 1000).clip(min=0)
    if millimetres.max() > 65_535:
        msg = (
            f"z reaches {millimetres.max() / 1000:.3f} m, but 16-bit millimetres end at "
            f"{PNG_LIMIT_M} m; write .npz instead"
        )
        raise ValueError(msg)
    done, encoded = cv2.imencode(".png", millimetres.astype(np.uint16))
    if not done:
        msg = f"cannot encode an image of shape {z_m.shape} as PNG; write .npz instead"
        raise ValueError(msg)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def write_ply(
    path: Path | str,
    depth: DepthMap,
    camera: Camera,
    *,
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Write the answered pixels as a binary little-endian PLY cloud.

    Parameters
    ----------
    path : path
        Target.
    depth : DepthMap
        The answer.
    camera : Camera
        Its camera.
    colours : ndarray, (H, W, 3), uint8, or None
        Red, green and blue of every pixel.

    Raises
    ------
    ValueError
        If no pixel has an answer: readers refuse empty clouds.

    Notes
    -----
    Float properties x, y, z (m; x right, y down, z forward), then amplitude, sigma_m and
    confidence where the answer has them; then red, green and blue as bytes.
    """
    known = np.isfinite(depth.range_m)
    if not known.any():
        msg = "no pixel has an answer, so there is no cloud to write; write .npz for the status"
        raise ValueError(msg)
    columns: dict[str, Any] = dict(zip("xyz", points(camera, depth.range_m)[known].T, strict=True))
    for name in ("amplitude", "sigma_m", "confidence"):
        extra = getattr(depth, name)
        if extra is not None:
            columns[name] = extra[known]
    kinds = dict.fromkeys(columns, ("float", "<f4"))
    if colours is not None:
        for name, channel in zip(("red", "green", "blue"), colours[known].T, strict=True):
            columns[name], kinds[name] = channel, ("uchar", "u1")
    vertices = np.empty(int(known.sum()), [(name, kind) for name, (_, kind) in kinds.items()])
    for name, column in columns.items():
        vertices[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment toftools: metres, x right, y down, z forward",
        f"element vertex {vertices.size}",
        *(f"property {word} {name}" for name, (word, _) in kinds.items()),
        "end_header\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())
