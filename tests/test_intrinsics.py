"""Intrinsics files of other programs, read back and refused."""

import json

import numpy as np
import pytest

from toftools.io.intrinsics import open3d_json, opencv_json, read_intrinsics, ros_yaml
from toftools.types import Camera

K = np.array([[9.0, 0.1, 3.1], [0, 9.5, 2.2], [0, 0, 1]])
PLAIN = Camera(7, 5, K)
LENS = Camera(7, 5, K, np.array([0.1, -1e-5, 1e-3, 2e-3, 0.02, 0.3, -0.1, 4e-5]))
FISHEYE = Camera(7, 5, K, np.array([0.1, -1e-5, 1e-3, 2e-3]), "fisheye")

STORAGE = """%YAML:1.0
---
K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 9., 0.1, 3.1, 0.,
       9.5e+00, 2.2, 0., 0., 1. ]
dist: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.1, -1.0e-05, 1.0e-03, 2.0e-03 ]
img_size: !!opencv-matrix
   rows: 2
   cols: 1
   dt: i
   data: [ 7, 5 ]
"""


@pytest.mark.parametrize(("camera", "written"), [
    (PLAIN, open3d_json), (PLAIN, opencv_json), (PLAIN, ros_yaml), (LENS, opencv_json),
    (LENS, ros_yaml), (FISHEYE, opencv_json), (FISHEYE, ros_yaml),
])  # fmt: skip
def test_what_is_written_is_read(camera, written, tmp_path):
    path = tmp_path / "camera"
    path.write_text(written(camera))
    found = read_intrinsics(path)
    assert (found.width, found.height, found.model) == (7, 5, camera.model)
    np.testing.assert_array_equal(found.K, camera.K)
    same = np.zeros(max(found.dist.size, camera.dist.size))
    same[: camera.dist.size] = camera.dist
    np.testing.assert_array_equal(np.resize(found.dist, same.shape) if same.size else same, same)


def test_opencv_storage_of_another_program(tmp_path):
    path = tmp_path / "calib.yml"
    path.write_text(STORAGE)
    found = read_intrinsics(path)
    np.testing.assert_array_equal(found.K, K)
    np.testing.assert_array_equal(found.dist, [0.1, -1e-5, 1e-3, 2e-3])
    assert found.shape == (5, 7)


def test_nested_lists_do_too(tmp_path):
    path = tmp_path / "rgb.json"
    content = {"camera_matrix": K.tolist(), "distortion_coefficients": [[0.1, 0, 0, 0, 0]],
               "image_width": 7, "image_height": 5}  # fmt: skip
    path.write_text(json.dumps(content))
    np.testing.assert_array_equal(read_intrinsics(path).K, K)


@pytest.mark.parametrize(("text", "message"), [
    ("", "no camera_matrix"),
    ("{", "Expecting"),
    ("{}", "no camera_matrix"),
    ('{"K": [1, 2, 3]}', "9 numbers, got 3"),
    ('{"K": "abc"}', "could not convert"),
    (json.dumps({"K": K.tolist()}), "image_width and image_height"),
    (json.dumps({"K": K.tolist(), "width": "x", "height": 5}), "invalid literal"),
    (json.dumps({"K": K.tolist(), "width": 7, "height": -5}), "1..65536 px"),
    (json.dumps({"K": [0] * 9, "width": 7, "height": 5}), "positive focal lengths"),
    (json.dumps({"K": {"rows": 3}, "width": 7, "height": 5}), "data"),
    (ros_yaml(LENS).replace("rational_polynomial", "omni"), "the distortion model 'omni'"),
    (STORAGE.replace("9.,", "9.x,"), "could not convert"),
    (STORAGE.replace("[ 7, 5 ]", "[ 7, 5, 3 ]"), "image_width and image_height"),
    ("[" * 100_000, "no camera_matrix"),
    ('{"K": ' + "[" * 100_000, "recursion"),
])  # fmt: skip
def test_one_sentence_for_files_that_hold_none(text, message, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_intrinsics(path)
    assert str(caught.value).startswith("bad.yaml holds no readable camera intrinsics")
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there_too_long_or_not_text(tmp_path):
    with pytest.raises(ValueError, match="is not there"):
        read_intrinsics(tmp_path / "no.json")
    (tmp_path / "long.json").write_bytes(b" " * ((1 << 20) + 1))
    with pytest.raises(ValueError, match="too many for the intrinsics"):
        read_intrinsics(tmp_path / "long.json")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00K")
    with pytest.raises(ValueError, match=r"bytes\.json holds no readable"):
        read_intrinsics(tmp_path / "bytes.json")
