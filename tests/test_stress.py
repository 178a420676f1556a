"""Stress axes and what is read from them: families of captures, breaking points, warnings."""

import csv
import json
import re

import numpy as np
import pytest

from toftools.bench.methods import method_of, points, specs_of
from toftools.bench.plan import make_plan
from toftools.bench.report import report
from toftools.bench.run import Settings, run_points
from toftools.bench.score import score
from toftools.bench.stability import Course, courses, stability
from toftools.bench.stress import axis_sources
from toftools.bench.suite import load_suite
from toftools.correct.crt import crt
from toftools.io.native import read_capture
from toftools.metrics.interval import inside_interval
from toftools.registry import CORRECTIONS
from toftools.sensors import sensor
from toftools.types import DepthMap, Truth
from toftools.viz.stress import Strain, stress_svg

AXIS = {
    "name": "light",
    "values": [4000, 1000, 250],
    "scene": "wall:range=2",
    "sensor": "opt8241:width=12,height=9,signal_e={value}",
    "seeds": 2,
}
SUITE = """name = "small"
methods = ["crt:max_range_m=0", "test_stress:wild", "test_stress:boastful"]
repeats = 1

[[axis]]
name = "clock"
values = [0, 1000, 10000, 40000]
f = ["40e6+70e6", "40.04e6+70.07e6", "40.4e6+70.7e6", "41.6e6+72.8e6"]
scene = "wall:range=3,albedo=0.9"
sensor = "opt8241:width=12,height=9,freqs={f}"
claimed = "opt8241:width=12,height=9"
seeds = 1
"""


def wild(device):
    """A method that is right until the range is a little off, then far from it."""
    plain = crt(device)

    def run(phasors):
        range_m = plain(phasors).range_m
        return DepthMap(np.where(np.abs(range_m - np.median(range_m)) < 9, range_m + 40 * np.abs(
            np.maximum(range_m - 3.02, 0)), range_m))  # fmt: skip

    return run


def boastful(device):
    """A method whose sigma is a hundredth of what it should be."""
    plain = crt(device)

    def run(phasors):
        depth = plain(phasors)
        return DepthMap(depth.range_m, sigma_m=depth.sigma_m / 100)

    return run


# Axes


def test_an_axis_is_a_scene_per_value_and_seed():
    found = list(axis_sources([AXIS], "mine.toml"))
    assert [(s.value, s.seed) for s in found] == [(v, s) for v in AXIS["values"] for s in (0, 1)]
    assert found[2].sensor == "opt8241:width=12,height=9,signal_e=1000"
    assert {s.axis for s in found} == {"light"} and {s.group for s in found} == {"axis: light"}


def test_columns_stand_beside_the_values():
    axis = {**AXIS, "rows": [9, 6, 3], "sensor": "opt8241:width={value},height={rows}"}
    found = list(axis_sources([axis], "mine.toml"))
    assert found[-1].sensor == "opt8241:width=250,height=3"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": ""}, "needs a name"),
        ({"values": [1, 2]}, "3 or more different numbers"),
        ({"values": [1, 2, 2]}, "3 or more different numbers"),
        ({"values": [1, 2, float("nan")]}, "3 or more different numbers"),
        ({"values": [1, True, 3]}, "3 or more different numbers"),
        ({"scene": ""}, "needs a scene and a sensor"),
        ({"scene": "wall:range={metres}"}, "asks for {metres}, known: {value}"),
        ({"scene": "nowhere:range={value}"}, "unknown scene 'nowhere'"),
        ({"scene": "wall:rang=2"}, "rang"),
        ({"rows": [1, 2]}, "has 2 rows for 3 values"),
        ({"seeds": 0}, "wants seeds from 1 to 1000, got 0"),
        ({"seeds": 1.5}, "wants seeds from 1 to 1000, got 1.5"),
        ({"tol_mm": -1}, "must be a positive number, got -1"),
        ({"engine": "magic"}, "unknown name 'magic'"),
        ({"sensor": "opt8241:signal={value}"}, "unknown sensor key 'signal'"),
        ({"claimed": "nope"}, "nope"),
        ({"wrong": 3}, "unknown key 'wrong'"),
        ({"value": [7, 8, 9]}, "has a list named value"),
    ],
)
def test_what_is_no_axis(change, said):
    with pytest.raises(ValueError, match=r"axis|name|sensor|scene") as caught:
        list(axis_sources([{**AXIS, **change}], "mine.toml"))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_axes_have_names_of_their_own():
    with pytest.raises(ValueError, match="two axes 'light'"):
        list(axis_sources([AXIS, AXIS], "mine.toml"))


