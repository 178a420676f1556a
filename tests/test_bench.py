"""The benchmark end to end: stages meet in files, failures are data, a kill loses nothing."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toftools.bench.methods import points
from toftools.bench.plan import Point, make_plan, read_plan
from toftools.bench.references import oracle_wrap, reported
from toftools.bench.render import markdown_table, text_table
from toftools.bench.run import Settings, is_finished, only_run, read_result, run_points
from toftools.bench.score import read_rows, reference_of, score, uncorrected
from toftools.bench.suite import built_in, load_suite
from toftools.bench.table import groups, label_of, summarise, unsuited
from toftools.io.native import read_capture, write_capture
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Capture, DepthMap, Scene, Shot

SUITE = """
name = "tiny"
sensor = "opt8241:width=24,height=18"
scenes = ["wall:range=2", "two_returns:range=2,extra=0.9,ratio=0.3"]
methods = [
    "single", "crt", "{module}:fails", "{module}:dies", "{module}:sleeps",
    "{module}:wants_three", "oracle_wrap:freq_index=1", "reported",
]
repeats = 3
[grid.single]
freq_index = [0, 1]
[grid.crt]
max_range_m = [5.0, 0.0]
"""

SETTINGS = Settings(repeats=3, threads=1, timeout_s=10.0)

METHODS = """
import os, time
from toftools.types import DepthMap

def fails(sensor):
    def run(phasors):
        raise ZeroDivisionError("planted")
    return run

def dies(sensor):
    return lambda phasors: os.kill(os.getpid(), 9)

def sleeps(sensor):
    return lambda phasors: time.sleep(60)

def wants_three(sensor):
    if sensor.modulation.n_freqs != 3:
        raise ValueError("got 2 frequencies, wanted 3")
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A benchmark folder with the tiny suite run once, and the log of every point's status."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "planted.py").write_text(METHODS)
    (folder / "tiny.toml").write_text(SUITE.format(module="planted"))
    old = Path.cwd()
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    try:
        suite = load_suite("tiny.toml")
        out = folder / "out"
        plan = make_plan(suite, out)
        log = []
        bad = run_points(plan, out, SETTINGS, lambda p, s: log.append((p.method, s)))
        rows = score(out)
        yield out, plan, log, bad, rows
    finally:
        os.chdir(old)
        sys.path.remove(str(folder))


def test_every_point_has_a_row_and_failures_are_recorded(finished):
    _, plan, log, bad, rows = finished
    assert len(rows) == len(plan) == len(log) == 2 * 9  # nothing is reported for scenes
    status = {label_of(row): row["status"] for row in rows}
    assert status == {
        "single:freq_index=0": "ok", "single:freq_index=1": "ok",
        "crt:max_range_m=5.0": "ok", "crt:max_range_m=0.0": "ok",
        "planted:fails": "failed", "planted:dies": "crashed", "planted:sleeps": "timeout",
        "planted:wants_three": "unsuited", "oracle_wrap:freq_index=1": "ok",
    }  # fmt: skip
    assert bad == 6
    why = {row["method"]: row["error"] for row in rows if row["status"] != "ok"}
    assert why["planted:fails"] == "ZeroDivisionError: planted"
    assert why["planted:wants_three"] == "got 2 frequencies, wanted 3"
    assert "no answer within 10 s" in why["planted:sleeps"]
    assert "exit code -9" in why["planted:dies"]


def test_rows_keep_the_contract(finished):
    out, _, _, _, rows = finished
    on_disk = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert len(on_disk) == len(rows)
    for row in on_disk:
        for key in ("suite", "capture", "method", "params", "status", "metrics"):
            assert key in row
    good = next(r for r in on_disk if r["method"] == "crt")
    for name in ("bias_m", "mae_m", "rmse_m", "median_m", "p25_m", "p75_m", "p95_m",
                 "valid_share", "wrap_share", "input_mae_m", "corners.mae_m",
                 "corners.input_mae_m"):  # fmt: skip
        assert name in good["metrics"], name
    for name in ("setup_s", "first_call_s", "ms", "ms_iqr", "peak_mb"):
        assert good[name] >= 0
    assert good["machine"]["threads"] == 1
    reference = next(r for r in on_disk if r["method"] == "oracle_wrap")
    assert reference["ms"] is None


