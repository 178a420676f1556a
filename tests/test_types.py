"""Types check once, freeze views, and say in one sentence what is wrong."""

import numpy as np
import pytest

from toftools.camera import pinhole
from toftools.types import (
    Camera,
    Capture,
    DepthMap,
    Modulation,
    Noise,
    Phasors,
    Scene,
    Sensor,
    Taps,
    Truth,
)

SENSOR = Sensor(pinhole(4, 3, hfov_deg=60), Modulation(np.array([40e6, 70e6])))


def test_arrays_are_read_only_views_and_the_callers_array_stays_writable():
    mine = np.ones((2, 3, 4), np.complex64)
    phasors = Phasors(mine)
    with pytest.raises(ValueError, match="read-only"):
        phasors.values[0, 0, 0] = 2
    mine[0, 0, 0] = 3
    assert phasors.valid.dtype == bool
    assert phasors.valid.all()


def test_non_finite_phasors_are_invalid():
    values = np.ones((2, 3, 4), np.complex64)
    values[1, 2, 3] = np.nan
    values[0, 0, 0] = np.inf
    assert Phasors(values).valid.sum() == 10


def test_infinite_truth_is_unknown_truth():
    assert np.isnan(Truth(np.array([[np.inf, 1.0]])).range_m).tolist() == [[True, False]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera(4, 3, np.eye(2)), r"K must have shape \(3, 3\), got \(2, 2\)"),
        (lambda: Camera(0, 3, np.eye(3)), "width and height must be 1..65536 px, got 0 x 3"),
        (lambda: Camera(4, 3, -np.eye(3)), "positive focal lengths"),
        (lambda: Camera(4, 3, np.eye(3), np.ones(3)), "0, 4, 5, 8, 12 or 14"),
        (lambda: Modulation(np.array([20.0])), "give Hz, not MHz"),
        (lambda: Modulation(np.array([20e6]), np.arange(2)), "K >= 3 taps"),
        (lambda: Modulation(np.array([20e6]), harmonics=np.zeros((1, 3))), "first column 1"),
        (lambda: Noise(read_e=-1), "must be positive"),
        (lambda: Noise(contrast=1.5), r"contrast must be in \(0, 1\], got 1.5"),
        (lambda: Taps(np.ones((2, 3, 4))), "taps must have 4 dimensions"),
        (lambda: Taps(np.ones((1, 4, 3, 4)), unit="volt"), "unit must be one of"),
        (lambda: Phasors(np.ones((2, 0, 4))), "no empty one"),
        (lambda: Phasors(np.ones((2, 3, 4)), np.ones((1, 3, 4))), "sigma must have shape"),
        (lambda: Phasors(np.ones((2, 3, 4)), valid=np.ones((4, 3))), "valid must have shape"),
        (lambda: Phasors("text"), "phasors must be an array of complex64, got str"),
        (lambda: DepthMap(np.array([[-1.0]])), "non-negative metres"),
        (lambda: DepthMap(np.array([[np.inf]])), "non-negative metres"),
        (lambda: DepthMap(np.ones((2, 2)), np.ones((3, 3))), "sigma_m must have shape"),
        (lambda: Truth(np.ones((3, 4)), np.ones((2, 4, 3))), "truth direct must have shape"),
        (lambda: Capture(SENSOR), "at least one of taps, phasors and depth"),
        (lambda: Capture(SENSOR, depth=DepthMap(np.ones((4, 3)))), r"shape \(3, 4\), got \(4, 3\)"),
        (lambda: Capture(SENSOR, phasors=Phasors(np.ones((1, 3, 4)))), "phasors must have shape"),
        (
            lambda: Capture(SENSOR, depth=DepthMap(np.ones((3, 4))), truth=Truth(np.ones((1, 1)))),
            "truth range_m must have shape",
        ),
        (lambda: Sensor(SENSOR.camera, SENSOR.modulation, emitter_offset_m=(0, 1)), "three finite"),
    ],
)
def test_wrong_values_are_refused_in_one_sentence(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_scene_parameters_cannot_be_changed_from_outside():
    params = {"range": 2.0}
    scene = Scene("wall", params)
    params["range"] = 3.0
    assert scene.params["range"] == 2.0
    with pytest.raises(TypeError):
        scene.params["range"] = 4.0
