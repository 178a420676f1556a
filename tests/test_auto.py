"""Automatic choice: the right model where one fits, and never worse than doing nothing."""

from pathlib import Path

import numpy as np
import pytest

import toftools.bench
from toftools.correct._evidence import explained, noise_of, pooled
from toftools.correct.auto import MODELS, ONE, auto
from toftools.correct.crt import crt
from toftools.io.native import read_capture
from toftools.phasor import phasors_of
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import DepthMap, Phasors, Scene, Shot
from toftools.units import ambiguity_m, range_to_phase

FIRST = sorted((Path(toftools.bench.__file__).parent / "suites" / "first").glob("*.h5"))


def made(scene, params, device, seed=1):
    return analytic(Scene(scene, params))(Shot(device, seed=seed))


def mae_m(depth, capture):
    return float(np.nanmean(np.abs(depth.range_m - capture.truth.range_m)))


def both(capture, **params):
    frame = phasors_of(capture)
    return auto(capture.sensor, **params)(frame), crt(capture.sensor)(frame)


@pytest.mark.parametrize("path", FIRST, ids=lambda p: p.stem)
def test_never_worse_than_doing_nothing_on_rendered_scenes(path):
    capture = read_capture(path)
    ours, plain = both(capture)
    assert mae_m(ours, capture) <= mae_m(plain, capture)
    assert np.array_equal(np.isfinite(ours.range_m), np.isfinite(plain.range_m))


@pytest.mark.parametrize("name", ["corner-angle-90-range-2-albedo-0.8", "vshape", "room-seed-5"])
def test_bounced_light_is_taken_out_where_there_is_some(name):
    capture = read_capture(next(p for p in FIRST if p.stem == name))
    ours, plain = both(capture, learned="none")
    assert mae_m(ours, capture) < 0.65 * mae_m(plain, capture)
    assert ours.info["shares"]["bounced light"] > 0.8
    assert "falls to" in ours.info["why"]["bounced light"]


@pytest.mark.parametrize(
    "device",
    [
        "opt8241:width=48,height=36",
        "kinect2_nominal:width=48,height=40",
        "opt8241:width=160,height=120",
    ],
)
@pytest.mark.parametrize(
    ("scene", "params"), [("wall", {"range": 2.0}), ("tilted", {"range": 2.0, "tilt": 30.0})]
)
def test_without_multipath_nothing_happens(device, scene, params):
    capture = made(scene, params, sensor(device))
    ours, plain = both(capture)
    assert np.abs(ours.range_m - plain.range_m).mean() < 1e-3
    assert (ours.info["model"] == ONE).mean() > 0.99
    error = (ours.range_m - capture.truth.range_m) / ours.sigma_m
    assert error.std() == pytest.approx(1, abs=0.1)


def test_two_returns_are_found_and_sigma_holds():
    capture = made("two_returns", {"range": 2.0, "extra": 0.9, "ratio": 0.3},
                   sensor("kinect2_nominal:width=48,height=40"))  # fmt: skip
    ours, plain = both(capture)
    assert mae_m(ours, capture) < 0.2 * mae_m(plain, capture)
    assert ours.info["shares"]["two returns"] > 0.99
    error = (ours.range_m - capture.truth.range_m) / ours.sigma_m
    assert np.median(np.abs(error)) / 0.6745 == pytest.approx(1, abs=0.1)


def test_light_from_surfaces_out_of_view_changes_nothing_but_sigma():
    """A sphere around the camera, of which it sees a part: no model of physics is right."""
    capture = made("cavity", {"radius": 2.0, "albedo": 0.5}, sensor("opt8241:width=48,height=36"))
    ours, plain = both(capture, learned="none")
    assert mae_m(ours, capture) <= mae_m(plain, capture)
    assert ours.info["shares"]["one return"] == 1
    error = np.abs(ours.range_m - capture.truth.range_m)
    assert (error < 3 * ours.sigma_m).mean() > 0.95
    assert (error < 3 * plain.sigma_m).mean() < 0.9


