"""What a directory allows, in which order, with reasons; and the verdict over held-out captures."""

from dataclasses import replace

import numpy as np
import pytest

from toftools.calib.chain import chain_for
from toftools.calib.needs import NEEDS, missing_before, slot_of
from toftools.calib.plan import held_out, plan
from toftools.calib.stage import SLOTS
from toftools.calib.verdict import GOOD, NO_DATA, verdict
from toftools.conditions import Conditions, conditions_of, name_of, with_conditions
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import PixelMaps, Scene, Shot
from toftools.units import range_to_phase

NOMINAL = sensor("opt8241:width=32,height=24")
SHAPE = (2, 24, 32)
FREQS = NOMINAL.modulation.freqs_hz[:, None, None]


def wall(kind, distance_m, phase_rad=0.0, seed=0, albedo=0.8, **told):
    """A wall seen by a camera with planted phases, handed over as if it were faultless."""
    phase = np.broadcast_to(phase_rad, SHAPE).astype(float)
    maps = PixelMaps(np.ones((1, 24, 32)), np.zeros((1, 24, 32)), phase)
    planted = replace(NOMINAL, maps=maps)
    taken = analytic(Scene("wall", {"range": distance_m, "albedo": albedo}))(
        Shot(planted, seed=seed)
    )
    conditions = Conditions(kind, distance_m=distance_m, **told)
    return with_conditions(
        replace(taken, sensor=NOMINAL), conditions, file=f"{kind}{seed}_{distance_m:g}.h5"
    )


def checks(phase_of, **told_of):
    """Six check captures whose planted phase is a function of distance and capture number."""
    found = []
    for n, distance_m in enumerate((0.8, 1.1, 1.4, 1.9, 2.3, 2.8)):
        told = {key: of(n) for key, of in told_of.items()}
        found.append(wall("check", distance_m, phase_of(distance_m, n), seed=n, **told))
    return found


def test_a_faultless_camera_is_good_at_its_noise_floor():
    found = verdict(chain_for(NOMINAL), checks(lambda d, n: 0.0))
    assert found.word == "GOOD"
    assert found.good
    last = found.after[-1]
    assert last.name == "together"
    assert last.ratio == pytest.approx(1.0, abs=0.03)
    assert last.n == 6 * 24 * 32
    assert abs(last.bias_mm) < 0.1 * last.rms_mm
    assert found.advice == ()
    assert max(found.causes_mm.values()) < 0.25 * last.noise_mm
    assert f"{last.rms_mm:.1f} mm rms on 6 held-out captures" in found.sentence


BENT = np.add.outer(np.linspace(-1, 1, 24) ** 2, np.linspace(-1, 1, 32) ** 2) - 0.7
PATTERN = np.random.default_rng(5).normal(0, 0.03, SHAPE)


@pytest.mark.parametrize(
    ("word", "captures"),
    [
        ("OFFSET LEFT", lambda: checks(lambda d, n: 0.05)),
        ("PATTERN LEFT", lambda: checks(lambda d, n: PATTERN)),
        ("LENS ERROR LEFT",
         lambda: checks(lambda d, n: range_to_phase(0.02 * d * BENT, FREQS))),
        ("CYCLIC ERROR LEFT",
         lambda: checks(lambda d, n: 0.07 * np.cos(4 * range_to_phase(d, FREQS) + 1))),
        ("DRIFT LEFT", lambda: checks(lambda d, n: 0.002 * (n - 2.5) ** 3,
                                      sensor_c=lambda n: 30 + (n - 2.5) ** 3 / 2,
                                      light_c=lambda n: 35.0)),
    ],
)  # fmt: skip
def test_the_cause_of_what_is_left_is_named(word, captures):
    found = verdict(chain_for(NOMINAL), captures())
    assert found.word == word, (found.sentence, found.causes_mm)
    assert found.after[-1].ratio > GOOD
    assert found.sentence.startswith(word)
    assert found.advice


def test_planted_error_is_measured_in_millimetres():
    offset_mm = 12.0
    found = verdict(chain_for(NOMINAL), checks(lambda d, n: range_to_phase(offset_mm / 1e3, FREQS)))
    for score in found.after:
        assert score.bias_mm == pytest.approx(offset_mm, abs=0.3)
        assert score.rms_mm == pytest.approx(np.hypot(offset_mm, score.noise_mm), rel=0.03)
    assert found.causes_mm["offset"] == pytest.approx(offset_mm, abs=0.3)
    assert [spot.distance_m for spot in found.spots] == [0.8, 1.1, 1.4, 1.9, 2.3, 2.8]


def test_nothing_held_out_is_said():
    found = verdict(chain_for(NOMINAL), [])
    assert (found.word, found.good) == (NO_DATA, False)


def test_a_held_out_capture_that_shows_nothing_is_named():
    dark = wall("check", 2.0)
    dark = replace(dark, taps=None, phasors=replace(dark.phasors, valid=np.zeros((24, 32), bool)))
    with pytest.raises(ValueError, match=r"check0_2\.h5 has no pixel with a range to judge"):
        verdict(chain_for(NOMINAL), [dark])


def labelled(kind, count, first_m=1.0):
    seen = wall("wall", 1.0)
    return [
        with_conditions(seen, Conditions(kind, distance_m=first_m + 0.1 * n), file=f"{kind}{n}.h5")
        for n in range(count)
    ]


def test_plan_has_a_step_per_slot_and_a_reason_for_each_that_is_left_out():
    made = plan([*labelled("rail", 12), *labelled("wall", 2), *labelled("check", 3)],
                skip=["common_phase"])  # fmt: skip
    assert [step.slot for step in made.steps] == list(SLOTS)
    by_slot = {step.slot: step for step in made.steps}
    assert "left out by --skip" in by_slot["common_phase"].reason
    assert "no captures for it; capture 15 to 30 views" in by_slot["lens"].reason
    assert all(bool(step.captures) != bool(step.reason) for step in made.steps)
    assert len(made.held_out) == 3
    assert made.how == "3 captures of kind check"
    used = {name_of(c) for step in made.steps for c in step.captures}
    assert not used & {name_of(c) for c in made.held_out}


def test_without_a_check_every_fifth_position_of_the_rail_is_held_out():
    held, rest, how = held_out(labelled("rail", 12))
    assert [conditions_of(c).distance_m for c in held] == pytest.approx([1.2, 1.7])
    assert len(rest) == 10
    assert "every fifth position" in how
    held, rest, _ = held_out([*labelled("rail", 12), *labelled("check", 1)])
    assert [name_of(c) for c in held] == ["check0.h5"]
    assert "check0.h5" not in [name_of(c) for c in rest]
    held, rest, how = held_out(labelled("rail", 9))
    assert (held, len(rest)) == ((), 9)
    assert "too short" in how


def test_an_unknown_slot_or_two_entries_for_one_are_refused():
    with pytest.raises(ValueError, match="there is no stage 'lense'"):
        plan([], skip=["lense"])
    with pytest.raises(ValueError, match="wanted one"):
        plan([], entries=["lens:a=1", "lens:a=2"])
    with pytest.raises(ValueError, match="unknown name 'lense'"):
        slot_of("lense")


def test_what_is_missing_before_a_stage_is_one_sentence():
    assert missing_before("fixed_pattern", ["lens", "wiggling", "common_phase"]) == ""
    said = missing_before("fixed_pattern", ["wiggling"])
    assert said.startswith("fixed_pattern is fitted without lens and common_phase, so")
    assert set(NEEDS) == set(SLOTS)
