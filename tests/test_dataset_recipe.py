"""Recipes of data sets: what follows from them, and what they refuse."""

from collections import Counter

import numpy as np
import pytest

from toftools.dataset.recipe import RECIPES, read_recipe
from toftools.registry import parse_entry
from toftools.sensors import sensor
from toftools.sim.scenes import world_of
from toftools.types import Scene

HEAD = 'name = "try"\nsensors = ["deeptof:width=8,height=6"]\n'


def recipe(tmp_path, text, head=HEAD):
    file = tmp_path / "try.toml"
    file.write_text(head + text)
    return read_recipe(file)


def test_deeptofs_design():
    jobs = read_recipe("deeptof").jobs
    assert len(jobs) == 25 * 6 * 7
    assert len({job.group for job in jobs}) == 25
    assert {job.max_bounces for job in jobs} == {20}
    assert sensor(jobs[0].sensor).camera.shape == (256, 256)


@pytest.mark.parametrize("name", sorted(path.stem for path in RECIPES.glob("*.toml")))
def test_no_scene_is_in_two_parts_and_nothing_is_drawn_twice(name):
    jobs = read_recipe(name).jobs
    parts = {}
    for job in jobs:
        parts.setdefault(job.group, set()).add(job.split)
    assert all(len(found) == 1 for found in parts.values())
    shares = Counter(job.split for job in jobs)
    assert shares["train"] / len(jobs) == pytest.approx(0.8, abs=0.08)
    assert min(shares.values()) > 0.04 * len(jobs)
    assert len({job.id for job in jobs}) == len({job.seed for job in jobs}) == len(jobs)


FAMILY = """[[family]]
scene = "wall"
scenes = {scenes}
params = {{ range = {{ from = 1.0, to = 3.0 }}, albedo = [0.2, 0.8] }}
"""


def test_more_scenes_and_more_families_leave_the_others_alone(tmp_path):
    few = recipe(tmp_path, FAMILY.format(scenes=10)).jobs
    other = '[[family]]\nscene = "cornell"\nparams = { size = 3 }\n'
    many = recipe(tmp_path, other + FAMILY.format(scenes=30)).jobs
    assert few == many[1:11]
    assert len({job.split for job in many[1:]}) == 3


def test_draws_are_what_the_rules_say(tmp_path):
    jobs = recipe(tmp_path, FAMILY.format(scenes=200)).jobs
    drawn = [parse_entry(job.scene)[1] for job in jobs]
    ranges = np.array([params["range"] for params in drawn])
    assert ranges.min() > 1 and ranges.max() < 3 and abs(ranges.mean() - 2) < 0.15
    assert {params["albedo"] for params in drawn} == {0.2, 0.8}
    counted = recipe(
        tmp_path,
        '[[family]]\nscene = "room"\nscenes = 3\npaints = 2\nviews = 2\n'
        "params = { seed = { first = 5 }, boxes = { from = 1, to = 3 } }",
    ).jobs
    assert len(counted) == 12 and len({job.group for job in counted}) == 3
    found = [parse_entry(job.scene)[1] for job in counted]
    assert {(p["seed"], p["paint"], p["view"]) for p in found} == {
        (s, p, v) for s in (5, 6, 7) for p in (0, 1) for v in (0, 1)
    }
    assert all(1 <= p["boxes"] <= 3 for p in found)


