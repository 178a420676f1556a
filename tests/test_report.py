"""The report: ranks with known answers, bars and curves that equal the rows, nothing that runs."""

import base64
import csv
import hashlib
import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from toftools.bench.best import best_of_each, entries
from toftools.bench.calibration import calibration, held
from toftools.bench.choices import choices
from toftools.bench.figures import slug, write_csv
from toftools.bench.plan import Point, make_plan
from toftools.bench.platforms import platforms
from toftools.bench.report import report
from toftools.bench.results import result_path
from toftools.bench.rows import read_rows
from toftools.bench.score import LEVELS
from toftools.bench.suite import load_suite
from toftools.bench.summary import cheapest, ranked, standings
from toftools.bench.summary_table import summary_table
from toftools.metrics.interval import inside_interval
from toftools.metrics.spread import z_spread
from toftools.types import DepthMap, Truth
from toftools.viz.charts import Curve, pareto_svg
from toftools.viz.raster import SCALE, chart_png
from toftools.viz.reliability import Reliability, reliability_svg
from toftools.viz.stress import Strain, stress_svg

MACHINE = {"cpu": "Chip A", "cores": 4, "threads": 2, "system": "Linux x86_64", "jobs": 1,
           "batch": False}  # fmt: skip
SVG = "{http://www.w3.org/2000/svg}"


def row(method, mae_m, *, capture="a", group="g", ms=1.0, valid=1.0, status="ok", **more):
    """A row of results as the score stage writes it."""
    metrics = {"mae_m": mae_m, "input_mae_m": 0.2, "valid_share": valid}
    good = status == "ok"
    return {
        "suite": "s", "capture": capture, "capture_id": capture, "group": group, "method": method,
        "params": {}, "against": "truth", "metrics": metrics if good else {}, "status": status,
        "error": None if good else "it said no", "ms": ms if good else None, "ms_iqr": 0.2,
        "setup_s": 0.1, "first_call_s": 0.1, "peak_mb": 5.0, "machine": MACHINE,
        "versions": {"python": "3.11"}, **more,
    }  # fmt: skip


# Ranks


def test_ranks_tie_on_three_digits_and_what_is_missing_comes_after_all():
    errors = {"a": 0.3, "b": 0.10, "c": 0.10004, "d": np.nan, "e": 0.1006, "f": np.inf}
    assert ranked(errors) == {"a": 4, "b": 1, "c": 1, "d": 5, "e": 3, "f": 5}


def several():
    """Two groups: `late` misses a capture, `odd` suits one group only, `lazy` skips most pixels."""
    rows = []
    for capture, scale in (("a", 1.0), ("b", 3.0)):
        rows += [
            row("fast", 0.0105 * scale, capture=capture, ms=1.0),
            row("best", 0.0100 * scale, capture=capture, ms=5.0, params={"k": 1}),
            row("best", 0.0300 * scale, capture=capture, ms=0.5, params={"k": 2}),
            row("equal", 0.0100 * scale, capture=capture, ms=9.0),
            row("lazy", 0.0010 * scale, capture=capture, ms=0.1, valid=0.3),
            row("oracle_wrap", 0.0001, capture=capture, ms=None),
        ]
    rows += [row("late", 0.001, capture="a"), row("late", None, capture="b", status="timeout")]
    rows += [row("odd", None, capture=c, status="unsuited") for c in "ab"]
    rows += [row(m, e, capture="c", group="h", ms=2.0) for m, e in
             (("fast", 0.01), ("best", 0.02), ("equal", 0.03), ("odd", 0.04))]  # fmt: skip
    rows.append(row("fast", 0.001, capture="d", group="camera alone", against="camera"))
    return rows