def test_scores_are_those_of_the_physics(finished):
    _, _, _, _, rows = finished
    by = {(r["capture"], label_of(r)): r["metrics"] for r in rows}
    wall, two = sorted({r["capture"] for r in rows}, reverse=True)
    noise = by[wall, "crt:max_range_m=0.0"]["rmse_m"]
    assert 0 < noise < 0.02
    assert by[wall, "crt:max_range_m=0.0"]["wrap_share"] == 0
    assert by[two, "crt:max_range_m=0.0"]["mae_m"] > 5 * noise
    # The worker runs one thread, the scorer all: chunks are vectorised differently, and the last
    # bit of a float32 range may differ.
    mine = by[two, "crt:max_range_m=0.0"]
    assert mine["input_mae_m"] == pytest.approx(mine["mae_m"], rel=1e-6)


def test_a_second_run_keeps_what_is_finished_and_retries_the_rest(finished):
    out, plan, _, _, _ = finished
    log = []
    quick = [p for p in plan if "sleeps" not in p.method]
    run_points(quick, out, SETTINGS, lambda p, s: log.append((p.method, s)))
    kept = {method for method, status in log if status == "kept"}
    assert kept == {"single", "crt", "oracle_wrap", "planted:wants_three"}
    assert {s for m, s in log if m == "planted:fails"} == {"failed"}


def test_a_damaged_result_is_run_again(finished):
    out, plan, _, _, _ = finished
    point = next(p for p in plan if p.method == "single")
    path = out / "runs" / f"{point.key}.json"
    whole = path.read_text()
    path.write_text(whole[:20])
    assert not is_finished(out, point, SETTINGS.fingerprint(point))
    run_points([point], out, SETTINGS, lambda *_: None)
    assert read_result(out, point)["status"] == "ok"


def result_files(out):
    return {path.name: path.stat().st_mtime_ns for path in (out / "runs").glob("*.json")}


def wait_until(condition, process):
    deadline = time.monotonic() + 120
    while not condition() and time.monotonic() < deadline:
        assert process.poll() is None, "the run ended before it could be killed"
        time.sleep(0.02)
    assert condition()


