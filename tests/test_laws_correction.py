"""Laws that every correction of the registry obeys, whatever its idea."""

import dataclasses
import functools
import importlib
import inspect
import itertools
import subprocess
import sys

import numpy as np
import pytest

from toftools.correct import INVALID, OK, REJECTED
from toftools.registry import CORRECTIONS
from toftools.sensors import sensor as preset
from toftools.types import Phasors
from toftools.units import ambiguity_m, joint_ambiguity_m, range_to_phase, wrap_phase

H, W = 6, 8
SIZE = f":width={W},height={H}"
ONE, TWO, THREE = (name + SIZE for name in ("deeptof", "opt8241", "kinect2_nominal"))

# The sensors an entry is tried on; a new entry with needs of its own adds a line here.
SENSORS = {
    "single": (ONE, TWO),
    "crt": (ONE, TWO, THREE),
    "residual_voting": (THREE,),
    "fuchs2010": (ONE, TWO, THREE),
    "fuchs2010_all_pairs": (ONE, TWO),
    "fuchs2013": (ONE, TWO, THREE),
    "jimenez2014": (ONE, TWO, THREE),
    "kde": (TWO, THREE),
    "sra": (TWO, THREE),
    "sra_lp": (TWO,),
    "semi_global": (TWO, THREE),
    "auto": (ONE, TWO, THREE),
    "network": (ONE, TWO),
    "two_returns": (THREE, "deeptof:freqs=20e6+50e6+70e6" + SIZE.replace(":", ",")),
    "gupta2015": ("phasor_imaging" + SIZE,),
    "heide2013": ("heide2013" + SIZE + ",freqs=" + "+".join(f"{i}0e6" for i in range(1, 17)),),
    "dorrington2011": (TWO, THREE),
    "godbaz2012_ratio": ("deeptof:freqs=20e6+40e6" + SIZE.replace(":", ","),),
    "kirmani2013": tuple(
        f"deeptof:freqs={freqs},width={W},height={H}"
        for freqs in ("20e6+40e6+60e6", "50e6+70e6+90e6+110e6")
    ),
    "bhandari2014": (THREE, "deeptof:freqs=20e6+50e6+70e6" + SIZE.replace(":", ",")),
    "bhandari2014_annihilating": (
        "deeptof:freqs=20e6+40e6+60e6+80e6" + SIZE.replace(":", ","),
        "deeptof:freqs=90e6+50e6+110e6+70e6" + SIZE.replace(":", ","),
    ),
    "feigin2016": ("deeptof:freqs=20e6+40e6+60e6+80e6+100e6+120e6" + SIZE.replace(":", ","),),
    "peters2015": ("deeptof:freqs=20e6+40e6+60e6+80e6" + SIZE.replace(":", ","),),
    "peters2015_pisarenko": tuple(
        f"deeptof:freqs={freqs},width={W},height={H}"
        for freqs in ("20e6+40e6+60e6+80e6", "20e6+40e6")
    ),
    "godbaz2012_cauchy": ("deeptof:freqs=20e6+40e6+60e6+80e6" + SIZE.replace(":", ","),),
}
# What a network has learnt is exact in no case; tests/test_network.py holds it to its own bounds.
LEARNED = ("network",)
CASES = [(name, text) for name in CORRECTIONS for text in SENSORS.get(name, (TWO,))]
EXACT = [(name, text) for name, text in CASES if name not in LEARNED]
NEEDS_SEVERAL = [name for name in CORRECTIONS if ONE not in SENSORS.get(name, (TWO,))]
# Noise-free recovery of a lone return: float32 phasors leave 1e-4 m at the joint ambiguity.
RECOVERY_M = 3e-4
# Moving all paths moves them against an entry's own range grid: half a cell of its default 1 cm.
# A network expects the bounced light of rooms even where there is none.
GRID_M = {"sra": 0.005, "sra_lp": 0.005, "network": 0.3}
FALSE_RETURNS = "noise makes small false returns and the first wins (its header gives the rates)"
MEDIAN_ONLY = {"sra": FALSE_RETURNS, "sra_lp": FALSE_RETURNS}
SLOW = {"sra_lp": "a linear program per pixel, tens of milliseconds each"}
SPATIAL = {
    "kde": "the window's neighbours decide: only mirroring the image commutes",
    "semi_global": "neighbours along paths decide: only mirroring the image commutes",
}