def test_the_summary_of_rows_made_by_hand():
    found = {one.method: one for one in standings(several(), {})}
    assert {m: dict(one.ranks) for m, one in found.items()} == {
        "fast": {"g": 3, "h": 1}, "best": {"g": 1, "h": 2}, "equal": {"g": 1, "h": 3},
        "lazy": {"g": 4}, "late": {"g": 4}, "odd": {"h": 4},
    }  # fmt: skip
    assert list(found) == ["best", "fast", "equal", "lazy", "late", "odd"]
    assert found["best"].mean_rank == 1.5 and found["fast"].mean_rank == 2
    assert found["best"].chosen["g"].label == "best:k=1"
    assert found["best"].ms == 5.0, "median over the three captures of 5, 5 and 2"
    assert (found["late"].answered, found["late"].captures) == (1, 2)
    assert (found["lazy"].answered, found["lazy"].captures) == (0, 2)
    assert found["lazy"].valid_share == pytest.approx(0.3)


def test_rungs_of_ladders_have_no_rank():
    rows = [row("a", 0.01), row("b", 0.02), {**row("rung", 0.001), "ladders": ["bounces"]}]
    assert [one.method for one in standings(rows, {})] == ["a", "b"]
    assert [one.best for one in cheapest(rows)] == [one.best for one in cheapest(rows[:2])]


def test_the_cheapest_within_a_tenth_answers_everything():
    found = {one.group: one for one in cheapest(several())}
    # best errs 0.02 on average, fast 0.021 at a fifth of the time; lazy and late leave something.
    assert found["g"].best.label == "best:k=1" and found["g"].cheapest.label == "fast"
    assert found["h"].best.label == found["h"].cheapest.label == "fast"
    slower = [r | {"metrics": {**r["metrics"], "mae_m": 1.06 * r["metrics"]["mae_m"]}}
              if r["method"] == "fast" else r for r in several()]  # fmt: skip
    assert cheapest(slower)[0].cheapest.label == "best:k=1", "0.0223 is more than a tenth above"


def test_a_setting_that_answers_more_stands_before_one_that_errs_less():
    rows = [row("m", 0.001, capture="a", params={"k": 1}), row("n", 0.1, capture="b")]
    rows += [row("m", 0.2, capture=c, params={"k": 2}) for c in "ab"]
    assert best_of_each(entries(rows))["m"].label == "m:k=2"


def test_axes_are_ranked_by_what_is_survived():
    rows = [row(m, 0.01, params=p, axis="x", value=1.0, seed=0)
            for m, p in (("m", {"k": 1}), ("m", {"k": 2}), ("n", {}), ("o", {}),
                         ("oracle_wrap", {}))]  # fmt: skip
    shares = {"m:k=1": [0.2, 0.4], "m:k=2": [0.5, 0.7], "n": [0.6, 0.60004], "o": [None, 0.1],
              "oracle_wrap": [1.0, 1.0]}  # fmt: skip
    found = {one.method: one for one in standings(rows, shares)}
    assert {m: one.stress_rank for m, one in found.items()} == {"m": 1, "n": 1, "o": 3}
    assert found["m"].stress_setting == "m:k=2" and found["o"].axes == 1
    table = summary_table(list(found.values()), [])
    assert table["head"] == ["method", "axes survived %", "rank on axes"]
    assert [[c["text"] for c in line] for line in table["rows"]] == [
        ["m", "60.0", "1"], ["n", "60.0", "1"], ["o", "10.0", "3"],
    ]  # fmt: skip


def test_marks_of_the_table():
    table = summary_table(standings(several(), {}), cheapest(several()))
    cells = {line[0]["text"]: line for line in table["rows"]}
    assert [c["win"] for c in cells["best"]] == [False, True, False, True, False, False, False]
    assert cells["late"][1]["small"] == "incomplete" and cells["odd"][1]["text"] == "–"
    assert cells["odd"][3]["small"] == "in 1 of 2"
    assert table["cheapest"]["rows"][0][-1] == "5.0"


# Sigma


