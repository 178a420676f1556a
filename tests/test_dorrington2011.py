"""Dorrington's numerical inversion: solutions, their choice, twin, bound, and where it breaks."""

import functools

import numpy as np
import pytest
from reference_two_returns import model, two_twin
from scipy.special import chdtri

from toftools.correct import INVALID, OK, REJECTED
from toftools.correct._relative_fit import fit, table_of_starts
from toftools.correct.crt import crt
from toftools.correct.dorrington2011 import _bound_m, dorrington2011
from toftools.crlb import crlb_returns_m
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import joint_ambiguity_m, range_to_phase

TWO, THREE, KINECT = "opt8241", "deeptof:freqs=20e6+50e6+70e6", "kinect2_nominal"


@functools.cache
def built(text, **params):
    return dorrington2011(sensor(text), **params)


def wavenumbers(text):
    return range_to_phase(1.0, sensor(text).modulation.freqs_hz)


def planted(text, n, *, near=(0.5, 3.0), apart=(0.3, 2.0), ratios=(0.05, 0.8), noise=0.0, seed=0):
    """Phasors (F, n) of two returns, the stronger first, and its range."""
    rng = np.random.default_rng(seed)
    first, extra = rng.uniform(*near, n), rng.uniform(*apart, n)
    z = model(wavenumbers(text)[:, None], first, extra, 1.0, rng.uniform(*ratios, n))
    return z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape)), first


def frame(z, noise=None):
    sigma = None if noise is None else np.full(z[:, None].shape, noise, np.float32)
    return Phasors(z[:, None].astype(np.complex64), sigma)


def off_m(depth, first, text):
    period = joint_ambiguity_m(sensor(text).modulation.freqs_hz)
    return np.mod(depth.range_m[0] - first + period / 2, period) - period / 2


@pytest.mark.parametrize("text", [THREE, KINECT])
def test_three_frequencies_recover_two_returns_over_the_joint_ambiguity(text):
    z, first = planted(text, 1500, near=(0.5, 12.0))
    # With the noise that the fit assumes this small, float32 phasors decide how well: 1e-7.
    off = np.abs(off_m(built(text)(frame(z, 1e-4)), first, text))
    assert np.median(off) < 1e-5
    assert (off < 0.005).mean() > 0.995
    assert (off < 0.1).mean() > 0.998


def test_two_frequencies_recover_two_returns_where_the_range_is_limited():
    z, first = planted(TWO, 1500)
    off = np.abs(off_m(built(TWO, max_range_m=3.5)(frame(z, 1e-4)), first, TWO))
    assert np.median(off) < 1e-5
    assert (off < 0.005).mean() > 0.99


def test_two_frequencies_do_not_determine_two_returns_over_the_joint_ambiguity():
    """The figure of the header: about a fifth of the pixels get another exact solution."""
    z, first = planted(TWO, 2000, near=(0.5, 8.0), noise=0.001, seed=1)
    depth = built(TWO)(frame(z, 0.001))
    wrong = np.abs(off_m(depth, first, TWO)) > 0.1
    assert 0.12 < wrong.mean() < 0.28
    ranges_m, amplitudes = depth.info["ranges_m"][:, 0], depth.info["amplitudes"][:, 0]
    both = wrong & (depth.info["returns"][0] == 2)
    turn = np.exp(1j * wavenumbers(TWO)[:, None, None] * ranges_m)
    left = np.abs(np.sum(amplitudes * turn, axis=1) - z)[:, both]
    assert np.median(left) < 0.001  # the wrong answers explain the data, too


def test_fit_agrees_with_a_general_solver():
    noise = 0.003
    z, _ = planted(THREE, 5, apart=(0.7, 2.0), ratios=(0.3, 0.8), noise=noise, seed=2)
    k, sigma = wavenumbers(THREE), np.full(3, noise)
    table = table_of_starts(k, 2.5, 1.0)
    bounds, limits = np.array([1e-3, 1.0, 0.03, 2.5]), np.array([-0.05, 4.0])
    wraps = 4
    noises = np.repeat(sigma[:, None], z.shape[1], axis=1)
    found = fit(z, noises, k, wraps, 6, bounds, limits, table.e, table.b, table.logs)
    for p in range(z.shape[1]):
        _, d, e, a, b = two_twin(z[:, p], sigma, k, 4.0, 2.5)
        bound = crlb_returns_m(sensor(THREE).modulation.freqs_hz, [d, d + e], [a, a * b], noise)
        # Logarithms weigh the noise to first order only: a fifth of sigma between the two.
        assert abs(found[0, p] - d) < 0.2 * bound[0]
        assert abs(found[0, p] + found[1, p] - d - e) < 0.2 * bound[1]
        assert found[2:, p] == pytest.approx([a, b], abs=0.02)