# Lone returns of any brightness on any concave image light each other, and the method is right to
# take that off: the laws see them nearly black. tests/test_fuchs2010.py has them lit.
BLACK = {"albedo_gain": 1e-9}
PARAMS = {
    "fuchs2010": BLACK,
    "fuchs2010_all_pairs": BLACK,
    "fuchs2013": BLACK,
    "jimenez2014": BLACK,
    "auto": {"bounced": "fuchs2010:albedo_gain=1e-9"},
}

each_case = pytest.mark.parametrize(("name", "text"), CASES, ids=lambda v: str(v).split(":")[0])
each_exact = pytest.mark.parametrize(("name", "text"), EXACT, ids=lambda v: str(v).split(":")[0])
each_entry = pytest.mark.parametrize("name", CORRECTIONS)


def longest_m(name, sensor):
    """Range that the entry can tell apart on this sensor with default parameters."""
    freqs = sensor.modulation.freqs_hz
    return float(ambiguity_m(freqs[0])) if name == "single" else joint_ambiguity_m(freqs)


def planted(sensor, range_m, *, amplitude=1000.0, sigma=1.0, seed=None):
    """Phasors of lone returns, with noise if there is a seed; sigma None leaves it out."""
    phase = range_to_phase(range_m, sensor.modulation.freqs_hz[:, None, None])
    values = amplitude * np.exp(1j * phase)
    if seed is not None:
        rng = np.random.default_rng(seed)
        shape = values.shape
        values = values + sigma * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    known = None if sigma is None else np.full(values.shape, sigma, np.float32)
    return Phasors(values.astype(np.complex64), known)


def smooth(longest):
    """A gently tilted image: neighbours differ by centimetres, so spatial methods are at home."""
    v, u = np.mgrid[0:H, 0:W]
    return 0.35 * longest + 0.02 * u + 0.01 * v


@functools.cache
def built(name, text):
    """The entry with default parameters, made once: the laws are about what it does."""
    return CORRECTIONS[name].build(preset(text), **PARAMS.get(name, {}))


@each_exact
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
def test_a_lone_return_is_recovered(name, text, known):
    sensor = preset(text)
    run, longest = built(name, text), longest_m(name, sensor)
    for share in (0.03, 0.2, 0.47, 0.8, 0.95):
        truth = share * longest + 0.001 * np.arange(H * W).reshape(H, W)
        depth = run(planted(sensor, truth, sigma=1.0 if known else None))
        assert np.abs(depth.range_m - truth).max() < RECOVERY_M, share


@each_case
def test_gain_changes_nothing(name, text):
    sensor = preset(text)
    run, longest = built(name, text), longest_m(name, sensor)
    frame = planted(sensor, smooth(longest), sigma=30.0, seed=1)
    for gain in (1e-3, 700.0):
        scaled = Phasors(frame.values * np.float32(gain), frame.sigma * np.float32(gain))
        for have, want in ((run(scaled), run(frame)),
                           (run(Phasors(scaled.values)), run(Phasors(frame.values)))):  # fmt: skip
            # Powers of ten round: a relative change of 1e-7 in the phasors.
            assert np.allclose(have.range_m, want.range_m, atol=1e-4, equal_nan=True)


@each_exact
def test_a_longer_path_adds_its_length(name, text):
    sensor = preset(text)
    run, longest = built(name, text), longest_m(name, sensor)
    frame = planted(sensor, smooth(longest), sigma=10.0, seed=2)
    for extra in (0.123, 0.2 * longest, 0.9 * longest):
        turn = np.exp(1j * range_to_phase(extra, sensor.modulation.freqs_hz))[:, None, None]
        moved = run(Phasors((frame.values * turn).astype(np.complex64), frame.sigma)).range_m
        gap = (moved - run(frame).range_m - extra) / longest * 2 * np.pi
        off_m = np.abs(wrap_phase(gap + np.pi) - np.pi).max() * longest / (2 * np.pi)
        assert off_m < GRID_M.get(name, RECOVERY_M)


@each_case
def test_input_stays_as_it_was_and_the_answer_repeats(name, text):
    sensor = preset(text)
    run, longest = built(name, text), longest_m(name, sensor)
    mine = planted(sensor, smooth(longest), seed=3)
    values, sigma = np.array(mine.values), np.array(mine.sigma)
    valid = np.ones((H, W), bool)
    before = values.copy(), sigma.copy(), valid.copy()
    first, second = (run(Phasors(values, sigma, valid)) for _ in range(2))
    for have, want in zip((values, sigma, valid), before, strict=True):
        assert np.array_equal(have, want)
    for key in ("range_m", "sigma_m", "confidence"):
        a, b = getattr(first, key), getattr(second, key)
        assert (a is None and b is None) or np.array_equal(a, b, equal_nan=True), key


