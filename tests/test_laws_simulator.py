"""Laws that every simulator of the registry obeys, whatever its idea."""

import functools
import importlib
import inspect
import json
from dataclasses import replace

import numpy as np
import pytest

from toftools.camera import rays
from toftools.io.native import read_capture, write_capture
from toftools.phasor import demodulate, wrapped_range_m
from toftools.registry import SIMULATORS
from toftools.sensors import sensor as preset
from toftools.types import Capture, Scene, Shot
from toftools.units import range_to_phase

H, W = 6, 8
ONE, TWO = (f"{name}:width={W},height={H}" for name in ("deeptof", "opt8241"))

# Scenes that an entry is tried on, and what makes its light cheap; a new entry adds a line here.
SCENES = {
    "analytic": ("wall", "corner", "cavity"),
    "path": ("wall", "corner", "cornell"),
    "radiosity": ("wall", "corner", "cornell"),
}
QUICK = {
    "analytic": {"max_bounces": 1},
    "path": {"max_bounces": 1, "samples": 16},
    "radiosity": {"max_bounces": 1, "samples": 256},
}
# Tracers know their light to single precision; indirect light of the same seed has the same paths
# or virtual lights, so that it repeats to the last digits.
DIGITS = {"analytic": 1e-6, "path": 1e-5, "radiosity": 1e-5}
CASES = [(name, scene) for name in SIMULATORS for scene in SCENES.get(name, ("wall",))]

each_case = pytest.mark.parametrize(("name", "scene"), CASES)
each_entry = pytest.mark.parametrize("name", SIMULATORS)


@functools.cache
def built(name, scene, **params):
    return SIMULATORS[name].build(Scene(scene, params))


def shoot(name, scene, text=TWO, *, params=None, noisy=False, **fields):
    device = preset(text) if isinstance(text, str) else text
    shot = Shot(device, noisy=noisy, **{**QUICK.get(name, {}), **fields})
    return built(name, scene, **(params or {}))(shot)


@each_case
def test_a_capture_is_whole(name, scene):
    capture = shoot(name, scene)
    device, truth = preset(TWO), capture.truth
    assert isinstance(capture, Capture)
    mod = device.modulation
    assert capture.taps.values.shape == (mod.n_freqs, mod.n_taps, H, W)
    assert capture.taps.values.dtype == np.float32
    assert np.isfinite(capture.taps.values).all() and (capture.taps.values >= 0).all()
    assert np.array_equal(capture.phasors.values, demodulate(capture.taps, device).values)
    assert (
        truth.range_m.dtype == np.float32 and (truth.range_m[np.isfinite(truth.range_m)] > 0).all()
    )
    assert truth.direct.shape == (mod.n_freqs, H, W)
    if truth.normals is not None:
        seen = np.isfinite(truth.range_m)
        assert np.allclose(np.linalg.norm(truth.normals[seen], axis=-1), 1, atol=1e-5)
        assert ((truth.normals * rays(device.camera)).sum(axis=-1)[seen] < 0).all()


@each_case
def test_a_capture_survives_its_file(name, scene, tmp_path):
    capture = shoot(name, scene)
    write_capture(tmp_path / "c.h5", capture)
    again = read_capture(tmp_path / "c.h5")
    for part in ("range_m", "direct", "one_bounce", "rest", "normals", "albedo"):
        mine, theirs = getattr(capture.truth, part), getattr(again.truth, part)
        assert (mine is None) == (theirs is None)
        assert mine is None or np.array_equal(mine, theirs, equal_nan=True)
    assert np.array_equal(capture.taps.values, again.taps.values)


@each_case
def test_provenance_says_what_was_done(name, scene):
    for noisy in (True, False):
        told = shoot(name, scene, noisy=noisy, seed=3, params={"ambient_e": 5.0}).provenance
        assert json.loads(json.dumps(dict(told), allow_nan=False)) == dict(told)
        assert told["engine"] == name
        assert told["seed"] == (3 if noisy else None)
        assert told["max_bounces"] == 1


