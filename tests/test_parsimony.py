"""Ladders of models and what is read from them: knees, first rungs that suffice, failures."""

import csv
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from toftools.bench.ladder import ladder_sources
from toftools.bench.light_models import MODELS, light_model
from toftools.bench.parsimony import ALL, climbs, first_sufficing, knee
from toftools.bench.parsimony_report import group_ladder, lines
from toftools.bench.plan import make_plan, read_plan
from toftools.bench.report import report
from toftools.bench.run import Settings, run_points
from toftools.bench.score import score
from toftools.bench.suite import load_suite
from toftools.correct._bounced import bounced
from toftools.correct.crt import crt
from toftools.registry import CORRECTIONS, SIMULATORS
from toftools.sensors import sensor
from toftools.types import DepthMap, Scene, Shot
from toftools.viz.parsimony import Scaled, parsimony_svg

LADDER = {
    "name": "window",
    "rungs": [3, 5],
    "method": "kde:window_px={rung}",
    "scenes": ["wall:range=2", "tilted:range=2"],
    "sensor": "opt8241:width=12,height=9",
    "seeds": 2,
}


# Suites


def test_a_ladder_is_a_method_per_rung_on_the_same_scenes():
    found = list(ladder_sources([LADDER], "mine.toml"))
    assert [(s.rung, s.text, s.seed) for s in found] == [
        (rung, scene, seed) for rung in (3, 5) for scene in LADDER["scenes"] for seed in (0, 1)
    ]
    assert found[-1].method == "kde:window_px=5" and found[-1].label == "5"
    assert {s.ladder for s in found} == {"window"} and found[0].within_m == pytest.approx(0.01)


def test_columns_and_labels_stand_beside_the_rungs():
    ladder = {**LADDER, "model": ["crt", "kde"], "light": [100, 200], "labels": ["few", "many"]}
    ladder |= {"method": "{model}", "sensor": "opt8241:width=12,height=9,signal_e={light}"}
    found = list(ladder_sources([{**ladder, "within_mm": 5}], "mine.toml"))
    assert (found[0].method, found[-1].method) == ("crt", "kde")
    assert (found[0].sensor[-3:], found[-1].sensor[-3:]) == ("100", "200")
    assert (found[0].label, found[-1].label) == ("few", "many")
    assert found[0].within_m == pytest.approx(0.005)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": ""}, "needs a name"),
        ({"rungs": [1]}, "2 or more rising numbers"),
        ({"rungs": [5, 3]}, "2 or more rising numbers"),
        ({"rungs": [3, 3]}, "2 or more rising numbers"),
        ({"rungs": [3, float("inf")]}, "2 or more rising numbers"),
        ({"rungs": [False, 3]}, "2 or more rising numbers"),
        ({"method": ""}, "needs a method"),
        ({"method": "magic:window_px={rung}"}, "unknown name 'magic'"),
        ({"method": "kde:window={rung}"}, "no parameter 'window'"),
        ({"method": "kde:window_px={wide}"}, "asks for {wide}, known: {rung}"),
        ({"sensor": ""}, "needs a sensor"),
        ({"sensor": "opt8241:signal={rung}"}, "unknown sensor key 'signal'"),
        ({"sensor": "opt8241:width={rung}"}, "cameras of different pixels"),
        ({"sensor": "opt8241:width=12,height=9,hfov_deg=6{rung}"}, "cameras of different pixels"),
        ({"claimed": "nope"}, "nope"),
        ({"scenes": []}, "needs a list of different scenes"),
        ({"scenes": ["wall", "wall"]}, "needs a list of different scenes"),
        ({"scenes": ["moon"]}, "moon"),
        ({"scenes": ["wall:rang=2"]}, "rang"),
        ({"labels": ["one"]}, "has 1 labels for 2 rungs"),
        ({"wide": [1, 2, 3]}, "has 3 wide for 2 rungs"),
        ({"rung": [1, 2]}, "has a list named rung"),
        ({"seeds": 0}, "wants seeds from 1 to 1000, got 0"),
        ({"tol_mm": 0}, "must be a positive number, got 0"),
        ({"within_mm": -1}, "must be a positive number, got -1"),
        ({"engine": "magic"}, "unknown name 'magic'"),
        ({"wrong": 3}, "unknown key 'wrong'"),
    ],
)
def test_what_is_no_ladder(change, said):
    with pytest.raises(ValueError, match=r"ladder|name|sensor|kde") as caught:
        list(ladder_sources([{**LADDER, **change}], "mine.toml"))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_the_ladder_of_the_docs_is_one():
    page = (Path(__file__).parents[1] / "docs" / "benchmark.md").read_text(encoding="utf-8")
    (block,) = (part for part in re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
                if "[[ladder]]" in part)  # fmt: skip
    found = list(ladder_sources(tomllib.loads(block)["ladder"], "docs"))
    assert [s.label for s in found][::4] == ["0", "1", "2", "all"]