@each_case
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
def test_shape_type_and_missing_pixels(name, text, known):
    sensor = preset(text)
    run, longest = built(name, text), longest_m(name, sensor)
    frame = planted(sensor, smooth(longest))
    values, valid = np.array(frame.values), np.ones((H, W), bool)
    values[:, 1, 2] = np.nan
    values[:, 2, 3] = 0
    valid[4, 5] = False
    depth = run(Phasors(values, frame.sigma if known else None, valid))  # warnings are errors
    missing = np.zeros((H, W), bool)
    missing[[1, 2, 4], [2, 3, 5]] = True
    assert depth.range_m.shape == (H, W)
    assert depth.range_m.dtype == np.float32
    assert np.array_equal(np.isnan(depth.range_m), missing)
    status = depth.info["status"]
    assert status.shape == (H, W)
    assert (status[missing] == INVALID).all()
    assert (status[~missing] == OK).all()
    assert np.nanmax(depth.range_m) <= longest * (1 + 1e-6)


@each_case
def test_a_frame_without_a_valid_pixel_is_no_error(name, text):
    sensor = preset(text)
    frame = planted(sensor, smooth(longest_m(name, sensor)))
    depth = built(name, text)(Phasors(frame.values, valid=np.zeros((H, W), bool)))
    assert np.isnan(depth.range_m).all()
    assert (depth.info["status"] == INVALID).all()


@each_case
def test_noise_alone_gives_an_answer_or_none_but_never_an_error(name, text):
    sensor = preset(text)
    run = built(name, text)
    rng = np.random.default_rng(4)
    shape = (sensor.modulation.n_freqs, H, W)
    values = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    depth = run(Phasors(values, np.ones(shape, np.float32)))
    assert np.isin(depth.info["status"], (OK, REJECTED)).all()
    assert np.array_equal(np.isfinite(depth.range_m), depth.info["status"] == OK)


@each_exact
def test_pixels_do_not_depend_on_their_place(name, text):
    sensor = preset(text)
    run, longest = built(name, text), longest_m(name, sensor)
    frame = planted(sensor, smooth(longest), sigma=30.0, seed=5)
    answer = run(frame).range_m
    for axis in (0, 1):  # mirroring commutes even with a window
        mirrored = Phasors(np.flip(frame.values, axis + 1), np.flip(frame.sigma, axis + 1))
        again = np.flip(run(mirrored).range_m, axis)
        assert np.allclose(again, answer, atol=1e-6, equal_nan=True)
    if name in SPATIAL:
        return
    order = np.random.default_rng(6).permutation(H * W)
    shuffled = [
        a.reshape(-1, H * W)[:, order].reshape(-1, H, W) for a in (frame.values, frame.sigma)
    ]
    again = run(Phasors(*shuffled)).range_m.reshape(-1)
    assert np.array_equal(again, answer.reshape(-1)[order], equal_nan=True)


# Shot noise: ten times the light is ten times the amplitude and sqrt(10) times the noise.
AMPLITUDE, SIGMA = 2000.0, 40.0


def noisy(name, text, gain=1.0):
    """Truth, frame and signed error of a gently tilted wall, large enough for statistics."""
    sensor, longest = preset(text), longest_m(name, preset(text))
    v, u = np.mgrid[0:8, 0:12] if name in SLOW else np.mgrid[0:32, 0:48]
    truth = 0.35 * longest + 0.005 * u + 0.003 * v
    light = {"amplitude": AMPLITUDE * gain, "sigma": SIGMA * np.sqrt(gain)}
    frame = planted(sensor, truth, **light, seed=7)
    return truth, frame, np.abs(built(name, text)(frame).range_m - truth)


def centre_and_doubt(name, error):
    """Typical error and four standard errors of it."""
    if name in MEDIAN_ONLY:  # the standard error of a median of n is about 1.25 sigma / sqrt(n)
        spread = np.subtract(*np.percentile(error, [75, 25]))
        return np.median(error), 4 * 1.25 * spread / np.sqrt(error.size)
    return error.mean(), 4 * error.std() / np.sqrt(error.size)


