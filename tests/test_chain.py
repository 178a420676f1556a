"""Chains: what a text means, what goes where, and that they walk through every command."""

import json
import sys

import numpy as np
import pytest

from toftools.bench.methods import check_method, labelled, method_of, points
from toftools.chain import Chain, find_method, own_dials
from toftools.cli import main
from toftools.correct import OK, REJECTED
from toftools.io.native import read_capture, write_capture
from toftools.registry import CORRECTIONS, FILTERS, Spec
from toftools.sensors import sensor as preset
from toftools.sim.analytic import analytic
from toftools.types import DepthMap, Phasors, Scene, Shot

DEVICE = preset("opt8241:width=64,height=48")


@pytest.fixture(scope="module")
def capture():
    return analytic(Scene("wall", {"range": 2.0}))(Shot(DEVICE, seed=1))


@pytest.fixture(scope="module")
def capture_file(capture, tmp_path_factory):
    path = tmp_path_factory.mktemp("chain") / "c.h5"
    write_capture(path, capture)
    return path


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A user's own steps, and one that gives the wrong thing, in the current folder."""
    (tmp_path / "own_steps.py").write_text(
        "import numpy as np\nfrom toftools.types import DepthMap, Phasors\n"
        "def double(sensor, *, factor=2.0):\n"
        "    return lambda p: Phasors(p.values * np.float32(factor), p.sigma, p.valid)\n"
        "def near(sensor):\n"
        "    return lambda p: DepthMap(np.abs(p.values[0]))\n"
        "def shift(sensor, *, by_m=1.0):\n"
        "    return lambda d, p: DepthMap(d.range_m + np.float32(by_m))\n"
        "def nothing(sensor):\n    return lambda *_: None\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "own_steps"
    sys.modules.pop("own_steps", None)


def test_a_chain_is_its_steps_one_after_the_other(capture):
    run = find_method("smooth:radius_px=1>crt:max_range_m=5 > flying_pixels").build(DEVICE)
    smoothed = FILTERS["smooth"].build(DEVICE, radius_px=1)(capture.phasors)
    depth = CORRECTIONS["crt"].build(DEVICE, max_range_m=5.0)(smoothed)
    want = FILTERS["flying_pixels"].build(DEVICE)(depth, smoothed)
    have = run(capture.phasors)
    assert np.array_equal(have.range_m, want.range_m, equal_nan=True)
    assert np.array_equal(have.sigma_m, want.sigma_m, equal_nan=True)
    assert np.array_equal(have.info["status"], want.info["status"])


def test_texts_and_options_make_the_same_chain():
    text = "smooth:radius_px=2 > crt > flying_pixels:gap_m=0.02"
    assert isinstance(find_method(text), Chain)
    assert find_method(text).name == text
    assert find_method(text.replace(" ", "")) == find_method(text)
    options = {"before": ["smooth:radius_px=2"], "after": ["flying_pixels:gap_m=0.02"]}
    assert find_method("crt", **options) == find_method(text)
    assert find_method("smooth:radius_px=2 > crt", after=options["after"]) == find_method(text)
    two = find_method("smooth > crt", before=["smooth:radius_px=1"])
    assert two.name == "smooth:radius_px=1 > smooth > crt"
    assert isinstance(find_method("crt:max_range_m=5"), Spec)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("flying_pixels > crt", "got flying_pixels before the correction, wanted a step from "
         "phasors to phasors, such as smooth"),
        ("crt > smooth", "got smooth after the correction, wanted a step from depth map to depth "
         "map, such as flying_pixels"),
        ("crt > kde", "got crt and kde in 'crt > kde', wanted one correction"),
        ("smooth > flying_pixels", "got no correction in 'smooth > flying_pixels', wanted one of"),
        ("smooth", "got no correction in 'smooth', wanted one of single, crt,"),
        ("a.b:c > d.e:f", "got 2 steps that are no registered ones in .*--before and --after"),
        ("crt >", "got 'crt >', wanted a method, or steps joined by >"),
        (">", "wanted a method, or steps joined by >"),
        ("nope", "unknown name 'nope'; known: single, crt"),
        ("smooth > nope", "unknown name 'nope'; known: single, crt"),
        ("nope > crt", "unknown name 'nope'; known: smooth, flying_pixels"),
        ("smooth:radius_px > crt", "wanted key=value"),
        ("smooth > oracle_wrap", "unknown name 'oracle_wrap'"),
    ],
)  # fmt: skip
def test_a_wrong_chain_is_refused_in_one_sentence(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        find_method(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("smooth:radius=2 > crt", "smooth has no parameter 'radius'; it takes: radius_px"),
        ("smooth:radius_px=0 > crt", "radius_px must be 1..16"),
        ("crt > flying_pixels:gap_m=-1", "no negative gap_m"),
    ],
)
def test_parameters_are_checked_as_those_of_a_single_method(text, message):
    with pytest.raises(ValueError, match=message):
        find_method(text).build(DEVICE)