def sure(device, *, sigma_m: float = 0.01, range_m: float = 2.0):
    """A learned method that is right about the cavity, and says how sure it is."""

    def run(phasors):
        shape = phasors.valid.shape
        return DepthMap(np.full(shape, range_m), sigma_m=np.full(shape, sigma_m))

    return run


def test_a_learned_answer_counts_where_it_is_surer_than_what_it_changes():
    """The cavity's light comes from all around: frequencies agree, and all read 18 mm too far."""
    hidden = made("cavity", {"radius": 2.0, "albedo": 0.5}, sensor("opt8241:width=48,height=36"))
    plain, _ = both(hidden, learned="none")
    away = mae_m(plain, hidden)
    taken, _ = both(hidden, learned=f"test_auto:sure:sigma_m={away / 5}")
    assert taken.info["shares"]["learned"] > 0.9 and mae_m(taken, hidden) < 0.2 * away
    unsure, _ = both(hidden, learned="test_auto:sure:sigma_m=1.0")
    assert unsure.info["shares"]["learned"] == 0
    assert np.array_equal(unsure.sigma_m, plain.sigma_m)
    assert "below what it changes" in taken.info["why"]["learned"]


def test_another_count_of_turns_takes_a_learned_sigma_of_a_tenth_of_the_change():
    """The wall at 2 m; the learned answer lies 4.28 m away: two turns of the higher frequency."""
    wall = made("wall", {"range": 2.0}, sensor("opt8241:width=20,height=12"))
    away = ambiguity_m(70e6) * 2
    for sigma_m, share in ((0.05 * away, 1.0), (0.2 * away, 0.0)):
        method = f"test_auto:sure:sigma_m={sigma_m},range_m={2.0 + away}"
        depth, _ = both(wall, learned=method)
        assert depth.info["shares"]["learned"] == share


def test_the_package_s_network_is_asked_for_frames_as_large_as_those_it_knows():
    for size, asked in (("width=159,height=112", False), ("width=160,height=112", True)):
        info = both(made("wall", {"range": 2.0}, sensor(f"opt8241:{size}")))[0].info
        assert ("learned" in info["why"]) == asked
    named, _ = both(made("wall", {"range": 2.0}, sensor("opt8241:width=20,height=12")),
                    learned="test_auto:sure")  # fmt: skip
    assert "learned" in named.info["why"]


def oracle(device, *, range_m: float = 2.0):
    """A learned method that is right about the cavity."""
    return lambda phasors: DepthMap(np.full(phasors.valid.shape, range_m, np.float32))


def test_a_learned_method_is_asked_only_where_nothing_else_explains_the_light():
    device = sensor("opt8241:width=48,height=36")
    hidden = made("cavity", {"radius": 2.0, "albedo": 0.5}, device)
    ours, _ = both(hidden, learned="test_auto:oracle")
    assert mae_m(ours, hidden) < 1e-6
    assert ours.info["shares"]["learned"] == 1
    wall = made("wall", {"range": 3.0}, device)
    ours, _ = both(wall, learned="test_auto:oracle")
    assert ours.info["shares"]["learned"] == 0


def test_one_frequency_trusts_amplitudes_only_in_the_unit_of_the_sensor():
    device = sensor("deeptof:width=48,height=48")
    capture = made("corner", {"angle": 90.0, "range": 2.0, "albedo": 0.8}, device)
    frame = phasors_of(capture)
    run, plain = auto(device, learned="none"), crt(device)(frame)
    assert mae_m(run(frame), capture) < 0.6 * mae_m(plain, capture)
    weak = run(Phasors(frame.values * np.float32(1e-4), frame.sigma * np.float32(1e-4)))
    assert np.allclose(weak.range_m, plain.range_m, atol=1e-4)
    assert "not that of a surface" in weak.info["why"]["bounced light"]


