"""Camera intrinsics as text for other tools, Open3D, OpenCV and ROS, and read from theirs.

Pixel centres lie at integer coordinates in all three, as here. Open3D stores its matrix by
columns and no distortion; ROS knows plumb_bob (5), rational_polynomial (8 coefficients) and, for
a fisheye, equidistant (4).
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.io.atomic import atomic_path
from toftools.types import Camera


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
        If the camera is a fisheye or has distortion, which Open3D cannot hold.
    """
    if camera.model != "pinhole":
        msg = f"Open3D intrinsics hold a pinhole, and this camera is a {camera.model}"
        raise ValueError(f"{msg}; undistort first (toftools.camera.undistorted)")
    if camera.dist.any():
        msg = "Open3D intrinsics hold no distortion, and this camera has some"
        raise ValueError(f"{msg}; undistort first (toftools.camera.undistorted)")
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
        JSON with image_width, image_height, camera_model (``pinhole`` or ``fisheye``, for cv2 or
        cv2.fisheye), camera_matrix and distortion_coefficients.
    """
    dist = camera.dist if camera.dist.size else np.zeros(5)
    node = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_model": camera.model,
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
        YAML; the model is equidistant for a fisheye, plumb_bob up to 5 coefficients, else
        rational_polynomial.

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
    model, count = _ros_model(camera)
    dist = np.zeros((1, count))
    dist[0, : camera.dist.size] = camera.dist
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    return "\n".join(
        [
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            f"camera_name: {name}",
            *_yaml_matrix("camera_matrix", camera.K),
            f"distortion_model: {model}",
            *_yaml_matrix("distortion_coefficients", dist),
            *_yaml_matrix("rectification_matrix", np.eye(3)),
            *_yaml_matrix("projection_matrix", projection),
            "",
        ]
    )


def _ros_model(camera: Camera) -> tuple[str, int]:
    """Name of the distortion model in ROS, and how many coefficients it holds."""
    if camera.model == "fisheye":
        return "equidistant", 4
    return ("plumb_bob", 5) if camera.dist.size <= 5 else ("rational_polynomial", 8)


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


NAMES = {
    "K": ("camera_matrix", "K", "intrinsic_matrix"),
    "dist": ("distortion_coefficients", "dist", "D"),
    "size": ("img_size", "image_size"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "model": ("camera_model", "distortion_model"),
}
"""What other programs call it."""
FISHEYE_NAMES = ("fisheye", "equidistant")
PINHOLE_NAMES = ("pinhole", "plumb_bob", "rational_polynomial", "")
MAX_TEXT = 1 << 20


def read_intrinsics(path: Path | str) -> Camera:
    """Camera out of the intrinsics file of another program.

    Parameters
    ----------
    path : path
        ROS camera_info YAML, or JSON or YAML of OpenCV's FileStorage (matrix ``camera_matrix`` or
        ``K``, ``distortion_coefficients`` or ``dist``, ``image_width`` and ``image_height`` or
        ``img_size`` as width and height), as `opencv_json` and `ros_yaml` write them; Open3D's
        JSON too.

    Returns
    -------
    Camera
        The camera.

    Raises
    ------
    ValueError
        If the file is missing, too long, or lacks one of these.
    """
    path = Path(path)
    if not path.is_file():
        msg = f"{path} is not there; give the intrinsics of the camera as OpenCV JSON or ROS YAML"
        raise ValueError(msg)
    if path.stat().st_size > MAX_TEXT:
        msg = (
            f"{path.name} has {path.stat().st_size} bytes, too many for the intrinsics of a camera"
        )
        raise ValueError(msg)
    try:
        text = path.read_text(encoding="utf-8")
        read = json.loads if text.lstrip().startswith("{") else _yaml_values
        return _camera_of(read(text))
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        detail = " ".join(str(error).split())[:250]
        msg = f"{path.name} holds no readable camera intrinsics: {detail}"
        raise ValueError(msg) from error


def _camera_of(content: Mapping[str, Any]) -> Camera:
    found = {
        key: next((content[name] for name in names if name in content), None)
        for key, names in NAMES.items()
    }
    if found["K"] is None:
        msg = "it has no camera_matrix"
        raise ValueError(msg)
    numbers = _numbers(found["K"]).ravel()
    if numbers.size != 9:
        msg = f"the camera matrix must have 9 numbers, got {numbers.size}"
        raise ValueError(msg)
    by_columns = "intrinsic_matrix" in content  # Open3D
    K = numbers.reshape(3, 3, order="F" if by_columns else "C")
    size: list[Any] = [found["width"], found["height"]]
    if found["size"] is not None:
        size = _numbers(found["size"]).ravel().tolist()
    if len(size) != 2 or None in size:
        msg = "it does not say image_width and image_height"
        raise ValueError(msg)
    model = str(found["model"] or "")
    if model not in (*FISHEYE_NAMES, *PINHOLE_NAMES):
        msg = (
            f"got the distortion model {model!r}; wanted plumb_bob, rational_polynomial or fisheye"
        )
        raise ValueError(msg)
    dist = np.zeros(0) if found["dist"] is None else _numbers(found["dist"]).ravel()
    known = "fisheye" if model in FISHEYE_NAMES else "pinhole"
    return Camera(int(size[0]), int(size[1]), K, dist, known)


def _numbers(value: Any) -> NDArray[np.float64]:  # noqa: ANN401 - out of a file
    return np.asarray(value["data"] if isinstance(value, Mapping) else value, dtype=np.float64)


def _yaml_values(text: str) -> dict[str, Any]:
    """Scalars, and matrices as their numbers, of a flat YAML file (ROS or OpenCV)."""
    found: dict[str, Any] = {}
    for block in re.split(r"\n(?=[A-Za-z_])", "\n" + text):
        name, _, value = block.strip().partition(":")
        numbers = re.search(r"\[([^\]]*)\]", value)
        if numbers:
            found[name] = [float(number) for number in numbers[1].split(",") if number.strip()]
        else:
            found[name] = value.strip().strip("\"'")
    return found
