"""What every calibration of the registry keeps to, on captures of the virtual rig."""

import pickle
from dataclasses import FrozenInstanceError, fields, replace
from functools import cache

import numpy as np
import pytest

from toftools.calib.chain import Chain, applied, chain_for, extended
from toftools.calib.needs import NEEDS, for_stage, slot_of
from toftools.calib.stage import SLOTS, Residual, Stage
from toftools.calib.store import load_chain, save_chain
from toftools.conditions import conditions_of, name_of, with_conditions
from toftools.registry import CALIBRATIONS
from toftools.sensors import sensor
from toftools.sim.rig import Errors, rig
from toftools.types import Phasors, Taps

SMALL, LARGE = "opt8241:width=32,height=24", "opt8241:width=64,height=48"
ODD = "opt8241:width=40,height=30"
SECOND_CAMERA = ("extrinsics",)  # its pictures come from elsewhere: tests/test_extrinsics.py
QUICK = {"lens": {"distortion": 4, "hold_out": 2}, "lens_fisheye": {"hold_out": 2}}
ENTRIES = [name for name in CALIBRATIONS if slot_of(name) not in SECOND_CAMERA]


@cache
def captures_of(size):
    return [capture for _, capture in rig(sensor(size), Errors(), seed=3)]


def given(name):
    """Captures for an entry: as the driver would choose them."""
    size = LARGE if slot_of(name) == "lens" else SMALL
    return for_stage(slot_of(name), captures_of(size))


def fitted(name, captures):
    return CALIBRATIONS[name].build(captures, **QUICK.get(name, {}))


@cache
def stage_of(name):
    return fitted(name, given(name))


def frame(stage_name):
    """Phasors of one capture, noise included, a few of them invalid or not finite."""
    capture = given(stage_name)[0]
    phasors = capture.phasors
    values, valid = np.array(phasors.values), np.array(phasors.valid)
    values[0, 3, 4] = np.nan
    valid[5, 6] = False
    values[:, 7, 7] = 0
    return Phasors(values, phasors.sigma, valid)


def ready(name):
    stage = stage_of(name)
    return stage.at(sensor_c=38.0, light_c=41.0) if slot_of(name) == "temperature" else stage


def bits(values):
    return [np.asarray(v).tobytes() for v in (values.values, values.valid)] + [
        b"" if values.sigma is None else values.sigma.tobytes()
    ]


def test_every_slot_has_an_entry_and_a_need():
    assert {slot_of(name) for name in CALIBRATIONS} | {"amplitude", "lens"} >= set(SLOTS)
    assert set(NEEDS) == set(SLOTS)


@pytest.mark.parametrize("name", ENTRIES)
def test_a_fit_gives_a_frozen_stage_of_its_slot(name):
    stage = stage_of(name)
    assert isinstance(stage, Stage)
    assert stage.slot == slot_of(name)
    assert stage.slot in SLOTS
    assert isinstance(stage.residual, Residual)
    with pytest.raises(FrozenInstanceError):
        stage.residual = Residual()
    for field in fields(stage):
        value = getattr(stage, field.name)
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable, field.name


@pytest.mark.parametrize("name", ENTRIES)
def test_the_residual_is_told_and_does_not_grow(name):
    residual = stage_of(name).residual
    assert residual.unit in ("mm", "px", "%")
    assert residual.n > 0
    assert np.isfinite([residual.before, residual.after]).all()
    assert residual.after <= residual.before * (1 + 1e-9)
    for note in residual.notes:
        assert isinstance(note, str)
        assert len(note.split()) > 2


@pytest.mark.parametrize("name", ENTRIES)
def test_fits_agree_with_themselves_and_leave_their_input_alone(name):
    captures = given(name)
    before = pickle.dumps([(c.phasors.values, c.phasors.valid, c.taps.values) for c in captures])
    again = fitted(name, list(captures))
    after = pickle.dumps([(c.phasors.values, c.phasors.valid, c.taps.values) for c in captures])
    assert before == after
    if slot_of(name) == "temperature":
        again = again.at(sensor_c=38.0, light_c=41.0)
    assert bits(again(frame(name))) == bits(ready(name)(frame(name)))