def test_ladders_have_names_of_their_own():
    with pytest.raises(ValueError, match="two ladders 'window'"):
        list(ladder_sources([LADDER, LADDER], "mine.toml"))


def test_a_suite_of_ladders_alone_needs_no_methods(tmp_path):
    (tmp_path / "s.toml").write_text('methods = ["crt"]\n', encoding="utf-8")
    with pytest.raises(ValueError, match="or else ladders"):
        load_suite(str(tmp_path / "s.toml"))
    suite = load_suite("parsimony")
    assert not suite.methods and all(source.ladder for source in suite.sources)
    assert {"bounces", "returns", "frequencies", "iterations"} <= {s.ladder for s in suite.sources}


# Measures


def made(off_m, *, within_m=0.01, ms=None, seeds=1):
    """Ladder, rows and errors of pixels; per rung and scene a list of errors, or a status."""
    rows, errors, rungs = {}, {}, []
    for rung, scenes in enumerate(off_m):
        keys = {}
        for scene, off in scenes.items():
            keys[scene] = [f"{rung}{scene}{seed}" for seed in range(seeds)]
            for seed, key in enumerate(keys[scene]):
                rows[key], errors[key] = answer(off, 1 + 0.1 * seed, ms[rung] if ms else 5.0)
        rungs.append({"rung": rung, "label": f"r{rung}", "method": "crt", "scenes": keys})
    return {"about": "", "within_m": within_m, "rungs": rungs}, rows, errors.get


def answer(off, scale, ms):
    if isinstance(off, str):
        return {"status": off, "error": "it raised", "metrics": {}}, None
    off = scale * np.asarray(off, float)[None]
    answered = off[np.isfinite(off)]
    metrics = {
        "mae_m": float(answered.mean()) if answered.size else None,
        "valid_share": answered.size / (~np.isnan(off)).sum(),
    }
    return {"status": "ok", "error": None, "metrics": metrics, "ms": ms}, off


def test_every_pixel_belongs_to_the_first_rung_that_suffices():
    off = [
        {"a": [0.005, 0.020, 0.030, 0.090, np.nan]},
        {"a": [0.050, 0.009, 0.030, 0.090, np.nan]},  # worse where the first was good
        {"a": [0.001, 0.001, 0.001, 0.090, np.nan]},
    ]
    found = climbs("l", *made(off))
    assert len(found) == 1
    assert found[0].first.tolist() == [0.25, 0.25, 0.25]
    assert found[0].within.tolist() == [0.25, 0.25, 0.75]
    table = lines(found[0])
    assert [line["cumulative_share"] for line in table] == [0.25, 0.5, 0.75]


def test_unanswered_pixels_are_not_sufficed():
    off = [{"a": [np.inf, 0.001]}, {"a": [0.001, np.inf]}]
    found = climbs("l", *made(off))[0]
    assert found.first.tolist() == [0.5, 0.5] and found.valid.tolist() == [0.5, 0.5]


