"""Points on a Dask cluster: a worker of it may die, the scores are those of one machine."""

import json
import os
import signal
import subprocess
import sys

import pytest

from toftools.bench import cluster as clustered
from toftools.bench.plan import make_plan
from toftools.bench.run import Settings, read_result, run_points
from toftools.bench.score import read_rows, score
from toftools.bench.suite import load_suite

SUITE = """
name = "cluster"
sensor = "deeptof:width=12,height=9"
scenes = ["wall:range=1.5", "wall:range=2", "wall:range=2.5"]
methods = ["single", "crt", "fails_there:make"]
repeats = 3
"""
FAILS = """
import os

def make(sensor):
    return lambda phasors: os._exit(3)
"""
DISTRIBUTED = pytest.importorskip("distributed")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "s.toml").write_text(SUITE)
    (tmp_path / "fails_there.py").write_text(FAILS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def metrics(out):
    score(out)  # the file holds null for NaN, which equals itself
    return [(row["method"], row["status"], row["error"], row["metrics"]) for row in read_rows(out)]


def test_a_cluster_whose_worker_dies_loses_no_point(folder):
    suite = load_suite("s.toml")
    with DISTRIBUTED.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        protocol="tcp", local_directory=str(folder / "dask"),
    ) as there:  # fmt: skip
        killed, log = [], []

        def after_the_first(point, status):
            log.append((point.key, status))
            if not killed:
                killed.append(next(iter(there.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        settings = Settings(3, 1, 60.0, cluster=there.scheduler_address)
        plan = make_plan(suite, folder / "far")
        assert run_points(plan, folder / "far", settings, after_the_first) == 3
        again = subprocess.run(
            [sys.executable, "-m", "toftools", "bench", "run", "s.toml", "--out", "far", "--json",
             "--threads", "1", "--dask", there.scheduler_address],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        (folder / "batch.toml").write_text("batch = true\n" + SUITE)
        batch = make_plan(load_suite("batch.toml"), folder / "batch")
        settings = Settings(3, 1, 60.0, batch=True, cluster=there.scheduler_address)
        assert run_points(batch, folder / "batch", settings, lambda *_: None) == 3
    assert killed and sorted(key for key, _ in log) == sorted(point.key for point in plan)
    assert again.returncode == 1, again.stderr
    assert json.loads(again.stdout) == {"kept": len(batch) - 3, "crashed": 3}
    assert read_result(folder / "far", plan[0])["machine"]["jobs"] == "cluster"
    plan = make_plan(suite, folder / "near")
    run_points(plan, folder / "near", Settings(3, 1, 60.0, jobs=2), lambda *_: None)
    for name in ("near", "batch"):
        assert metrics(folder / name) == metrics(folder / "far")


def test_a_cluster_that_does_not_answer_or_does_not_fit(folder, monkeypatch):
    plan = make_plan(load_suite("s.toml"), folder / "out")
    settings = Settings(3, 1, 60.0, cluster="tcp://127.0.0.1:9")
    with pytest.raises(ValueError, match="no Dask scheduler answers"):
        run_points(plan, folder / "out", settings, lambda *_: None)
    with pytest.raises(RuntimeError, match="install the same version on the whole cluster"):
        clustered._on_worker(folder / "out", settings, "other", ())
    with pytest.raises(RuntimeError, match="must lie in a folder that all machines share"):
        clustered._on_worker(folder / "elsewhere", settings, clustered.package_digest(), ())
    told = []
    monkeypatch.setattr(clustered, "on_cluster", lambda a, w, jobs, n: ((j, "lost") for j in jobs))
    run_points(plan[:1], folder / "out", settings, lambda p, s: told.append(s))
    assert told == ["crashed"]
    assert read_result(folder / "out", plan[0])["error"] == "lost"


def test_jobs_and_dask_do_not_go_together(folder):
    done = subprocess.run(
        [sys.executable, "-m", "toftools", "bench", "run", "s.toml", "--out", "o", "--jobs", "2",
         "--dask", "tcp://127.0.0.1:9"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2 and "leave --jobs out" in done.stderr
