"""Transient imaging: the reconstruction against its twin, the fit against its, and the limits."""

import functools

import numpy as np
import pytest
import reference_heide as slow

from toftools.correct import INVALID, OK
from toftools.correct import _heide_fit as parametric
from toftools.correct._heide_peaks import MOST
from toftools.correct._heide_solver import HUBER, problem, transients
from toftools.correct.crt import crt
from toftools.correct.heide2013 import heide2013
from toftools.registry import SIMULATORS
from toftools.sensors import sensor
from toftools.types import Phasors, Scene, Shot
from toftools.units import ambiguity_m, range_to_phase

COMB = "heide2013:freqs=" + "+".join(f"{i}0e6" for i in range(1, 17)) + ",width=32,height=16"
SWEEP = "heide2013:width=32,height=16"  # 221 frequencies
SHAPE = (16, 32)


@functools.cache
def built(text=COMB, **params):
    return heide2013(sensor(text), **params)


def turns(range_m, freqs):
    return np.exp(1j * range_to_phase(range_m, freqs[:, None, None]))


def frame(z, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    z = z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    return Phasors(z.astype(np.complex64), np.full(z.shape, noise, np.float32) if noise else None)


def ranges(seed=0, near=0.5, far=6.0):
    return np.random.default_rng(seed).uniform(near, far, SHAPE)


@pytest.mark.parametrize("cyclic", [True, False])
def test_admm_reaches_the_minimum_of_the_twin(cyclic):
    freqs = sensor(COMB).modulation.freqs_hz
    length_m = float(ambiguity_m(10e6)) if cyclic else 6.0
    task = problem(freqs, length_m, 0.003, cyclic=cyclic)
    matrix = task.adjoint.T.astype(np.float64)
    rng = np.random.default_rng(1)
    parts = np.zeros((2 * freqs.size, 4), np.float32)
    for i in range(4):
        d = rng.uniform(0.5, 4.5, 3)
        z = (np.array([1.0, 0.5, 0.2]) * np.exp(1j * range_to_phase(d, freqs[:, None]))).sum(axis=1)
        z += 0.02 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
        parts[:, i] = np.concatenate([z.real, z.imag]) / np.sqrt(freqs.size)
    default, long = (transients(parts, task, n) for n in (60, 2000))
    assert (long >= 0).all()
    for i in range(4):
        data = parts[:, i].astype(np.float64)
        _, least = slow.transient(matrix, data, task.weight, HUBER, cyclic=cyclic)
        values = [
            slow.objective(x[i].astype(np.float64), matrix, data, task.weight, HUBER, cyclic)[0]
            for x in (default, long)
        ]
        assert values[0] < 1.04 * least  # 60 iterations, the default
        assert 0.995 * least < values[1] < 1.003 * least


@pytest.mark.parametrize("decay", [False, True])
def test_the_fit_is_that_of_scipy(decay):
    k = range_to_phase(1.0, sensor(COMB).modulation.freqs_hz)
    rng = np.random.default_rng(2)
    for _ in range(10):
        truth = np.array([1.0, rng.uniform(1, 3), 0.5, rng.uniform(5, 9), 0.4, np.log(0.5)])
        truth = truth if decay else truth[:4]
        z = slow.model(truth, k, 2, decay=decay)
        z = z + 0.01 * (rng.normal(size=k.size) + 1j * rng.normal(size=k.size))
        start = truth + rng.normal(0, 0.05, truth.size)
        expected, cost = slow.fit(z, k, start, 2, decay=decay)
        p = np.zeros(2 * MOST + 2)
        p[: truth.size] = start
        normal = np.empty((p.size, p.size))
        got = parametric.fit(z, np.ones(k.size), k, 2, decay, p, normal)
        assert np.allclose(p[: truth.size], expected, atol=2e-5)
        assert np.isclose(got, cost, rtol=1e-6)
        # The normal matrix is that of central differences of the twin's model.
        steps = 1e-6 * np.eye(truth.size)
        ahead, behind = (
            np.array([slow.model(p[: truth.size] + s, k, 2, decay=decay) for s in sign * steps])
            for sign in (1, -1)
        )
        rows = (ahead - behind) / 2e-6
        expected_normal = np.real(np.conj(rows) @ np.transpose(rows))
        lower = np.tril_indices(truth.size)
        assert np.allclose(normal[lower], expected_normal[lower], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("text", [COMB, SWEEP], ids=["comb", "sweep"])
@pytest.mark.parametrize("share", [0.3, 1.2])
def test_two_returns_without_noise_come_back(text, share):
    freqs, near = sensor(text).modulation.freqs_hz, ranges()
    far = near + 1.2 + ranges(1, 0.0, 3.0)
    depth = built(text)(frame(turns(near, freqs) + share * turns(far, freqs)))
    assert (depth.info["returns"] == 2).mean() > 0.98  # the rest has a weak, false third one
    two = depth.info["returns"] == 2
    assert np.abs(depth.range_m - near)[two].max() < 1e-4
    assert np.abs(depth.info["ranges_m"][1] - far)[two].max() < 1e-4
    assert np.abs(depth.info["amplitudes"][1] - share)[two].max() < 1e-3
    assert np.isnan(depth.info["ranges_m"][2:][:, two]).all()


@pytest.mark.parametrize(("text", "noise"), [(COMB, 0.03), (SWEEP, 0.1)], ids=["comb", "sweep"])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_sigma_is_honest(text, noise, share):
    freqs, near = sensor(text).modulation.freqs_hz, ranges(2)
    depth = built(text)(frame(turns(near, freqs) + share * turns(near + 2, freqs), noise, seed=3))
    error = depth.range_m - near
    right = np.abs(error) < 0.05
    assert right.mean() > 0.99
    assert 0.93 < (error / depth.sigma_m)[right].std() < 1.07  # 512 pixels: 3 %
    freedom = 2 * freqs.size - 2 * (2 if share else 1)
    assert abs(np.median(depth.info["chi2"]) / freedom - 1) < 0.05


def test_a_decay_is_found_where_there_is_one_and_only_there():
    freqs, near = sensor(COMB).modulation.freqs_hz, ranges(4)
    k = range_to_phase(1.0, freqs)[:, None, None]
    sharp, blurred = (turns(near, freqs) * (1 + b / (1 - 0.6j * k)) for b in (0.0, 0.4))
    alone = built()(frame(sharp, 0.01, seed=5))
    assert (alone.info["decay_m"] == 0).mean() > 0.995
    both = built()(frame(blurred, 0.01, seed=5))
    assert (both.info["decay_m"] > 0).all()
    assert abs(np.median(both.info["decay_m"]) - 0.6) < 0.02
    assert abs(np.median(both.info["decay_share"]) - 0.4) < 0.02
    error = both.range_m - near
    assert 0.9 < (error / both.sigma_m).std() < 1.1
    # A lone return fitted to the same phasors is off by centimetres.
    usual = crt(sensor(COMB))(frame(blurred)).range_m - near
    assert np.median(usual) > 5 * np.median(np.abs(error))


def test_diffuse_light_of_a_corner():
    camera = sensor(COMB)
    scene = Scene("corner", {"angle": 90.0, "range": 1.0})
    capture = SIMULATORS["analytic"].build(scene)(Shot(camera, noisy=False))
    seen = np.isfinite(capture.truth.range_m)
    mine, usual = (
        np.abs(run(capture.phasors).range_m - capture.truth.range_m)[seen]
        for run in (built(), crt(camera))
    )
    assert np.median(usual) > 0.02
    assert np.median(mine) < 0.55 * np.median(usual)


def test_returns_too_close_for_two_peaks_are_one_and_sigma_says_so():
    freqs, near = sensor(SWEEP).modulation.freqs_hz, ranges(6)
    depth = built(SWEEP)(frame(turns(near, freqs) + 0.5 * turns(near + 0.7, freqs), 0.01))
    assert (depth.info["returns"] == 1).mean() > 0.9
    assert 0.08 < np.median(np.abs(depth.range_m - near)) < 0.13
    assert np.median(depth.sigma_m) > 5e-4  # the bound of the one return is 0.2 mm


def test_smaller_weights_tell_closer_returns_apart():
    freqs, near = sensor(SWEEP).modulation.freqs_hz, ranges(7)
    two = frame(turns(near, freqs) + 0.5 * turns(near + 0.8, freqs), 0.01)
    shares = [(built(SWEEP, weight=w)(two).info["returns"] == 2).mean() for w in (3e-4, 1e-3, 1e-2)]
    assert shares[0] > 0.98
    assert shares[0] > shares[1] > shares[2]


def test_noise_makes_false_returns():
    freqs, near = sensor(COMB).modulation.freqs_hz, ranges(8)
    rates = [
        (built()(frame(turns(near, freqs), n)).info["returns"] > 1).mean() for n in (0.03, 0.1)
    ]
    assert rates[0] < 0.01
    assert 0.3 < rates[1] < 0.8


def test_the_limit_holds_and_dead_pixels_are_invalid():
    camera = sensor(COMB)
    freqs = camera.modulation.freqs_hz
    z = turns(ranges(9, 0.5, 3.5), freqs)
    z[:, 0, 1] = 0
    valid = np.ones(SHAPE, bool)
    valid[0, 2] = False
    depth = heide2013(camera, max_range_m=4.0)(Phasors(z.astype(np.complex64), valid=valid))
    assert depth.info["status"][0, :4].tolist() == [OK, INVALID, INVALID, OK]
    assert np.nanmax(depth.range_m) < 4
    assert np.nanmax(np.abs(depth.range_m - ranges(9, 0.5, 3.5))) < 1e-4


@pytest.mark.parametrize(("text", "params", "message"), [
    ("opt8241", {}, "8 or more different frequencies, got 2"),
    (COMB, {"iterations": 0}, "iterations must be 1 or more, got 0"),
    (COMB, {"weight": 1.0}, "weight must lie in"),
    (COMB, {"first_share": 0.0}, "first_share must lie between"),
    (COMB, {"max_range_m": -1.0}, "max_range_m must be metres"),
    (SWEEP, {"max_range_m": 300.0}, "would need 3840 cells"),
])  # fmt: skip
def test_bad_input_is_refused_in_one_sentence(text, params, message):
    with pytest.raises(ValueError, match=message) as caught:
        heide2013(sensor(text), **params)
    assert "\n" not in str(caught.value)
