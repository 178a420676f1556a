"""Unwrapping along paths: the same sums as the readable twin, and right where plain wraps fail."""

import itertools

import numpy as np
import pytest

from toftools.correct._paths import aggregate
from toftools.correct.crt import crt
from toftools.correct.semi_global import semi_global
from toftools.phasor import phasors_of
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Phasors, Scene, Shot

PATHS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def twin(range_m, cost, valid, jump):
    """Equation 13 pixel by pixel, in the order of the path; invalid pixels are stepped over."""
    height, width = valid.shape
    total = np.zeros_like(cost)
    for dy, dx in PATHS:
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        summed = {}
        for y, x in itertools.product(rows, columns):
            before = summed.get((y - dy, x - dx))
            if not valid[y, x]:
                summed[y, x] = before
                continue
            here = cost[:, y, x].copy()
            if before is not None:
                there, ranges = before
                step = np.minimum(np.abs(range_m[:, y, x, None] - ranges[None]), 1.0)
                here += (there[None] + jump * step).min(axis=1) - there.min()
            summed[y, x] = here, range_m[:, y, x]
            total[:, y, x] += here
    return total


def test_sums_are_those_of_the_readable_twin():
    rng = np.random.default_rng(1)
    range_m = rng.uniform(0, 3, (4, 7, 9)).astype(np.float32)
    cost = rng.uniform(0, 5, range_m.shape).astype(np.float32)
    valid = rng.uniform(size=(7, 9)) > 0.15
    want = twin(range_m, cost, valid, 3.0)
    # float32 sums of a few dozen terms.
    np.testing.assert_allclose(aggregate(range_m, cost, valid, 3.0)[:, valid], want[:, valid],
                               rtol=1e-5)  # fmt: skip


def wrong_wraps(method, scene, params, device):
    capture = analytic(Scene(scene, params))(Shot(device, seed=1))
    error = method(device)(phasors_of(capture)).range_m - capture.truth.range_m
    return float((np.abs(error) > 0.5).mean())


@pytest.mark.parametrize("name", ["opt8241", "kinect2_nominal"])
def test_light_that_bounced_does_not_move_wraps(name):
    """A bright cavity: all pixels are biased alike, so only the one-sided error and white help."""
    device = sensor(f"{name}:width=32,height=24")
    cavity = "cavity", {"radius": 2.0, "albedo": 0.8}
    assert wrong_wraps(crt, *cavity, device) > 0.3
    assert wrong_wraps(semi_global, *cavity, device) == 0


@pytest.mark.parametrize("name", ["opt8241", "kinect2_nominal"])
def test_noise_is_outvoted_by_the_neighbours(name):
    device = sensor(f"{name}:width=64,height=48")
    wall = "wall", {"range": 7.0, "albedo": 0.4, "ambient_e": 1500.0}
    assert wrong_wraps(crt, *wall, device) > 0.15
    assert wrong_wraps(semi_global, *wall, device) < 0.02


@pytest.mark.parametrize("gain", [30.0, 1e-3])
def test_a_wrong_radiometry_does_no_harm(gain):
    """Amplitudes in another unit than the sensor says: no surface would be white enough."""
    device = sensor("kinect2_nominal:width=32,height=24")
    capture = analytic(Scene("wall", {"range": 5.0, "albedo": 0.8}))(Shot(device, seed=2))
    frame = phasors_of(capture)
    scaled = Phasors(frame.values * np.float32(gain), frame.sigma * np.float32(gain))
    run = semi_global(device)
    assert np.abs(run(scaled).range_m - capture.truth.range_m).max() < 0.5


def test_changed_says_where_the_least_residual_lost():
    device = sensor("opt8241:width=64,height=48")
    wall = Scene("wall", {"range": 7.0, "albedo": 0.4, "ambient_e": 1500.0})
    frame = phasors_of(analytic(wall)(Shot(device, seed=1)))
    ours, plain = semi_global(device)(frame), crt(device)(frame)
    assert np.array_equal(ours.info["changed"], np.abs(ours.range_m - plain.range_m) > 1e-3)


@pytest.mark.parametrize("params", [{"jump": -1.0}, {"multipath_rad": -0.1}, {"jump": np.nan}])
def test_bad_parameters_are_refused(params):
    with pytest.raises(ValueError, match="jump and multipath_rad must be 0 or more"):
        semi_global(sensor("opt8241"), **params)
