"""Making data sets: the same set however it came about, nothing lost and nothing doubled."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from toftools.bench.fingerprint import capture_digest
from toftools.bench.run import only_run
from toftools.dataset import make as making
from toftools.dataset.make import captured, make
from toftools.dataset.manifest import STALE_S, read_manifest
from toftools.dataset.pools import local, over_cluster
from toftools.dataset.recipe import read_recipe
from toftools.io.native import read_capture

WALLS = """name = "walls"
sensors = ["deeptof:width=8,height=6"]
[[family]]
scene = "wall"
scenes = 6
params = { range = { from = 1.0, to = 3.0 } }
"""
CORNERS = WALLS.replace("wall", "corner").replace("scenes = 6", "scenes = 8")


@pytest.fixture
def walls(tmp_path):
    (tmp_path / "walls.toml").write_text(WALLS)
    return read_recipe(tmp_path / "walls.toml")


def content(folder):
    """What captures hold, by name, and the manifest without times."""
    files = {file.name: capture_digest(read_capture(file))
             for file in sorted((folder / "captures").glob("[!.]*"))}  # fmt: skip
    lines = [{k: v for k, v in entry.items() if k not in ("seconds", "sha256", "bytes")}
             for entry in read_manifest(folder)]  # fmt: skip
    return files, lines


def test_a_set_is_the_same_from_one_process_and_from_two(walls, tmp_path):
    said = []
    one = make(walls, tmp_path / "one", local(1), said.append)
    two = make(walls, tmp_path / "two", local(2))
    assert one.fresh == two.fresh == 6 and not one.failed
    assert content(tmp_path / "one") == content(tmp_path / "two")
    assert len(said) == 6 and said[-1].startswith("6 of 6, ") and said[-1].endswith("0:00 h left")
    (entry, *_) = one.entries
    assert entry["split"] in ("train", "validation", "test") and entry["seconds"] > 0
    capture = read_capture(tmp_path / "one" / "captures" / f"{entry['id']}.h5")
    assert capture.taps is not None and capture.truth.direct is not None


def test_only_what_is_missing_is_made(walls, tmp_path):
    make(walls, tmp_path / "set", local(1))
    before = content(tmp_path / "set")
    gone, cut, *_ = sorted((tmp_path / "set" / "captures").iterdir())
    gone.unlink()
    cut.write_bytes(cut.read_bytes()[:-100])
    old, new = (tmp_path / "set" / "captures" / f".wall.{name}.h5" for name in ("old", "new"))
    for half in (old, new):
        half.write_bytes(b"half")
    os.utime(old, (0, time.time() - 2 * STALE_S))  # of a writer that was killed
    made = make(walls, tmp_path / "set", local(1))
    assert made.fresh == 1 and len(made.entries) == 6  # the other was there, but cut
    assert not old.exists() and new.exists()
    assert content(tmp_path / "set") == before
    seconds = [entry["seconds"] for entry in read_manifest(tmp_path / "set")]
    assert make(walls, tmp_path / "set", local(1)).fresh == 0
    assert seconds == [entry["seconds"] for entry in read_manifest(tmp_path / "set")]


@pytest.mark.parametrize("damage", ["gone", "cut", "nonsense"])
def test_a_damaged_manifest_is_made_again(walls, tmp_path, damage):
    make(walls, tmp_path / "set", local(1))
    before, file = content(tmp_path / "set"), tmp_path / "set" / "manifest.jsonl"
    text = file.read_text()
    if damage == "gone":
        file.unlink()
    else:
        file.write_text(text[:-30] if damage == "cut" else 'null\n{"id": 3}\n' + text[:300])
    assert make(walls, tmp_path / "set", local(1)).fresh == 0
    assert content(tmp_path / "set") == before


def test_the_journal_keeps_what_an_interrupted_run_has_made(walls, tmp_path, monkeypatch):
    """Its captures are not even read again."""

    def three(work, jobs):
        yield from map(work, jobs[:3])
        raise KeyboardInterrupt

    monkeypatch.setattr(making.manifest, "write", lambda *_: None)  # as after kill -9
    with pytest.raises(KeyboardInterrupt):
        make(walls, tmp_path / "set", three)
    monkeypatch.undo()
    asked = []

    def rest(work, jobs):
        asked.extend(jobs)
        yield from map(work, jobs)

    assert len(make(walls, tmp_path / "set", rest).entries) == 6
    assert asked == list(walls.jobs[3:])


def test_failures_are_told_and_tried_again(walls, tmp_path, monkeypatch):
    bad, real = walls.jobs[2], making.simulated

    def sometimes(job):
        if job == bad:
            raise ValueError("the light\nwent out")
        return real(job)

    monkeypatch.setattr(making, "simulated", sometimes)
    made = make(walls, tmp_path / "set", local(1))
    assert made.failed == {bad.id: "the light went out"}
    assert made.fresh == 5 and len(read_manifest(tmp_path / "set")) == 5
    told = json.loads((tmp_path / "set" / "failed.jsonl").read_text())
    assert told == {"id": bad.id, "error": "the light went out"}
    monkeypatch.undo()
    assert make(walls, tmp_path / "set", local(1)).fresh == 1
    assert not (tmp_path / "set" / "failed.jsonl").read_text()


def test_a_full_disk_ends_the_work(walls, tmp_path, monkeypatch):
    calls = []

    def full(path, capture):
        calls.append(path)
        raise ValueError(f"cannot write {path.name}: No space left on device")

    monkeypatch.setattr(making, "write_capture", full)
    made = make(walls, tmp_path / "set", local(1))
    assert len(calls) == 1 and len(made.failed) == 1 and not made.entries


def dying(job):
    """Work whose process dies on the third wall, as one without memory does."""
    if job.group == "wall-2":
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.02)
    return {"id": job.id}


def test_a_process_that_dies_takes_no_other_job_with_it(walls):
    entries = list(local(2)(dying, walls.jobs))
    assert sorted(entry["id"] for entry in entries) == sorted(job.id for job in walls.jobs)
    (failed,) = (entry for entry in entries if "error" in entry)
    assert failed["id"] == walls.jobs[2].id and "process died" in failed["error"]


def test_a_folder_is_held_against_a_second_run(walls, tmp_path):
    (tmp_path / "set").mkdir()
    with only_run(tmp_path / "set"), pytest.raises(ValueError, match="another run is at work"):
        make(walls, tmp_path / "set", local(1))


def command(recipe, out, *more):
    return [
        sys.executable,
        "-m",
        "toftools",
        "dataset",
        "make",
        str(recipe),
        "--out",
        str(out),
        *more,
    ]


def test_killed_at_any_moment_it_goes_on(tmp_path):
    (tmp_path / "corners.toml").write_text(CORNERS)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    subprocess.run(command(tmp_path / "corners.toml", whole, "--jobs", "1"), check=True)
    for count in (1, 4):
        run = subprocess.Popen(
            command(tmp_path / "corners.toml", broken, "--jobs", "2"), start_new_session=True
        )
        while run.poll() is None and len(list(broken.glob("captures/corner*.h5"))) < count:
            time.sleep(0.01)
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    done = subprocess.run(
        command(tmp_path / "corners.toml", broken, "--json"), check=True, capture_output=True
    )
    told = json.loads(done.stdout)
    assert told["captures"] == 8 and told["made"] < 8 and not told["failed"]
    assert not (broken / "journal.jsonl").exists()
    assert content(broken) == content(whole)


def test_a_cluster_whose_worker_dies(tmp_path):
    distributed = pytest.importorskip("distributed")
    (tmp_path / "corners.toml").write_text(CORNERS)
    recipe = read_recipe(tmp_path / "corners.toml")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        protocol="tcp", local_directory=str(tmp_path / "dask"),
    ) as cluster:  # fmt: skip
        pool, killed = over_cluster(cluster.scheduler_address), []

        def after_the_first(work, jobs):
            for entry in pool(work, jobs):
                if not killed:
                    killed.append(next(iter(cluster.workers.values())).pid)
                    os.kill(killed[0], signal.SIGKILL)
                yield entry

        made = make(recipe, tmp_path / "cluster", after_the_first)
        again = make(recipe, tmp_path / "elsewhere", pool)
    assert killed and not made.failed and len(made.entries) == 8
    assert not again.failed and again.fresh == 8
    make(recipe, tmp_path / "here", local(1))
    assert content(tmp_path / "cluster") == content(tmp_path / "here")


def test_a_cluster_that_does_not_answer(walls, tmp_path):
    pytest.importorskip("distributed")
    with pytest.raises(ValueError, match="no Dask scheduler answers"):
        make(walls, tmp_path / "set", over_cluster("tcp://127.0.0.1:9"))


def test_work_can_be_sent_to_other_processes(walls, tmp_path):
    (tmp_path / "captures").mkdir()
    entry = partial(captured, tmp_path)(walls.jobs[0])
    assert entry["seconds"] and json.loads(json.dumps(entry))["scene"] == walls.jobs[0].scene
