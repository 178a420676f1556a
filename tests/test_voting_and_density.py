"""Residual voting and kernel density: against slow twins, and what they drop or repair."""

import numpy as np
import pytest
import reference_unwrapping as reference
from reference_unwrapping import planted

from toftools.correct import OK, REJECTED
from toftools.correct.crt import crt
from toftools.correct.kde import _density, _spatial_weights, kde
from toftools.correct.residual_voting import residual_voting
from toftools.sensors import sensor as preset
from toftools.types import Phasors
from toftools.units import joint_ambiguity_m, range_to_phase

KINECT = "kinect2_nominal"


def test_votes_are_those_of_the_driver():
    truth = np.random.default_rng(8).uniform(0.2, 18.5, (20, 50))
    frame = planted(KINECT, truth, snr=3.0, known=False)
    depth = residual_voting(preset(KINECT), lax_rad=9.0)(frame)
    order = np.argsort(preset(KINECT).modulation.freqs_hz)
    for at in np.ndindex(truth.shape):
        phases = np.mod(np.angle(frame.values[order][:, *at].astype(np.complex128)), 2 * np.pi)
        range_m, residual = reference.driver_votes(phases)
        if 0 <= range_m <= 18.737:
            assert abs(depth.range_m[at] - range_m) < 1e-4  # float32 phases of 15 turns
            # sqrt of a float32 sum of squares of about 90 rad: differences of 1e-5 rad.
            assert abs(depth.info["residual"][at] - residual) < 1e-4
        else:
            assert depth.info["status"][at] == REJECTED


def test_voting_takes_any_three_frequencies_in_any_order():
    for text in ("adtf3175", "kinect2", "opt8241:freqs=70e6+20e6+50e6"):
        longest = joint_ambiguity_m(preset(text).modulation.freqs_hz)
        truth = np.linspace(0.1, 0.97 * longest, 200).reshape(10, 20)
        depth = residual_voting(preset(text))(planted(text, truth, snr=200.0))
        # SNR 200 is 5 mrad: centimetres at 16 MHz, less after averaging.
        assert np.abs(depth.range_m - truth).max() < 0.05, text


def test_weak_and_disagreeing_pixels_are_dropped():
    run = residual_voting(preset(KINECT))
    truth = np.full((1, 4), 4.0)
    frame = planted(KINECT, truth, snr=1e3)
    values, sigma = np.array(frame.values), np.array(frame.sigma)
    sigma[0, 0, 1] = 0.5  # one frequency of SNR 2: under three amplitude units of 0.9
    values[2, 0, 2] *= np.exp(1j * 1.5)  # 120 MHz off by 86 degrees
    values[2, 0, 3] *= np.exp(1j * 0.5)  # by 29: its share across the line is 0.28 rad < 20 deg
    depth = run(Phasors(values, sigma))
    assert depth.info["status"].tolist() == [[OK, REJECTED, REJECTED, OK]]
    strict = residual_voting(preset(KINECT), strict_rad=0.2, lax_rad=0.2)(Phasors(values, sigma))
    assert strict.info["status"].tolist() == [[OK, REJECTED, REJECTED, REJECTED]]


@pytest.mark.parametrize(("shape", "window"), [((6, 9), 3), ((5, 4), 7), ((1, 1), 5)])
def test_density_is_that_of_the_loops(shape, window):
    rng = np.random.default_rng(9)
    range_m = rng.uniform(1, 3, (3, *shape)).astype(np.float32)
    weight = np.where(rng.random((3, *shape)) < 0.3, 0, rng.random((3, *shape))).astype(np.float32)
    have = _density(range_m, weight, _spatial_weights(window), np.float32(1 / (2 * 0.4**2)))
    # The series of the exponential is good to 5e-6, sums of 147 terms in float32 to 1e-5.
    assert np.allclose(have, reference.kde(range_m, weight, window, 0.4), rtol=3e-5, atol=1e-6)


def test_neighbours_repair_a_wrong_wrap_and_a_lone_outlier_is_dropped():
    v, u = np.mgrid[0:15, 0:15]
    truth = 6.0 + 0.02 * u + 0.01 * v
    values = np.array(planted(KINECT, truth, snr=6.0, seed=10).values)
    sigma = np.full(values.shape, 1 / 6, np.float32)
    freqs = preset(KINECT).modulation.freqs_hz
    # One pixel at a range that no neighbour has: it agrees with itself, but finds no support.
    values[:, 7, 7] = np.exp(1j * range_to_phase(14.0, freqs))
    frame = Phasors(values, sigma)
    alone, depth = crt(preset(KINECT))(frame).range_m, kde(preset(KINECT))(frame)
    assert alone[7, 7] == pytest.approx(14.0, abs=0.01)
    assert np.isnan(depth.range_m[7, 7])
    assert depth.info["status"][7, 7] == REJECTED
    noisy = planted(KINECT, truth, snr=2.0, seed=11)
    wrong = np.abs(crt(preset(KINECT))(noisy).range_m - truth) > 0.3
    repaired = np.abs(kde(preset(KINECT), threshold=0.0)(noisy).range_m - truth) > 0.3
    assert wrong.sum() > 20
    assert repaired.sum() < wrong.sum() / 2


def test_density_is_a_confidence():
    truth = np.full((40, 60), 9.0)
    frame = planted(KINECT, truth, snr=1.0, seed=12)
    depth = kde(preset(KINECT), threshold=0.0)(frame)
    right = np.abs(depth.range_m - truth) < 0.5
    assert depth.confidence[right].mean() > depth.confidence[~right].mean() + 0.05
    assert ((depth.confidence >= 0) & (depth.confidence <= 1 + 1e-5)).all()
    kept = kde(preset(KINECT), threshold=0.4)(frame).info["status"] == OK
    assert np.array_equal(kept, depth.confidence >= 0.4)


def test_noisy_pixels_speak_softly():
    # Equation 23: at SNR 1 the phase noise of 1 rad weighs exp(-3 / (2 s2)), before any residual.
    truth = np.full((9, 9), 5.0)
    loud, soft = (planted(KINECT, truth, snr=snr, seed=3) for snr in (100.0, 1.0))
    for frame, least, most in ((loud, 0.999, 1.001), (soft, 0.0, 0.7)):
        usual, strict = (
            kde(preset(KINECT), threshold=0.0, phase_scale=s2)(frame).confidence.mean()
            for s2 in (3.0, 0.3)
        )
        assert least <= strict / usual <= most
