"""Cluttered tables, other paints and views of furnished scenes, and bodies turned on a lathe."""

from itertools import combinations

import numpy as np
import pytest
from test_scenes import RAYS, cast, stage, world

from toftools.sim._ground import CLEAR_M
from toftools.sim.solids import lathe, material

GREY = material("diffuse", 0.5)


def volume(entry):
    corner = entry["vertices"][entry["faces"]]
    return np.sum(corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])) / 6


def test_a_turned_cylinder_has_its_volume_and_faces_outwards():
    radius, height, sides = 0.3, 0.5, 32
    profile = [[0, 0], [radius, 0], [radius, height], [0, height]]
    made = lathe([1.0, 2.0, 3.0], profile, GREY, sides=sides)
    base = sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
    assert volume(made) == pytest.approx(base * height)
    assert made["vertices"][:, 1].max() == 2 and made["vertices"][:, 1].min() == 1.5


def circle(entry):
    """Foot of a thing: middle and radius of the circle around it, and its lowest height."""
    if entry["type"] == "sphere":
        middle, radius = np.asarray(entry["center"]), entry["radius"]
        return middle[[0, 2]], radius, middle[1] + radius
    if entry["type"] == "cube":
        pose = entry["to_world"]
        middle, half = pose[:3, 3], np.linalg.norm(pose[:3, :3], axis=0)
        return middle[[0, 2]], np.hypot(half[0], half[2]), middle[1] + half[1]
    at = entry["vertices"]
    middle = at[:, [0, 2]].mean(axis=0)
    radius = np.linalg.norm(at[:, [0, 2]] - middle, axis=1).max()
    return middle, radius, at[:, 1].max()


@pytest.mark.parametrize("seed", range(12))
def test_things_stand_on_the_table_side_by_side(seed):
    shapes = world(f"clutter:seed={seed},things=20").description
    things = [circle(entry) for name, entry in shapes.items() if name.startswith("thing_")]
    half = np.linalg.norm(shapes["table"]["to_world"][:3, :3], axis=0)[[0, 2]]
    assert len(things) > 5
    for middle, radius, low in things:
        assert low == pytest.approx(-CLEAR_M)
        assert (np.abs(middle) + radius < half + 0.01).all()
    for (a, r, _), (b, s, _) in combinations(things, 2):
        assert np.linalg.norm(a - b) > 0.98 * (r + s)


@pytest.mark.parametrize("view", range(12))
def test_cameras_see_the_things_from_near(view):
    range_m, _, names = cast(stage(f"clutter:seed={view % 3},view={view}"), RAYS)
    seen = [name for name in names if name.startswith("thing_")]
    assert np.isfinite(range_m).mean() > 0.9
    assert len(set(seen)) >= 2 and len(seen) > 0.05 * len(names)
    assert np.nanmin(range_m) > 0.15 and np.nanmedian(range_m) < 2.5


@pytest.mark.parametrize("view", range(1, 12))
def test_other_cameras_of_a_room_stand_in_it_and_see_things(view):
    range_m, _, names = cast(stage(f"room:seed={view % 4},view={view}"), RAYS)
    assert np.isfinite(range_m).all() and range_m.min() > 0.1 and len(set(names)) >= 4


def test_gloss_is_a_share_of_the_things():
    kinds = [
        entry["bsdf"]["bsdf"]["type"]
        for seed in range(30)
        for name, entry in world(f"clutter:seed={seed},gloss=0.4").description.items()
        if name.startswith("thing_")
    ]
    shiny = np.mean([kind != "diffuse" for kind in kinds])
    assert abs(shiny - 0.4) < 4 * np.sqrt(0.24 / len(kinds))
    assert {"roughplastic", "roughconductor"} < set(kinds)


@pytest.mark.parametrize(
    ("text", "said"),
    [("seed=-1", "seed=-1"), ("things=61", "things=61"), ("gloss=1.5", "gloss=1.5"),
     ("view=-1", "view=-1")],
)  # fmt: skip
def test_bad_numbers_are_refused(text, said):
    with pytest.raises(ValueError, match=said):
        world(f"clutter:{text}")