def test_kill_nine_of_the_run_alone_loses_no_finished_point_and_leaves_no_worker(tmp_path):
    suite = tmp_path / "kill.toml"
    suite.write_text(
        'name = "kill"\nsensor = "opt8241:width=16,height=12"\nscenes = ["wall:range=2"]\n'
        'methods = ["single", "crt", "slow:make"]\nrepeats = 3\n'
    )
    (tmp_path / "slow.py").write_text(
        "import os, time\nfrom pathlib import Path\n"
        "def make(sensor):\n"
        "    Path('worker.pid').write_text(str(os.getpid()))\n"
        "    return lambda phasors: time.sleep(300)\n"
    )
    out = tmp_path / "out"
    command = [sys.executable, "-m", "toftools", "bench", "run", str(suite), "--out", str(out)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    process = subprocess.Popen(command, **quiet)
    pid_file = tmp_path / "worker.pid"
    wait_until(lambda: pid_file.exists() and pid_file.read_text(), process)
    before = result_files(out)
    process.send_signal(signal.SIGKILL)  # the parent alone: no process group, no clean-up
    process.wait()
    worker = Path(f"/proc/{pid_file.read_text()}")
    for _ in range(500):
        if not worker.exists():
            break
        time.sleep(0.02)
    assert not worker.exists(), "the worker outlived its benchmark"
    assert result_files(out) == before
    _, plan = read_plan(out)
    settings = Settings(repeats=3, threads=os.cpu_count() or 1, timeout_s=900)
    done = [p for p in plan if is_finished(out, p, settings.fingerprint(p))]
    assert {p.method for p in done} == {"single", "crt"}
    (tmp_path / "slow.py").write_text("def make(sensor):\n    raise ValueError('not today')\n")
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    after = result_files(out)
    assert {name: after[name] for name in before} == before, "a finished point was run again"
    assert len(after) == len(plan)
    leftovers = [p for p in out.rglob(".*") if p.name != ".lock" and p.suffix == ".json"]
    assert leftovers == []


def test_an_edited_method_other_threads_or_other_repeats_are_run_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = tmp_path / "edited_method.py"
    code = (
        "from toftools.types import DepthMap\nimport numpy as np\n"
        "def make(sensor):\n    return lambda z: DepthMap(np.full(z.valid.shape, {}))\n"
    )
    module.write_text(code.format(1.0))
    Path("s.toml").write_text(
        'sensor = "opt8241:width=8,height=6"\nscenes = ["wall:range=2"]\n'
        'methods = ["edited_method:make"]\n'
    )
    plan = make_plan(load_suite("s.toml"), tmp_path / "out")

    def statuses(settings):
        log = []
        run_points(plan, tmp_path / "out", settings, lambda p, s: log.append(s))
        return log

    assert statuses(SETTINGS) == ["ok"]
    assert statuses(SETTINGS) == ["kept"]
    assert statuses(Settings(repeats=4, threads=1, timeout_s=10.0)) == ["ok"]
    assert statuses(Settings(repeats=4, threads=2, timeout_s=10.0)) == ["ok"]
    module.write_text(code.format(2.0))
    assert statuses(Settings(repeats=4, threads=2, timeout_s=10.0)) == ["ok"]
    row = score(tmp_path / "out")[0]
    assert row["metrics"]["mae_m"] < 0.8
    assert row["machine"]["threads"] == 2


def test_a_changed_capture_file_is_a_new_capture(tmp_path):
    path = tmp_path / "a.h5"
    (tmp_path / "s.toml").write_text('captures = ["*.h5"]\nmethods = ["single"]\n')
    ids = []
    for range_m in (1.0, 1.5):
        scene = Scene("wall", {"range": range_m})
        write_capture(path, analytic(scene)(Shot(sensor("deeptof:width=8,height=6"))))
        (tmp_path / ".hidden.h5").write_bytes(b"left by a killed run")
        plan = make_plan(load_suite(str(tmp_path / "s.toml")), tmp_path / "out")
        ids.append(plan[0].capture)
    assert len(plan) == 1
    assert ids[0] != ids[1]
    assert read_plan(tmp_path / "out")[0]["captures"][0]["group"] == "captures"


def test_a_stray_file_beside_the_captures_replaces_no_library(tmp_path):
    (tmp_path / "h5py.py").write_text("raise SystemExit('shadowed')\n")
    (tmp_path / "s.toml").write_text(
        'sensor = "deeptof:width=8,height=6"\nscenes = ["wall:range=2"]\nmethods = ["single"]\n'
    )
    command = [sys.executable, "-P", "-m", "toftools", "bench", "run", "s.toml", "--out", "o"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(json.loads(p.read_text())["status"] == "ok" for p in tmp_path.glob("o/runs/*.json"))


def test_two_runs_in_one_folder_are_refused(tmp_path):
    with (
        only_run(tmp_path),
        pytest.raises(ValueError, match="another run is at work"),
        only_run(tmp_path),
    ):
        pass
    with only_run(tmp_path):
        pass


def test_tables_have_the_input_first_and_every_label(finished):
    _, _, _, _, rows = finished
    lines = summarise(rows)
    assert lines[0].label.startswith("input")
    text, markdown = text_table(lines), markdown_table(lines)
    for row in rows:
        listed = row["status"] != "unsuited"
        assert (label_of(row) in text) == listed
        assert (f"`{label_of(row)}`" in markdown) == listed
    assert unsuited(rows) == [
        "planted:wants_three does not apply here: got 2 frequencies, wanted 3"
    ]
    assert "ZeroDivisionError: planted" in text
    widths = {line.count("|") for line in markdown.splitlines() if line.startswith("|")}
    assert len(widths) == 1


def test_report_is_one_file_without_network(finished):
    from toftools.bench.report import report

    out, *_ = finished
    page = report(out).read_text()
    assert page.count("<svg") >= 1
    assert "data:image/webp;base64," in page
    assert "ZeroDivisionError: planted" in page
    body = page.replace("http://www.w3.org/", "")
    assert "http://" not in body
    assert "https://" not in body
    assert "<script src" not in body


def test_scenes_of_a_suite_say_what_makes_them(tmp_path):
    (tmp_path / "s.toml").write_text(
        'methods = ["crt"]\ntol_mm = 30\nsensor = ["deeptof:width=8,height=6", "pmd"]\n'
        'scenes = ["corner", { scene = "corner", engine = "analytic", sensor = "pmd", '
        'group = "exact", tol_mm = 1 }]\n'
    )
    suite = load_suite(str(tmp_path / "s.toml"))
    found = [(s.sensor, s.group, s.engine, s.tol_mm) for s in suite.sources]
    assert found == [
        ("deeptof:width=8,height=6", "scenes, deeptof", "auto", 30.0),
        ("pmd", "scenes, pmd", "auto", 30.0),
        ("pmd", "exact", "analytic", 1.0),
    ]


def test_a_traced_scene_is_rendered_once_and_to_its_tolerance(tmp_path, monkeypatch):
    (tmp_path / "s.toml").write_text(
        'methods = ["single"]\nsensor = "deeptof:width=16,height=12"\ntol_mm = 40\n'
        'scenes = ["vshape", "corner", { scene = "corner", engine = "analytic" }]\n'
    )
    suite = load_suite(str(tmp_path / "s.toml"))
    make_plan(suite, tmp_path / "out")
    captures = sorted((tmp_path / "out" / "captures").glob("*.h5"))
    made = [read_capture(path) for path in captures]
    assert sorted(c.provenance["engine"] for c in made) == ["analytic", "radiosity", "radiosity"]
    for capture in made:
        if capture.provenance["engine"] == "radiosity":
            assert capture.provenance["standard_error_mm"] <= 40
            assert capture.provenance["tolerance_mm"] == pytest.approx(40)
            assert np.abs(capture.truth.one_bounce).max() > 0
    written = [path.stat().st_mtime_ns for path in captures]
    monkeypatch.setattr("toftools.bench.ingest.find", None)  # nothing may be made again
    make_plan(suite, tmp_path / "out")
    assert [path.stat().st_mtime_ns for path in captures] == written


def test_the_main_job_takes_the_first_set_where_no_real_data_is_at_hand(tmp_path, monkeypatch):
    suite = replace(load_suite("full"), methods=("single",))
    suite = replace(suite, sources=tuple(s for s in suite.sources if s.sensor is None))
    monkeypatch.delenv("TOFTOOLS_DATA", raising=False)
    make_plan(suite, tmp_path / "without")
    items = read_plan(tmp_path / "without")[0]["captures"]
    assert len(items) >= 5
    assert {item["group"] for item in items} == {"first set"}
    assert all(item["truth"] and item["n_freqs"] == 2 for item in items)
    monkeypatch.setenv("TOFTOOLS_DATA", str(tmp_path))
    first = replace(suite, sources=tuple(s for s in suite.sources if s.group == "first set"))
    with pytest.raises(ValueError, match="found no capture"):
        make_plan(first, tmp_path / "with")


def test_built_in_suites_load_and_name_known_methods():
    assert {"quick", "core", "full", "real"} <= set(built_in())
    for name in built_in():
        suite = load_suite(name)
        for method in suite.methods:
            assert points(method, suite.grid)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = ", "is not a suite"),
        ('methods = ["crt"]\nscenez = ["wall"]', "unknown key 'scenez'"),
        ('methods = ["crt"]', "needs methods, and captures or scenes"),
        ('scenes = ["wall"]\nmethods = ["nope"]', "unknown name 'nope'"),
        ('scenes = ["wall"]\nmethods = ["crt"]\nmask = 3', "mask in bad.toml must be a table"),
        ('scenes = ["wall"]\nmethods = ["crt"]\ngrid = 3', "grid in bad.toml must be a table"),
        ('scenes = ["wall"]\nmethods = ["crt"]\n[grid.crtt]', "unknown key 'crtt'; known: crt"),
        ('scenes = ["wall"]\nmethods = ["crt"]\n[mask]\nmin_range = 3', "unknown key 'min_range'"),
        ('scenes = ["wall"]\nmethods = ["crt"]\nrepeats = 0', "wants repeats >= 1"),
        (
            'scenes = ["wall"]\nmethods = ["crt"]\n[mask]\nmin_range_m = 5\nmax_range_m = 1',
            "min_range_m < max_range_m",
        ),
        ('captures = [{format = "npz"}]\nmethods = ["crt"]', "tables with a path"),
        ('scenes = [{sensor = "pmd"}]\nmethods = ["crt"]', "tables with a scene"),
        ('scenes = [{scene = "wall", tol = 1}]\nmethods = ["crt"]', "unknown key 'tol'"),
        ('scenes = ["wall"]\nmethods = ["crt"]\nengine = "magic"', "unknown name 'magic'"),
        ('scenes = ["wall"]\nmethods = ["crt"]\ntol_mm = 0', "tol_mm in bad.toml must be a posit"),
        ('scenes = ["wall"]\nmethods = ["crt"]\ntol_mm = "2"', "tol_mm in bad.toml must be a numb"),
        (
            'scenes = ["cornell"]\nmethods = ["crt"]\nengine = "analytic"',
            "no closed form for scene",
        ),
        ('scenes = ["wall"]\nmethods = ["crt:max_rnage_m=5"]', "no parameter 'max_rnage_m'"),
        ('scenes = ["wall"]\nmethods = ["no_such_module:make"]', "cannot load method"),
        ('captures = ["*.nothing"]\nmethods = ["crt"]', "no file matches"),
        ('captures = ["$NO_SUCH_VARIABLE_HERE/*.h5"]\nmethods = ["crt"]', "found no capture"),
    ],
)
def test_bad_suites_are_one_sentence(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        make_plan(load_suite(str(path)), tmp_path / "out")


def test_missing_results_say_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="start with: toftools bench run"):
        score(tmp_path)
    with pytest.raises(ValueError, match="run: toftools bench score"):
        read_rows(tmp_path)
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(ValueError, match="is damaged"):
        read_plan(tmp_path)