def test_the_suite_of_the_package_has_every_axis():
    suite = load_suite("stress")
    names = {source.axis for source in suite.sources}
    assert len(names) == 28
    for source in suite.sources:
        if source.claimed:
            true, told = sensor(source.sensor), sensor(source.claimed)
            assert true.camera.shape == told.camera.shape
            assert true.modulation.steps_rad.shape == told.modulation.steps_rad.shape


def test_every_correction_is_put_under_stress():
    suite = load_suite("stress")
    named = {spec.name for text in suite.methods for spec in specs_of(method_of(text))}
    assert all(len(points(text, suite.grid)) == 1 for text in suite.methods), "one setting each"
    assert set(CORRECTIONS) - named == {"sra_lp", "fuchs2010_all_pairs"}, "the slow twins"


# Measures


def row(value, seed, mae, raw, *, label="m", valid=1.0, status="ok", inside=(0.68, 0.95)):
    metrics = {"mae_m": mae, "input_mae_m": raw, "valid_share": valid, "p99_m": 3 * mae}
    return {
        "axis": "a", "value": value, "seed": seed, "method": label, "params": {}, "status": status,
        "error": "it raised" if status != "ok" else None,
        "metrics": metrics if status == "ok" else {},
        "intervals": {"68": inside[0], "95": inside[1]},
    }  # fmt: skip


def told(errors, raws, values=(1.0, 10.0, 100.0, 1000.0), **more):
    rows = [row(v, s, e * (1 + 0.01 * s), r, **more)
            for v, e, r in zip(values, errors, raws, strict=True) for s in range(3)]  # fmt: skip
    return stability(courses(rows)[0])


def test_it_breaks_where_it_passes_the_input():
    found = told((0.01, 0.05, 0.2, 0.8), (0.1, 0.1, 0.1, 0.1))
    # Its own error has doubled before: 0.02 between 0.01 and 0.05 on logarithms.
    part = np.log(2) / np.log(5)
    assert found.why == "own" and found.breaks_at == pytest.approx(10**part, rel=0.02)
    late = told((0.06, 0.07, 0.3, 0.8), (0.1, 0.1, 0.1, 0.1))
    assert late.why == "input"
    # 0.11, the input's error and a tenth of slack, between 0.07 and 0.3 on logarithms; its own
    # error has doubled later, at 0.12.
    part = np.log(0.11 / 0.07) / np.log(0.3 / 0.07)
    assert late.breaks_at == pytest.approx(10 ** (1 + part), rel=0.05)
    assert late.low <= late.breaks_at <= late.high
    assert late.flags == ("unstable",)


def test_what_never_breaks_says_so():
    found = told((0.01, 0.011, 0.012, 0.013), (0.1, 0.1, 0.1, 0.1))
    assert found.breaks_at is None and found.share == 1 and found.why == "" and found.flags == ()
    assert np.isfinite(found.slope_m) and found.slope_m > 0


def test_methods_that_only_unwrap_equal_the_input_and_break_by_their_own_error():
    found = told((0.01, 0.012, 0.05, 0.4), (0.01, 0.012, 0.05, 0.4))
    part = np.log(0.02 / 0.012) / np.log(0.05 / 0.012)
    assert found.why == "own" and found.flags == ()
    assert found.breaks_at == pytest.approx(10 ** (1 + part), rel=0.03)


def test_missing_answers_and_failures_break():
    rows = [row(v, s, 0.01, 0.1, valid=0.3 if v == 3 else 1.0) for v in (1, 2, 3) for s in (0, 1)]
    found = stability(courses(rows)[0])
    assert found.why == "no answer" and found.breaks_at > 2
    rows = [row(v, s, 0.01, 0.1, status="failed" if v > 1 else "ok")
            for v in (1, 2, 3) for s in (0, 1)]  # fmt: skip
    found = stability(courses(rows)[0])
    assert found.share < 1 and "fails" in found.flags
    assert courses(rows)[0].failures == ("it raised",)


def test_one_crash_among_three_seeds_is_no_error_of_the_method():
    rows = [row(v, s, 0.01, 0.1, status="crashed" if (v, s) == (2, 1) else "ok")
            for v in (1, 2, 3) for s in (0, 1, 2)]  # fmt: skip
    course = courses(rows)[0]
    assert course.valid[1].tolist() == [1, 0, 1] and np.isfinite(course.input_m).sum() == 8
    found = stability(course)
    assert found.breaks_at is None and found.high is None and found.low is None
    assert found.flags == ("fails",)


