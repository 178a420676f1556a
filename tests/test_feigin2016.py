"""Feigin et al.: returns in closed form, the noise carried through it, and where it breaks."""

import numpy as np
import pytest

from toftools.correct import INVALID, OK
from toftools.correct.feigin2016 import feigin2016, sharpened
from toftools.crlb import crlb_returns_m
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import ambiguity_m, range_to_phase

FIVE = sensor("deeptof:freqs=20e6+40e6+60e6+80e6+100e6")
FREQS = FIVE.modulation.freqs_hz


def frame(ranges_m, amplitudes, freqs=FREQS, *, noise=0.0, n=1, seed=0):
    """A row of n pixels with the same returns, and noise of known sigma."""
    turn = np.exp(1j * range_to_phase(np.asarray(ranges_m), np.reshape(freqs, (-1, 1))))
    z = np.repeat((turn @ np.asarray(amplitudes))[:, None, None], n, axis=2)
    rng = np.random.default_rng(seed)
    z = z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    return Phasors(z.astype(np.complex64), np.full(z.shape, max(noise, 1e-6), np.float32))


def twin(z, order):
    """Ranges by a singular value decomposition and numpy's roots, sharpened plainly."""
    toeplitz = np.array([z[i : i + order + 1] for i in range(z.size - order)])
    null = np.linalg.svd(toeplitz)[2][-1].conj()
    roots = np.roots(null[::-1])
    step = FREQS[1] - FREQS[0]
    ranges_m = np.mod(np.angle(roots), 2 * np.pi) / range_to_phase(1.0, step)
    vandermonde = np.exp(1j * range_to_phase(ranges_m, FREQS[:, None]))
    carried = np.linalg.lstsq(vandermonde, z, rcond=None)[0]
    return np.sort(ranges_m + np.angle(carried) / range_to_phase(1.0, FREQS[2]))


@pytest.mark.parametrize(
    ("text", "ranges_m", "amplitudes"),
    [("20e6+40e6+60e6+80e6+100e6", [2.0], [5.0]),
     ("20e6+40e6+60e6+80e6+100e6", [1.0, 1.4], [1.0, 0.9]),
     ("100e6+60e6+20e6+40e6+80e6", [0.3, 5.0], [0.2, 1.0]),
     ("50e6+70e6+90e6+110e6+130e6", [9.0, 10.0], [1.0, 0.4]),  # beyond the ambiguity of the step
     ("20e6+40e6+60e6+80e6+100e6+120e6+140e6", [1.0, 2.2, 4.0], [1.0, 0.5, 0.7])],
)  # fmt: skip
def test_returns_are_recovered_to_rounding(text, ranges_m, amplitudes):
    camera = sensor(f"deeptof:freqs={text}")
    run = feigin2016(camera, returns=max(len(ranges_m), 2))
    depth = run(frame(ranges_m, amplitudes, camera.modulation.freqs_hz))
    n = len(ranges_m)
    assert depth.info["returns"][0, 0] == n
    # complex64 has 1e-7, of which close returns cost a factor of a thousand.
    np.testing.assert_allclose(depth.info["ranges_m"][:n, 0, 0], ranges_m, atol=2e-4)
    np.testing.assert_allclose(depth.info["amplitudes"][:n, 0, 0], amplitudes, rtol=2e-3)


def test_it_is_its_plain_twin():
    phasors = frame([2.0, 3.0], [1.0, 0.5], noise=0.005, n=50)
    found = feigin2016(FIVE)(phasors).info["ranges_m"][:, 0]
    for p in range(50):
        expected = twin(phasors.values[:, 0, p].astype(complex), 2)
        np.testing.assert_allclose(found[:, p], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("second_m", "strength", "noise"),
    [(None, 0.0, 0.02), (4.0, 0.5, 0.02), (3.0, 0.5, 0.01), (2.6, 0.5, 0.002), (3.0, 0.2, 0.005)],
)
def test_sigma_is_honest(second_m, strength, noise):
    at, size = ([2.0, second_m], [1.0, strength]) if second_m else ([2.0], [1.0])
    depth = feigin2016(FIVE)(frame(at, size, noise=noise, n=4000, seed=1))
    spread = (depth.range_m[0] - 2.0) / depth.sigma_m[0]
    assert abs(spread.mean()) < 0.1
    assert 0.9 < spread.std() < 1.1


@pytest.mark.parametrize(
    ("second_m", "least", "most"), [(None, 1.0, 1.2), (4.0, 1.0, 1.3), (3.0, 3.0, 4.0)]
)
def test_error_against_the_bound(second_m, least, most):
    at, size = ([2.0, second_m], [1.0, 0.5]) if second_m else ([2.0], [1.0])
    depth = feigin2016(FIVE)(frame(at, size, noise=0.005, n=4000, seed=2))
    bound = crlb_returns_m(FREQS, at, size, 0.005)[0]
    assert least < np.std(depth.range_m[0]) / bound < most


def test_close_returns_break_it():
    depth = feigin2016(FIVE)(frame([2.0, 2.4], [1.0, 0.5], noise=0.01, n=2000, seed=3))
    wrong = np.mean(np.abs(depth.range_m[0] - 2.0) > 0.2)
    assert 0.2 < wrong < 0.35  # measured 27 %


def test_amplitude_phases_sharpen_the_roots():
    z = frame([2.0, 3.0], [1.0, 0.5]).values.reshape(5, 1).astype(complex)
    rough = np.array([[2.002], [2.998]])
    better = sharpened(rough, z, FREQS)
    # Not to zero: the other return's rough range leaks into the amplitude.
    assert np.abs(better - [[2.0], [3.0]]).max() < 1.1e-3


def test_sigma_is_none_without_noise_and_bad_pixels_stay_out():
    phasors = frame([2.0, 3.0], [1.0, 0.5], n=4)
    values = np.array(phasors.values)
    values[:, 0, 1], values[2, 0, 2] = 0, np.nan
    depth = feigin2016(FIVE)(Phasors(values))
    assert depth.sigma_m is None
    assert depth.info["status"].tolist() == [[OK, INVALID, INVALID, OK]]
    assert np.isnan(depth.range_m[0, 1:3]).all()
    assert ambiguity_m(20e6) > depth.range_m[0, 0] > 0


@pytest.mark.parametrize(
    ("text", "params", "words"),
    [("deeptof:freqs=20e6+40e6+60e6+80e6", {}, "feigin2016 needs 5 or more frequencies in equal"),
     ("deeptof:freqs=20e6+40e6+60e6+80e6+110e6", {}, "in equal steps, got"),
     ("kinect2_nominal", {"returns": 1}, "in equal steps, got"),
     ("deeptof:freqs=20e6+40e6+60e6", {"returns": 0}, "returns must be"),
     ("deeptof:freqs=20e6+40e6+60e6+80e6+100e6", {"first_share": 2.0}, "first_share must be")],
)  # fmt: skip
def test_what_does_not_fit_is_refused(text, params, words):
    with pytest.raises(ValueError, match=words):
        feigin2016(sensor(text), **params)