@each_entry
def test_a_wall_reads_its_range(name):
    capture = shoot(name, "wall", params={"range": 2.0})
    freqs = capture.sensor.modulation.freqs_hz
    expected = 2.0 / rays(capture.sensor.camera)[..., 2]
    assert np.abs(capture.truth.range_m - expected).max() < 2e-6
    turn = np.exp(-1j * range_to_phase(expected, freqs[:, None, None]))
    off = np.angle(capture.phasors.values * turn) / range_to_phase(1.0, freqs)[:, None, None]
    assert np.abs(off).max() < 5e-6


@each_entry
def test_a_wall_is_as_bright_as_lambert_says(name):
    device = preset(TWO)
    capture = shoot(name, "wall", params={"range": 2.0, "albedo": 0.6})
    charge = device.noise.signal_e * 0.6 * rays(device.camera)[..., 2] ** 3 / 4
    assert np.allclose(capture.taps.values.mean(axis=1), charge, rtol=1e-5)
    assert np.allclose(np.abs(capture.phasors.values), device.noise.contrast * charge, rtol=1e-5)


@each_case
def test_same_seed_same_bits(name, scene):
    for noisy in (True, False):
        first, second = (shoot(name, scene, noisy=noisy, seed=7) for _ in range(2))
        assert np.array_equal(first.taps.values, second.taps.values)
        assert np.array_equal(first.truth.direct, second.truth.direct)


@each_case
def test_another_seed_is_another_noise(name, scene):
    first, second = (shoot(name, scene, noisy=True, seed=s).taps.values for s in (7, 8))
    assert (first != second).mean() > 0.9


@each_case
def test_noise_scatters_about_the_noiseless_taps(name, scene):
    clean = shoot(name, scene, seed=5).taps.values.astype(float)
    read_e = preset(TWO).noise.read_e
    noisy = shoot(name, scene, noisy=True, seed=5).taps.values
    z = (noisy - clean) / np.sqrt(clean + read_e**2)
    # 384 taps of one exposure: mean and variance of a standard normal number.
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)


@each_case
def test_more_light_is_more_of_the_same(name, scene):
    weak, strong = (shoot(name, scene, f"{TWO},signal_e={e}") for e in (1000, 3000))
    size = np.abs(strong.phasors.values).max()
    assert np.abs(3 * weak.phasors.values - strong.phasors.values).max() < DIGITS[name] * size
    assert np.abs(3 * weak.truth.direct - strong.truth.direct).max() < DIGITS[name] * size


@each_case
def test_truth_sums_to_what_the_camera_sees(name, scene):
    capture = shoot(name, scene)
    size = np.abs(capture.phasors.values).max()
    alone = shoot(name, scene, max_bounces=0)
    assert np.abs(alone.phasors.values - capture.truth.direct).max() < DIGITS[name] * size
    if capture.truth.one_bounce is not None:
        parts = capture.truth.direct + capture.truth.one_bounce + capture.truth.rest
        assert np.abs(parts - capture.phasors.values).max() < DIGITS[name] * size
        assert not capture.truth.rest.any(), "at most one bounce was asked for"


@each_case
def test_ambient_light_moves_no_phase(name, scene):
    dark, bright = (shoot(name, scene, params={"ambient_e": e}) for e in (0.0, 4000.0))
    size = np.abs(dark.phasors.values).max()
    # Taps are float32, and all of them have grown.
    room = 4 * np.finfo(np.float32).eps * bright.taps.values.max()
    assert np.abs(bright.phasors.values - dark.phasors.values).max() < DIGITS[name] * size + room
    assert np.allclose(bright.taps.values - dark.taps.values, 4000.0, atol=room)
    assert np.array_equal(bright.truth.direct, dark.truth.direct)


