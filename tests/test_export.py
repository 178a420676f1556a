"""What is written comes back the same, in the words of the programs that will read it."""

import json

import numpy as np
import pytest

from toftools.camera import pinhole, points, range_to_z
from toftools.io.export import write_answer
from toftools.io.intrinsics import open3d_json, opencv_json, ros_yaml, write_text
from toftools.io.native import read_capture
from toftools.io.open import open_capture
from toftools.types import Camera, Capture, DepthMap, Modulation, Phasors, Sensor

SHAPE = (5, 7)
CAMERA = Camera(7, 5, np.array([[9.0, 0, 3.1], [0, 9.5, 2.2], [0, 0, 1]]))
LENS = Camera(7, 5, np.array([[9.0, 0, 3.1], [0, 9.5, 2.2], [0, 0, 1]]),
              np.array([0.1, -1e-5, 1e-3, 2e-3, 0.02, 0.3, -0.1, 4e-5]))  # fmt: skip


def answer(**extras):
    range_m = np.linspace(0.5, 4, 35).reshape(SHAPE).astype(np.float32)
    range_m[0, 0] = range_m[2, 3] = np.nan
    return DepthMap(range_m, **extras)


def capture_of(camera=CAMERA, **parts):
    z = np.ones((1, *SHAPE), np.complex64)
    return Capture(Sensor(camera, Modulation(np.array([20e6]))), phasors=Phasors(z), **parts)


def maps():
    rng = np.random.default_rng(3)
    return {name: rng.random(SHAPE, dtype=np.float32)
            for name in ("sigma_m", "confidence", "amplitude")}  # fmt: skip


def test_npz_holds_every_documented_key(tmp_path):
    depth, extras = answer(**maps()), maps()
    write_answer(tmp_path / "d.npz", depth, capture_of(LENS))
    with np.load(tmp_path / "d.npz") as stored:
        assert {"range_m", "z_m", "sigma_m", "confidence", "status"} <= set(stored)
        np.testing.assert_array_equal(stored["range_m"], depth.range_m)
        np.testing.assert_array_equal(stored["z_m"], range_to_z(LENS, depth.range_m))
        for name, values in extras.items():
            np.testing.assert_array_equal(stored[name], values)
        assert stored["status"].dtype == np.uint8
        assert (stored["status"] == np.isnan(depth.range_m)).all()
        np.testing.assert_array_equal(stored["K"], LENS.K)


def test_npz_keys_exist_even_where_the_method_has_nothing_to_say(tmp_path):
    write_answer(tmp_path / "d.npz", answer(), capture_of())
    with np.load(tmp_path / "d.npz") as stored:
        assert np.isnan(stored["sigma_m"]).all()
        assert np.isnan(stored["confidence"]).all()
    again = open_capture(tmp_path / "d.npz")
    assert again.depth.sigma_m is None
    assert again.depth.confidence is None


def test_npz_keeps_the_methods_own_status(tmp_path):
    status = np.zeros(SHAPE, np.uint8)
    status[0, 0], status[2, 3] = 1, 2
    write_answer(tmp_path / "d.npz", answer(info={"status": status}), capture_of())
    with np.load(tmp_path / "d.npz") as stored:
        np.testing.assert_array_equal(stored["status"], status)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_npz_reads_back_as_a_capture_with_its_camera(camera, tmp_path):
    depth = answer(**maps())
    write_answer(tmp_path / "d.npz", depth, capture_of(camera))
    again = open_capture(tmp_path / "d.npz")
    for name in ("range_m", "sigma_m", "confidence", "amplitude"):
        np.testing.assert_array_equal(getattr(again.depth, name), getattr(depth, name))
    np.testing.assert_array_equal(again.sensor.camera.K, camera.K)
    np.testing.assert_array_equal(again.sensor.camera.dist, camera.dist)


def test_png_is_z_in_whole_millimetres_and_zero_where_there_is_no_answer(tmp_path):
    import cv2

    depth = answer()
    write_answer(tmp_path / "d.png", depth, capture_of(LENS))
    image = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    known = np.isfinite(depth.range_m)
    assert (image[~known] == 0).all()
    z_mm = 1000 * range_to_z(LENS, depth.range_m).astype(np.float64)
    # Half a millimetre of rounding, and float32 at the border between two whole numbers.
    assert np.abs(image - z_mm)[known].max() <= 0.5 + 1e-3


def test_png_reads_back_through_the_png_reader(tmp_path):
    camera, depth = CAMERA, answer()
    write_answer(tmp_path / "d.png", depth, capture_of(camera))
    text = "depth_png:camera=9.0+9.5+3.1+2.2"  # fx, fy, cx, cy of CAMERA
    again = open_capture(tmp_path / "d.png", text)
    assert again.sensor.camera.K.tolist() == camera.K.tolist()
    error_m = again.depth.range_m - depth.range_m
    assert np.nanmax(np.abs(error_m)) < 1e-3
    assert (np.isnan(error_m) == np.isnan(depth.range_m)).all()


def test_png_refuses_what_does_not_fit(tmp_path):
    far = DepthMap(np.full(SHAPE, 80.0, np.float32))
    with pytest.raises(ValueError, match=r"65\.535 m"):
        write_answer(tmp_path / "d.png", far, capture_of())
    assert list(tmp_path.iterdir()) == []


