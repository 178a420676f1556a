"""Regions against analytic geometry, exact and rounded to 2 cm, and against a slow twin."""

import numpy as np
import pytest
import reference_metrics as reference

from toftools.camera import pinhole, points, rays
from toftools.metrics.regions import (
    CORNER_ARM_M,
    CORNER_TURN_RAD,
    EDGE_JUMP_M,
    find_corners,
    find_edges,
    regions,
)
from toftools.types import Camera, Capture, DepthMap, Modulation, Phasors, Sensor, Taps, Truth

CAMERAS = {"vga_quarter": pinhole(320, 240, hfov_deg=70), "small": pinhole(64, 48, hfov_deg=70)}


BARREL = Camera(128, 128, [[90, 0, 63.5], [0, 90, 63.5], [0, 0, 1]], [-0.3, 0.1, 0, 0])


def plane(camera, normal, through_z_m):
    """Radial range of the plane with this normal through (0, 0, z), NaN behind the camera."""
    normal = np.asarray(normal, dtype=np.float64)
    towards = rays(camera) @ normal
    with np.errstate(divide="ignore"):
        range_m = through_z_m * normal[2] / towards
    return np.where((range_m > 0) & (range_m < 20), range_m, np.nan)


def rounded(range_m, step_m):
    return np.round(range_m / step_m) * step_m if step_m else range_m


def capture_of(camera, range_m, amplitude=1.0):
    values = np.broadcast_to(amplitude, camera.shape)[None].astype(np.complex64)
    sensor = Sensor(camera, Modulation(np.array([20e6])))
    return Capture(sensor, phasors=Phasors(values), truth=Truth(range_m))


@pytest.fixture(name="camera", params=list(CAMERAS))
def _camera(request):
    return CAMERAS[request.param]