def gaussian(wide=1.0):
    rng = np.random.default_rng(0)
    truth, sigma_m = Truth(np.full((300, 300), 2.0)), np.full((300, 300), 0.1)
    return truth, DepthMap(2 + wide * sigma_m * rng.standard_normal((300, 300)), sigma_m=sigma_m)


@pytest.mark.parametrize("wide", [0.5, 1.0, 2.0])
def test_spread_of_a_known_gaussian(wide):
    truth, answer = gaussian(wide)
    # 90,000 draws: standard errors 0.0024 of the rms and 0.004 of the median, relative.
    assert z_spread(truth)(answer) == pytest.approx((wide, wide), rel=0.015)
    assert {0.5, 0.68, 0.8, 0.9, 0.95, 0.99} <= set(LEVELS)
    held_ = {level: inside_interval(truth, level=level)(answer) for level in LEVELS}
    off = [share - level for level, share in held_.items()]
    if wide == 1:
        assert np.abs(off).max() < 0.006
    else:
        assert (np.sign(off) == (1 if wide < 1 else -1)).all()


def test_wrong_turns_carry_the_rms_and_not_the_median():
    truth, answer = gaussian()
    wrong = answer.range_m.copy()
    wrong[:3] += 2.0  # one pixel in a hundred, 20 sigma off
    rms, robust = z_spread(truth)(DepthMap(wrong, sigma_m=answer.sigma_m))
    assert rms == pytest.approx(np.sqrt(1 + 0.01 * 400), rel=0.03)
    assert robust == pytest.approx(1, abs=0.03)
    assert np.isnan(z_spread(truth)(DepthMap(wrong))).all()


def test_a_sigma_of_zero_is_right_where_there_is_no_error():
    truth = Truth(np.full((1, 2), 1.0))
    exact = DepthMap(np.full((1, 2), 1.0), sigma_m=np.zeros((1, 2)))
    assert z_spread(truth)(exact) == (0, 0)
    off = DepthMap(np.array([[1.0, 1.1]]), sigma_m=np.zeros((1, 2)))
    assert z_spread(truth)(off)[0] == np.inf


def sigmas():
    told = ({"50": 0.4, "95": 0.9}, {"50": 0.2, "95": None})
    return [
        row("m", 0.01, capture=c, intervals=t, z={"rms": rms, "robust": 1.0})
        for c, t, rms in zip("ab", told, (1.0, 3.0), strict=True)
    ] + [row("no_sigma", 0.01, capture=c, intervals={"50": None, "95": None}) for c in "ab"]


def test_calibration_of_a_group_is_the_mean_over_captures(tmp_path):
    (tmp_path / "figures").mkdir()
    shares, rms, robust = held(sigmas())["m"]
    assert shares == {0.5: pytest.approx(0.3), 0.95: 0.9} and (rms, robust) == (2, 1)
    assert list(held(sigmas())) == ["m"]
    made = calibration(tmp_path, sigmas(), title="g", stem="c")
    assert made["table"]["rows"] == [["m", "30.0", "90.0", "2.00", "1.00"]]
    with (tmp_path / "figures" / "c.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(float(x["promised"]), float(x["held"])) for x in lines] == [
        (0.5, pytest.approx(0.3)), (0.95, 0.9)
    ]  # fmt: skip
    assert calibration(tmp_path, sigmas()[2:], title="g", stem="none") == {}
    old = [r | {"z": None, "intervals": {"68": 0.5, "95": 0.9}} for r in sigmas()[:2]]
    assert held(old)["m"][0] == {0.68: 0.5, 0.95: 0.9}