def test_a_course_that_is_not_all_run_says_so():
    """One of three seeds is there at the hard end, and no value is taken for broken or held."""
    rows = [row(v, s, 0.01, 0.1, status="missing" if v > 2 and s else "ok")
            for v in (1, 2, 3, 4) for s in (0, 1, 2)]  # fmt: skip
    found = stability(courses(rows)[0])
    assert found.breaks_at is None and found.flags == ("unfinished",)
    assert found.seeds == 3 and np.isnan(found.low), "the one whole seed tells no spread"


def test_the_input_of_a_crashed_point_is_that_of_other_methods():
    rows = [row(v, 0, 0.01, 0.1 * v, label=m, status="failed" if m == "b" and v == 2 else "ok")
            for v in (1, 2, 3) for m in ("a", "b")]  # fmt: skip
    assert courses(rows)[1].input_m[:, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])


def test_a_sensor_that_does_not_suit_breaks_a_method_there_and_keeps_it_on_the_chart():
    rows = [row(v, s, 0.01, 0.1, label=m, status="unsuited" if m == "b" and v > 1 else "ok")
            for v in (1, 2, 3) for s in (0, 1) for m in ("a", "b")]  # fmt: skip
    rows += [row(v, s, 0.01, 0.1, label="c", status="unsuited") for v in (1, 2, 3) for s in (0, 1)]
    found = {c.label: stability(c) for c in courses(rows)}
    assert list(found) == ["a", "b"], "what suits nowhere has no course"
    assert found["b"].why == "no answer" and found["b"].share < 1
    assert courses(rows)[1].values.tolist() == [1, 2, 3]


def test_a_millimetre_lost_on_a_perfect_input_is_no_instability():
    assert told((0.0004, 0.0004, 0.1, 0.1), (0.0002, 0.0002, 0.1, 0.1)).flags == ()
    assert told((0.04, 0.04, 0.1, 0.1), (0.02, 0.02, 0.1, 0.1)).flags == ("unstable",)


def test_the_interval_of_a_place_covers_it_as_often_as_it_says():
    """Curves that double at 2.5 steps, on average, and seeds that scatter by a third of a step."""
    rng = np.random.default_rng(3)
    for seeds in (2, 3, 5):
        hits, tries = 0, 400
        for _ in range(tries):
            late = 2.5 + rng.normal(0, 0.33, seeds)
            error = 0.01 * 2.0 ** (np.arange(6)[:, None] - late + 1)
            error[0] = 0.01  # the own error of the easy end, the same for all
            ones = np.ones_like(error)
            none = np.full((6, seeds, 2), np.nan)
            values = np.arange(6.0) + 1
            course = Course("a", "m", values, error, 10 * ones, ones, error, none)
            found = stability(course)
            low, high = (7.0 if end is None else end for end in (found.low, found.high))
            middle = float(np.exp(np.interp(2.5, np.arange(6), np.log(values))))
            hits += low <= middle <= high
        # Standard error of a share of 0.95 of 400: 0.011.
        assert 0.91 <= hits / tries <= 0.985, (seeds, hits / tries)
    alone = Course("a", "m", *(part[:, :1] if np.ndim(part) > 1 else part for part in (
        values, error, 10 * ones, ones, error, none)))  # fmt: skip
    assert np.isnan(stability(alone).low), "one seed has no spread"


def test_what_was_not_run_yet_breaks_nothing():
    rows = [row(v, s, 0.01, 0.1) for v in (1, 2) for s in (0, 1)]
    rows += [row(3, s, 0.01, 0.1, status="missing") for s in (0, 1)]
    assert stability(courses(rows)[0]).breaks_at is None
    assert stability(courses(rows[:2])[0]).share == 0, "one value alone has no length"


def test_seeds_that_disagree_widen_the_interval():
    calm = (1, (0.01, 0.01, 0.01, 0.01))
    torn = ((2, (0.01, 0.05, 0.01, 0.04)), (4, (0.2, 0.2, 0.2, 0.2)), (8, (0.2, 0.2, 0.2, 0.2)))
    same = ((2, (0.01, 0.01, 0.01, 0.01)), *torn[1:])
    wide, narrow = (
        stability(courses([row(v, s, e, 0.1) for v, four in (calm, *rest)
                           for s, e in enumerate(four)])[0])
        for rest in (torn, same)
    )  # fmt: skip
    assert wide.low < wide.breaks_at < wide.high
    assert wide.high / wide.low > 2 > narrow.high / narrow.low == 1


