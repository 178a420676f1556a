"""Workers side by side: tasks handed out, points noted as they are finished, failures told.

One loop looks at all workers in turn. Which points are finished is read from their result files
alone, so that whatever ends a worker, the first point without a result is the one under way.
"""

import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from toftools.bench.machine import machine, versions
from toftools.bench.memory import usual_limit_mb
from toftools.bench.plan import Point, write_json
from toftools.bench.process import Worker, end, start, trouble
from toftools.bench.results import read_result, result_path
from toftools.bench.settings import Settings

LOOK_S = 0.05
"""Pause between looks: a look costs 0.1 ms of a core that a method may be using."""

Told = Callable[[Point, str], None]
"""Takes a point and its status."""


@dataclass(frozen=True)
class Task:
    """Points of one method for one worker after another.

    Parameters
    ----------
    points : tuple of Point
        In the order in which they are run.
    fingerprint : str
        What their results carry.
    folder : str
        Where a user's own method lies.
    untimed : bool
        Run once, to leave compiled code on disk; its results are thrown away.
    """

    points: tuple[Point, ...]
    fingerprint: str
    folder: str
    untimed: bool = False


@dataclass
class _Shift:
    """A task with the worker that is at it, and how many of its points are finished."""

    task: Task
    worker: Worker
    results: Path
    done: int = 0


def work_off(tasks: Sequence[Task], out: Path, settings: Settings, told: Told) -> None:
    """Run tasks, several at once, until every point has a result.

    Parameters
    ----------
    tasks : sequence of Task
        An untimed one comes before all others of its method, which wait for it.
    out : Path
        Benchmark folder.
    settings : Settings
        Jobs, threads, limits.
    told : callable
        ``told(point, status)`` after each point.

    Raises
    ------
    ValueError
        If results cannot be written.
    """
    waiting, shifts = deque(tasks), list[_Shift]()
    if settings.memory_mb is None:
        settings = replace(settings, memory_mb=usual_limit_mb())
    stamp = {"machine": {**machine(settings.threads), **settings.company()}, "versions": versions()}
    with tempfile.TemporaryDirectory() as scratch, _stopped_by_sigterm():
        files = (Path(scratch) / f"{number}.json" for number in range(10**9))
        try:
            while waiting or shifts:
                while len(shifts) < settings.jobs and (task := _next(waiting, shifts)):
                    shifts.append(_begin(task, out, next(files), settings, stamp))
                time.sleep(LOOK_S)
                for shift in list(shifts):
                    rest = _look(shift, settings, stamp, told)
                    if rest is not None:
                        shifts.remove(shift)
                        waiting.extendleft([rest] if rest.points else [])
        finally:
            for shift in shifts:
                end(shift.worker)


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end a run as Ctrl-C does, so that no worker is left behind."""
    if threading.current_thread() is not threading.main_thread():
        yield  # on a cluster; signals belong to its process
        return

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _next(waiting: deque[Task], shifts: Sequence[_Shift]) -> Task | None:
    """Take the first task whose method is not being compiled at the moment."""
    compiled = {shift.task.points[0].method for shift in shifts if shift.task.untimed}
    for task in waiting:
        if task.points[0].method not in compiled:
            waiting.remove(task)
            return task
    return None


def _begin(task: Task, out: Path, file: Path, settings: Settings, stamp: dict[str, Any]) -> _Shift:
    results = out.resolve()
    if task.untimed:
        results = file.with_suffix("")
        (results / "runs").mkdir(parents=True)
    points = []
    for point in task.points:
        target = result_path(results, point)
        target.unlink(missing_ok=True)
        points.append({
            "capture": str(out.resolve() / "captures" / f"{point.capture}.h5"),
            "params": dict(point.params),
            "answer": str(target.with_suffix(".npz")),
            "result": str(target),
        })  # fmt: skip
    job = {
        "method": task.points[0].method,
        "points": points,
        "repeats": 1 if task.untimed else settings.repeats,
        "batch": settings.batch and not task.untimed,
        "sensitivity": settings.sensitivity and not task.untimed,
        "timeout_s": settings.timeout_s,
        "stamp": {"fingerprint": task.fingerprint, **stamp},
        "folder": task.folder,
    }
    return _Shift(task, start(job, file, settings.threads), results)


def _look(shift: _Shift, settings: Settings, stamp: dict[str, Any], told: Told) -> Task | None:
    """Note what is finished; what is left of the task if its worker is at its end."""
    wrong = trouble(shift.worker, settings.timeout_s, settings.memory_mb or float("inf"))
    points, before = shift.task.points, shift.done
    while shift.done < len(points) and (result := read_result(shift.results, points[shift.done])):
        _tell(shift, str(result["status"]), told)
    alive = wrong is None or wrong[0] != "crashed"
    # What was wrong while a point was being finished is not held against the next one.
    if shift.done < len(points) and alive and (wrong is None or shift.done > before):
        return None
    # A worker without work is not waited for: threads that a method left might never end.
    end(shift.worker)
    if wrong is not None and shift.done == before:
        failure = {"status": wrong[0], "error": wrong[1], **stamp}
        failure["fingerprint"] = shift.task.fingerprint
        write_json(result_path(shift.results, points[shift.done]), failure)
        _tell(shift, wrong[0], told)
    return replace(shift.task, points=points[shift.done :])


def _tell(shift: _Shift, status: str, told: Told) -> None:
    if not shift.task.untimed:
        told(shift.task.points[shift.done], status)
    shift.done += 1
    shift.worker.since_s = time.monotonic()  # the next one's time begins
