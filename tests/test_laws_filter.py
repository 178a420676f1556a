"""Laws that every filter of the registry obeys, on either side of a correction."""

import importlib
import inspect
import itertools
import subprocess
import sys

import numpy as np
import pytest

from toftools.camera import rays
from toftools.correct import INVALID, OK, REJECTED
from toftools.registry import CORRECTIONS, FILTERS
from toftools.sensors import sensor as preset
from toftools.types import DepthMap, Phasors
from toftools.units import range_to_phase

H, W = 24, 32
TEXTS = (f"opt8241:width={W},height={H}", f"kinect2_nominal:width={W},height={H}",
         f"deeptof:width={W},height={H}")  # fmt: skip
AMPLITUDE = 1000.0

each = pytest.mark.parametrize("name", FILTERS)
each_case = pytest.mark.parametrize(
    ("name", "text"), list(itertools.product(FILTERS, TEXTS)), ids=lambda v: str(v).split(":")[0]
)


def tilted(camera, tilt_deg, z_m=2.0):
    """Range of a plane tilted about the upright axis; NaN behind its horizon."""
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    across = rays(camera) @ normal
    return np.where(across > 1e-3, z_m * normal[2] / np.maximum(across, 1e-3), np.nan)


def measured(text, *, sigma=20.0, seed=None, amplitude=AMPLITUDE, range_m=None, known=True):
    """Phasors of a tilted wall."""
    sensor = preset(text)
    truth = tilted(sensor.camera, 40) if range_m is None else range_m
    phase = range_to_phase(truth, sensor.modulation.freqs_hz[:, None, None])
    values = amplitude * np.exp(1j * phase)
    if seed is not None:
        rng = np.random.default_rng(seed)
        shape = values.shape
        values = values + sigma * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    noise = np.full(values.shape, sigma, np.float32) if known else None
    return Phasors(values.astype(np.complex64), noise)


def outcome(name, text, phasors):
    """What the filter does to a frame, as comparable arrays (value, sigma, usable)."""
    sensor = preset(text)
    run = FILTERS[name].build(sensor)
    if FILTERS[name].place == "before":
        out = run(phasors)
        return out.values, out.sigma, out.valid
    method = "crt" if sensor.modulation.n_freqs > 1 else "single"
    out = run(CORRECTIONS[method].build(sensor)(phasors), phasors)
    status = out.info["status"]
    assert np.isin(status, (OK, INVALID, REJECTED)).all()
    assert np.array_equal(np.isfinite(out.range_m), status == OK)
    return out.range_m, out.sigma_m, status == OK


def same(have, want, **close):
    for a, b in zip(have, want, strict=True):
        assert (a is None) == (b is None)
        assert a is None or np.allclose(a, b, equal_nan=True, **close)


@each_case
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
def test_input_stays_as_it_was_and_the_answer_repeats(name, text, known):
    frame = measured(text, seed=1, known=known)
    before = np.array(frame.values), np.array(frame.valid)
    first, second = (outcome(name, text, frame) for _ in range(2))
    same(first, second, rtol=0, atol=0)
    assert np.array_equal(frame.values, before[0])
    assert np.array_equal(frame.valid, before[1])


@each_case
def test_mirroring_the_image_commutes(name, text):
    frame = measured(text, seed=2, range_m=np.full((H, W), 3.0))
    want = outcome(name, text, frame)
    for axis in (-1, -2):
        mirrored = Phasors(np.flip(frame.values, axis), np.flip(frame.sigma, axis))
        have = [a if a is None else np.flip(a, axis) for a in outcome(name, text, mirrored)]
        same(have, want, rtol=1e-5, atol=1e-5 * AMPLITUDE if have[0].ndim == 3 else 1e-5)


@each_case
def test_gain_changes_nothing(name, text):
    frame = measured(text, seed=3)
    want = outcome(name, text, frame)
    for gain in (1e-3, 700.0):
        scaled = Phasors(frame.values * np.float32(gain), frame.sigma * np.float32(gain))
        have = outcome(name, text, scaled)
        if FILTERS[name].place == "before":
            have = (have[0] / np.float32(gain), have[1] / np.float32(gain), have[2])
        # A relative change of 1e-7 in the phasors moves a weight by little.
        same(have, want, rtol=1e-4, atol=1e-4)


@each_case
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
def test_missing_pixels_stay_missing_and_nobody_looks_at_them(name, text, known):
    frame = measured(text, known=known, seed=5)
    valid = np.ones((H, W), bool)
    valid[12, 13] = valid[12, 14] = valid[0, 0] = False
    kept = outcome(name, text, Phasors(frame.values, frame.sigma, valid))
    assert not kept[2][~valid].any()
    for strange in (np.nan, 1e6, 0):
        values = np.array(frame.values)
        values[:, ~valid] = strange
        have = outcome(name, text, Phasors(values, frame.sigma, valid))
        for a, b in zip(have, kept, strict=True):
            assert a is None or np.array_equal(a[..., valid], b[..., valid], equal_nan=True)


