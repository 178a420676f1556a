"""The fisheye model: beside OpenCV within 90 degrees, beside plain formulas beyond, in files."""

import dataclasses
import json

import h5py
import numpy as np
import pytest

from toftools._lens import fisheye_limit, pinhole_limit
from toftools.camera import points, project, range_to_z, rays, rays_at, resized, z_to_range
from toftools.io.export import write_answer
from toftools.io.intrinsics import open3d_json, opencv_json, ros_yaml
from toftools.io.native import read_capture, write_capture
from toftools.io.open import open_capture
from toftools.sensors import sensor as make_sensor
from toftools.sim.analytic import analytic
from toftools.types import Camera, Capture, DepthMap, Modulation, Phasors, Scene, Sensor, Shot

K = np.array([[20.0, 0.3, 39.2], [0, 21.0, 29.7], [0, 0, 1]])
LENS = np.array([0.02, -0.004, 0.0003, 0.00002])
WIDE = Camera(80, 60, K, LENS, "fisheye")
"""Looks back in the corners."""
BROWN = Camera(
    80,
    60,
    K * [[3], [3], [1]] - [[0, 0, 78], [0, 0, 59], [0, 0, 0]],
    np.array([-0.2, 0.01, 1e-3, -2e-3]),
)


def test_opencv_projects_the_rays_onto_their_pixels():
    import cv2

    way = rays(WIDE)
    ahead = way[..., 2] > 0.05
    assert ahead.mean() > 0.6
    some = np.ascontiguousarray(way[ahead]).reshape(-1, 1, 3)
    got = cv2.fisheye.projectPoints(some, np.zeros(3), np.zeros(3), K, LENS, alpha=0.3 / 20)[0]
    v, u = np.nonzero(ahead)
    np.testing.assert_allclose(got.reshape(-1, 2), np.stack([u, v], -1), atol=1e-9)


def slow_image(camera, direction):
    """Pixel of one direction, straight from the definition."""
    x, y, z = direction
    theta = np.arccos(z / np.linalg.norm(direction))
    powers = sum(k * theta ** (2 * i + 2) for i, k in enumerate(camera.dist))
    radius, turn = theta * (1 + powers), np.arctan2(y, x)
    return (camera.K @ [radius * np.cos(turn), radius * np.sin(turn), 1.0])[:2]


def test_rays_beyond_ninety_degrees_are_those_of_the_definition():
    way = rays(WIDE)
    assert way[..., 2].min() < -0.1
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1), 1, atol=1e-12)
    for v in range(0, 60, 7):
        for u in range(0, 80, 9):
            np.testing.assert_allclose(slow_image(WIDE, way[v, u]), [u, v], atol=1e-8)


@pytest.mark.parametrize("camera", [WIDE, BROWN, dataclasses.replace(BROWN, dist=np.zeros(0))],
                         ids=["fisheye", "distorted", "pinhole"])  # fmt: skip
def test_projecting_undoes_the_rays_at_any_length(camera):
    v, u = np.mgrid[0:60, 0:80].astype(float)
    got = project(camera, 3.7 * rays(camera))
    np.testing.assert_allclose(got, [u, v], atol=1e-5)


def test_no_pixel_behind_a_pinhole_or_beyond_the_turning_point():
    behind, aside = np.array([0.1, 0.0, -1.0]), np.array([3.0, 0.0, 1.0])
    assert np.isnan(project(BROWN, behind)).all()
    assert np.hypot(3.0, 0.0) > pinhole_limit(BROWN.dist)
    assert np.isnan(project(BROWN, aside)).all()
    assert np.isfinite(project(dataclasses.replace(BROWN, dist=np.zeros(0)), aside)).all()
    short = Camera(80, 60, K, np.array([-0.2, 0.0, 0.0, 0.0]), "fisheye")
    last = fisheye_limit(short.dist)
    assert last == pytest.approx(np.sqrt(1 / 0.6))
    for angle, seen in ((last - 1e-6, True), (last + 1e-6, False)):
        direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
        assert np.isfinite(project(short, direction)).all() == seen
    assert np.isnan(rays(short)[0, 0]).all()
    assert np.isfinite(rays(short)[30, 40]).all()


@pytest.mark.parametrize("dist", [
    [-0.2, 0, 0, 0], [0.1, -0.2, 0, 0], [0.05, 0.1, -0.1, 0], [0.05, 0.02, 0.01, -0.05],
])  # fmt: skip
def test_the_limit_of_a_fisheye_is_where_its_radius_stops_rising(dist):
    theta = np.linspace(0, np.pi, 600_001)
    radius = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(dist))
    last = theta[np.argmax(np.diff(radius) < 0)]
    assert fisheye_limit(np.array(dist, float)) == pytest.approx(last, abs=2e-5)


