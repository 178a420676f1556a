"""Several points at once and batches: the same scores, however a run is arranged or interrupted."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from toftools.bench.plan import make_plan
from toftools.bench.results import read_result
from toftools.bench.run import Settings, run_points, tasks_of
from toftools.bench.score import score
from toftools.bench.suite import load_suite

SUITE = """
name = "small"
batch = {batch}
sensor = "deeptof:width=12,height=9"
scenes = ["wall:range=2", "two_returns:range=2,extra=0.9,ratio=0.3"]
methods = ["single", "near:make"]
repeats = 3
[grid."near:make"]
metres = [1.0, 2.0]
"""
NEAR = """
import numpy as np
from toftools.types import DepthMap

def make(sensor, *, metres=1.0):
    return lambda phasors: DepthMap(np.full(phasors.valid.shape, metres))
"""
TIMES = ("setup_s", "first_call_s", "ms", "ms_iqr", "peak_mb")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "near.py").write_text(NEAR)
    for batch in ("true", "false"):
        (tmp_path / f"{batch}.toml").write_text(SUITE.format(batch=batch))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def untimed(out, *more):
    """Lines of the results without what a clock or a meter says."""
    lines = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in (*TIMES, *more)} for line in lines]


def command(stage, suite, out, *more):
    return [sys.executable, "-m", "toftools", "bench", stage, suite, "--out", str(out), *more]


def note(log, point, status):
    assert point.key not in log, "a point was told twice"
    log[point.key] = status


def test_jobs_and_batches_give_the_same_scores(folder):
    seen = {}
    for name, settings in {
        "plain": Settings(3, 1, 60.0),
        "jobs": Settings(3, 1, 60.0, jobs=3),
        "batch": Settings(3, 1, 60.0, batch=True),
        "both": Settings(3, 1, 60.0, jobs=2, batch=True),
    }.items():
        plan = make_plan(load_suite("false.toml"), folder / name)
        log = {}
        assert run_points(plan, folder / name, settings, partial(note, log)) == 0
        assert log == {point.key: "ok" for point in plan}
        result = read_result(folder / name, plan[0])
        assert result["machine"]["jobs"] == settings.jobs
        assert result["machine"]["batch"] == settings.batch
        assert result["setup_s"] > 0
        score(folder / name)
        seen[name] = untimed(folder / name, "machine")  # which says how many jobs
    assert seen["jobs"] == seen["batch"] == seen["both"] == seen["plain"]


@pytest.mark.skipif(sys.platform != "linux", reason="peaks of memory are read from /proc")
@pytest.mark.parametrize("batch", ["true", "false"])
def test_memory_is_what_a_method_takes_beyond_the_process(folder, batch):
    """80 MB held for a moment in every call; the process alone holds over 100."""
    block = NEAR.replace("metres))", "metres + 0 * np.ones(10_000_000).sum()))")
    (folder / "near.py").write_text(block)
    plan = make_plan(load_suite(f"{batch}.toml"), folder / "out")
    mine = [point for point in plan if point.method == "near:make"]
    assert (
        run_points(
            mine, folder / "out", Settings(1, 1, 60.0, batch=batch == "true"), lambda *_: None
        )
        == 0
    )
    for point in mine:
        assert 70 < read_result(folder / "out", point)["peak_mb"] < 120


def test_a_batch_is_one_process_and_is_marked_as_one(folder):
    (folder / "near.py").write_text(
        "import os\n" + NEAR.replace("    return", "    open('pids', 'a').write(f'{os.getpid()} ')"
                                     "\n    return")
    )  # fmt: skip
    assert load_suite("true.toml").batch and not load_suite("false.toml").batch
    plan = make_plan(load_suite("true.toml"), folder / "out")
    mine = [point for point in plan if point.method == "near:make"]
    settings = Settings(3, 1, 60.0, batch=True)
    run_points(mine, folder / "out", settings, lambda *_: None)
    pids = Path("pids").read_text().split()
    assert len(mine) == 4 and len(pids) == 1 + 4 and len(set(pids)) == 1, "once to warm up"
    alone = Settings(3, 1, 60.0)
    assert settings.fingerprint(mine[0]) != alone.fingerprint(mine[0])
    assert settings.fingerprint(mine[0]) != Settings(3, 1, 60.0, jobs=2).fingerprint(mine[0])


def test_tasks_come_in_the_order_of_the_plan_with_each_method_compiled_first(folder):
    plan = make_plan(load_suite("false.toml"), folder / "out")
    left = [(point, "mark") for point in plan]
    alone = tasks_of(left, Settings(3, 1, 60.0))
    timed = [task.points[0] for task in alone if not task.untimed]
    assert timed == plan
    assert [t.points[0].method for t in alone if t.untimed] == ["single"]
    assert alone[0].untimed
    batches = tasks_of(left, Settings(3, 1, 60.0, batch=True))
    assert [len(task.points) for task in batches] == [
        sum(p.method == name for p in plan) for name in ("single", "near:make")
    ]
    assert not any(task.untimed for task in batches)


def test_batch_must_be_a_flag(tmp_path):
    (tmp_path / "s.toml").write_text('batch = 1\nscenes = ["wall"]\nmethods = ["crt"]\n')
    with pytest.raises(ValueError, match=r"batch in s\.toml must be true or false, got 1"):
        load_suite(str(tmp_path / "s.toml"))


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_workers_and_what_they_started(folder, sent):
    (folder / "slow.py").write_text(
        "import os, subprocess, time\n"
        "def make(sensor, *, number=0):\n"
        "    child = subprocess.Popen(['sleep', '600'])\n"
        "    open(f'pids{number}', 'w').write(f'{os.getpid()} {child.pid} ')\n"
        "    return lambda phasors: time.sleep(600)\n"
    )
    (folder / "s.toml").write_text(
        'sensor = "deeptof:width=8,height=6"\nscenes = ["wall:range=2"]\n'
        'methods = ["slow:make"]\n[grid."slow:make"]\nnumber = [0, 1]\n'
    )
    run = subprocess.Popen(command("run", "s.toml", folder / "out", "--jobs", "2"),
                           stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)  # fmt: skip
    files = [Path("pids0"), Path("pids1")]
    deadline = time.monotonic() + 120
    while not all(f.exists() and f.read_text().endswith(" ") for f in files):
        assert run.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    run.send_signal(sent)  # to the run alone, not to its group
    _, said = run.communicate(timeout=30)
    assert run.returncode == 1 and said.decode().strip().endswith("stopped")
    for pid in (int(pid) for file in files for pid in file.read_text().split()):
        assert not running(pid), "a worker or its child outlived the interrupt"


def running(pid):
    """Whether a process is there and no zombie that waits for its parent."""
    for _ in range(100):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return False
        if state == "Z":
            return False
        time.sleep(0.02)
    return True


@pytest.mark.parametrize("batch", ["false", "true"])
def test_killed_at_random_moments_it_ends_with_the_same_results(folder, batch):
    suite, whole, broken = f"{batch}.toml", folder / "whole", folder / "broken"
    fast = ("--threads", "1", "--jobs", "2")
    subprocess.run(command("run", suite, whole, *fast), check=True, capture_output=True)
    rng, struck, longest_s = np.random.default_rng(7), 0, 3.0
    for _ in range(20):
        begin = time.monotonic()
        run = subprocess.Popen(
            command("run", suite, broken, *fast), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            run.wait(timeout=longest_s * rng.uniform(0.3, 1.0))
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            struck += 1
        else:  # too late: begin anew, with less patience
            longest_s = time.monotonic() - begin
            shutil.rmtree(broken / "runs")
        if struck == 4:
            break
    assert struck == 4, "the kills came too late to mean anything"
    done = subprocess.run(command("run", suite, broken, *fast, "--json"), check=True,
                          capture_output=True)  # fmt: skip
    counts = json.loads(done.stdout)
    assert sum(counts.values()) == 6 and set(counts) <= {"ok", "kept"}
    for out in (whole, broken):
        score(out)
    assert untimed(broken) == untimed(whole)
    assert not list((broken / "runs").glob(".*"))