def test_steps_of_the_user_go_anywhere(mine, capture):
    with_correction = find_method(f"{mine}:double:factor=3 > crt > {mine}:shift:by_m=0.5")
    plain = CORRECTIONS["crt"].build(DEVICE)(capture.phasors).range_m
    assert np.allclose(with_correction.build(DEVICE)(capture.phasors).range_m, plain + 0.5)
    own = find_method(f"{mine}:near", before=[f"{mine}:double"], after=[f"{mine}:shift"])
    want = 2 * np.abs(capture.phasors.values[0]) + 1
    assert np.allclose(own.build(DEVICE)(capture.phasors).range_m, want)
    for text in (f"{mine}:nothing > crt", f"smooth > {mine}:nothing", f"crt > {mine}:nothing"):
        wanted = "Phasors" if text.startswith(mine) else "DepthMap"
        with pytest.raises(ValueError, match=f"own_steps:nothing' gave NoneType, wanted {wanted}"):
            find_method(text).build(DEVICE)(capture.phasors)


def test_points_sweep_every_step_without_typed_parameters():
    grids = {"smooth": {"radius_px": (1, 2)}, "crt": {"max_range_m": (5.0, 0.0)}}
    text = "smooth > crt > flying_pixels:gap_m=0.02"
    found = points(text, grids)
    assert [name for name, _ in found] == [text] * 4  # one curve
    assert found[1][1] == {"smooth.radius_px": 1, "crt.max_range_m": 0.0}
    assert points("smooth:radius_px=2 > crt:max_range_m=5 > flying_pixels:gap_m=0.02", grids) == [
        ("smooth:radius_px=2 > crt:max_range_m=5 > flying_pixels:gap_m=0.02", {})
    ]
    swept = points("crt:max_range_m=5 > flying_pixels", {})
    assert [p["flying_pixels.least_neighbours"] for _, p in swept] == [2, 3, 4]


def test_a_point_is_built_and_labelled_with_its_own_setting(capture):
    text = "smooth > crt > flying_pixels:gap_m=0.02"
    dials = {"smooth.radius_px": 1, "crt.max_range_m": 5.0}
    label = labelled(text, dials)
    assert label == "smooth:radius_px=1 > crt:max_range_m=5.0 > flying_pixels:gap_m=0.02"
    have = method_of(text).build(DEVICE, **dials)(capture.phasors)
    want = method_of(label).build(DEVICE)(capture.phasors)
    assert np.array_equal(have.range_m, want.range_m, equal_nan=True)
    assert own_dials("smooth:radius_px=2", dials) == {}


def test_dials_of_a_suite_are_checked_before_it_runs():
    with pytest.raises(ValueError, match="smooth has no parameter 'radius'"):
        check_method("smooth > crt", {"smooth": {"radius": (1,)}})
    with pytest.raises(ValueError, match="smooth got radius_px='a', wanted a whole number"):
        check_method("smooth:radius_px=a > crt", {})
    with pytest.raises(ValueError, match=r"cannot load method 'no_such\.module:make'"):
        check_method("smooth > no_such.module:make", {})


