"""Second stage: every point in a worker process, threads pinned, finished points kept."""

from collections.abc import Callable
from pathlib import Path

from toftools.bench.crew import Task, work_off
from toftools.bench.machine import machine as machine
from toftools.bench.machine import versions as versions
from toftools.bench.methods import is_ours, method_of
from toftools.bench.plan import Point
from toftools.bench.results import is_finished as is_finished
from toftools.bench.results import only_run as only_run
from toftools.bench.results import read_result as read_result
from toftools.bench.results import result_path as result_path
from toftools.bench.settings import Settings as Settings


def run_points(
    points: list[Point],
    out: Path,
    settings: Settings,
    progress: Callable[[Point, str], None],
) -> int:
    """Run what is not finished.

    Numba keeps compiled code on disk; a method of toftools is run once, untimed, before its first
    point, so that set-up and first call mean the same for every point. In a batch each worker does
    that itself.

    Parameters
    ----------
    points : list of Point
        The plan.
    out : Path
        Benchmark folder.
    settings : Settings
        Repeats, threads, jobs, limits.
    progress : callable
        ``progress(point, status)`` after each point.

    Returns
    -------
    int
        Number of points that failed, crashed or ran out of time.

    Raises
    ------
    ValueError
        If results cannot be written, or a cluster is wanted and none answers.
    """
    bad = 0

    def told(point: Point, status: str) -> None:
        nonlocal bad
        bad += status not in ("ok", "unsuited", "kept")
        progress(point, status)

    left: list[tuple[Point, str]] = []
    for point in points:
        fingerprint = settings.fingerprint(point)
        if is_finished(out, point, fingerprint):
            told(point, "kept")
        else:
            left.append((point, fingerprint))
    if settings.cluster:  # workers there outlive an interrupt: what they write is left alone
        from toftools.bench.cluster import work_off_there

        work_off_there(tasks_of(left, settings), out, settings, told)
    else:
        for stray in (out / "runs").glob(".*"):  # a killed worker was writing it; nobody is now
            stray.unlink(missing_ok=True)
        work_off(tasks_of(left, settings), out, settings, told)
    return bad


def tasks_of(left: list[tuple[Point, str]], settings: Settings) -> list[Task]:
    """Points as tasks: each alone, or all of one method together.

    Parameters
    ----------
    left : list of (Point, str)
        Points to run, each with its fingerprint.
    settings : Settings
        Whether they are run in batches.

    Returns
    -------
    list of Task
        In the order of the plan; the methods of toftools compiled first where points are alone.
    """
    folder = str(Path.cwd())
    if settings.batch:
        by_method: dict[str, list[Point]] = {}
        marks = {}
        for point, fingerprint in left:
            by_method.setdefault(point.method, []).append(point)
            marks[point.method] = fingerprint
        return [Task(tuple(mine), marks[name], folder) for name, mine in by_method.items()]
    tasks, primed = [], set()
    for point, fingerprint in left:
        task = Task((point,), fingerprint, folder)
        if point.method not in primed and is_ours(method_of(point.method)):
            primed.add(point.method)
            tasks.append(Task((point,), fingerprint, folder, untimed=True))
        tasks.append(task)
    return tasks