@pytest.mark.parametrize("step_m", [0.0, 0.02])
@pytest.mark.parametrize("tilt_deg", [0, 30, 60, 80, 87])
@pytest.mark.parametrize("distance_m", [0.6, 2.0, 6.0])
@pytest.mark.parametrize("camera", [*CAMERAS.values(), BARREL], ids=[*CAMERAS, "barrel"])
def test_a_plane_has_neither_edges_nor_corners(camera, step_m, tilt_deg, distance_m):
    tilt = np.radians(tilt_deg)
    for turn in (0.0, 0.5, np.pi / 2):
        normal = [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        found = regions(capture_of(camera, rounded(plane(camera, normal, distance_m), step_m)))
        assert found["all"].any()
        assert not found["edges"].any() and not found["corners"].any()


@pytest.mark.parametrize("step_m", [0.0, 0.02])
@pytest.mark.parametrize("tilt_deg", [0, 50])
def test_edges_lie_exactly_along_a_step(camera, step_m, tilt_deg):
    tilt = np.tan(np.radians(tilt_deg))
    near, far = plane(camera, [tilt, 0, 1], 2.0), plane(camera, [tilt, 0, 1], 2.3)
    column = camera.width // 2
    range_m = np.where(np.arange(camera.width) < column, near, far)
    expected = np.zeros(camera.shape, dtype=bool)
    expected[:, column - 2 : column + 2] = True
    found = regions(capture_of(camera, rounded(range_m, step_m)))
    np.testing.assert_array_equal(found["edges"], expected)
    assert not found["corners"].any()
    rows = plane(camera, [0, 0, 1], 2.0) + np.where(np.arange(camera.height) < 9, 0.3, 0)[:, None]
    expected = np.zeros(camera.shape, dtype=bool)
    expected[7:11] = True
    np.testing.assert_array_equal(regions(capture_of(camera, rows))["edges"], expected)


def test_a_mixed_pixel_does_not_hide_an_edge(camera):
    range_m = np.where(np.arange(camera.width) < 20, 2.0, 3.0) / rays(camera)[..., 2]
    range_m[:, 20] = 2.45 / rays(camera)[:, 20, 2]
    marked = regions(capture_of(camera, range_m))["edges"]
    assert marked[:, 19:22].all() and not marked[:, :18].any() and not marked[:, 23:].any()


def test_a_thin_pole_is_an_edge(camera):
    for width in (1, 2, 3):
        range_m = np.full(camera.shape, 3.0)
        range_m[:, 30 : 30 + width] = 2.0
        marked = regions(capture_of(camera, range_m))["edges"]
        assert marked[:, 28 : 32 + width].all()
        assert not marked[:, :27].any() and not marked[:, 33 + width :].any()


def test_only_steps_above_the_limit_are_edges(camera):
    left = np.arange(camera.width) < 30
    for jump_m, is_edge in ((0.9 * EDGE_JUMP_M, False), (1.1 * EDGE_JUMP_M, True)):
        range_m = np.where(left, 2.0, 2.0 + jump_m) / rays(camera)[..., 2]
        found = regions(capture_of(camera, range_m))
        assert found["edges"].any() == is_edge
        assert not found["corners"].any()


def dihedral(camera, *, half_angle_deg, turn_rad, concave):
    """Range of two planes that meet 2 m away, and the distance of their points to the crease."""
    half = np.radians(half_angle_deg)
    across = np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    side = 1 if concave else -1
    walls = [
        plane(camera, s * np.cos(half) * across + side * np.array([0, 0, np.sin(half)]), 2.0)
        for s in (1, -1)
    ]
    range_m = np.fmin(*walls) if concave else np.maximum(*walls)
    xyz = points(camera, range_m)
    return range_m, np.hypot(xyz @ across, xyz[..., 2] - 2.0)


@pytest.mark.parametrize("step_m", [0.0, 0.02])
@pytest.mark.parametrize("turn_rad", [0.0, 0.6, np.pi / 2])
def test_corners_lie_along_a_concave_right_angle(camera, step_m, turn_rad):
    range_m, distance_m = dihedral(camera, half_angle_deg=45, turn_rad=turn_rad, concave=True)
    found = regions(capture_of(camera, rounded(range_m, step_m)))
    assert not found["edges"].any()
    # An arm is rounded up to whole pixels, at least two, and is longer on a receding wall.
    pixel_m = 2.0 / camera.K[0, 0]
    assert distance_m[found["corners"]].max() < 1.5 * (CORNER_ARM_M + 2 * pixel_m)
    border = 2 + int(np.ceil(1.3 * CORNER_ARM_M / pixel_m))
    inner = np.zeros(camera.shape, dtype=bool)
    inner[border:-border, border:-border] = True
    on_crease = inner & (distance_m < pixel_m)
    assert on_crease.sum() > 5
    assert found["corners"][on_crease].all()


@pytest.mark.parametrize("step_m", [0.0, 0.02])
@pytest.mark.parametrize("turn_rad", [0.0, 0.6, np.pi / 2])
def test_a_convex_right_angle_is_no_corner(camera, step_m, turn_rad):
    range_m, _ = dihedral(camera, half_angle_deg=45, turn_rad=turn_rad, concave=False)
    found = regions(capture_of(camera, rounded(range_m, step_m)))
    assert np.isfinite(range_m).mean() > 0.5
    assert not found["corners"].any() and not found["edges"].any()


@pytest.mark.parametrize(("half_angle_deg", "is_corner"), [(60, True), (80, False)])
def test_a_flat_crease_is_no_corner(half_angle_deg, is_corner):
    camera = CAMERAS["vga_quarter"]
    range_m, _ = dihedral(camera, half_angle_deg=half_angle_deg, turn_rad=0.0, concave=True)
    assert regions(capture_of(camera, range_m))["corners"].any() == is_corner


def test_a_sphere_around_the_camera_is_smooth(camera):
    for step_m in (0.0, 0.02):
        found = regions(capture_of(camera, rounded(np.full(camera.shape, 2.013), step_m)))
        assert not found["edges"].any() and not found["corners"].any()


@pytest.mark.parametrize("seed", range(3))
def test_geometry_equals_its_slow_twin(seed):
    rng = np.random.default_rng(seed)
    camera = pinhole(36, 30, hfov_deg=60)
    surfaces = [plane(camera, [*rng.uniform(-1, 1, 2), 1], rng.uniform(1, 3)) for _ in range(4)]
    range_m = np.fmax(np.fmin(surfaces[0], surfaces[1]), np.fmin(surfaces[2], surfaces[3]))
    range_m[:, 20:] += 0.3
    range_m[4, 7] = np.nan
    xyz = points(camera, range_m).astype(np.float64)
    found = find_edges(xyz[..., 2]), find_corners(camera, xyz[..., 2])
    np.testing.assert_array_equal(found[0], reference.edges(xyz[..., 2], EDGE_JUMP_M))
    twin = reference.corners(xyz, camera.K, CORNER_ARM_M, CORNER_TURN_RAD, EDGE_JUMP_M)
    np.testing.assert_array_equal(found[1], twin)
    assert found[0].any() and found[1].any()


def test_far_and_dark_are_the_outer_fifths(camera):
    rng = np.random.default_rng(0)
    range_m, amplitude = 1 + rng.random(camera.shape), 1 + rng.random(camera.shape)
    found = regions(capture_of(camera, range_m, amplitude))
    far, dark = found["far"], found["dark"]
    # A fifth of the pixels, up to the one on the border.
    assert abs(far.mean() - 0.2) < 1.5 / far.size and abs(dark.mean() - 0.2) < 1.5 / far.size
    assert range_m[far].min() > range_m[~far].max()
    assert amplitude[dark].max() < amplitude[~dark].min()


def test_normalised_phasors_leave_darkness_to_the_depth(camera):
    rng = np.random.default_rng(0)
    brightness = rng.random(camera.shape)
    unit = np.exp(1j * rng.uniform(0, 6, camera.shape))
    plain = capture_of(camera, np.full(camera.shape, 2.0), unit)
    assert not regions(plain)["dark"].any()
    depth = DepthMap(plain.truth.range_m, amplitude=brightness)
    found = regions(Capture(plain.sensor, phasors=plain.phasors, depth=depth, truth=plain.truth))[
        "dark"
    ]
    assert found.any() and brightness[found].max() < brightness[~found].min()


def test_taps_stand_in_for_phasors(camera):
    rng = np.random.default_rng(0)
    sensor = Sensor(camera, Modulation(np.array([20e6])))
    valid = rng.random(camera.shape) < 0.9
    taps = Taps(rng.uniform(100, 200, (1, 4, *camera.shape)), valid=valid)
    found = regions(Capture(sensor, taps=taps, truth=Truth(np.full(camera.shape, 2.0))))
    np.testing.assert_array_equal(found["all"], valid)
    assert found["dark"].any() and not found["dark"][~valid].any()


def test_regions_lie_within_the_scored_pixels(camera):
    rng = np.random.default_rng(0)
    range_m = rng.uniform(1, 4, camera.shape)
    range_m[rng.random(camera.shape) < 0.1] = np.nan
    found = regions(capture_of(camera, range_m), min_range_m=1.5, max_range_m=3.5)
    within = np.isfinite(range_m) & (range_m >= 1.5) & (range_m <= 3.5)
    np.testing.assert_array_equal(found["all"], within)
    assert list(found) == ["all", "edges", "corners", "dark", "far"]
    for mask in found.values():
        assert mask.dtype == np.bool_ and not mask[~within].any()


def test_regions_of_nothing_are_empty(camera):
    found = regions(capture_of(camera, np.full(camera.shape, np.nan)))
    assert not any(mask.any() for mask in found.values())


def test_regions_refuse_what_they_cannot_read():
    camera = CAMERAS["small"]
    sensor = Sensor(camera, Modulation(np.array([20e6])))
    with pytest.raises(ValueError, match="without truth"):
        regions(Capture(sensor, depth=DepthMap(np.ones(camera.shape))))
    with pytest.raises(ValueError, match="range limits"):
        regions(capture_of(camera, np.ones(camera.shape)), min_range_m=2.0, max_range_m=1.0)
