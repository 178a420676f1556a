"""Fuchs 2010: what it recovers, how it stays honest, and when it gives up."""

import dataclasses

import numpy as np
import pytest
from reference_fuchs import corner_frame

from toftools.correct.crt import crt
from toftools.correct.fuchs2010 import fuchs2010
from toftools.correct.fuchs2010_all_pairs import fuchs2010_all_pairs
from toftools.io.open import open_capture
from toftools.phasor import phasors_of
from toftools.sensors import sensor as preset
from toftools.types import Phasors

CAMERA = preset("opt8241:width=40,height=30")


def error_mm(depth, truth):
    return 1e3 * np.abs(depth.range_m - truth)


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_all_bounces_go_where_the_model_holds(albedo):
    truth, phasors, direct = corner_frame(CAMERA, albedo)
    before = error_mm(crt(CAMERA)(phasors), truth)
    depth = fuchs2010_all_pairs(CAMERA, iterations=12)(phasors)
    assert before.mean() > 15
    assert np.median(error_mm(depth, truth)) < 0.05
    assert error_mm(depth, truth).mean() < 0.2
    assert not depth.info["fallback"].any()
    removed = depth.info["indirect"] - (phasors.values - direct)
    assert np.abs(removed).mean() < 1e-3 * np.abs(phasors.values).mean()
    assert np.median(np.abs(depth.info["albedo"] - albedo)) < 1e-3


def test_production_agrees_with_all_pairs_away_from_the_crease():
    _, phasors, _ = corner_frame(CAMERA, 0.5)
    sparse, every = (make(CAMERA)(phasors) for make in (fuchs2010, fuchs2010_all_pairs))
    apart = 1e3 * np.abs(sparse.range_m - every.range_m)
    inner = np.abs(np.arange(40) - CAMERA.camera.K[0, 2]) > 4
    assert np.sqrt(np.mean(apart[:, inner] ** 2)) < 1.0
    assert np.sqrt(np.mean(apart**2)) < 3.0  # 26 mm of interference
    loose = fuchs2010(CAMERA, tol_mm=30.0)(phasors)
    assert np.mean((loose.range_m - every.range_m) ** 2) > np.mean((apart * 1e-3) ** 2)


def test_sigma_is_honest():
    truth, clean, _ = corner_frame(CAMERA, 0.5)
    sigma = 0.01 * np.abs(clean.values)
    rng = np.random.default_rng(1)
    run = fuchs2010_all_pairs(CAMERA, iterations=5)
    scores = []
    for _ in range(4):
        mess = rng.standard_normal(sigma.shape) + 1j * rng.standard_normal(sigma.shape)
        depth = run(Phasors((clean.values + sigma * mess).astype(np.complex64), sigma))
        scores.append(((depth.range_m - truth) / depth.sigma_m)[~depth.info["fallback"]])
    assert 0.9 < np.std(np.concatenate(scores)) < 1.1


@pytest.mark.parametrize("make", [fuchs2010, fuchs2010_all_pairs])
def test_too_much_energy_is_noticed_and_nothing_is_lost(make):
    _, phasors, _ = corner_frame(CAMERA, 0.8)
    bright = Phasors(phasors.values * np.float32(4), phasors.sigma)  # an albedo of about three
    depth, plain = make(CAMERA)(bright), crt(CAMERA)(bright)
    gone = depth.info["fallback"]
    assert gone.mean() > 0.9
    assert np.array_equal(depth.range_m[gone], plain.range_m[gone])
    assert (depth.sigma_m[gone] >= plain.sigma_m[gone]).all()
    assert (depth.info["status"] == 0).all()
    assert not depth.info["indirect"][:, gone].any()


def test_an_unknown_scale_is_fitted():
    truth, phasors, _ = corner_frame(CAMERA, 0.6)
    dim = Phasors(phasors.values / np.float32(3), phasors.sigma)
    depth = fuchs2010(CAMERA, albedo_gain=0.0, iterations=4)(dim)
    assert depth.info["albedo_gain"] == pytest.approx(3, rel=0.1)
    assert np.median(error_mm(depth, truth)) < 2
    known = fuchs2010(CAMERA, albedo_gain=3.0, iterations=4)(dim)
    assert np.median(error_mm(known, truth)) < 1


def test_one_frequency_is_enough():
    camera = preset("deeptof:width=40,height=30")
    truth, phasors, _ = corner_frame(camera, 0.5)
    before = np.median(error_mm(crt(camera)(phasors), truth))
    assert before > 20
    for gain in (1.0, 0.0):
        after = np.median(error_mm(fuchs2010(camera, albedo_gain=gain)(phasors), truth))
        assert after < (1 if gain else 0.7 * before)


@pytest.mark.parametrize(
    ("name", "share"),
    [("corner-angle-90-range-2-albedo-0.8", 0.35), ("room-seed-5", 0.7), ("vshape", 0.6)],
)
def test_rendered_scenes_lose_their_interference(name, share):
    from toftools.bench import suite

    folder = suite.__file__.replace("suite.py", "suites/first")
    capture = open_capture(f"{folder}/{name}.h5")
    phasors, truth = phasors_of(capture), capture.truth.range_m
    before = np.nanmean(error_mm(crt(capture.sensor)(phasors), truth))
    after = np.nanmean(error_mm(fuchs2010(capture.sensor)(phasors), truth))
    assert after < share * before


def test_sizes_that_have_no_surface():
    run = fuchs2010(CAMERA)
    for shape in ((1, 1), (1, 300), (2, 2), (300, 1)):
        depth = run(Phasors(np.full((2, *shape), 100j, np.complex64)))
        assert np.isfinite(depth.range_m).all()
        assert depth.sigma_m is None
        assert not depth.info["fallback"].any()


def test_black_scenes_are_left_alone():
    _, phasors, _ = corner_frame(CAMERA, 0.5)
    depth = fuchs2010(CAMERA, albedo_gain=1e-9)(phasors)
    assert np.allclose(depth.range_m, crt(CAMERA)(phasors).range_m, atol=1e-5)


@pytest.mark.parametrize(
    ("params", "says"),
    [
        ({"tol_mm": 0.0}, "tol_mm must be a positive"),
        ({"iterations": 0}, "iterations must be 1 or more, got 0"),
        ({"albedo_gain": -1.0}, "albedo_gain must be positive, or 0"),
        ({"max_range_m": -1.0}, "max_range_m must be metres"),
    ],
)
def test_bad_parameters_are_refused(params, says):
    with pytest.raises(ValueError, match=says) as caught:
        fuchs2010(CAMERA, **params)
    assert "\n" not in str(caught.value)


def test_contrast_per_frequency_and_beam_scale_the_flash():
    from toftools.correct._scene import optics

    noise = dataclasses.replace(CAMERA.noise, contrast=(0.8, 0.4))
    view = optics(dataclasses.replace(CAMERA, noise=noise))
    assert np.allclose(view.flash[0], 2 * view.flash[1])