def test_an_honest_sigma_lies_on_the_diagonal_of_the_chart():
    levels = [0.1, 0.5, 0.9]
    svg = reliability_svg([Reliability("m", levels, levels)], title="t")
    marks = re.findall(r'<g data-series="m" transform="translate\(([\d.]+),([\d.]+)\)', svg)
    line = re.search(r'class="honest" d="M([\d.]+),([\d.]+)L([\d.]+),([\d.]+)"', svg)
    x0, y0, x1, y1 = map(float, line.groups())
    for x, y in marks:
        assert float(y) == pytest.approx(y0 + (float(x) - x0) * (y1 - y0) / (x1 - x0), abs=0.2)
    assert len(marks) == 3 and "Nothing to chart" in reliability_svg([], title="t")
    with pytest.raises(ValueError, match="1 shares for 3 levels"):
        reliability_svg([Reliability("m", levels, [0.1])], title="t")


# Models


def test_shares_of_models_are_those_of_the_answered_pixels(tmp_path):
    (tmp_path / "runs").mkdir()
    mine = row("auto", 0.01)
    answer = result_path(tmp_path, Point("a", "auto", {})).with_suffix(".npz")
    range_m = np.array([[1.0, 1.0, np.nan, 1.0]])
    np.savez(answer, range_m=range_m, model=np.array([[0, 1, 1, 0]]),
             models=np.array(["plain", "two"]))  # fmt: skip
    found = choices(tmp_path, [mine, row("crt", 0.01)])
    assert found["rows"] == [["auto", "a", "66.7 %", "33.3 %"]]
    assert [line["share"] for line in found["table"]] == pytest.approx([2 / 3, 1 / 3])
    assert choices(tmp_path, [row("crt", 0.01)]) == {}


# Pictures


def bars(svg):
    found = [p.get("d") for p in ElementTree.fromstring(svg).iter(f"{SVG}path")
             if p.get("class") == "bars"]  # fmt: skip
    return [tuple(map(float, end)) for d in found
            for end in re.findall(r"M([\d.]+),([\d.]+)L([\d.]+),([\d.]+)", d)]  # fmt: skip


def test_error_bars_stand_on_their_points():
    curve = Curve("m", [10.0], [0.02], ["k=1"], spread_m=[(0.01, 0.04)], iqr_ms=[4.0])
    svg = pareto_svg([curve], title="t")
    x, y = map(float, re.search(r"<g .*translate\(([\d.]+),([\d.]+)\)", svg).groups())
    upright, level = bars(svg)
    assert upright[0] == upright[2] == x and level[1] == level[3] == y
    # On logarithms a half and a double are as far from the point.
    assert upright[1] - y == pytest.approx(y - upright[3], abs=0.2) and upright[1] > y
    assert level[0] < x < level[2]
    assert "m k=1: 10 ms, 2 cm; middle half of the captures 1 cm to 4 cm" in svg
    assert bars(pareto_svg([Curve("m", [10.0], [0.02])], title="t")) == []
    with pytest.raises(ValueError, match="2 bars for 1 points"):
        pareto_svg([Curve("m", [10.0], [0.02], iqr_ms=[1.0, 2.0])], title="t")


def test_bars_of_an_axis_reach_from_the_best_seed_to_the_worst():
    svg = stress_svg((1.0, 2.0), [Strain("m", np.array([[0.1, 0.4], [0.2, 0.2]]))], title="t",
                     name="n")  # fmt: skip
    first, second = bars(svg)
    assert first[1] - first[3] > 50 and second[1] == second[3]


def test_the_png_of_a_chart_shows_its_marks_where_the_svg_has_them():
    svg = pareto_svg([Curve("m", [1.0, 8.0], [0.05, 0.02]), Curve("n", [3.0], [0.09])], title="t")
    image = np.asarray(Image.open(io.BytesIO(chart_png(svg))).convert("RGB")).astype(int)
    assert image.shape == (560 * SCALE, 960 * SCALE, 3)
    marks = re.findall(r'data-series="(.)" transform="translate\(([\d.]+),([\d.]+)\)', svg)
    colour = {"m": (0x00, 0x72, 0xB2), "n": (0xD5, 0x5E, 0x00)}
    assert len(marks) == 3
    for name, x, y in marks:
        got = image[round(SCALE * float(y)), round(SCALE * float(x))]
        assert np.abs(got - colour[name]).max() < 12, (name, got)
    assert (image[100:900] < 128).any(), "the words"


