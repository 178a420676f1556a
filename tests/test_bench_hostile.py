"""Methods that misbehave: each is recorded with its reason, and all others are finished."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from toftools.bench.measure import measure, plain_answer, sentence
from toftools.bench.memory import resident_mb, usual_limit_mb
from toftools.bench.plan import make_plan
from toftools.bench.report import report
from toftools.bench.run import Settings, read_result, run_points
from toftools.bench.score import read_answer, score
from toftools.bench.suite import load_suite
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import DepthMap, Scene, Shot

HERE = Path(__file__).parent
SETTINGS = Settings(repeats=3, threads=1, timeout_s=10.0, jobs=2, memory_mb=700)
SHAPE = (6, 8)

FATES = {
    "honest": ("ok", None),
    "raises": ("failed", "RuntimeError: planted and long"),
    "speechless": ("failed", "Speechless: its message cannot be shown"),
    "leaves": ("failed", "SystemExit: 0"),
    "exits": ("crashed", "exit code 7: no message"),
    "segfaults": ("crashed", "exit code -11 (SIGSEGV): no message"),
    "hangs": ("timeout", "no answer within 10 s"),
    "eats": ("failed", "used more than 700 MB (--memory-mb)"),
    "shouts": ("ok", None),
    "wrong_shape": ("failed", "TypeError: the method must return a DepthMap of shape (6, 8), got"),
    "wrong_type": ("failed", "TypeError: the method must return a DepthMap of shape (6, 8), got"),
    "wrong_later": ("failed", "got NoneType"),
    "lies": ("failed", "range_m must be non-negative metres"),
    "changes": ("ok", None),
    "models": ("failed", "info['model'] must be a map (6, 8) of whole numbers"),
    "writes": ("failed", "the method changed its input"),
    "replaces": ("failed", "the method changed its input"),
    "never_ends": ("ok", None),
    "starts_a_child": ("ok", None),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the planted methods, as one types a command in it."""
    shutil.copy(HERE / "hostile_methods.py", tmp_path / "harm.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def planned(folder, methods, more=""):
    text = (
        f'name = "harm"\nsensor = "deeptof:width=8,height=6"\nscenes = ["wall:range=2"]\n'
        f"methods = {json.dumps(methods)}\n{more}"
    )
    (folder / "harm.toml").write_text(text)
    return make_plan(load_suite("harm.toml"), folder / "out")


def test_every_harm_is_told_and_touches_no_other(folder):
    plan = planned(folder, [f"harm:{name}" for name in FATES])
    before = resident_mb("VmRSS")
    log = []
    bad = run_points(plan, folder / "out", SETTINGS, lambda p, s: log.append(p.method))
    assert sorted(log) == sorted(p.method for p in plan)
    assert resident_mb("VmRSS") - before < 100, "the run kept what methods printed or ate"
    for point in plan:
        status, reason = FATES[point.method.removeprefix("harm:")]
        result = read_result(folder / "out", point)
        assert result["status"] == status, (point.method, result)
        if reason is not None:
            assert reason in result["error"] and "\n" not in result["error"]
            assert len(result["error"]) <= 500
    assert bad == sum(status != "ok" for status, _ in FATES.values())
    rows = score(folder / "out")
    assert len(rows) == len(FATES)
    assert "RuntimeError: planted" in report(folder / "out").read_text()
    for line in (folder / "children").read_text().split():
        assert not alive(int(line)), "a process that a method started outlived its point"


def alive(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


def test_in_a_batch_only_the_point_under_way_suffers(folder):
    harms = ["none", "exit", "raise", "hang", "eat", "last"]
    # Each harm is a setting of one method: all would go to one worker.
    plan = planned(folder, ["harm:sometimes"], f"[grid.'harm:sometimes']\nharm = {harms}\n")
    settings = Settings(3, 1, 6.0, batch=True, memory_mb=700)
    log = []
    run_points(plan, folder / "out", settings, lambda p, s: log.append((p.params["harm"], s)))
    assert log == [
        ("none", "ok"), ("exit", "crashed"), ("raise", "failed"), ("hang", "timeout"),
        ("eat", "failed"), ("last", "ok"),
    ]  # fmt: skip
    again = []
    run_points(plan, folder / "out", settings, lambda p, s: again.append((p.params["harm"], s)))
    assert again == [("none", "kept"), ("last", "kept"), *log[1:-1]]


def test_the_limit_of_time_is_per_point_in_a_batch_too(folder):
    numbers = list(range(4))  # 1.6 s each: together more than the limit
    plan = planned(folder, ["harm:naps"], f"[grid.'harm:naps']\nnumber = {numbers}\n")
    log = []
    settings = Settings(3, 1, 5.0, batch=True)
    run_points(plan, folder / "out", settings, lambda p, s: log.append((p.params["number"], s)))
    assert log == [(number, "ok") for number in numbers]


def test_an_answer_is_read_once_and_rebuilt():
    class Sub(DepthMap):
        pass

    plain = plain_answer(Sub(np.ones(SHAPE), sigma_m=np.ones(SHAPE)), SHAPE)
    assert type(plain) is DepthMap and plain.sigma_m.shape == SHAPE
    made = DepthMap(np.ones(SHAPE))
    object.__setattr__(made, "sigma_m", np.ones((2, 2), np.float32))
    with pytest.raises(ValueError, match="sigma_m must have shape"):
        plain_answer(made, SHAPE)
    object.__setattr__(made, "sigma_m", "much")
    with pytest.raises(ValueError, match="sigma_m must be an array"):
        plain_answer(made, SHAPE)


def test_honest_methods_and_references_pass_the_watch():
    capture = analytic(Scene("wall", {"range": 2.0}))(Shot(sensor("deeptof:width=8,height=6")))
    assert measure(capture, "oracle_wrap", {}, 3)["status"] == "ok"
    assert measure(capture, "single", {}, 3)["ms"] > 0


def test_reasons_are_one_short_line():
    assert sentence(ValueError("a\n  b")) == "ValueError: a b"
    assert sentence(ValueError("a\n  b"), named=False) == "a b"
    assert len(sentence(ValueError("x" * 10**7))) == 500


def test_the_usual_limit_is_most_of_the_machine():
    total_mb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    assert 0 < usual_limit_mb() <= 0.9 * total_mb
    assert resident_mb("VmRSS", os.getpid()) > 10
    assert np.isnan(resident_mb("VmRSS", 2**22 + 1))


def test_a_stored_answer_needs_no_pickle(folder):
    plan = planned(folder, ["harm:honest"])
    run_points(plan, folder / "out", SETTINGS, lambda *_: None)
    answer = read_answer(folder / "out" / "runs" / f"{plan[0].key}.npz")
    assert (answer.range_m == 2).all()