@each_case
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_a_frame_without_signal_is_no_error(name, text, value, known):
    frame = measured(text, known=known)
    values = np.full(frame.values.shape, value, np.complex64)
    outcome(name, text, Phasors(values, frame.sigma))
    outcome(name, text, Phasors(frame.values, frame.sigma, np.zeros((H, W), bool)))


@each_case
@pytest.mark.parametrize("amplitude", [1e30, 1e-30])
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
def test_huge_and_tiny_amplitudes_are_no_error(name, text, amplitude, known):
    frame = measured(text, amplitude=amplitude, sigma=1e-2 * amplitude, seed=4, known=known)
    value, sigma, _ = outcome(name, text, frame)
    assert not np.isinf(value).any()
    if FILTERS[name].place == "before" and known:
        usual = outcome(name, text, measured(text, sigma=1e-2 * AMPLITUDE, seed=4))[1]
        assert np.allclose(sigma / np.float32(amplitude), usual / AMPLITUDE, rtol=1e-3)


@each_case
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 1e30, 1e-30])
def test_strange_sigma_is_no_error(name, text, value):
    frame = measured(text)
    sigma = np.array(frame.sigma)
    sigma[:, 7, 8] = value
    outcome(name, text, Phasors(frame.values, sigma))
    outcome(name, text, Phasors(frame.values, np.full_like(sigma, value)))


@each_case
@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (4096, 1), (2, 3), (3, 2)])
def test_pixels_and_lines(name, text, shape):
    text = text.replace(f"width={W},height={H}", f"width={shape[1]},height={shape[0]}")
    for known in (True, False):
        frame = measured(text, range_m=tilted(preset(text).camera, 0), known=known)
        value, _, usable = outcome(name, text, frame)
        assert usable.shape == shape
        assert np.isfinite(value).all()


@each_case
@pytest.mark.parametrize("tilt_deg", [0, 50, 80])
def test_a_wall_of_any_tilt_stays_where_it_is(name, text, tilt_deg):
    text = f"{text},hfov_deg=7"  # pixels as fine as those of a camera with ten times as many
    truth = tilted(preset(text).camera, tilt_deg)
    frame = measured(text, sigma=10.0, range_m=truth)
    value, _, usable = outcome(name, text, frame)
    assert usable.all()  # nothing is lost
    if FILTERS[name].place == "before":
        # A quarter of one pixel's noise: the range of a flat wall is curved itself.
        assert np.abs(np.angle(value * frame.values.conj())).max() < 0.25 * 10.0 / AMPLITUDE
    else:
        assert np.abs(value - truth).max() < 1e-3


@each
def test_phasors_of_another_sensor_are_refused(name):
    run = FILTERS[name].build(preset(TEXTS[0]))
    if FILTERS[name].place == "before":
        with pytest.raises(ValueError, match="must have 2 frequencies, got 5"):
            run(Phasors(np.ones((5, H, W), np.complex64)))
    else:
        with pytest.raises(ValueError, match=r"got a depth map of \(3, 4\) pixels, wanted"):
            run(DepthMap(np.ones((3, 4))), Phasors(np.ones((2, 3, 4))))


@each
def test_header_tells_source_and_failure(name):
    header = inspect.getdoc(importlib.import_module(FILTERS[name].target.partition(":")[0]))
    assert "Reference" in header
    assert "Fails" in header
    make = inspect.getdoc(FILTERS[name].load())
    for section in ("Parameters", "Returns", "Raises", "References"):
        assert f"\n{section}\n---" in make


@each
def test_every_grid_point_builds(name):
    grid = FILTERS[name].grid
    for values in itertools.product(*grid.values()):
        assert FILTERS[name].build(preset(TEXTS[0]), **dict(zip(grid, values, strict=True)))


COMPILED = """
import sys
import numpy as np
from toftools.registry import FILTERS
from toftools.sensors import sensor
from toftools.types import DepthMap, Phasors

def compiled():
    modules = [m for name, m in sys.modules.items() if name.startswith("toftools.filter")]
    return {(m.__name__, key): len(f.signatures) for m in modules for key, f in vars(m).items()
            if hasattr(f, "signatures")}

device = sensor("opt8241:width=8,height=6")
for name, spec in FILTERS.items():
    run = spec.build(device)
    before = compiled()
    values = np.ones((2, 6, 8), np.complex64)
    sigma = np.ones(values.shape, np.float32)
    for turned in (False, True):
        if turned:  # arrays that are not contiguous
            values, sigma = (np.moveaxis(a.T.copy(), 2, 0).swapaxes(1, 2) for a in (values, sigma))
            values, sigma = values.reshape(2, 6, 8), sigma.reshape(2, 6, 8)
            values, sigma = values[:, ::-1], sigma[:, ::-1]
        for known in (None, sigma):
            if spec.place == "before":
                run(Phasors(values, known))
            else:
                run(DepthMap(sigma[0], None if known is None else sigma[1]), Phasors(values))
    grown = {key: n for key, n in compiled().items() if n != before[key]}
    assert not grown, (name, grown)
"""


def test_nothing_is_compiled_after_making():
    done = subprocess.run(
        [sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
