"""Frames that no camera should give and some do: every entry answers, or says per pixel why not."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from test_laws_correction import CASES as LAW_CASES
from test_laws_correction import (
    GRID_M,
    PARAMS,
    RECOVERY_M,
    SIZE,
    SLOW,
    SPATIAL,
    built,
    longest_m,
    planted,
)  # fmt: skip

from toftools.camera import resized
from toftools.correct import INVALID, OK, REJECTED
from toftools.registry import CORRECTIONS
from toftools.sensors import sensor as preset
from toftools.types import Phasors

H, W = 3, 4
SMALL = f"width={W},height={H}"
# What goes wrong goes wrong in one pixel: small frames, since some entries take their time.
CASES = [(name, text.replace(SIZE.strip(":"), SMALL)) for name, text in LAW_CASES]
MOST_MB = 256
"""What a frame of 4096 pixels may take: an entry that holds a range grid for all of them at once
takes more, and gigabytes at four million."""

each_case = pytest.mark.parametrize(("name", "text"), CASES, ids=lambda v: str(v).split(":")[0])


def wall(name, sensor, shape=(H, W)):
    """Ranges of a gently tilted wall, well inside what the entry can tell apart."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return 0.35 * longest_m(name, sensor) + 0.02 * (u % W) + 0.01 * v


def frame_of(name, text, **light):
    sensor = preset(text)
    return planted(sensor, wall(name, sensor), **light)


def said(depth, shape=(H, W)):
    """Status of an answer whose every pixel is a range, or a NaN with a reason."""
    status = depth.info["status"]
    assert depth.range_m.shape == status.shape == shape
    assert np.isin(status, (OK, INVALID, REJECTED)).all()
    assert np.array_equal(np.isfinite(depth.range_m), status == OK)
    if depth.sigma_m is not None:
        assert not (depth.sigma_m[status == OK] < 0).any()
    return status


@each_case
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_frames_without_a_signal_are_invalid_throughout(name, text, value, known):
    frame = frame_of(name, text)
    values = np.full(frame.values.shape, value, np.complex64)
    depth = built(name, text)(Phasors(values, frame.sigma if known else None))
    assert (said(depth) == INVALID).all()


@each_case
def test_a_saturated_frame_is_invalid_throughout(name, text):
    frame = frame_of(name, text)
    nowhere = np.zeros((H, W), bool)
    assert (said(built(name, text)(Phasors(frame.values, frame.sigma, nowhere))) == INVALID).all()


@each_case
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
@pytest.mark.parametrize("amplitude", [1e30, 1e-30])
def test_huge_and_tiny_amplitudes_give_the_range_or_none(name, text, amplitude, known):
    sigma = 1e-3 * amplitude
    depth = built(name, text)(
        frame_of(name, text, amplitude=amplitude, sigma=sigma if known else None)
    )
    good = said(depth) == OK
    truth = wall(name, preset(text))
    allowed = GRID_M.get(name, RECOVERY_M)
    assert np.abs(depth.range_m - truth)[good].max(initial=0) <= allowed


@each_case
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 1e30, 1e-30])
def test_strange_sigma_in_places_hurts_no_other_pixel(name, text, value):
    frame = frame_of(name, text)
    run = built(name, text)
    sigma, strange = np.array(frame.sigma), np.zeros((H, W), bool)
    strange[0, 1] = strange[2, 3] = True
    sigma[:, strange] = value
    depth = run(Phasors(frame.values, sigma))
    status = said(depth)
    if name in SPATIAL:
        return
    assert (status[~strange] == OK).all()
    again = run(frame)
    assert np.array_equal(depth.range_m[~strange], again.range_m[~strange])
    if value == 0.0:  # no noise at all is what synthetic data have
        truth = wall(name, preset(text))
        assert np.abs(depth.range_m - truth).max() <= GRID_M.get(name, RECOVERY_M)


@each_case
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_frames_of_strange_sigma_alone(name, text, value):
    frame = frame_of(name, text)
    sigma = np.full_like(frame.sigma, value)
    said(built(name, text)(Phasors(frame.values, sigma)))


def with_freqs(sensor, order):
    """The sensor with its frequencies taken in another order, or some of them twice."""
    old = sensor.modulation
    new = dataclasses.replace(old, freqs_hz=old.freqs_hz[order], steps_rad=old.steps_rad[order],
                              harmonics=old.harmonics[order])  # fmt: skip
    return dataclasses.replace(sensor, modulation=new)


@each_case
def test_unsorted_frequencies_give_the_same_answer(name, text):
    sensor = preset(text)
    if sensor.modulation.n_freqs == 1:
        pytest.skip("one frequency has one order")
    order = np.roll(np.arange(sensor.modulation.n_freqs), 1)[::-1]
    noisy = frame_of(name, text, sigma=10.0, seed=11)
    moved = Phasors(noisy.values[order], noisy.sigma[order])
    params = dict(PARAMS.get(name, {}))
    if name == "single":
        params["freq_index"] = int(np.argwhere(order == 0)[0, 0])
    have = CORRECTIONS[name].build(with_freqs(sensor, order), **params)(moved)
    want = built(name, text)(noisy)
    assert np.array_equal(have.info["status"], want.info["status"])
    assert np.allclose(have.range_m, want.range_m, atol=RECOVERY_M, equal_nan=True)
    if want.sigma_m is not None:
        assert np.allclose(have.sigma_m, want.sigma_m, rtol=1e-2, equal_nan=True)


@each_case
def test_a_frequency_twice_is_refused_or_harmless(name, text):
    sensor = preset(text)
    order = np.arange(sensor.modulation.n_freqs)
    order[-1] = 0
    twice = with_freqs(sensor, order)
    try:
        run = CORRECTIONS[name].build(twice, **PARAMS.get(name, {}))
    except ValueError as error:
        assert "frequenc" in str(error)
        assert "\n" not in str(error)
        return
    truth = wall(name, twice)
    depth = run(planted(twice, truth))
    good = said(depth) == OK
    assert np.abs(depth.range_m - truth)[good].max(initial=0) <= GRID_M.get(name, RECOVERY_M)


@each_case
@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (64, 1)])
def test_pixels_and_lines(name, text, shape):
    if name in SLOW and max(shape) > 1:
        shape = tuple(min(n, 16) for n in shape)
    sensor = preset(text)
    device = dataclasses.replace(sensor, camera=resized(sensor.camera, shape[1], shape[0]))
    run = CORRECTIONS[name].build(device, **PARAMS.get(name, {}))
    truth = wall(name, sensor, shape) % (0.8 * longest_m(name, sensor))
    frame = planted(device, truth)
    tracemalloc.start()
    try:
        depth = run(frame)
        peak_mb = tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
    good = said(depth, shape) == OK
    assert np.abs(depth.range_m - truth)[good].max(initial=0) <= GRID_M.get(name, RECOVERY_M)
    assert peak_mb < MOST_MB