def test_png_of_the_farthest_and_of_nothing(tmp_path):
    import cv2

    camera = pinhole(3, 1, hfov_deg=1e-3)  # so narrow that z is the range
    capture = Capture(Sensor(camera, Modulation(np.array([2e6]))),
                      phasors=Phasors(np.ones((1, 1, 3), np.complex64)))  # fmt: skip
    depth = DepthMap(np.array([[65.535, np.nan, 0.0004]]))
    write_answer(tmp_path / "d.png", depth, capture)
    image = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert image.tolist() == [[65535, 0, 0]]


def test_ply_comes_back_in_open3d_with_all_fields(tmp_path):
    from toftools._native import import_open3d

    o3d = import_open3d()
    depth = answer(**maps())
    write_answer(tmp_path / "d.ply", depth, capture_of(LENS))
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "d.ply"))
    known = np.isfinite(depth.range_m)
    np.testing.assert_array_equal(
        cloud.point["positions"].numpy(), points(LENS, depth.range_m)[known]
    )
    for name in ("amplitude", "sigma_m", "confidence"):
        got = cloud.point[name].numpy()
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got.ravel(), getattr(depth, name)[known])


def test_ply_has_only_the_fields_there_are(tmp_path):
    write_answer(tmp_path / "d.ply", answer(), capture_of())
    head, _, body = (tmp_path / "d.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 33\n" in head
    assert [line.split()[-1] for line in head.splitlines() if line.startswith(b"property")] == [
        b"x", b"y", b"z"]  # fmt: skip
    assert len(body) == 33 * 12


def test_ply_of_nothing_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no pixel has an answer"):
        write_answer(tmp_path / "d.ply", DepthMap(np.full(SHAPE, np.nan)), capture_of())
    assert list(tmp_path.iterdir()) == []


def test_h5_keeps_the_measurement_and_moves_the_cameras_own_depth(tmp_path):
    own = DepthMap(np.full(SHAPE, 1.5))
    depth = answer(**maps())
    write_answer(tmp_path / "d.h5", depth, capture_of(depth=own, provenance={"source": "x"}))
    again = read_capture(tmp_path / "d.h5")
    np.testing.assert_array_equal(again.depth.range_m, depth.range_m)
    np.testing.assert_array_equal(again.reported["camera"], own.range_m)
    assert (again.phasors.values == 1).all()
    assert again.provenance["source"] == "x"


def test_an_unknown_suffix_is_refused(tmp_path):
    for name in ("d.tiff", "d"):
        with pytest.raises(ValueError, match=r"wanted \.npz, \.png, \.ply or \.h5"):
            write_answer(tmp_path / name, answer(), capture_of())


def test_open3d_reads_its_intrinsics(tmp_path):
    from toftools._native import import_open3d

    o3d = import_open3d()
    write_text(tmp_path / "c.json", open3d_json(CAMERA))
    got = o3d.io.read_pinhole_camera_intrinsic(str(tmp_path / "c.json"))
    assert (got.width, got.height) == (7, 5)
    np.testing.assert_array_equal(got.intrinsic_matrix, CAMERA.K)
    with pytest.raises(ValueError, match="undistort first"):
        open3d_json(LENS)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_opencv_reads_its_intrinsics(camera, tmp_path):
    import cv2

    write_text(tmp_path / "c.json", opencv_json(camera))
    storage = cv2.FileStorage(str(tmp_path / "c.json"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), camera.K)
    dist = storage.getNode("distortion_coefficients").mat().ravel()
    np.testing.assert_array_equal(dist, camera.dist if camera.dist.size else np.zeros(5))
    assert storage.getNode("image_width").real() == 7
    storage.release()


def parsed(text):
    """The flat YAML that camera_info_manager reads: scalars, and matrices of a row of numbers."""
    found, key = {}, ""
    for line in text.splitlines():
        name, _, value = line.partition(": ")
        if not line.startswith(" "):
            key = name.removesuffix(":")
            found[key] = value or {}
        else:
            found[key][name.strip()] = value
    return found


@pytest.mark.parametrize(
    ("dist", "model", "stored"),
    [
        ([], "plumb_bob", [0, 0, 0, 0, 0]),
        ([0.1, 0.2, 3e-3, 4e-5], "plumb_bob", [0.1, 0.2, 3e-3, 4e-5, 0]),
        (LENS.dist, "rational_polynomial", LENS.dist),
    ],
)
def test_ros_camera_info(dist, model, stored):
    camera = Camera(7, 5, CAMERA.K, np.array(dist))
    info = parsed(ros_yaml(camera, name="left"))
    assert (info["image_width"], info["image_height"], info["camera_name"]) == ("7", "5", "left")
    assert info["distortion_model"] == model

    def matrix(key):
        values = np.array(json.loads(info[key]["data"]))
        return values.reshape(int(info[key]["rows"]), int(info[key]["cols"]))

    np.testing.assert_array_equal(matrix("camera_matrix"), camera.K)
    np.testing.assert_array_equal(matrix("distortion_coefficients").ravel(), stored)
    np.testing.assert_array_equal(matrix("rectification_matrix"), np.eye(3))
    np.testing.assert_array_equal(matrix("projection_matrix"), np.c_[camera.K, np.zeros(3)])
    # YAML 1.1 reads 4e-05 as a word; a number needs the point.
    for number in info["distortion_coefficients"]["data"].strip("[]").split(", "):
        assert "." in number


def test_ros_refuses_more_coefficients_than_its_models_hold():
    with pytest.raises(ValueError, match="at most 8"):
        ros_yaml(Camera(7, 5, CAMERA.K, np.full(12, 1e-3)))
    with pytest.raises(ValueError, match="camera name"):
        ros_yaml(CAMERA, name="a: b")