def test_bound_is_that_of_crlb():
    freqs, k = sensor(KINECT).modulation.freqs_hz, wavenumbers(KINECT)
    ranges_m = np.array([[1.0, 2.0, np.nan], [1.7, 4.0, np.nan]])
    amplitudes = np.array([[1.0, 0.4, np.nan], [0.3, 1.0, np.nan]])
    sigma = np.array([0.01, 0.02, 0.03])
    have = _bound_m(ranges_m, amplitudes, k, np.repeat(sigma[:, None], 3, axis=1))
    for p in range(2):
        want = crlb_returns_m(freqs, ranges_m[:, p], amplitudes[:, p], sigma)
        assert np.allclose(have[:, p], want, rtol=1e-6)
    assert np.isnan(have[:, 2]).all()


@pytest.mark.parametrize(("text", "limit"), [(TWO, 3.5), (THREE, 0.0), (KINECT, 0.0)])
@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_sigma_is_honest_where_returns_are_apart(text, limit, noise):
    z, first = planted(text, 3000, apart=(0.8, 2.0), ratios=(0.2, 0.7), noise=noise, seed=3)
    depth = built(text, max_range_m=limit)(frame(z, noise))
    normalised = off_m(depth, first, text) / depth.sigma_m[0]
    right = np.abs(normalised) < 10
    assert right.mean() > 0.99
    assert 0.9 < normalised[right].std() < 1.1


def test_it_is_efficient():
    noise = 0.01
    z, first = planted(THREE, 3000, apart=(1.0, 1.0), ratios=(0.5, 0.5), noise=noise, seed=4)
    off = off_m(built(THREE)(frame(z, noise)), first, THREE)
    bound = crlb_returns_m(sensor(THREE).modulation.freqs_hz, [1.0, 2.0], [1.0, 0.5], noise)[0]
    assert np.sqrt(np.mean(off**2)) == pytest.approx(bound, rel=0.06)
    alone = off_m(crt(sensor(THREE))(frame(z, noise)), first, THREE)
    assert np.median(np.abs(alone)) > 20 * bound


def test_close_returns_are_not_separated():
    """The figure of the header: 0.3 m apart at 1 % of noise, bias and spread take over."""
    z, first = planted(THREE, 2000, apart=(0.3, 0.3), ratios=(0.5, 0.5), noise=0.01, seed=5)
    off = off_m(built(THREE)(frame(z, 0.01)), first, THREE)
    assert np.median(np.abs(off)) > 0.03


def test_lone_returns_stay_alone():
    z, _ = planted(THREE, 20000, ratios=(0.0, 0.0), noise=0.02, seed=6)
    depth, alone = built(THREE)(frame(z, 0.02)), crt(sensor(THREE))(frame(z, 0.02))
    alarms = depth.info["chi2_one"] > chdtri(4, 0.001)
    assert 2 <= alarms.sum() <= 38
    assert np.abs(depth.range_m - alone.range_m)[~alarms].max() == 0


def test_limits_are_kept():
    z, first = planted(THREE, 500, near=(1.0, 6.0), noise=0.003, seed=7)
    depth = built(THREE, max_range_m=4.0, max_extra_m=1.0, max_ratio=0.5)(frame(z, 0.003))
    answered = depth.info["status"] == OK
    assert np.nanmax(depth.range_m) <= 4.0 + 1e-6
    two = answered & (depth.info["returns"] == 2)
    ranges_m, amplitudes = depth.info["ranges_m"][:, two], depth.info["amplitudes"][:, two]
    assert (np.diff(ranges_m, axis=0) <= 1.0 + 1e-5).all()
    assert (amplitudes[1] <= (0.5 + 1e-5) * amplitudes[0]).all()
    near = first < 4.0
    assert answered[0, near].mean() > 0.98


def test_more_starts_find_more():
    z, first = planted(TWO, 1500, near=(0.5, 8.0), noise=0.01, seed=8)
    right = [
        (np.abs(off_m(built(TWO, starts=n)(frame(z, 0.01)), first, TWO)) < 0.1).mean()
        for n in (1, 4)
    ]
    assert right[0] + 0.03 < right[1]


def test_a_frequency_without_signal_is_survived():
    z, _ = planted(THREE, 20, seed=9)
    z[1] = 0
    depth = built(THREE)(frame(z, 0.01))
    assert np.isin(depth.info["status"], (OK, REJECTED)).all()
    z[:] = 0
    assert (built(THREE)(frame(z, 0.01)).info["status"] == INVALID).all()


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"max_extra_m": 0.0}, "max_extra_m must be positive"),
        ({"max_ratio": np.inf}, "max_ratio must be positive"),
        ({"starts": 0}, "starts must lie in 1..1000"),
        ({"max_extra_m": 1e5}, "which make more than 100000 starts"),
        ({"first_share": -0.1}, "first_share must lie"),
        ({"max_range_m": -1.0}, "max_range_m must be metres"),
    ],
)
def test_parameters_out_of_range_are_refused(params, message):
    with pytest.raises(ValueError, match=message):
        dorrington2011(sensor(TWO), **params)