OUTER = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">{}</svg>'


@pytest.mark.parametrize(
    "text",
    ["no svg", "<svg/>", OUTER.format("<image/>"), OUTER.format('<path d="M0,0C1,1 2,2 3,3"/>')],
)
def test_what_is_no_chart_of_ours_is_refused(text):
    with pytest.raises(ValueError, match="no chart of this package"):
        chart_png(text)


# Platforms, names, tables


def test_one_machine_is_one_sentence_and_several_say_who_ran_where():
    assert platforms([row("m", 0.1), row("n", 0.1)]) == [
        "Times: Chip A, 2 of 4 cores, Linux x86_64; python 3.11."
    ]
    other = {**MACHINE, "cpu": "Chip B", "jobs": 3}
    told = platforms([row("m", 0.1), row("n", 0.1, machine=other), row("m", 0.1)])
    assert len(told) == 2 and "2 machines" in told[0] and told[0].endswith("for m.")
    assert "Chip B" in told[1] and "busy machine" in told[1] and told[1].endswith("for n.")
    assert platforms([row("oracle_wrap", 0.1, ms=None)]) == []


def test_slugs_are_no_paths_and_tell_names_apart():
    names = ["a b", "a-b", "a/b", "../../x", "..", "ä", "a" * 300, "a" * 301, "<script>", "a  b"]
    made = [slug(name) for name in names]
    assert len(set(made)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]{1,80}", one) for one in made)
    assert slug("indirect light") == "indirect-light"


def test_tables_leave_what_is_missing_empty(tmp_path):
    write_csv(tmp_path / "t.csv", [{"a": 0.1, "b": np.nan}, {"a": None, "b": 'say "x", y'}])
    assert (tmp_path / "t.csv").read_text() == 'a,b\n0.1,\n,"say ""x"", y"\n'


