"""Jobs on a Dask cluster that is there already: benchmark points here, captures in `dataset`.

Workers of a cluster see the same folder. Results lie there, under names that follow from the job,
so that a job which a dying worker lost is run again without harm.
"""

import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from toftools.bench.crew import Task, Told, work_off
from toftools.bench.fingerprint import package_digest
from toftools.bench.plan import write_json
from toftools.bench.results import is_finished, read_result, result_path
from toftools.bench.settings import Settings

Job = TypeVar("Job")
Result = TypeVar("Result")
Order = tuple[Task, ...]

RETRIES = 3
"""How often a cluster tries a job that raised again."""
_COMPILED: set[str] = set()
"""Fingerprints of methods that this process of a cluster has had compiled."""


def on_cluster(
    address: str, work: Callable[[Job], Result], jobs: Sequence[Job], names: Sequence[str]
) -> Iterator[tuple[Job, Result | str]]:
    """Run jobs on a cluster.

    Parameters
    ----------
    address : str
        Of its scheduler, such as tcp://10.0.0.1:8786.
    work : callable
        Takes a job; workers import it by name.
    jobs : sequence
        What to do.
    names : sequence of str
        Of the jobs, all different.

    Yields
    ------
    job, result or str
        As they come; a text says why there is no result. Work must return no text itself.

    Raises
    ------
    ValueError
        If Dask is missing, or no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        msg = "--dask needs Dask: pip install 'toftools[cluster]'"
        raise ValueError(msg) from error
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        msg = f"no Dask scheduler answers at {address}: {error}"
        raise ValueError(msg) from error
    run = uuid.uuid4().hex  # a cluster runs a key only once, whoever asks for it
    with client:
        by_key = {f"{name}-{run}": job for name, job in zip(names, jobs, strict=True)}
        futures = client.map(work, list(jobs), key=list(by_key), retries=RETRIES)
        for future in as_completed(futures):
            try:
                got: Result | str = future.result()
            except Exception as error:  # lost, cancelled, or its workers keep dying
                got = " ".join(str(error).split()) or type(error).__name__
            future.release()  # or it is run again when the worker that keeps it dies
            yield by_key[future.key], got


def work_off_there(tasks: Sequence[Task], out: Path, settings: Settings, told: Told) -> None:
    """Run tasks on a cluster: each of its slots starts and watches workers as this machine would.

    Parameters
    ----------
    tasks : sequence of Task
        As for `work_off`.
    out : Path
        Benchmark folder, which all machines see under this path.
    settings : Settings
        Threads, limits, address.
    told : callable
        ``told(point, status)`` after each point, or all of a task.

    Raises
    ------
    ValueError
        If Dask is missing, or no scheduler answers.
    """
    out = out.resolve()
    first = {task.points[0].method: task for task in tasks if task.untimed}
    orders: list[Order] = []
    for task in (task for task in tasks if not task.untimed):
        before = first.get(task.points[0].method)
        orders.append((before, task) if before else (task,))
        for point in task.points:
            result_path(out, point).unlink(missing_ok=True)
    if not orders:
        return
    work = partial(_on_worker, out, settings, package_digest())
    names = [order[-1].points[0].key for order in orders]
    for order, why in on_cluster(settings.cluster, work, orders, names):
        task = order[-1]
        for point in task.points:
            result = read_result(out, point)
            if result is None:
                error = why if isinstance(why, str) else "run, but its result is not in this folder"
                result = {"status": "crashed", "error": error, "fingerprint": task.fingerprint}
                write_json(result_path(out, point), result)
            told(point, str(result["status"]))


def _on_worker(out: Path, settings: Settings, code: str, order: Order) -> bool:
    """What a slot of the cluster does; true, or an error that says what the machine lacks."""
    if package_digest() != code:
        msg = "a worker has other code of toftools; install the same version on the whole cluster"
        raise RuntimeError(msg)
    if not (out / "plan.json").is_file():
        msg = f"a worker does not see {out}; --out must lie in a folder that all machines share"
        raise RuntimeError(msg)
    task = order[-1]
    # A worker that died had finished some of them.
    points = tuple(p for p in task.points if not is_finished(out, p, task.fingerprint))
    before = [t for t in order[:-1] if t.fingerprint not in _COMPILED]
    if points:
        work_off([*before, replace(task, points=points)], out, settings, lambda *_: None)
        _COMPILED.add(task.fingerprint)
    return True
