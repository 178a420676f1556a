"""Phasor imaging: indirect light vanishes with frequency, beats unwrap, and where both end."""

import itertools

import numpy as np
import pytest

from toftools.camera import pinhole
from toftools.correct import INVALID, OK
from toftools.correct.crt import crt
from toftools.correct.gupta2015 import gupta2015
from toftools.registry import SIMULATORS
from toftools.sensors import sensor
from toftools.sim.shapes import cavity, corner
from toftools.types import Phasors, Scene, Shot
from toftools.units import ambiguity_m, phase_to_range, range_to_phase

CAMERA = sensor("phasor_imaging:width=100,height=100")
FREQS = CAMERA.modulation.freqs_hz
NARROW = pinhole(32, 8, hfov_deg=60)


def planted(range_m, freqs, *, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    z = np.exp(1j * range_to_phase(range_m, freqs[:, None, None]))
    z = z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    return Phasors(z.astype(np.complex64), np.full(z.shape, noise, np.float32) if noise else None)


def test_every_range_up_to_the_beat_comes_back():
    truth = np.linspace(0.0, 14.93, 10_000).reshape(100, 100)
    depth = gupta2015(CAMERA)(planted(truth, FREQS))
    # The phasors are float32: 6e-8 rad, hence 1e-6 turns of 0.14 m, and 15 m are good to 1e-6.
    assert np.abs(depth.range_m - truth).max() < 2e-6
    assert (depth.info["status"] == OK).all()


def slow(z, freqs):
    """The ladder with complex products, one pixel at a time."""
    pairs = sorted(
        ((i, j) for i, j in itertools.permutations(range(freqs.size), 2) if freqs[i] > freqs[j]),
        key=lambda p: freqs[p[0]] - freqs[p[1]],
    )
    beats = [(freqs[i] - freqs[j], z[i] * np.conj(z[j])) for i, j in pairs]
    beats.append((freqs.max(), z[np.argmax(freqs)]))
    range_m = float(phase_to_range(np.angle(beats[0][1]) % (2 * np.pi), beats[0][0]))
    for freq, beat in beats[1:]:
        off = np.angle(beat * np.exp(-1j * range_to_phase(range_m, freq)))
        range_m += float(phase_to_range(off, freq))
    off = np.angle(z * np.exp(-1j * range_to_phase(range_m, freqs)))
    weight = (freqs * np.abs(z)) ** 2
    return range_m + float((weight * phase_to_range(off, freqs)).sum() / weight.sum())


@pytest.mark.parametrize("text", ["1000e6+1010e6+1100e6", "1.3e9+900e6+1005e6+910e6", "1e9+1.03e9"])
def test_the_fast_ladder_is_the_slow_one(text):
    camera = sensor(f"phasor_imaging:freqs={text},width=20,height=20")
    freqs = camera.modulation.freqs_hz
    differences = np.abs(freqs[:, None] - freqs)[np.triu_indices(freqs.size, 1)]
    longest = float(ambiguity_m(differences.min()))
    truth = np.random.default_rng(1).uniform(0.2, 0.95 * longest, (20, 20))
    frame = planted(truth, freqs, noise=0.02)
    got = gupta2015(camera)(Phasors(frame.values)).range_m.reshape(-1)
    z = frame.values.reshape(freqs.size, -1).astype(complex)
    expected = np.array([slow(column, freqs) for column in z.T])
    assert np.abs(got - expected).max() < 3e-6


def test_sigma_is_honest_and_confidence_finds_wrong_wraps():
    truth = np.random.default_rng(2).uniform(0.5, 14, (100, 100))
    depth = gupta2015(CAMERA)(planted(truth, FREQS, noise=1 / 20))
    error = depth.range_m - truth
    assert 0.97 < (error / depth.sigma_m).std() < 1.03  # no wrong wrap among them
    chi2 = depth.info["residual"]
    assert abs(chi2.mean() - (FREQS.size - 1)) < 0.1
    noisy = gupta2015(CAMERA)(planted(truth, FREQS, noise=1 / 7))
    wrong = np.abs(noisy.range_m - truth) > 0.05
    assert 0.15 < wrong.mean() < 0.28
    right_ones, wrong_ones = noisy.confidence[~wrong], noisy.confidence[wrong]
    assert np.median(right_ones) > 2 * np.median(wrong_ones)


def test_a_pair_alone_amplifies_noise_and_a_third_frequency_helps():
    truth = np.random.default_rng(3).uniform(0.5, 14, (100, 100))
    pair = sensor("phasor_imaging:freqs=1000e6+1010e6,width=100,height=100")
    frames = [planted(truth, s.modulation.freqs_hz, noise=1 / 50) for s in (pair, CAMERA)]
    wrong = [
        (np.abs(gupta2015(s)(frame).range_m - truth) > 0.05).mean()
        for s, frame in zip((pair, CAMERA), frames, strict=True)
    ]
    # Half a turn of 1010 MHz against sqrt(1 + 1) 101 phase noises of 0.02 rad: 1.10 sigma.
    assert abs(wrong[0] - 0.2699) < 0.02
    assert wrong[1] == 0
    # The ladder of the pair loses nothing against the search over all wraps.
    best = (np.abs(crt(pair)(frames[0]).range_m - truth) > 0.05).mean()
    assert abs(wrong[0] - best) < 0.005


@pytest.mark.parametrize(
    ("scene", "limits_mm"),
    [  # at 20, 100, 500, 1000, 1500 MHz: the measured medians, a fifth wider
        (cavity(NARROW, radius=2.0), (1110, 38, 0.96, 0.32, 0.25)),
        (cavity(NARROW, radius=1.0), (1280, 22, 2.6, 0.48, 0.49)),
        (corner(NARROW, range=1.0), (75, 43, 2.5, 0.94, 0.36)),
    ],
    ids=["cavity2", "cavity1", "corner1"],
)
def test_indirect_light_vanishes_with_frequency(scene, limits_mm):
    previous = np.inf
    for freq, limit in zip((20e6, 100e6, 500e6, 1e9, 1.5e9), limits_mm, strict=True):
        whole, direct = scene.phasor(freq, None), scene.phasor(freq, 0)
        lit = np.abs(direct) > 0
        error = phase_to_range(np.angle(whole[lit] * direct[lit].conj()), freq)
        assert limit / 1.5 < 1e3 * np.median(np.abs(error)) < limit
        share = np.median(np.abs(whole - direct)[lit] / np.abs(direct)[lit])
        assert share < previous  # what is left of indirect light falls at every step
        previous = share


def test_next_to_a_concave_edge_no_frequency_is_high_enough():
    scene = corner(pinhole(256, 4, hfov_deg=60), range=1.0)
    for freq in (500e6, 1e9):
        whole, direct = scene.phasor(freq, None), scene.phasor(freq, 0)
        off = np.abs(np.angle(whole * direct.conj()))
        assert 0.19 < off.max() < 0.27


@pytest.mark.parametrize(("scene", "median_mm", "worst_mm"), [
    (Scene("corner", {"angle": 90.0, "range": 1.0}), 0.9, 7.0),
    (Scene("cavity", {"radius": 2.0, "albedo": 0.8}), 0.5, 0.5),
], ids=["corner", "cavity"])  # fmt: skip
def test_whole_chain_on_simulated_taps(scene, median_mm, worst_mm):
    camera = sensor("phasor_imaging:width=32,height=8")
    capture = SIMULATORS["analytic"].build(scene)(Shot(camera, noisy=False))
    error = 1e3 * np.abs(gupta2015(camera)(capture.phasors).range_m - capture.truth.range_m)
    seen = np.isfinite(capture.truth.range_m)
    assert np.median(error[seen]) < median_mm
    assert error[seen].max() < worst_mm  # no wrong wrap anywhere
    low = sensor("phasor_imaging:freqs=20e6+30e6+50e6,width=32,height=8")
    there = SIMULATORS["analytic"].build(scene)(Shot(low, noisy=False))
    usual = 1e3 * np.abs(crt(low)(there.phasors).range_m - there.truth.range_m)
    assert np.median(usual[seen]) > 30 * np.median(error[seen])


def test_a_mirrored_return_does_not_vanish():
    apart = np.linspace(0.3, 1.3, 1000)[None]
    one, second = (planted(3.0 + d, FREQS).values for d in (0 * apart, apart))
    run = gupta2015(sensor("phasor_imaging:width=1000,height=1"))
    weak = np.abs(run(Phasors(one + 0.1 * second)).range_m - 3.0)
    assert 0.0007 < weak.mean() < 0.0009
    assert weak.max() < 0.1 / range_to_phase(1.0, FREQS.min()) * 1.01
    strong = np.abs(run(Phasors(one + 0.4 * second)).range_m - 3.0)
    assert 0.65 < (strong > 0.05).mean() < 0.75


def test_low_frequencies_are_ignored_and_dead_pixels_invalid():
    mixed = sensor("phasor_imaging:freqs=20e6+1000e6+1010e6+1100e6,width=3,height=1")
    z = np.array(planted(np.full((1, 3), 4.0), mixed.modulation.freqs_hz).values)
    z[0] = 0  # the 20 MHz image is dead everywhere
    z[2, 0, 1] = 0
    depth = gupta2015(mixed)(Phasors(z))
    assert depth.info["status"].tolist() == [[OK, INVALID, OK]]
    assert np.allclose(depth.range_m[0, ::2], 4.0, atol=1e-5)


@pytest.mark.parametrize("text", [
    "opt8241", "phasor_imaging:freqs=1000e6", "phasor_imaging:freqs=1e9+1e9",
    "phasor_imaging:freqs=100e6+1e9",
])  # fmt: skip
def test_sensors_without_a_high_pair_are_refused(text):
    with pytest.raises(ValueError, match=r"two different frequencies of 5e\+08 Hz .*got") as caught:
        gupta2015(sensor(text))
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="frequencies of -1 Hz"):
        gupta2015(CAMERA, least_hz=-1.0)
