"""Two returns by maximum likelihood: exact without noise, at the bound with it, silent on one."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from toftools.correct.two_returns import two_returns
from toftools.crlb import crlb_returns_m
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import range_to_phase

FOUR = "deeptof:freqs=20e6+50e6+70e6+90e6"
SIGMA = 1.0


def planted(camera, ranges_m, amplitudes, *, seed=None, shape=(40, 50)):
    """Phasors of the same returns in every pixel, with noise of `SIGMA` if there is a seed."""
    freqs = camera.modulation.freqs_hz[:, None]
    z = (np.exp(1j * range_to_phase(np.asarray(ranges_m), freqs)) * amplitudes).sum(axis=1)
    z = np.broadcast_to(z[:, None, None], (freqs.size, *shape))
    if seed is not None:
        rng = np.random.default_rng(seed)
        z = z + SIGMA * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape))
    return Phasors(z.astype(np.complex64), np.full(z.shape, SIGMA, np.float32))


@pytest.mark.parametrize("ranges_m", [(1.0, 1.6), (2.0, 3.3), (2.5, 6.0), (0.4, 4.0)])
@pytest.mark.parametrize("ratio", [0.1, 0.4, 1.5])
def test_noise_free_returns_come_back(ranges_m, ratio):
    camera = sensor(FOUR)
    depth = two_returns(camera, model_share=0.0)(
        planted(camera, ranges_m, [1000.0, 1000.0 * ratio], shape=(1, 1))
    )
    # complex64 carries 6e-8 of the amplitude; close returns magnify it a hundredfold.
    np.testing.assert_allclose(depth.info["ranges_m"][:, 0, 0], ranges_m, atol=2e-4)
    np.testing.assert_allclose(depth.info["amplitudes"][:, 0, 0], [1000, 1000 * ratio], rtol=1e-3)


@pytest.mark.parametrize(("ranges_m", "ratio"), [((2.0, 3.0), 0.4), ((1.2, 2.6), 0.7)])
def test_noise_is_that_of_the_bound_and_sigma_says_so(ranges_m, ratio):
    camera = sensor(FOUR)
    amplitudes = [400.0, 400.0 * ratio]
    run = two_returns(camera, model_share=0.0)
    depth = run(planted(camera, ranges_m, amplitudes, seed=1))
    error = depth.range_m - ranges_m[0]
    bound = crlb_returns_m(camera.modulation.freqs_hz, ranges_m, amplitudes, SIGMA)[0]
    # 2000 pixels: the standard deviation is known to 1.6 %; four of these, and no outliers.
    assert error.std() == pytest.approx(bound, rel=0.064)
    assert abs(error.mean()) < 4 * bound / np.sqrt(error.size)
    assert (error / depth.sigma_m).std() == pytest.approx(1, abs=0.064)


def test_one_return_stays_one():
    camera = sensor(FOUR)
    depth = two_returns(camera)(planted(camera, [3.0], [300.0], seed=2, shape=(200, 200)))
    # Chance 0.1 % by the chi-squared law of two more parameters; the search over all ranges looks
    # in many places, which multiplies it.
    assert (depth.info["returns"] == 2).mean() < 0.02
    assert ((depth.range_m - 3.0) / depth.sigma_m).std() == pytest.approx(1, abs=0.1)


def test_it_agrees_with_a_readable_twin():
    """scipy from the planted values: the same minimum, or one that is at least as deep."""
    camera = sensor(FOUR)
    freqs = camera.modulation.freqs_hz
    frame = planted(camera, (2.0, 3.1), [200.0, 90.0], seed=3, shape=(5, 6))
    depth = two_returns(camera, model_share=0.0, first_share=0.0)(frame)
    for v, u in np.ndindex(5, 6):
        z = frame.values[:, v, u].astype(np.complex128)

        def misfit(x, z=z):
            model = x[2] * np.exp(1j * range_to_phase(x[0], freqs))
            off = (z - model - x[3] * np.exp(1j * range_to_phase(x[1], freqs))) / SIGMA
            return np.concatenate([off.real, off.imag])

        twin = least_squares(misfit, [2.0, 3.1, 200.0, 90.0], xtol=1e-14, ftol=1e-14)
        assert depth.info["chi2"][v, u] <= 2 * twin.cost * (1 + 1e-6)
        if abs(depth.range_m[v, u] - twin.x[0]) < 0.3:  # the same valley
            assert depth.range_m[v, u] == pytest.approx(twin.x[0], abs=2e-5)


@pytest.mark.parametrize(
    ("params", "complaint"),
    [
        ({"first_share": 2.0}, "first_share and model_share must lie"),
        ({"significance": -1.0}, "significance must be 0 or more"),
        ({"max_range_m": -1.0}, "max_range_m must be metres"),
    ],
)
def test_bad_parameters_are_refused(params, complaint):
    with pytest.raises(ValueError, match=complaint):
        two_returns(sensor(FOUR), **params)


def test_two_frequencies_are_too_few():
    with pytest.raises(ValueError, match="at least three frequencies, got 2"):
        two_returns(sensor("opt8241"))