# Whole reports


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A benchmark folder with two captures and no results yet, and the ids of the captures."""
    # Maps and clouds have tests of their own, and take most of the time of a report.
    monkeypatch.setattr("toftools.bench.report.capture_pictures", lambda *_: {})
    (tmp_path / "s.toml").write_text(
        'name = "s"\nmethods = ["crt"]\nsensor = "opt8241:width=12,height=9"\n'
        'scenes = ["wall:range=2", "two_returns:range=2"]\n'
    )
    out = tmp_path / "three" / "folders" / "deep"
    make_plan(load_suite(str(tmp_path / "s.toml")), out)
    items = json.loads((out / "plan.json").read_text())["captures"]
    return out, [item["id"] for item in items]


def store(out, rows):
    (out / "results.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))


def usual(ids):
    """Rows of a plain group and of an axis, with all that a scored row has."""
    more = {
        "intervals": {"68": 0.6, "95": 0.9},
        "z": {"rms": 1.2, "robust": 1.1},
        "pixels": {"all": 108},
        "coverage": {"coverage": [0.5, 1.0], "mae_m": [0.01, 0.02]},
    }
    settings = (("m", 0.01, 3.0), ("n", 0.02, 1.0))
    rows = [row(m, e * (1 + i), capture=c, ms=ms, **more)
            for i, c in enumerate(ids) for m, e, ms in settings]  # fmt: skip
    rows += [row(m, 0.01 * v, capture=ids[0], axis="light", value=v, seed=s, **more)
             for m in ("m", "n") for v in (1.0, 2.0, 40.0) for s in (0, 1)]  # fmt: skip
    return rows


def test_every_chart_is_there_as_svg_png_and_csv_and_the_figures_are_those_of_the_rows(folder):
    out, ids = folder
    store(out, usual(ids))
    page = report(out).read_text(encoding="utf-8")
    stems = ("pareto-g", "coverage-g", "calibration-g", "axis-light")
    for stem in stems:
        svg = (out / "figures" / f"{stem}.svg").read_text(encoding="utf-8")
        assert svg in page
        ElementTree.fromstring(svg)
        Image.open(out / "figures" / f"{stem}.png").verify()
    assert len(bars((out / "figures" / "pareto-g.svg").read_text())) == 4

    def lines(path):
        with (out / path).open(encoding="utf-8") as file:
            return list(csv.DictReader(file))

    timed = {line["setting"]: line for line in lines("figures/pareto-g.csv")}
    assert float(timed["m"]["mae_m"]) == pytest.approx(0.015)
    assert float(timed["m"]["mae_q25_m"]) == pytest.approx(0.0125)
    assert float(timed["m"]["ms"]) == 3 and float(timed["m"]["ms_iqr"]) == pytest.approx(0.2)
    points = lines("figures/axis-light.csv")
    assert [
        (p["setting"], float(p["value"]), int(p["seed"]), float(p["mae_m"])) for p in points
    ] == [
        (r["method"], r["value"], r["seed"], r["metrics"]["mae_m"])
        for r in usual(ids)
        if "axis" in r
    ]
    assert [(p["setting"], float(p["coverage"]), float(p["mae_m"]))
            for p in lines("figures/coverage-g.csv")] == [
        ("m", 0.5, 0.01), ("m", 1.0, 0.02), ("n", 0.5, 0.01), ("n", 1.0, 0.02)]  # fmt: skip
    summary = {line["method"]: line for line in lines("summary.csv")}
    assert summary["m"]["rank: g"] == "1" and summary["n"]["rank: g"] == "2"
    assert lines("cheapest.csv")[0]["best"] == "m"


def test_no_two_places_of_the_page_share_an_address(folder):
    out, ids = folder
    store(out, usual(ids))
    page = report(out).read_text(encoding="utf-8")
    addresses = re.findall(r' id="([^"]+)"', page)
    assert len(addresses) == len(set(addresses)) > 3
    assert {a for a in re.findall(r'href="#([^"]+)"', page)} <= set(addresses)


def test_the_page_loads_nothing_and_runs_its_own_script_only(folder):
    out, ids = folder
    store(out, usual(ids))
    page = report(out).read_text(encoding="utf-8")
    assert not re.search(r"https?://", page.replace("http://www.w3.org/2000/svg", ""))
    assert not re.search(
        r"<(link|iframe|object|embed|base)\b|@import|url\(|\bsrc=\"(?!data:)", page
    )
    assert not re.search(r"\son[a-z]+\s*=", page), "an inline event handler"
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(scripts) == page.count("<script") == 1
    risky = r"\beval\b|Function\(|innerHTML|insertAdjacent|document\.write|fetch\(|XMLHttp"
    assert not re.search(risky, scripts[0])
    mark = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{mark}'" in page and "default-src 'none'" in page
    assert 'data-pin="m"' in page and 'id="axis-light"' in page and "Chip A" in page


EVIL = '"><script>alert(1)</script><img src=x onerror=alert(2)> $\\bad{$ 漢'


def test_names_and_errors_are_shown_and_never_run_and_never_a_path(folder, tmp_path):
    out, ids = folder
    rows = usual(ids)
    for one in rows:
        one["method"] = one["method"] + EVIL
        one["suite"], one["capture"] = EVIL, f"c{EVIL}"
        one["machine"] = {**MACHINE, "cpu": EVIL}
        if "axis" in one:
            one["axis"] = f"../../axis{EVIL}"
        else:
            one["group"] = f"../../../x{EVIL}\x1b[31m\ud800"
    rows.append(row(f"bad{EVIL}", None, capture=ids[0], group=rows[0]["group"], status="crashed",
                    error=f"died {EVIL}"))  # fmt: skip
    rows.append(row(f"none{EVIL}", None, capture=ids[0], group=rows[0]["group"],
                    status="unsuited", error=EVIL, params={EVIL: EVIL}))  # fmt: skip
    before = {path for path in tmp_path.rglob("*") if out not in path.parents}
    store(out, rows)
    plan = json.loads((out / "plan.json").read_text())
    plan["axes"] = {f"../../axis{EVIL}": f"about {EVIL}"}
    (out / "plan.json").write_text(json.dumps(plan))
    page = report(out).read_text(encoding="utf-8")
    assert page.count("<script") == 1 and "<img src=x" not in page and "alert(1)" in page
    for svg in (out / "figures").glob("*.svg"):
        tags = {e.tag.removeprefix(SVG) for e in ElementTree.parse(svg).iter()}
        assert tags <= {"svg", "title", "rect", "path", "text", "g", "circle"}, svg
    assert {path for path in tmp_path.rglob("*") if out not in path.parents} == before
    assert all(path.parent == out / "figures" for path in (out / "figures").rglob("*"))
    assert len(list((out / "figures").glob("pareto-*.svg"))) == 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("[1, 2]", "the line is \\[1, 2\\], wanted an object"),
        ("{", "line 2 of .* is damaged: Expecting"),
        ('{"a": ' * 100_000, "line 2 of .* is damaged"),
        ({"metrics": {"mae_m": 1e308}}, "metrics mae_m is 1e\\+308, wanted a finite number"),
        ({"metrics": {"mae_m": -0.1}}, "metrics mae_m is -0.1, wanted no negative number"),
        ({"ms": -1}, "ms is -1, wanted no negative number"),
        ({"metrics": {"mae_m": "0.1"}}, "metrics mae_m is '0.1', wanted a finite number or null"),
        ({"metrics": {"mae_m": 10**400}}, "wanted a finite number or null"),
        ({"metrics": None}, "metrics is None, wanted an object of numbers"),
        ({"metrics": {"mae_m": True}}, "metrics mae_m is True"),
        ({"method": 3}, "method is 3, wanted a text"),
        ({"method": ""}, "method is ''"),
        ({"method": "m" * 100_000}, "method is 'mmm.*wanted a text of 1 to 1000 letters"),
        ({"group": None}, "group is None"),
        ({"capture_id": "../../../etc/passwd"}, "capture_id is '../../../etc/passwd', wanted lett"),
        ({"capture_id": ".hidden"}, "capture_id is '.hidden'"),
        ({"params": [1]}, "params is \\[1\\], wanted an object"),
        ({"params": {"k": {"deep": 1}}}, "parameter k is"),
        ({"against": "moon"}, "against is 'moon', wanted one of truth, camera, nothing"),
        ({"error": 7}, "error is 7, wanted a text or null"),
        ({"ms": "fast"}, "ms is 'fast'"),
        ({"machine": "box"}, "machine is 'box'"),
        ({"machine": {"cpu": ["x"]}}, "machine cpu is"),
        ({"coverage": {"coverage": [1.0], "mae_m": []}}, "two lists of one length"),
        ({"coverage": [1]}, "coverage is \\[1\\], wanted an object"),
        ({"intervals": {"68": "most"}}, "intervals 68 is 'most'"),
        ({"axis": "x"}, "value is None, wanted a number, since the row has an axis"),
        ({"axis": 3, "value": 1, "seed": 0}, "axis is 3"),
    ],
)  # fmt: skip
def test_a_damaged_line_is_one_sentence_with_its_number(tmp_path, change, told):
    line = change if isinstance(change, str) else json.dumps(row("m", 0.1) | change)
    (tmp_path / "results.jsonl").write_text(json.dumps(row("m", 0.1)) + "\n" + line + "\n")
    with pytest.raises(ValueError, match=told) as caught:
        read_rows(tmp_path)
    assert "line 2 of" in str(caught.value) and "toftools bench score" in str(caught.value)
    assert len(str(caught.value)) < 700 and "\n" not in str(caught.value)


def test_text_that_is_no_text_is_refused_and_long_errors_are_cut(tmp_path):
    (tmp_path / "results.jsonl").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="is damaged"):
        read_rows(tmp_path)
    store(tmp_path, [row("m\tn", None, status="failed", error="x\x1b[31m" * 10_000)])
    (found,) = read_rows(tmp_path)
    assert found["method"] == "m n" and len(found["error"]) == 2000
    assert found["error"].isprintable()
    store(tmp_path, [row("m", float("nan"), ms=float("inf"))])
    (found,) = read_rows(tmp_path)
    assert found["metrics"]["mae_m"] is None and found["ms"] is None


def test_rows_of_an_older_version_make_a_report(folder):
    out, ids = folder
    rows = [{k: v for k, v in r.items() if k not in ("machine", "versions", "ms_iqr", "intervals",
                                                     "coverage", "z", "pixels")}
            for r in usual(ids)]  # fmt: skip
    store(out, rows)
    page = report(out).read_text(encoding="utf-8")
    assert "Summary" in page and "Calibration of sigma" not in page


# In a browser

DRIVER = """
const svg = document.querySelector('figure.chart svg'), told = {};
const state = () => [...new Set([...svg.querySelectorAll('.lit')].map((e) => e.dataset.series))];
const send = (e, kind, more) => e.dispatchEvent(
  new PointerEvent(kind, { bubbles: true, pointerType: 'mouse', ...more }));