def test_the_tolerance_is_the_ladders():
    off = [{"a": [0.02, 0.04]}, {"a": [0.01, 0.01]}]
    assert climbs("l", *made(off, within_m=0.03))[0].first.tolist() == [0.5, 0.5]
    assert climbs("l", *made(off, within_m=0.05))[0].first.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("error_m", "valid", "at"),
    [
        ([0.1, 0.05, 0.03, 0.03], [1, 1, 1, 1], 2),
        ([0.1, 0.0329, 0.03], [1, 1, 1], 1),  # within a tenth
        ([0.1, 0.0331, 0.03], [1, 1, 1], 2),
        ([0.0029, 0.002], [1, 1], 0),  # within a millimetre
        ([0.0031, 0.002], [1, 1], 1),
        ([0.03, 0.02, 0.5], [1, 1, 1], 1),  # the most complex is the worst
        ([0.02, 0.03, 0.5], [1, 1, 1], 0),
        ([0.001, 0.03], [0.4, 1], 1),  # hardly answers
        ([0.001, 0.03], [0.89, 1], 1),  # drops the hard pixels
        ([0.001, 0.03], [0.91, 1], 0),
        ([0.03, 0.02, 0.001], [1, 1, 0.8], 1),
        ([np.inf, 0.03, 0.02], [1, 1, 1], 2),
        ([np.inf, np.inf], [1, 1], None),
        ([0.1, 0.2], [0.4, 0.1], None),
    ],
)
def test_the_knee_is_the_simplest_that_is_hardly_worse(error_m, valid, at):
    assert knee(np.array(error_m, float), np.array(valid, float)) == at


def test_a_more_complex_rung_that_is_worse_is_no_knee_and_suffices_for_nothing_more():
    off = [{"a": [0.05, 0.05]}, {"a": [0.005, 0.005]}, {"a": [0.5, 0.009]}]
    found = climbs("l", *made(off))[0]
    assert found.knee == 1 and found.first.tolist() == [0, 1, 0] and found.within[2] == 0.5


def test_failures_stay_on_the_ladder():
    off = [
        {"a": [0.05, 0.05], "b": [0.05, 0.05]},
        {"a": [0.001, 0.02], "b": "unsuited"},
        {"a": "crashed", "b": [0.004, 0.02]},
    ]
    first, second, whole = climbs("l", *made(off))
    assert (first.knee, second.knee, whole.knee) == (1, 2, 0)
    assert whole.scene == ALL and np.isinf(whole.mean_m[1:]).all()
    assert whole.first.tolist() == [0, 0.25, 0.25]  # of the scenes where they answered
    assert second.failures == ("", "unsuited: it raised", "")
    assert whole.failures == ("", "b: unsuited: it raised", "a: crashed: it raised")
    line = lines(whole)[1]
    assert line["mae_m"] is None and line["failure"] == "b: unsuited: it raised"


def test_a_rung_that_was_not_run_and_one_without_answers_say_so():
    ladder, rows, pixels = made([{"a": [0.01]}, {"a": [np.inf]}, {"a": [0.02]}])
    del rows["2a0"]
    found = climbs("l", ladder, rows, pixels)[0]
    assert found.failures == ("", "no answer", "missing: not run")
    assert np.isinf(found.mean_m[1:]).all() and found.knee == 0


def test_nothing_answered_leaves_nothing():
    found = climbs("l", *made([{"a": "failed"}, {"a": "timeout"}]))[0]
    assert found.knee is None and found.first.tolist() == [0, 0] and np.isnan(found.ms).all()


def test_means_over_scenes_and_seeds():
    off = [{"a": [0.10], "b": [0.02]}, {"a": [0.04], "b": [0.02]}]
    first, _, whole = climbs("l", *made(off, seeds=2, ms=[1, 3]))
    assert first.error_m == pytest.approx(np.array([[0.1, 0.11], [0.04, 0.044]]))
    assert whole.error_m == pytest.approx(np.array([[0.06, 0.066], [0.03, 0.033]]))
    assert whole.ms.tolist() == [1, 3] and whole.knee == 1
    line = lines(whole)[0]
    assert (line["least_m"], line["most_m"]) == pytest.approx((0.06, 0.066))


def test_shares_of_no_pixels_are_none():
    assert first_sufficing(np.zeros((3, 0), bool)).tolist() == [0, 0, 0]


# Groups of a suite


def test_methods_of_a_group_are_a_ladder_by_their_time():
    def row(method, params, mae, ms, capture="c"):
        metrics = {"mae_m": mae, "input_mae_m": 0.1, "valid_share": 1.0}
        return {"capture": capture, "capture_id": capture, "method": method, "params": params,
                "status": "ok", "error": None, "metrics": metrics, "ms": ms}  # fmt: skip

    rows = [row("slow", {"n": 1}, 0.03, 9.0), row("slow", {"n": 2}, 0.01, 8.0),
            row("quick", {}, 0.02, 1.0), row("oracle_wrap", {}, 0.0, None)]  # fmt: skip
    rungs = group_ladder(rows)["rungs"]
    assert [(r["method"], r["rung"]) for r in rungs] == [("quick", 1.0), ("slow:n=2", 8.0)]
    assert list(rungs[0]["scenes"]) == ["c"]