def test_the_command_line_takes_a_chain_in_both_ways(capture_file, tmp_path, capsys):
    def answer(*options):
        out = tmp_path / "d.npz"
        with pytest.raises(SystemExit) as ended:
            main(["correct", str(capture_file), "--json", "--out", str(out), *options])
        said = capsys.readouterr()
        assert ended.value.code == 0, said.err
        with np.load(out) as stored:
            return json.loads(said.out), stored["range_m"], stored["sigma_m"], stored["status"]

    options = ("--before", "smooth", "--after", "flying_pixels:gap_m=0.02")
    told, range_m, sigma_m, status = answer("--method", "crt:max_range_m=5", *options)
    text = "smooth > crt:max_range_m=5 > flying_pixels:gap_m=0.02"
    assert told["method"] == text
    again = answer("--method", text)
    assert np.array_equal(range_m, again[1], equal_nan=True)
    assert np.isin(status, (OK, REJECTED)).all()
    plain = answer("--method", "crt:max_range_m=5")
    assert np.nanmedian(sigma_m) < 0.5 * np.nanmedian(plain[2])


def test_the_command_line_refuses_a_step_in_the_wrong_place(capture_file, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["correct", str(capture_file), "--before", "flying_pixels", "--out",
              str(tmp_path / "d.npz")])  # fmt: skip
    assert ended.value.code == 2
    assert "got flying_pixels before the correction, wanted a step from" in capsys.readouterr().err
    assert not (tmp_path / "d.npz").exists()


def test_help_names_the_filters(capsys):
    with pytest.raises(SystemExit):
        main(["correct", "--help"])
    out = capsys.readouterr().out
    assert all(name in out for name in FILTERS)


def test_the_benchmark_runs_times_and_draws_a_chain(tmp_path, capsys):
    suite = tmp_path / "s.toml"
    suite.write_text(
        'name = "s"\nengine = "analytic"\nsensor = "opt8241:width=64,height=48"\n'
        'scenes = ["wall:range=2"]\nrepeats = 1\n'
        'methods = ["crt:max_range_m=5", "smooth > crt:max_range_m=5 > flying_pixels:gap_m=0.02"]\n'
        "[grid.smooth]\nradius_px = [1, 2]\n"
    )
    with pytest.raises(SystemExit) as ended:
        main(["bench", str(suite), "--out", str(tmp_path / "out"), "--threads", "1"])
    assert ended.value.code == 0, capsys.readouterr().err
    lines = (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    plain, one, two = map(json.loads, lines)
    text = "smooth > crt:max_range_m=5 > flying_pixels:gap_m=0.02"
    assert (one["method"], one["params"]) == (text, {"smooth.radius_px": 1})
    assert plain["ms"] > 0
    assert one["ms"] > 0
    assert two["metrics"]["mae_m"] < plain["metrics"]["mae_m"]
    report = (tmp_path / "out" / "report.html").read_text()
    assert "smooth:radius_px=2 &gt; crt:max_range_m=5 &gt; flying_pixels:gap_m=0.02" in report


def test_protocol_of_the_steps_is_what_the_registry_says(capture):
    depth = CORRECTIONS["crt"].build(DEVICE)(capture.phasors)
    for name, spec in FILTERS.items():
        assert spec.place in ("before", "after"), name
        run = spec.build(DEVICE)
        if spec.place == "before":
            assert isinstance(run(capture.phasors), Phasors)
        else:
            assert isinstance(run(depth, capture.phasors), DepthMap)


def test_a_capture_that_was_read_gives_the_same_answer(capture, capture_file):
    run = find_method("smooth > crt").build(DEVICE)
    stored = read_capture(capture_file)
    assert np.array_equal(run(stored.phasors).range_m, run(capture.phasors).range_m, equal_nan=True)