def test_ids_follow_from_what_a_capture_is_of_alone(tmp_path):
    one = '[[family]]\nscene = "wall"\n'
    (plain,) = recipe(tmp_path, one).jobs
    (renamed,) = recipe(tmp_path, one + 'name = "other"\n').jobs
    (finer,) = recipe(tmp_path, one + "tol_mm = 1\n").jobs
    assert plain.id == renamed.id != finer.id


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no \\[\\[family\\]\\]"),
        ("family = 3", "wanted a list"),
        ("[[family]]\nscenes = 2", "names no scene"),
        ('[[family]]\nscene = "wall"\nsize = 2', "has the key 'size'; known: name, scene"),
        ('[[family]]\nscene = "wall"\nscenes = "two"', "scenes = 'two', wanted a whole number"),
        ('[[family]]\nscene = "wall"\nscenes = 0', "scenes = 0, wanted 1 or more"),
        ('[[family]]\nscene = "wall"\nscenes = 2', "asks twice for wall"),
        ('[[family]]\nscene = "wall"\nviews = 2', "no parameter"),
        ('[[family]]\nscene = "wal"', "no file in .* and not one of"),
        ('[[family]]\nscene = "wall"\nseed = -1', "seed = -1, wanted 0 or more"),
        ('[[family]]\nscene = "wall"\ntol_mm = inf', "positive number of millimetres"),
        ('[[family]]\nscene = "wall"\nmax_bounces = true', "wanted a whole number"),
        ('[[family]]\nscene = "wall"\nsensors = [3]', "wanted names such as"),
        ('[[family]]\nscene = "room:view=2"', "sets view; write views = N"),
        ('[[family]]\nscene = "room"\nparams = { paint = 1 }', "sets paint"),
        ('[[family]]\nscene = "room"\nparams = { seed = { first = true } }', "wanted a value"),
        ('[[family]]\nscene = "wall"\nparams = { range = { from = 3, to = 1 } }', "a up to b"),
        ('[[family]]\nscene = "wall"\nparams = { range = { from = nan, to = 1 } }', "a up to b"),
        ('[[family]]\nscene = "wall"\nparams = { range = [] }', "wanted a value"),
        ('[[family]]\nscene = "room"\nparams = { material = "diffuse,boxes=9" }', "another one"),
        (
            '[[family]]\nscene = "room"\nscenes = 3\nparams = { seed = { first = 1 }, '
            'material = ["diffuse", "plastc"] }',
            "plastc",
        ),
        ('[split]\ntrain = nan\n[[family]]\nscene = "wall"', "add up to 1"),
        ('[split]\ntrain = "1"\n[[family]]\nscene = "wall"', "add up to 1"),
        ('[[family]]\nscene = "wall"\nparams = { range = { from = 1 } }', "wanted a value"),
        ('[[family]]\nscene = "wall"\nsensors = ["nikon"]', "nikon"),
        ('[[family]]\nscene = "wall"\n[[family]]\nscene = "wall"', "another name"),
        ('[split]\ntrain = 0.5\n[[family]]\nscene = "wall"', "add up to 1"),
        ("[[family", "cannot read the recipe"),
    ],
)
def test_mistakes_are_told(tmp_path, text, said):
    with pytest.raises(ValueError, match=said):
        recipe(tmp_path, text)


def test_what_shows_the_same_furniture_is_in_one_part(tmp_path):
    jobs = recipe(
        tmp_path,
        '[[family]]\nscene = "room"\nscenes = 20\nparams = { seed = { first = 1 } }\n'
        '[[family]]\nname = "shiny"\nscene = "room"\nscenes = 20\n'
        'params = { seed = { first = 1 }, material = "plastic" }',
    ).jobs
    parts = [job.split for job in jobs]
    assert parts[:20] == parts[20:] and len(set(parts)) > 1


def test_scene_files_lie_beside_the_recipe_and_count_by_their_content(tmp_path):
    cube = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    family = '[[family]]\nscene = "./thing.off"\nparams = { range = 2.0 }\n'
    (tmp_path / "thing.off").write_text(cube)
    (one,) = recipe(tmp_path, family).jobs
    assert one.id.startswith("thing.off-range-2.0-")
    (tmp_path / "thing.off").write_text(cube.replace("0 1 0", "0 2 0"))
    (two,) = recipe(tmp_path, family).jobs
    assert one.id != two.id and one.scene == two.scene
    assert world_of(Scene(*parse_entry(one.scene))).description["mesh"]["faces"].shape == (1, 3)


def test_planted_scenes_are_scenes_too(tmp_path):
    (job,) = recipe(tmp_path, '[[family]]\nscene = "two_returns"\n').jobs
    assert job.scene == "two_returns"


def test_an_unknown_recipe_names_those_there_are():
    with pytest.raises(ValueError, match="broad, deeptof"):
        read_recipe("nothing")


@pytest.mark.parametrize("scene", ["room:seed=12", "clutter:seed=12,gloss=0.5"])
def test_paints_and_views_leave_the_geometry_alone(scene):
    def world(more=""):
        return world_of(Scene(*parse_entry(scene + more)))

    def places(found):
        return {k: np.asarray(e.get("vertices", e.get("to_world", e.get("center"))))
                for k, e in found.description.items()}  # fmt: skip

    first, painted, turned = world(), world(",paint=3"), world(",view=2")
    for other in (painted, turned):
        assert places(first).keys() == places(other).keys()
        for name, place in places(first).items():
            assert np.array_equal(place, places(other)[name])
    assert np.array_equal(first.to_world, painted.to_world)
    assert not np.allclose(first.to_world, turned.to_world)
    paints = [{k: e["bsdf"] for k, e in w.description.items()} for w in (first, painted, turned)]
    assert paints[0] == paints[2]
    assert all(paints[0][name] != paints[1][name] for name in paints[0])
