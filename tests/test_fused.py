"""The chain in one pass does what its stages do one after another."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_toys import Bend, Constant, Drift, Pattern, Waves

from toftools.calib.amplitude import Amplitude
from toftools.calib.chain import chain_for, extended
from toftools.calib.common_phase import CommonPhase
from toftools.calib.fixed_pattern import FixedPattern
from toftools.calib.fused import at_temperatures, fused
from toftools.calib.stage import Residual
from toftools.calib.temperature import Temperature
from toftools.calib.wiggling import Wiggling
from toftools.calib.wiggling_lut import WigglingLut
from toftools.sensors import sensor
from toftools.types import Phasors

DEVICE = sensor("kinect2_nominal:width=37,height=23")
SHAPE = (3, 23, 37)


def chain_of(*stages):
    chain = chain_for(DEVICE)
    for stage in stages:
        chain = extended(chain, stage)
    return chain


def all_stages():
    rng = np.random.default_rng(2)
    pattern = rng.normal(size=SHAPE) * 0.1
    pattern[:, 3, 4] = np.nan
    return (
        Waves(),
        Constant(np.array([0.3, -2.0, 5.0])),
        Pattern(pattern),
        Bend(),
        Drift(np.array([0.01, 0.02, 0.03]), sensor_c=35.0),
    )


def phasors(seed=1):
    rng = np.random.default_rng(seed)
    amplitude = 2 ** rng.uniform(3.2, 15.8, SHAPE)
    values = amplitude * np.exp(2j * np.pi * rng.random(SHAPE))
    valid = rng.random(SHAPE[1:]) > 0.1
    return Phasors(values.astype(np.complex64), rng.random(SHAPE).astype(np.float32), valid)


def one_by_one(chain, measured):
    for stage in chain.stages:
        measured = stage(measured)
    return measured


@pytest.mark.parametrize("n", range(6))
def test_same_as_one_by_one(n):
    chain, measured = chain_of(*all_stages()[:n]), phasors()
    slow, fast = one_by_one(chain, measured), fused(chain)(measured)
    error = np.abs(np.angle(fast.values * slow.values.conj()))[:, slow.valid]
    assert error.max() < 1e-4
    # The polynomials of sine and cosine are good to a millionth or so.
    np.testing.assert_allclose(np.abs(fast.values), np.abs(measured.values), rtol=4e-6)
    np.testing.assert_allclose(fast.sigma, slow.sigma, rtol=1e-4)
    np.testing.assert_array_equal(fast.valid, slow.valid)


@pytest.mark.parametrize("which", range(5))
def test_every_stage_alone(which):
    chain, measured = chain_of(all_stages()[which]), phasors(3)
    slow, fast = one_by_one(chain, measured), fused(chain)(measured)
    error = np.abs(np.angle(fast.values * slow.values.conj()))[:, slow.valid]
    assert error.max() < (1e-4 if which == 3 else 5e-6)


def test_it_corrects_something():
    chain, measured = chain_of(*all_stages()), phasors()
    done = fused(chain)(measured)
    assert np.abs(np.angle(done.values * measured.values.conj())).mean() > 0.5


def test_amplitudes_beyond_the_span_keep_its_ends():
    chain, ones = chain_of(Bend()), np.ones(SHAPE, np.complex64)
    run = fused(chain)
    for inside, beyond in ((8.0, 0.5), (2.0**16, 2.0**20)):
        at, out = run(Phasors(ones * inside)).values, run(Phasors(ones * beyond)).values
        np.testing.assert_allclose(np.angle(at), np.angle(out), atol=1e-6)


def test_without_sigma_and_with_hopeless_pixels():
    run, measured = fused(chain_of(*all_stages())), phasors()
    values = np.array(measured.values)
    values[0, 0, 0], values[1, 1, 1], values[:, 2, 2] = np.nan, np.inf, 0
    done = run(Phasors(values))
    assert done.sigma is None
    assert not done.valid[0, 0] and not done.valid[1, 1]
    rest = np.isfinite(values).all(axis=0)
    np.testing.assert_array_equal(
        np.isfinite(done.values).all(axis=0)[rest], np.ones(rest.sum(), bool)
    )
    assert (done.values[:, 2, 2] == 0).all()


def real_stages():
    rng = np.random.default_rng(5)
    wave, sd = rng.normal(size=(2, 3, 8)) * 0.01, np.full((3, 8), 1e-4)
    freqs = np.asarray(DEVICE.modulation.freqs_hz)
    return (
        Wiggling(freqs, wave[0], wave[1], sd, sd, 30, np.ones((3, 64), bool), Residual()),
        CommonPhase(np.array([0.1, 2.0, -4.0]), np.full(3, 1e-4), np.full(2, 25.0)),
        FixedPattern(rng.normal(size=SHAPE) * 0.1, np.full(SHAPE, 1e-3)),
        Amplitude(rng.normal(size=(3, 4, 6)) * 0.01, np.zeros((3, 24, 24)),
                  np.tile([8.0, 2.0**16], (3, 1)), np.full(3, 1e3)),
        Temperature(np.full((3, 2), 1e-3), np.full((3, 2), 1e-5), np.full(2, 25.0),
                    np.tile([20.0, 60.0], (2, 1)), sensor_c=30.0, light_c=35.0),
    )  # fmt: skip


def test_real_stages_too():
    chain, measured = chain_of(*real_stages()), phasors()
    slow, fast = one_by_one(chain, measured), fused(chain)(measured)
    assert np.abs(np.angle(fast.values * slow.values.conj()))[:, slow.valid].max() < 1e-4
    np.testing.assert_allclose(fast.sigma, slow.sigma, rtol=2e-4)


def test_sigma_of_a_table_jumps_where_its_slope_does():
    knots = np.random.default_rng(3).normal(size=(3, 16)) * 0.02
    freqs, covered = np.asarray(DEVICE.modulation.freqs_hz), np.ones((3, 64), bool)
    lut = WigglingLut(freqs, knots, np.full((3, 16), 1e-4), (16,) * 3, 30, covered, Residual())
    measured = phasors()
    slow, fast = lut(measured), fused(chain_of(lut))(measured)
    off = np.abs(fast.sigma / slow.sigma - 1)
    assert (off > 1e-4).mean() < 16 * 2 / 2048 * 2
    assert off[:, slow.valid].max() < 0.4


def test_temperatures():
    cold = chain_of(replace(all_stages()[4], sensor_c=float("nan")))
    with pytest.raises(ValueError, match="temperature"):
        fused(cold)
    done = fused(at_temperatures(cold, sensor_c=27.0))(phasors())
    turn = np.angle(done.values[2] * phasors().values[2].conj())
    np.testing.assert_allclose(turn, -0.06, atol=1e-6)


def test_another_size_is_refused():
    run = fused(chain_of(Waves()))
    with pytest.raises(ValueError, match=r"\(3, 23, 37\)"):
        run(Phasors(np.ones((3, 4, 5), np.complex64)))


def test_nothing_is_compiled_after_making():
    from toftools.calib import fused as module

    run = fused(chain_of(*all_stages()))
    known = len(module._correct.signatures)
    strided = Phasors(np.ones((3, 37, 23), np.complex64).transpose(0, 2, 1))
    run(strided)
    run(phasors())
    run(replace(phasors(), sigma=None))
    assert len(module._correct.signatures) == known