def test_reference_rows_see_truth_and_published_output():
    scene = Scene("two_returns", {"range": 2.0})
    capture = analytic(scene)(Shot(sensor("opt8241:width=12,height=9"), noisy=False))
    answer = oracle_wrap(capture, freq_index=1)(capture.phasors)
    assert np.abs(answer.range_m - capture.truth.range_m).max() < 0.3
    plain = uncorrected(capture)
    assert plain.range_m.shape == (9, 12)
    published = Capture(sensor=capture.sensor, phasors=capture.phasors,
                        reported={"tofnet": np.full((9, 12), 1.5, np.float32)})  # fmt: skip
    assert (reported(published)(capture.phasors).range_m == 1.5).all()
    with pytest.raises(ValueError, match="published outputs"):
        reported(capture)
    with pytest.raises(ValueError, match="needs a capture with truth"):
        oracle_wrap(published)


def test_keys_depend_on_capture_method_and_parameters():
    made = [("a", "m", {}), ("b", "m", {}), ("a", "n", {}), ("a", "m", {"k": 1})]
    assert len({Point(*args).key for args in made}) == 4


def test_a_mean_over_captures_without_an_answer_is_not_compared():
    def row(capture, mae_m):
        return {"method": "m", "params": {}, "status": "ok", "capture_id": capture, "ms": 1.0,
                "metrics": {"mae_m": mae_m, "input_mae_m": 0.2}}  # fmt: skip

    whole = summarise([row("a", 0.1), row("b", 0.3)])[1]
    part = summarise([row("a", 0.1), row("b", None)])[1]
    assert whole.complete
    assert not part.complete
    assert part.note == "no answer on 1 of 2 captures"


