"""Second stage: every point in a process of its own, threads pinned, finished points kept."""

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from toftools.bench.plan import Point, write_json

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


def result_path(out: Path, point: Point) -> Path:
    """Where the result of a point is kept.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    point : Point
        The point.

    Returns
    -------
    Path
        JSON file; the answer lies beside it as npz.
    """
    return out / "runs" / f"{point.key}.json"


def read_result(out: Path, point: Point) -> dict[str, Any] | None:
    """Result of a point, or None if it is not finished.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    point : Point
        The point.

    Returns
    -------
    dict or None
        Status, times, memory.
    """
    try:
        result = json.loads(result_path(out, point).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) and "status" in result else None


def is_finished(out: Path, point: Point) -> bool:
    """Whether a point needs no run: it has an answer, or the method said it does not apply.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    point : Point
        The point.

    Returns
    -------
    bool
        False for a missing, failed, crashed or timed-out point: a rerun tries those again.
    """
    result = read_result(out, point)
    if result is None:
        return False
    if result["status"] == "ok":
        return result_path(out, point).with_suffix(".npz").exists()
    return bool(result["status"] == "unsuited")


def run_points(
    points: list[Point],
    out: Path,
    *,
    repeats: int,
    threads: int,
    timeout_s: float,
    progress: Callable[[int, int, Point, str], None],
) -> int:
    """Run what is not finished.

    Parameters
    ----------
    points : list of Point
        The plan.
    out : Path
        Benchmark folder.
    repeats : int
        Timed calls per point.
    threads : int
        Threads each method may use.
    timeout_s : float
        Limit per point, s.
    progress : callable
        ``progress(done, total, point, status)`` after each point.

    Returns
    -------
    int
        Number of points that failed, crashed or ran out of time.
    """
    bad = 0
    for i, point in enumerate(points, start=1):
        status = "kept"
        if not is_finished(out, point):
            result = _run(point, out, repeats=repeats, threads=threads, timeout_s=timeout_s)
            status = str(result["status"])
            bad += status not in ("ok", "unsuited")
        progress(i, len(points), point, status)
    return bad


def _run(
    point: Point, out: Path, *, repeats: int, threads: int, timeout_s: float
) -> dict[str, Any]:
    target = result_path(out, point).resolve()
    target.unlink(missing_ok=True)
    job = {
        **asdict(point),
        "capture": str((out / "captures" / f"{point.capture}.h5").resolve()),
        "repeats": repeats,
        "answer": str(target.with_suffix(".npz")),
        "result": str(target),
    }
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(threads))}
    # Threads that spin while they wait make every figure depend on what else the machine does.
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    # A user's own method is importable from where the command was typed.
    environment["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(Path.cwd()), os.environ.get("PYTHONPATH", "")])
    )
    with tempfile.TemporaryDirectory() as folder:
        job_file = Path(folder) / "job.json"
        job_file.write_text(json.dumps(job), encoding="utf-8")
        failure = _spawn(job_file, environment, timeout_s)
    result = read_result(out, point)
    if result is None:
        result = {"status": failure[0] or "crashed", "error": failure[1]}
    result.update(machine=machine(threads), versions=versions())
    write_json(target, result)
    return result


def _spawn(job_file: Path, environment: dict[str, str], timeout_s: float) -> tuple[str, str]:
    """Run one worker; status and reason if it left no result of its own."""
    command = [sys.executable, "-m", "toftools.bench.worker", str(job_file)]
    try:
        done = subprocess.run(
            command, env=environment, timeout=timeout_s, capture_output=True, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout", f"no answer within {timeout_s:g} s"
    lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
    return "crashed", f"exit code {done.returncode}: {lines[-1] if lines else 'no message'}"


def versions() -> dict[str, str]:
    """Versions that matter for a figure.

    Returns
    -------
    dict
        Package to version.
    """
    from importlib.metadata import version

    return {
        "toftools": version("toftools"),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
    }


def machine(threads: int) -> dict[str, Any]:
    """What the figures were measured on.

    Parameters
    ----------
    threads : int
        Threads given to each method.

    Returns
    -------
    dict
        CPU name, core count, threads, operating system.
    """
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [s for s in info.read_text(errors="replace").splitlines() if "model name" in s]
        cpu = names[0].partition(":")[2].strip() if names else cpu
    return {
        "cpu": cpu,
        "cores": os.cpu_count() or 1,
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
    }