def test_every_correction_has_a_model_of_light():
    assert set(MODELS) == set(CORRECTIONS)
    assert light_model("smooth:radius_px=2 > fuchs2010:tol_mm=3 > flying_pixels").startswith("diff")


# Pictures


def test_the_chart_marks_the_knee_and_shares_add_up():
    scaled = [
        Scaled("corner", np.array([[0.05], [np.inf], [0.01]]), np.array([1, np.nan, 3.0]),
               np.array([0.2, 0, 0.5]), 2),
        Scaled("all <scenes>", np.array([[0.05], [0.04], [0.03]]), np.array([1, 2, 3.0]),
               np.array([0.1, 0.2, 0.3]), 1),
    ]  # fmt: skip
    svg = parsimony_svg(["a", "b", "c"], scaled, title="t", name="n", within_m=0.01)
    assert svg.count('class="knee"') == 2
    for said in ("corner: 20.0% a", "corner: 30.0% no rung", "all &lt;scenes&gt;: 40.0% no rung"):
        assert said in svg, said
    nothing = parsimony_svg(["a"], [Scaled("x", np.full((1, 1), np.inf), np.full(1, np.nan),
                                           np.zeros(1), None)],
                            title="t", name="n", within_m=0.01)  # fmt: skip
    assert "Nothing to chart" in nothing


# Bounces


def freed_of(bounces, light, transport, direct, iterations=60):
    """Direct light that a model of some bounces finds in light, by a transport matrix."""
    ratio = np.zeros_like(direct)
    for _ in range(iterations):
        ratio = bounced(lambda out: (transport @ out) / direct, light, ratio, 1.0, bounces)
    return light / (1 + ratio)


@pytest.mark.parametrize("bounces", [1, 2, 3])
def test_as_many_bounces_are_removed_as_there_are(bounces):
    rng = np.random.default_rng(0)
    transport = 0.05 * rng.random((9, 9)) * np.exp(1j * rng.random((9, 9)))
    direct = (1 + rng.random(9)) * np.exp(2j * rng.random(9))
    light, part = direct.copy(), direct
    for _ in range(bounces):
        part = transport @ part
        light += part
    assert freed_of(bounces, light, transport, direct) == pytest.approx(direct, rel=1e-6)
    for other in {1, 2, 3, 4} - {bounces}:
        off = np.abs(freed_of(other, light, transport, direct) - direct).max()
        assert off > 1e-3, other
    every = np.linalg.solve(np.eye(9) - transport, direct)
    assert freed_of(0, every, transport, direct) == pytest.approx(direct, rel=1e-6)


def test_the_method_counts_its_bounces():
    camera = sensor("opt8241:width=24,height=18")
    corner = SIMULATORS["analytic"].build(Scene("corner", {"size": 0.9, "height": 1.0}))
    phasors = corner(Shot(camera, noisy=False)).phasors

    def range_m(bounces, iterations):
        dials = {"bounces": bounces, "iterations": iterations}
        return CORRECTIONS["fuchs2010_all_pairs"].build(camera, **dials)(phasors).range_m

    # At first the measured light goes out, whatever was asked for.
    np.testing.assert_array_equal(range_m(1, 1), range_m(0, 1))
    one, two, every = (range_m(bounces, 6) for bounces in (1, 2, 0))
    assert np.nanmax(np.abs(one - every)) > 2 * np.nanmax(np.abs(two - every)) > 1e-4


def test_bounces_are_counted_from_one():
    with pytest.raises(ValueError, match="bounces must be 1 or more, or 0 for all, got -1"):
        CORRECTIONS["fuchs2010_all_pairs"].build(sensor("opt8241:width=8,height=6"), bounces=-1)


# From suite to report