@each_exact
def test_more_light_never_hurts(name, text):
    dim, bright = (noisy(name, text, gain)[2] for gain in (1.0, 10.0))
    assert np.isfinite(dim).all()
    assert np.isfinite(bright).all()
    (less, doubt), (more, _) = centre_and_doubt(name, dim), centre_and_doubt(name, bright)
    assert more <= less + doubt


@each_exact
def test_without_multipath_no_worse_than_the_best_frequency(name, text):
    truth, frame, error = noisy(name, text)
    freqs = preset(text).modulation.freqs_hz
    alone = []
    for i, freq in enumerate(freqs[:1] if name == "single" else freqs):
        # Wraps known: the error is the noise alone.
        turn = frame.values[i] * np.exp(-1j * range_to_phase(truth, freq))
        one = np.abs(np.angle(turn) / range_to_phase(1.0, freq))
        alone.append(centre_and_doubt(name, one)[0])
    centre, doubt = centre_and_doubt(name, error)
    assert centre <= min(alone) + doubt


@pytest.mark.parametrize("name", NEEDS_SEVERAL)
def test_one_frequency_is_refused_in_one_sentence(name):
    with pytest.raises(ValueError, match=r"frequenc.*got (1;|\[20000000\.0\] Hz)") as caught:
        CORRECTIONS[name].build(preset(ONE))
    assert "\n" not in str(caught.value)


@each_case
def test_an_emitter_off_the_camera_is_refused_in_one_sentence(name, text):
    device = dataclasses.replace(preset(text), emitter_offset_m=(0.2, 0.0, 0.0))
    with pytest.raises(
        ValueError, match=r"emitter \(0\.2, 0\.0, 0\.0\) m off the camera"
    ) as caught:
        CORRECTIONS[name].build(device)
    assert "\n" not in str(caught.value)


# Compiled kernels are shared by the whole process, so this takes a fresh one.
COMPILED = """
import importlib, sys
import numpy as np
from toftools.registry import CORRECTIONS
from toftools.sensors import sensor
from toftools.types import Phasors

def compiled():
    modules = [m for name, m in sys.modules.items() if name.startswith("toftools.correct")]
    return {(m.__name__, key): len(f.signatures) for m in modules for key, f in vars(m).items()
            if hasattr(f, "signatures")}

for line in sys.argv[1:]:
    name, text = line.split(" ")
    device = sensor(text)
    params = {"grid_m": 0.1} if name.startswith("sra") else {}
    run = CORRECTIONS[name].build(device, **params)
    before = compiled()
    values = np.ones((device.modulation.n_freqs, 6, 8), np.complex64)
    sigma = np.ones(values.shape, np.float32)
    for turned in (False, True):
        if turned:  # arrays that are not contiguous
            values, sigma = (np.moveaxis(a.T.copy(), 2, 0) for a in (values, sigma))
        for known in (None, sigma):
            run(Phasors(values, known))
            run(Phasors(values[:, ::2, ::2], None if known is None else known[:, ::2, ::2]))
    grown = {key: n for key, n in compiled().items() if n != before[key]}
    assert not grown, (name, grown)
"""


def test_nothing_is_compiled_after_making():
    cases = [f"{name} {text}" for name, text in CASES]
    done = subprocess.run(
        [sys.executable, "-c", COMPILED, *cases], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


@each_case
def test_phasors_of_another_sensor_are_refused(name, text):
    run = built(name, text)
    with pytest.raises(ValueError, match="frequenc"):
        run(Phasors(np.ones((5, H, W), np.complex64)))


@each_entry
def test_header_tells_source_and_failure(name):
    module = importlib.import_module(CORRECTIONS[name].target.partition(":")[0])
    header = inspect.getdoc(module)
    assert "Reference" in header
    assert "ail" in header  # "Fails when", "When it fails"
    make = inspect.getdoc(CORRECTIONS[name].load())
    for section in ("Parameters", "Returns", "References"):
        assert f"\n{section}\n---" in make


@each_entry
def test_every_grid_point_builds(name):
    grid = CORRECTIONS[name].grid
    sensor = preset(SENSORS.get(name, (TWO,))[0])
    frame = planted(sensor, smooth(2.0))
    for values in itertools.product(*grid.values()):
        params = dict(zip(grid, values, strict=True))
        depth = CORRECTIONS[name].build(sensor, **params)(frame)
        assert np.isfinite(depth.range_m).all(), params