@pytest.mark.parametrize("dist", [[-0.3, 0.1, 0, 0, -0.02], [0.2, -0.1, 0, 0, 0.01, 0.1, -0.2, 0]])
def test_the_limit_is_where_the_radius_stops_rising(dist):
    k1, k2, _, _, k3, k4, k5, k6 = [*dist, 0, 0, 0][:8]
    r = np.linspace(0, 6, 600_001)
    s = r * r
    bent = r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    first = r[np.argmax(np.diff(bent) < 0)]
    assert pinhole_limit(np.array(dist, float)) == pytest.approx(first, abs=2e-5)


def test_straight_ahead_and_straight_behind():
    np.testing.assert_allclose(project(WIDE, np.array([0.0, 0, 2])), K[:2, 2])
    np.testing.assert_allclose(rays_at(WIDE, K[:1, 2], K[1:2, 2]), [[0, 0, 1]])
    assert np.isnan(project(WIDE, np.array([0.0, 0, -2]))).all()


def test_range_and_z_of_rays_that_look_back():
    range_m = np.full((60, 80), 2.0)
    z_m = range_to_z(WIDE, range_m)
    assert z_m.min() < 0
    np.testing.assert_allclose(z_to_range(WIDE, z_m), range_m, rtol=1e-5)
    flat = z_to_range(WIDE, np.full((60, 80), 1.0))
    assert np.isnan(flat[rays(WIDE)[..., 2] <= 0]).all()
    assert (flat[rays(WIDE)[..., 2] > 0] >= 1).all()


def test_another_grid_is_the_same_view():
    half = resized(WIDE, 40, 30)
    assert half.model == "fisheye"
    u, v = np.array([3.0, 20.0]), np.array([5.0, 11.0])
    np.testing.assert_allclose(rays_at(half, u, v), rays_at(WIDE, 2 * u + 0.5, 2 * v + 0.5))


def test_four_coefficients_and_a_known_model():
    with pytest.raises(ValueError, match="exactly 4 coefficients"):
        Camera(80, 60, K, np.zeros(5), "fisheye")
    with pytest.raises(ValueError, match="wanted pinhole or fisheye"):
        Camera(80, 60, K, LENS, "omni")


def sensor():
    return Sensor(WIDE, Modulation(np.array([20e6])))


def test_the_capture_file_keeps_the_model_and_checks_it(tmp_path):
    path = tmp_path / "c.h5"
    write_capture(path, Capture(sensor(), phasors=Phasors(np.ones((1, 60, 80)))))
    assert read_capture(path).sensor.camera.model == "fisheye"
    for wrong, message in ((["fisheye"], "must be a word"), ("omni", "wanted pinhole or fisheye")):
        with h5py.File(path, "a") as file:
            extra = json.loads(file["sensor"].attrs["extra"])
            file["sensor"].attrs["extra"] = json.dumps({**extra, "camera_model": wrong})
        with pytest.raises(ValueError, match=message):
            read_capture(path)


def test_files_of_pinholes_say_nothing_of_a_model(tmp_path):
    path = tmp_path / "c.h5"
    write_capture(path, Capture(dataclasses.replace(sensor(), camera=BROWN),
                                phasors=Phasors(np.ones((1, 60, 80)))))  # fmt: skip
    with h5py.File(path) as file:
        assert "camera_model" not in file["sensor"].attrs["extra"]


def test_an_answer_keeps_the_model(tmp_path):
    depth = DepthMap(np.full((60, 80), 2.0))
    whole = Capture(sensor(), phasors=Phasors(np.ones((1, 60, 80))))
    write_answer(tmp_path / "d.npz", depth, whole)
    assert open_capture(tmp_path / "d.npz").sensor.camera.model == "fisheye"
    write_answer(tmp_path / "d.png", depth, whole)
    import cv2

    z_mm = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert (z_mm[rays(WIDE)[..., 2] <= 0] == 0).all()
    assert z_mm.max() == 2000


def test_intrinsics_for_other_tools():
    assert json.loads(opencv_json(WIDE))["camera_model"] == "fisheye"
    assert json.loads(opencv_json(BROWN))["camera_model"] == "pinhole"
    assert "distortion_model: equidistant\n" in ros_yaml(WIDE)
    assert "cols: 4\n" in ros_yaml(WIDE)
    with pytest.raises(ValueError, match="a fisheye; undistort first"):
        open3d_json(WIDE)


def test_the_simulator_measures_along_the_rays():
    wide = dataclasses.replace(make_sensor("opt8241:width=80,height=60"), camera=WIDE)
    capture = analytic(Scene("wall", {"range": 1.0}))(Shot(wide, seed=1))
    way, range_m = rays(WIDE), capture.truth.range_m
    seen = way[..., 2] > 1e-3
    np.testing.assert_allclose(points(WIDE, range_m)[seen][:, 2], 1.0, rtol=1e-4)
    assert np.isnan(range_m[way[..., 2] < 0]).all()
