"""Orthogonal matching pursuit: its cells, its fit off the grid, its sigma, what it refuses."""

import functools

import numpy as np
import pytest
import reference_spectral as slow

from toftools.correct.bhandari2014 import bhandari2014, pursue
from toftools.crlb import crlb_returns_m
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import joint_ambiguity_m, range_to_phase

FOUR = "deeptof:freqs=20e6+40e6+60e6+80e6"
ODD = "deeptof:freqs=20e6+50e6+70e6"  # not equispaced
KINECT = "kinect2_nominal"


@functools.cache
def built(text, **params):
    return bhandari2014(sensor(text), **params)


def freqs_of(text):
    return sensor(text).modulation.freqs_hz


def planted(text, ranges_m, amplitudes, *, noise=0.0, seed=0):
    """Phasors (F, P) of returns (L, P)."""
    k = range_to_phase(1.0, freqs_of(text))
    z = (np.asarray(amplitudes) * np.exp(1j * k[:, None, None] * ranges_m)).sum(axis=1)
    rng = np.random.default_rng(seed)
    return z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))


def frame(z, noise=None):
    sigma = None if noise is None else np.full(z[:, None].shape, noise, np.float32)
    return Phasors(z[:, None].astype(np.complex64), sigma)


def pairs(n, text, apart, *, seed=0):
    first = np.random.default_rng(seed).uniform(
        0.3, joint_ambiguity_m(freqs_of(text)) - apart - 0.3, n
    )
    return np.stack([first, first + apart])


@pytest.mark.parametrize("text", [FOUR, ODD])
def test_pursuit_is_its_plain_twin(text):
    k = range_to_phase(1.0, freqs_of(text))
    rng = np.random.default_rng(1)
    z = rng.normal(size=(k.size, 50)) + 1j * rng.normal(size=(k.size, 50))
    noise = rng.uniform(0.5, 2.0, z.shape)
    grid = np.arange(0.0, joint_ambiguity_m(freqs_of(text)), 0.05)
    angle = k[:, None] * grid
    tables = (f(angle).astype(np.float32) for f in (np.cos, np.sin))
    fast = pursue(z, noise, k, grid, *tables, 3)
    plain = np.array([slow.pursuit(z[:, p], noise[:, p], k, grid, 3) for p in range(50)])
    # float32 scores: cells next to each other may tie
    assert np.mean(np.abs(fast - plain.T) <= 1) > 0.97


@pytest.mark.parametrize(("text", "apart"), [(FOUR, 1.0), (ODD, 1.3), (KINECT, 1.1)])
def test_two_returns_are_recovered_over_the_joint_ambiguity(text, apart):
    ranges_m = pairs(300, text, apart)
    z = planted(text, ranges_m, [[1.0], [0.5]])
    depth = built(text)(frame(z, 1e-4))
    right = np.abs(depth.info["ranges_m"][:, 0] - ranges_m).max(axis=0) < 2e-5
    # 3 frequencies leave other pairs of returns that nearly agree, where a start may end.
    assert right.mean() > (0.999 if text == FOUR else 0.98)


def test_three_returns():
    ranges_m = np.array([[1.0], [2.3], [4.1]])
    z = planted(FOUR, ranges_m, [[1.0], [0.7], [0.5]])
    depth = built(FOUR, returns=3)(frame(z, 1e-4))
    np.testing.assert_allclose(depth.info["ranges_m"][:, 0], ranges_m, atol=1e-4)


@pytest.mark.parametrize(("text", "apart"), [(FOUR, 1.2), (ODD, 1.4)])
def test_fit_reaches_the_bound_and_sigma_says_so(text, apart):
    ranges_m, noise = pairs(3000, text, apart, seed=2), 0.01
    z = planted(text, ranges_m, [[1.0], [0.6]], noise=noise, seed=3)
    depth = built(text)(frame(z, noise))
    error = depth.range_m[0] - ranges_m[0]
    bound = crlb_returns_m(freqs_of(text), [2.0, 2.0 + apart], [1.0, 0.6], noise)[0]
    near = np.abs(error) < 0.2  # beyond it is the other return, or a near repetition
    assert near.mean() > 0.995
    assert 0.9 < (error / depth.sigma_m[0])[near].std() < 1.1
    assert 0.9 < error[near].std() / bound < 1.1


def test_noise_of_each_frequency_counts():
    ranges_m = pairs(3000, FOUR, 1.4, seed=4)
    noise = np.array([0.01, 0.01, 0.02, 0.04])[:, None]
    z = planted(FOUR, ranges_m, [[1.0], [0.6]])
    rng = np.random.default_rng(5)
    z = z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    sigma = np.broadcast_to(noise[:, None], z[:, None].shape).astype(np.float32)
    depth = built(FOUR)(Phasors(z[:, None].astype(np.complex64), sigma))
    error = depth.range_m[0] - ranges_m[0]
    bound = crlb_returns_m(freqs_of(FOUR), [2.0, 3.4], [1.0, 0.6], noise[:, 0])[0]
    assert 0.9 < (error / depth.sigma_m[0]).std() < 1.1
    assert 0.9 < error.std() / bound < 1.1


def test_the_pursuit_alone_lies_on_its_grid_and_between_close_returns():
    ranges_m = pairs(400, FOUR, 0.8)
    z = planted(FOUR, ranges_m, [[1.0], [0.6]])
    depth = built(FOUR, refine=0)(frame(z, 0.02))
    cell_m = joint_ambiguity_m(freqs_of(FOUR)) / np.ceil(joint_ambiguity_m(freqs_of(FOUR)) / 0.05)
    cells = depth.range_m[0] / cell_m
    assert np.abs(cells - np.round(cells)).max() < 1e-4
    assert (depth.sigma_m > cell_m / np.sqrt(12)).all()
    # where it breaks: its header says 23 cm
    assert 0.15 < np.median(np.abs(depth.range_m[0] - ranges_m[0])) < 0.3


@pytest.mark.parametrize("freqs", ["20e6", "20e6+50e6", "20e6+50e6+50e6"])
def test_too_few_frequencies_are_refused_in_one_sentence(freqs):
    with pytest.raises(ValueError, match=r"needs 3 or more different frequencies, got") as no:
        bhandari2014(sensor(f"deeptof:freqs={freqs}"))
    assert "\n" not in str(no.value)


@pytest.mark.parametrize("grid_m", [1e-4, 100.0, 0.0])
def test_grids_too_fine_or_too_coarse_are_refused(grid_m):
    with pytest.raises(ValueError, match="grid_m must give"):
        bhandari2014(sensor(FOUR), grid_m=grid_m)