SUITE = """name = "small"
repeats = 1
batch = true
methods = ["crt:max_range_m=0", "single:freq_index=1"]
scenes = [{ scene = "wall:range=2", sensor = "opt8241:width=12,height=9" }]

[[ladder]]
name = "halves"
rungs = [1, 2, 3]
model = ["test_parsimony:left", "test_parsimony:right", "test_parsimony:refusing"]
method = "{model}"
scenes = ["wall:range=2", "tilted:range=2"]
sensor = "opt8241:width=12,height=9"
seeds = 1
within_mm = 100

[[ladder]]
name = "again"
rungs = [1, 2]
model = ["test_parsimony:left", "crt:max_range_m=0"]
method = "{model}"
scenes = ["wall:range=2"]
sensor = "opt8241:width=12,height=9"
seeds = 1
within_mm = 100
"""


def half(device, good):
    plain = crt(device)

    def run(phasors):
        range_m = plain(phasors).range_m.copy()
        range_m[:, good:] += 0.3
        return DepthMap(range_m)

    return run


def left(device):
    """Right in the first quarter of the columns."""
    return half(device, 3)


def right(device):
    """Right in three quarters of them."""
    return half(device, 9)


def refusing(device):
    """A method that suits no sensor."""
    msg = "this method suits no sensor"
    raise ValueError(msg)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    here = tmp_path_factory.mktemp("ladder")
    (here / "small.toml").write_text(SUITE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir("tests")
        suite = load_suite(str(here / "small.toml"))
        points = make_plan(suite, here / "out")
        run_points(points, here / "out", Settings(suite.repeats, 1, 120.0, batch=suite.batch),
                   lambda point, status: None)  # fmt: skip
    return here / "out"


def test_shared_captures_are_listed_once_and_climbed_by_their_own_rungs_alone(folder):
    plan, points = read_plan(folder)
    assert [c["name"] for c in plan["captures"]] == ["wall-range-2", "tilted-range-2"]
    wall, tilted = (c["id"] for c in plan["captures"])
    met = {(p.capture, p.method.split(":")[-1]) for p in points}
    assert met == {(wall, m) for m in ("crt", "single", "left", "right", "refusing")} | {
        (tilted, m) for m in ("left", "right", "refusing")
    }
    assert list(plan["ladders"]) == ["halves", "again"]
    own = plan["ladders"]["again"]["own"]
    assert len(own) == 1  # crt there is a point of the suite as well


def test_a_suite_of_ladders_alone_takes_no_other_method(tmp_path):
    text = SUITE.replace('methods = ["crt:max_range_m=0", "single:freq_index=1"]', "")
    text = "\n".join(line for line in text.splitlines() if "scene =" not in line)
    (tmp_path / "alone.toml").write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir("tests")
        suite = load_suite(str(tmp_path / "alone.toml"))
        with pytest.raises(ValueError, match="ladders alone"):
            make_plan(suite, tmp_path / "out", ("crt",))


def test_rows_of_ladders_say_so_and_all_else_stays(folder):
    rows = score(folder)
    mine = {r["method"].split(":")[-1]: r.get("ladders") for r in rows if r["capture"][0] == "w"}
    assert mine == {"crt": None, "single": None, "left": ["halves", "again"],
                    "right": ["halves"], "refusing": ["halves"]}  # fmt: skip


def test_the_report_shows_ladders_and_groups(folder):
    score(folder)
    page = report(folder).read_text(encoding="utf-8")
    assert page.count('id="parsimony"') == 1
    for said in ('id="ladder-halves"', 'id="ladder-again"', "what suffices", "suits no sensor"):
        assert said in page, said
    told = json.loads((folder / "parsimony.json").read_text(encoding="utf-8"))
    with (folder / "parsimony.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(told)
    halves = [t for t in told if t["ladder"] == "halves" and t["scene"] == "all scenes"]
    assert [round(t["first_share"], 6) for t in halves] == [0.25, 0.5, 0.0]
    assert [t["knee"] for t in halves] == [False, True, False]
    assert halves[2]["mae_m"] is None and "unsuited" in halves[2]["failure"]
    again = [t for t in told if t["ladder"] == "again"]
    assert [round(t["first_share"], 6) for t in again] == [0.25, 0.75] and again[1]["knee"]
    # The plain group knows the suite's methods alone.
    plain = {t["label"] for t in told if t["ladder"].startswith("scenes")}
    assert plain == {"crt", "single"}