const label = svg.querySelector('.label[data-series=m]');
send(svg.querySelector('g[data-series=n]'), 'pointerover');
told.hover = state();
told.tip = document.querySelector('.tip').textContent;
send(svg, 'pointerleave');
told.left = [state(), document.querySelector('.tip').hidden];
label.dispatchEvent(new MouseEvent('click', { bubbles: true }));
told.pinned = [state(), label.getAttribute('aria-pressed'), svg.classList.contains('dim')];
label.dispatchEvent(new KeyboardEvent('keydown', { key: 'Enter', bubbles: true }));
told.unpinned = state();
label.focus();
label.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight', bubbles: true }));
told.next = document.activeElement.dataset.series;
document.querySelector('a[data-pin=n]').click();
told.matrix = [location.hash, state()];
const table = document.querySelector('.summary table');
const order = () => [...table.tBodies[0].rows].map((r) => r.cells[0].textContent);
const at = [...table.tHead.rows[0].cells].findIndex((h) => h.textContent === 'ms');
told.before = order();
table.tHead.rows[0].cells[at].querySelector('button').click();
told.after = [order(), table.tHead.rows[0].cells[at].getAttribute('aria-sort')];
document.title = 'TOLD' + JSON.stringify(told) + 'END';
"""


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium here")
def test_charts_and_tables_answer_in_a_browser(folder):
    out, ids = folder
    store(out, usual(ids))
    page = report(out).read_text(encoding="utf-8")
    # The page allows no script but its own: the copy that is driven has no such rule.
    page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    driven = Path(out) / "driven.html"
    driven.write_text(page.replace("</body>", f"<script>{DRIVER}</script></body>"))
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom",
               f"--user-data-dir={out / 'profile'}", driven.as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"<title>TOLD(.*)END</title>", done.stdout)
    assert found, done.stderr[-500:]
    told = json.loads(found[1].replace("&gt;", ">").replace("&amp;", "&"))
    assert told["hover"] == ["n"] and told["tip"].startswith("n at ")
    assert told["left"] == [[], True]
    assert told["pinned"] == [["m"], "true", True] and told["unpinned"] == []
    assert told["next"] == "n"
    assert told["matrix"] == ["#axis-light", ["n"]]
    assert told["before"] == ["m", "n"] and told["after"] == [["n", "m"], "ascending"]