@each_case
def test_frequencies_do_not_know_of_each_other(name, scene):
    both = shoot(name, scene, f"{ONE},freqs=20e6+50e6").phasors.values
    back = shoot(name, scene, f"{ONE},freqs=50e6+20e6").phasors.values
    alone = shoot(name, scene, f"{ONE},freqs=50e6").phasors.values
    size = np.abs(both).max()
    assert np.abs(both - back[::-1]).max() < DIGITS[name] * size
    assert np.abs(both[1:] - alone).max() < DIGITS[name] * size


@each_case
def test_no_phasor_exceeds_the_mean_charge(name, scene):
    capture = shoot(name, scene)
    mean = capture.taps.values.astype(float).mean(axis=1)
    contrast = preset(TWO).noise.contrast
    assert (np.abs(capture.phasors.values) <= contrast * mean * (1 + 1e-5) + 1e-3).all()


@each_case
def test_pixels_see_where_they_look(name, scene):
    """The middle of a larger picture is the smaller picture: direct light, no neighbours' share."""
    whole = preset(TWO)
    K = np.array(whole.camera.K)
    K[:2, 2] -= (2, 1)
    part = replace(whole, camera=replace(whole.camera, width=4, height=3, K=K))
    large, small = (shoot(name, scene, s, max_bounces=0) for s in (whole, part))
    inner = large.truth.direct[:, 1:4, 2:6]
    assert np.abs(inner - small.truth.direct).max() < DIGITS[name] * np.abs(inner).max()
    ranges = large.truth.range_m[1:4, 2:6], small.truth.range_m
    assert np.allclose(*ranges, rtol=1e-6, equal_nan=True)


@each_case
def test_running_leaves_its_input_alone(name, scene):
    device = preset(TWO)
    before = [np.array(device.camera.K), np.array(device.modulation.steps_rad)]
    shot = Shot(device, seed=1, **QUICK.get(name, {}))
    run = built(name, scene)
    first = run(shot)
    shoot(name, scene, ONE)  # another sensor in between
    again = run(shot)
    assert np.array_equal(first.taps.values, again.taps.values)
    after = [device.camera.K, device.modulation.steps_rad]
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    assert first.sensor is device


@each_case
def test_defaults_work(name, scene):
    """Nothing but a scene and a sensor: noise, bounces and paths as they come."""
    capture = built(name, scene)(Shot(preset(ONE), tol_m=0.05))
    assert np.isfinite(capture.phasors.values).all()
    assert wrapped_range_m(capture.phasors.values, capture.sensor.modulation.freqs_hz).shape


@each_entry
@pytest.mark.parametrize(
    ("scene", "params"),
    [("nowhere", {}), ("wall", {"colour": 3}), ("wall", {"range": -1.0}), ("wall", {"albedo": 1.5}),
     ("wall", {"albedo": float("nan")}), ("cavity", {"albedo": 1.0}), ("no/file.xml", {}),
     ("wall", {"ambient_e": -1.0}), ("wall", {"range": "far"})],
)  # fmt: skip
def test_bad_scenes_are_one_sentence(name, scene, params):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        SIMULATORS[name].build(Scene(scene, params))(Shot(preset(ONE), **QUICK.get(name, {})))


@each_entry
def test_bad_parameters_are_one_sentence(name):
    with pytest.raises(ValueError, match=r"^[^\n]*no parameter 'colour'[^\n]*$"):
        SIMULATORS[name].build(Scene("wall"), colour=3)


@each_entry
def test_header_tells_source_and_failure(name):
    module = importlib.import_module(SIMULATORS[name].target.partition(":")[0])
    header = inspect.getdoc(module)
    assert any(word in header for word in ("fail", "Fail", "cannot"))
    make = inspect.getdoc(SIMULATORS[name].load())
    for section in ("Parameters", "Returns", "Raises"):
        assert f"\n{section}\n---" in make


@each_entry
def test_every_grid_point_runs(name):
    for key, values in SIMULATORS[name].grid.items():
        for value in values:
            run = SIMULATORS[name].build(Scene("wall"), **{key: value})
            capture = run(Shot(preset(ONE), noisy=False, **QUICK.get(name, {})))
            assert np.isfinite(capture.taps.values).all()
