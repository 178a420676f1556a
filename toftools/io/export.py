"""Answers out: archive, 16-bit PNG, point cloud, capture; and camera intrinsics for other tools.

Everything is written whole or not at all. Invalid pixels are NaN in archives, 0 in PNG, and left
out of clouds.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.camera import points, range_to_z
from toftools.io.atomic import atomic_path
from toftools.io.native import write_capture
from toftools.types import Camera, Capture, DepthMap

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
    one; and the camera as K (3, 3) px and dist.
    """
    unknown = np.full(depth.range_m.shape, np.nan, np.float32)
    maps: dict[str, NDArray[Any]] = {
        "range_m": depth.range_m,
        "z_m": range_to_z(camera, depth.range_m),
        "sigma_m": unknown if depth.sigma_m is None else depth.sigma_m,
        "confidence": unknown if depth.confidence is None else depth.confidence,
        "status": _status(depth),
        "K": camera.K,
        "dist": camera.dist,
    }
    if depth.amplitude is not None:
        maps["amplitude"] = depth.amplitude
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
    import cv2

    z_m = range_to_z(camera, depth.range_m)
    # np.round(z * 1000) in float64: float32 millimetres are exact only below 16.7 m.
    millimetres = np.round(np.nan_to_num(z_m.astype(np.float64), nan=0.0) * 1000)
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


def write_ply(path: Path | str, depth: DepthMap, camera: Camera) -> None:
    """Write the answered pixels as a binary little-endian PLY cloud.

    Parameters
    ----------
    path : path
        Target.
    depth : DepthMap
        The answer.
    camera : Camera
        Its camera.

    Raises
    ------
    ValueError
        If no pixel has an answer: readers refuse empty clouds.

    Notes
    -----
    Float properties x, y, z (m; x right, y down, z forward), then amplitude, sigma_m and
    confidence where the answer has them.
    """
    known = np.isfinite(depth.range_m)
    if not known.any():
        msg = "no pixel has an answer, so there is no cloud to write; write .npz for the status"
        raise ValueError(msg)
    columns = dict(zip("xyz", points(camera, depth.range_m)[known].T, strict=True))
    for name in ("amplitude", "sigma_m", "confidence"):
        extra = getattr(depth, name)
        if extra is not None:
            columns[name] = extra[known]
    vertices = np.empty(int(known.sum()), [(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertices[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment toftools: metres, x right, y down, z forward",
        f"element vertex {vertices.size}",
        *(f"property float {name}" for name in columns),
        "end_header\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())


def open3d_json(camera: Camera) -> str:
    """Intrinsics as Open3D's PinholeCameraIntrinsic JSON, whose matrix is column-major.

    Parameters
    ----------
    camera : Camera
        Camera without distortion.

    Returns
    -------
    str
        JSON text.

    Raises
    ------
    ValueError
        If the camera has distortion, which Open3D cannot hold.
    """
    if camera.dist.any():
        msg = "Open3D intrinsics hold no distortion, and this camera has some; undistort first"
        raise ValueError(msg)
    matrix = camera.K.flatten(order="F").tolist()
    size = {"width": camera.width, "height": camera.height}
    return json.dumps({**size, "intrinsic_matrix": matrix}, indent=1) + "\n"


def opencv_json(camera: Camera) -> str:
    """Intrinsics as JSON that OpenCV's FileStorage reads.

    Parameters
    ----------
    camera : Camera
        Any camera.

    Returns
    -------
    str
        JSON with image_width, image_height, camera_matrix and distortion_coefficients.
    """
    dist = camera.dist if camera.dist.size else np.zeros(5)
    node = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_matrix": _matrix(camera.K),
        "distortion_coefficients": _matrix(dist[None]),
    }
    return json.dumps(node, indent=1) + "\n"


def _matrix(values: NDArray[np.float64]) -> dict[str, Any]:
    rows, cols = values.shape
    data = values.ravel().tolist()
    return {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d", "data": data}


def ros_yaml(camera: Camera, *, name: str = "tof") -> str:
    """Intrinsics as the YAML file that ROS camera_info_manager loads.

    Parameters
    ----------
    camera : Camera
        Camera with at most 8 distortion coefficients.
    name : str
        Camera name, letters, digits and underscores.

    Returns
    -------
    str
        YAML; the model is plumb_bob up to 5 coefficients, else rational_polynomial.

    Raises
    ------
    ValueError
        If the distortion has more than 8 coefficients, or the name other characters.
    """
    if camera.dist.size > 8:
        msg = f"ROS models hold at most 8 distortion coefficients, got {camera.dist.size}"
        raise ValueError(msg)
    if not name.isidentifier() or not name.isascii():
        msg = f"the camera name must be letters, digits and underscores, got {name!r}"
        raise ValueError(msg)
    count = 5 if camera.dist.size <= 5 else 8
    dist = np.zeros((1, count))
    dist[0, : camera.dist.size] = camera.dist
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    return "\n".join(
        [
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            f"camera_name: {name}",
            *_yaml_matrix("camera_matrix", camera.K),
            f"distortion_model: {'plumb_bob' if count == 5 else 'rational_polynomial'}",
            *_yaml_matrix("distortion_coefficients", dist),
            *_yaml_matrix("rectification_matrix", np.eye(3)),
            *_yaml_matrix("projection_matrix", projection),
            "",
        ]
    )


def _yaml_matrix(key: str, values: NDArray[np.float64]) -> list[str]:
    data = ", ".join(map(_yaml_float, values.ravel().tolist()))
    rows, cols = values.shape
    return [f"{key}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: [{data}]"]


def _yaml_float(value: float) -> str:
    """Shortest text that reads back the same; YAML 1.1 takes 1e-05 for a word, 1.0e-05 not."""
    text = repr(value)
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if mark and "." not in mantissa else text


def write_text(path: Path | str, text: str) -> None:
    """Write a text file whole or not at all.

    Parameters
    ----------
    path : path
        Target.
    text : str
        Content, such as that of `ros_yaml`.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
