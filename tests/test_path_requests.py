"""The path engine does what it is asked: numbers of paths, kinds of scene, ambient light."""

import numpy as np
import pytest

from toftools.sensors import sensor
from toftools.sim.path import path
from toftools.types import Scene, Shot

DEVICE = sensor("deeptof:width=16,height=12,hfov_deg=46")


@pytest.mark.parametrize(("engine", "samples"), [({}, 1), ({}, 3), ({}, 10), ({"antialias": 2}, 9)])
def test_as_many_paths_as_asked_for(engine, samples):
    capture = path(Scene("cornell"), **engine)(Shot(DEVICE, samples=samples, max_bounces=1))
    assert capture.provenance["samples"] == samples


def test_no_more_paths_than_allowed():
    capture = path(Scene("cornell"), max_samples=10)(Shot(DEVICE, tol_m=1e-5, max_bounces=1))
    assert capture.provenance["samples"] == 10
    assert not capture.provenance["tolerance_met"]


def test_a_dictionary_is_refused_with_advice():
    with pytest.raises(ValueError, match=r"path got a dict, wanted a Scene .*from_dict"):
        path({"type": "scene"})


def test_ambient_light_does_not_depend_on_the_tolerance():
    from toftools.sim.scenes import from_dict, world_of

    lit = {**world_of(Scene("cornell")).description, "sky": {"type": "constant", "radiance": 0.5}}
    run = path(from_dict(lit, to_world=world_of(Scene("cornell")).to_world, lamp_gain=1.0))
    shots = [run(Shot(DEVICE, noisy=False, tol_m=tol_m)) for tol_m in (0.2, 0.05)]
    bounces = [shot.provenance["max_bounces"] for shot in shots]
    assert bounces[0] < bounces[1] < 12, "two depths of the modulated light"
    dark = [
        path(Scene("cornell"))(Shot(DEVICE, noisy=False, samples=64, max_bounces=b))
        for b in bounces
    ]
    charge = [
        (shot.taps.values - none.taps.values).mean(axis=(0, 1), dtype=np.float64).mean()
        for shot, none in zip(shots, dark, strict=True)
    ]
    # The tails of the modulated light are 64 paths here and a few there: 1 % of it, not of this.
    assert abs(charge[0] / charge[1] - 1) < 0.02