def test_a_crash_on_one_capture_makes_a_line_incomplete():
    good = {"method": "m", "params": {}, "status": "ok", "capture_id": "a", "ms": 1.0,
            "metrics": {"mae_m": 0.01, "input_mae_m": 0.2}}  # fmt: skip
    bad = {"method": "m", "params": {}, "status": "crashed", "capture_id": "b", "ms": None,
           "error": "exit code -9", "metrics": {}}  # fmt: skip
    line = summarise([good, bad])[1]
    assert not line.complete
    assert "crashed on 1 of 2" in line.note
    assert "crashed on 1 of 2" in markdown_table([line])


def test_captures_with_truth_and_without_are_not_averaged_together():
    rows = [{"group": "g", "against": against} for against in ("truth", "camera", "truth")]
    assert {name: len(mine) for name, mine in groups(rows).items()} == {
        "g": 2, "g, against the camera's own distance": 1
    }  # fmt: skip


def test_a_damaged_answer_is_named_and_run_again(finished):
    out, plan, _, _, _ = finished
    point = next(p for p in plan if p.method == "single")
    answer = out / "runs" / f"{point.key}.npz"
    answer.write_bytes(b"garbage")
    with pytest.raises(ValueError, match="is damaged; delete it and run the suite again"):
        score(out)
    assert not is_finished(out, point, SETTINGS.fingerprint(point))
    run_points([point], out, SETTINGS, lambda *_: None)
    assert score(out)


def test_a_depth_only_capture_is_not_scored_against_itself():
    depth = DepthMap(np.full((6, 8), 1.5))
    capture = Capture(sensor("deeptof:width=8,height=6"), depth=depth)
    assert reference_of(capture) == (None, "nothing")


def test_the_documented_suite_is_a_suite(tmp_path):
    page = Path(__file__).parent.parent / "docs" / "benchmark.md"
    text = page.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    (tmp_path / "mine.toml").write_text(text)
    suite = load_suite(str(tmp_path / "mine.toml"))
    assert len(suite.sources) == 5
    assert suite.sources[-1].group == "rooms"
    assert suite.grid["crt"]["max_range_m"] == (5.0, 10.0, 0.0)
    assert suite.max_range_m == 9.9