@pytest.mark.parametrize("name", ENTRIES)
def test_application_is_pure_and_keeps_what_it_must(name):
    stage, phasors = ready(name), frame(name)
    before = bits(phasors)
    out = stage(phasors)
    assert bits(phasors) == before
    assert bits(stage(phasors)) == bits(out)
    assert out.values.shape == phasors.values.shape
    assert out.values.dtype == np.complex64
    assert (out.sigma is None) == (phasors.sigma is None)
    assert not (out.valid & ~phasors.valid).any()
    good = out.valid
    assert np.isfinite(out.values[:, good]).all()
    assert good.mean() > 0.5
    if slot_of(name) not in ("response", "lens"):
        assert np.abs(out.values[:, good]) == pytest.approx(
            np.abs(phasors.values[:, good]), rel=1e-5
        )


@pytest.mark.parametrize("name", ENTRIES)
def test_phasors_without_sigma_are_taken(name):
    phasors = replace(frame(name), sigma=None)
    assert ready(name)(phasors).sigma is None


@pytest.mark.parametrize("name", ENTRIES)
def test_a_saved_stage_corrects_bit_for_bit_alike(name, tmp_path):
    stage, captures = stage_of(name), given(name)
    chain = extended(chain_for(captures[0].sensor), stage)
    save_chain(tmp_path / "cal.json", chain)
    back = load_chain(tmp_path / "cal.json")
    assert isinstance(back, Chain)
    assert back.stage(stage.slot).residual == stage.residual
    capture = captures[0]
    once, twice = (applied(one, capture) for one in (chain, back))
    assert bits(once.phasors) == bits(twice.phasors)
    assert once.sensor.camera.K.tobytes() == twice.sensor.camera.K.tobytes()
    assert once.taps.values.tobytes() == twice.taps.values.tobytes()


@pytest.mark.parametrize("name", ENTRIES)
def test_no_capture_is_refused(name):
    with pytest.raises(ValueError, match=r"\w+ .*(none|no |0 |nothing|needs)"):
        fitted(name, [])


def resized(capture):
    """The same kind of capture from a camera of another size, and its name."""
    kind = conditions_of(capture).kind
    other = next(c for c in captures_of(ODD) if conditions_of(c).kind == kind)
    return with_conditions(other, conditions_of(capture), file="odd_one.h5")


@pytest.mark.parametrize("name", ENTRIES)
def test_mixed_resolutions_are_refused_by_name(name):
    captures = given(name)
    with pytest.raises(ValueError, match=r"odd_one\.h5 has 40 x 30 px"):
        fitted(name, [*captures[:-1], resized(captures[-1])])


@pytest.mark.parametrize("name", ENTRIES)
def test_mixed_frequencies_are_refused_by_name(name):
    captures = given(name)
    last = captures[-1]
    modulation = replace(last.sensor.modulation, freqs_hz=[20e6, 70e6])
    odd = replace(last, sensor=replace(last.sensor, modulation=modulation))
    odd = with_conditions(odd, conditions_of(last), file="odd_one.h5")
    with pytest.raises(ValueError, match=r"odd_one\.h5 was taken at 20 \+ 70 MHz"):
        fitted(name, [*captures[:-1], odd])


@pytest.mark.parametrize("name", ENTRIES)
def test_a_frame_that_shows_nothing_does_not_turn_into_nan(name):
    """Either it is refused by name, or the fit gets on with the others."""
    captures = list(given(name))
    last = captures[-1]
    dead = replace(last.phasors, valid=np.zeros(last.phasors.valid.shape, bool))
    taps = Taps(last.taps.values, last.taps.unit, dead.valid)
    captures[-1] = replace(last, taps=taps, phasors=dead)
    try:
        stage = fitted(name, captures)
    except ValueError as error:
        assert name_of(last) in str(error)
    else:
        assert np.isfinite(stage.residual.after)