def test_info_names_the_model_of_every_pixel():
    capture = read_capture(FIRST[0])
    info = both(capture)[0].info
    assert info["models"] == MODELS
    assert info["model"].shape == capture.sensor.camera.shape
    assert sum(info["shares"].values()) == pytest.approx(1)


def test_a_learned_method_for_one_frequency_is_refused():
    with pytest.raises(ValueError, match="got one frequency and no sigma from it; use it alone"):
        auto(sensor("deeptof"), learned="test_auto:oracle")


@pytest.mark.parametrize("name", ["opt8241", "kinect2_nominal"])
def test_no_model_answers_beyond_the_limit(name):
    device = sensor(f"{name}:width=48,height=36")
    capture = made("two_returns", {"range": 3.0, "extra": 2.0, "ratio": 0.5}, device)
    ours, _ = both(capture, max_range_m=4.0)
    assert np.nanmax(ours.range_m) <= 4.1  # the last fit may move a range at the limit by noise


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="unknown name 'nope'"):
        auto(sensor("opt8241"), bounced="nope")


def test_residuals_of_noise_are_those_of_chi_squared():
    k = range_to_phase(1.0, np.array([80e6, 16e6, 120e6]))
    rng = np.random.default_rng(1)
    z = 100 * np.exp(1j * k[:, None, None] * np.full((60, 80), 2.3))
    z = z + rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape)
    valid = np.ones((60, 80), bool)
    found = explained(z, np.ones(z.shape, np.float32), np.full((60, 80), 2.4), k, valid)
    # Mean of 4800 values of chi-squared with 2 degrees of freedom: 2 +- 4 * 2 / sqrt(4800).
    assert found.chi2.mean() == pytest.approx(2, abs=0.116)
    assert ((found.range_m - 2.3) / found.sigma_m).std() == pytest.approx(1, abs=0.05)
    mean, count = pooled(found.chi2, valid, 2)
    assert count[30, 40] == 81
    assert count[0, 0] == 25
    assert mean[30, 40] == pytest.approx(found.chi2[26:35, 36:45].mean() / 2, rel=1e-5)


def test_explained_agrees_with_a_readable_twin():
    k = range_to_phase(1.0, np.array([80e6, 16e6, 120e6]))
    rng = np.random.default_rng(3)
    z = (rng.standard_normal((3, 5, 6)) + 1j * rng.standard_normal((3, 5, 6))).astype(np.complex64)
    sigma = rng.uniform(0.1, 0.5, z.shape).astype(np.float32)
    near = rng.uniform(1, 9, (5, 6)).astype(np.float32)
    found = explained(z, sigma, near, k, np.ones((5, 6), bool))
    off = np.angle(z * np.exp(-1j * k[:, None, None] * near)) / k[:, None, None]
    weight = (k[:, None, None] * np.abs(z) / sigma) ** 2
    shift = (weight * off).sum(axis=0) / weight.sum(axis=0)
    np.testing.assert_allclose(found.range_m, np.maximum(near + shift, 0), atol=1e-5)
    np.testing.assert_allclose(found.chi2, (weight * (off - shift) ** 2).sum(axis=0), rtol=1e-3)
    np.testing.assert_allclose(found.sigma_m, weight.sum(axis=0) ** -0.5, rtol=1e-5)


def test_unknown_noise_is_read_from_the_image():
    k = range_to_phase(1.0, np.array([40e6, 70e6]))
    rng = np.random.default_rng(2)
    z = 50 * np.exp(1j * k[:, None, None] * np.linspace(2, 3, 80) * np.ones((60, 1)))
    z = z + rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape)
    ranges = np.broadcast_to(np.linspace(2, 3, 80), (60, 80)).astype(np.float32)
    noise = noise_of(Phasors(z), ranges, k)
    assert np.median(noise) == pytest.approx(1, rel=0.05)