def test_an_overconfident_sigma_is_flagged():
    assert told((0.01,) * 4, (0.1,) * 4, inside=(0.1, 0.2)).flags == ("overconfident",)
    assert told((0.01,) * 4, (0.1,) * 4, inside=(0.9, 1.0)).flags == ()
    assert np.isnan(told((0.01,) * 4, (0.1,) * 4, inside=(None, None)).inside_68)


def test_intervals_hold_what_they_promise():
    rng = np.random.default_rng(0)
    truth, sigma_m = Truth(np.full((300, 300), 2.0)), np.full((300, 300), 0.1)
    answer = DepthMap(2 + 0.1 * rng.standard_normal((300, 300)), sigma_m=sigma_m)
    for level in (0.5, 0.68, 0.95):
        # 90,000 draws: standard error below 0.0017.
        got = inside_interval(truth, level=level)(answer)
        assert got == pytest.approx(level, abs=0.006)
    assert np.isnan(inside_interval(truth)(DepthMap(answer.range_m)))
    with pytest.raises(ValueError, match="level must be a probability"):
        inside_interval(truth, level=1.0)


# All together


def test_a_suite_of_axes_runs_and_bad_methods_are_flagged(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "tests")
    (tmp_path / "small.toml").write_text(SUITE)
    plan = make_plan(load_suite(str(tmp_path / "small.toml")), tmp_path / "out")
    capture = read_capture(tmp_path / "out" / "captures" / f"{plan[-1].capture}.h5")
    assert capture.sensor.modulation.freqs_hz.tolist() == [40e6, 70e6]
    # The light is that of the true clock: 4 % more phase than the one that methods are told of.
    turn = 4 * np.pi * capture.truth.range_m / 299_792_458.0
    off = np.angle(capture.truth.direct * np.exp(-1j * turn * np.array([[[41.6e6]], [[72.8e6]]])))
    assert np.abs(off).max() < 1e-3
    run_points(plan, tmp_path / "out", Settings(1, 1, 60.0), lambda *_: None)
    rows = score(tmp_path / "out")
    assert all(r["status"] == "ok" and r["axis"] == "clock" for r in rows), rows[0]["error"]
    found = {s.label: s for s in map(stability, courses(rows))}
    # Noise-free, a clock that is 4 % fast reads 3 m as 3.12 m.
    assert courses(rows)[0].error_m[-1].mean() == pytest.approx(0.12, abs=0.02)
    assert found["test_stress:wild"].flags == ("unstable",)
    assert found["test_stress:boastful"].flags == ("overconfident",)
    assert found["crt:max_range_m=0"].flags == () and found["crt:max_range_m=0"].why == "own"
    page = report(tmp_path / "out").read_text(encoding="utf-8")
    assert "Where methods break" in page and 'id="axis-clock"' in page and "<sup>u</sup>" in page
    assert "by how much" not in page and "NaN" not in page
    assert "wild" in (tmp_path / "out" / "figures" / "axis-clock.svg").read_text()
    with (tmp_path / "out" / "stability.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["label"] for line in lines] == ["crt:max_range_m=0", "test_stress:wild",
                                                 "test_stress:boastful"]  # fmt: skip
    assert lines[1]["flags"] == "unstable"
    # Results of an older version name neither jobs nor batches.
    for row_ in rows:
        row_["machine"] = {k: v for k, v in row_["machine"].items() if k not in ("jobs", "batch")}
    (tmp_path / "out" / "results.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    assert "clock" in report(tmp_path / "out").read_text(encoding="utf-8")
    kept = json.loads((tmp_path / "out" / "stability.json").read_text())
    assert kept[0]["breaks_at"] == pytest.approx(float(lines[0]["breaks_at"]))


# The chart


def test_the_easiest_value_stands_on_the_left():
    for values in ((1.0, 2.0, 40.0), (40.0, 2.0, 1.0), (0.0, 1.0, 2.0)):
        errors = np.array([[0.01, 0.012], [0.02, 0.02], [0.3, np.inf]])
        svg = stress_svg(values, [Strain("mine", errors)], title="t", name="n")
        points = [float(x) for x in re.findall(r"translate\((\d+\.?\d*),", svg)]
        assert points[:3] == sorted(points[:3]), values
        assert len(points) >= 3 and f"mine at {values[0]:g}" in svg
    nothing = stress_svg((1.0, 2.0), [Strain("mine", np.full((2, 1), np.inf))], title="t", name="n")
    assert nothing.startswith("<svg")
