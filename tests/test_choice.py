"""Engine `auto`: which engine answers which request, and that all agree where they can."""

import numpy as np
import pytest

from toftools.registry import SIMULATORS, parameters_of
from toftools.sensors import sensor
from toftools.sim.analytic import SCENES
from toftools.sim.choice import LAST_BOUNCE, choose
from toftools.sim.scenes import WORLDS
from toftools.types import Emitter, Scene, Sensor, Shot

PLAIN = sensor("deeptof:width=8,height=6")


@pytest.mark.parametrize(
    ("scene", "options", "engine", "why"),
    [
        (Scene("wall"), {}, "analytic", "the scene has a closed form"),
        (Scene("wall", {"ambient_e": 900.0}), {}, "analytic", "the scene has a closed form"),
        (Scene("tilted", {"velocity_mps": 1.0}), {}, "analytic", "the scene has a closed form"),
        (Scene("cavity"), {"max_bounces": 3}, "analytic", "the scene has a closed form"),
        (Scene("two_returns"), {}, "analytic", "has no geometry to trace"),
        (Scene("two_returns"), {"samples": 4}, "analytic", "has no geometry to trace"),
        (Scene("corner"), {"max_bounces": 0}, "analytic", "the scene has a closed form"),
        (Scene("corner"), {"max_bounces": 1}, "analytic", "the scene has a closed form"),
        (Scene("corner"), {"max_bounces": 2}, "radiosity", "corner ends after 1 indirect bounce"),
        (Scene("corner"), {}, "radiosity", "corner ends after 1 indirect bounce"),
        (Scene("cornell"), {}, "radiosity", "cornell has no closed form"),
        (Scene("a/room.xml"), {}, "radiosity", "a scene file has no closed form"),
        (Scene("korner"), {}, "radiosity", "has no closed form"),
        (Scene("wall", {"material": "metal"}), {}, "radiosity", "form of wall has no material"),
        (Scene("cavity"), {"samples": 4}, "path", "a number of paths was asked for"),
        (Scene("cornell"), {"samples": 4}, "path", "cornell has no closed form"),
    ],
)
def test_auto_takes_the_closed_form_where_it_covers_the_request(scene, options, engine, why):
    name, reason = choose(scene, PLAIN, **options)
    assert name == engine
    assert why in reason


def test_other_emitters_have_no_closed_form():
    aside = sensor("deeptof:width=8,height=6,emitter=0.05+0+0")
    spot = sensor("deeptof:width=8,height=6,beam_deg=60")
    two = Sensor(PLAIN.camera, PLAIN.modulation, emitters=(Emitter(), Emitter((0.1, 0.0, 0.0))))
    for device in (aside, spot, two):
        assert choose(Scene("wall"), device)[0] == "radiosity"
        assert choose(Scene("wall"), device, samples=4)[0] == "path"


def test_closed_forms_that_end_are_those_that_keep_no_further_bounce():
    """The table of this module against the closed forms themselves."""
    for name, build in SCENES.items():
        transport = build(sensor("deeptof:width=12,height=8").camera)
        one, all_there_is = transport.phasor(20e6, 1), transport.phasor(20e6, None)
        bounces = not np.allclose(transport.phasor(20e6, 0), all_there_is)
        ends = bounces and np.allclose(one, all_there_is)
        assert (name in LAST_BOUNCE) == (ends and name in WORLDS), name


@pytest.mark.parametrize("name", sorted(set(SCENES) & set(WORLDS)))
def test_all_engines_know_the_parameters_of_a_scene_and_its_ranges(name):
    mine, other = parameters_of(SCENES[name]), parameters_of(WORLDS[name])
    assert {key: other[key] for key in mine} == mine
    shot = Shot(PLAIN, noisy=False, max_bounces=0)
    engines = ("analytic", "path", "radiosity")
    exact, *others = (SIMULATORS[e].build(Scene(name))(shot) for e in engines)
    # float32 of the taps, whose offset exceeds the amplitude.
    scale = np.abs(exact.phasors.values).max()
    for traced in others:
        assert np.allclose(exact.truth.range_m, traced.truth.range_m, atol=1e-4, equal_nan=True)
        assert np.abs(exact.phasors.values - traced.phasors.values).max() < 1e-4 * scale
