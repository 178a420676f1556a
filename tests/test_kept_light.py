"""Shots that differ in electronics alone share their light, traced once."""

from dataclasses import replace

import numpy as np
import pytest

import toftools.sim.path as path_module
from toftools.sensors import sensor
from toftools.sim._kept import light_key, light_seed
from toftools.sim.path import path
from toftools.types import Scene, Shot

CAMERA = "opt8241:width=12,height=9,beam_deg=100"
SCENE = Scene("vshape", {"range": 1.2})


def shot(more="", **given):
    return Shot(sensor(CAMERA + more), tol_m=0.02, **{"samples": 64, "light_seed": 5, **given})


@pytest.fixture
def traced(monkeypatch):
    """Counts the pictures that are traced."""
    count = []
    plain = path_module.render

    def counting(*args, **named):
        count.append(1)
        return plain(*args, **named)

    monkeypatch.setattr(path_module, "render", counting)
    return count


def test_light_is_traced_once_and_is_the_same(traced):
    run = path(SCENE)
    first = run(shot(seed=1))
    other = run(shot(",signal_e=3000,contrast=0.4", seed=2))
    assert len(traced) == 1
    fresh = path(SCENE)(shot(",signal_e=3000,contrast=0.4", seed=2))
    assert len(traced) == 2
    assert np.array_equal(other.taps.values, fresh.taps.values)
    assert other.provenance == fresh.provenance and other.provenance["path_seed"] == 5
    assert not np.array_equal(first.taps.values, other.taps.values)
    for name in ("range_m", "direct", "one_bounce"):
        assert np.array_equal(getattr(other.truth, name), getattr(fresh.truth, name))


@pytest.mark.parametrize(
    "more",
    [
        {"light_seed": 6},
        {"more": ",hfov_deg=40"},
        {"more": ",freqs=30e6+70e6"},
        {"more": ",emitter=0.05+0+0"},
        {"samples": 65},
        {"max_bounces": 2},
        {"more": ",waveform=trapezoid,rise=0.2"},
    ],
)
def test_other_light_is_traced_anew(more):
    assert light_key(shot(**more)) != light_key(shot())


def test_without_a_seed_of_light_nothing_is_kept(traced):
    run, plain = path(SCENE), shot(light_seed=None, seed=3)
    run(plain)
    run(plain)
    assert len(traced) == 2 and light_key(plain) is None and light_seed(plain) == 3
    assert light_key(replace(plain, light_seed=0)) is not None
