"""Second stage: every point in a process of its own, threads pinned, finished points kept."""

import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from toftools.bench.fingerprint import point_fingerprint
from toftools.bench.methods import is_ours, method_of, specs_of
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


def is_finished(out: Path, point: Point, fingerprint: str) -> bool:
    """Whether a point needs no run: it was run to its end by this very code.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    point : Point
        The point.
    fingerprint : str
        `point_fingerprint` of the code and settings at hand.

    Returns
    -------
    bool
        False for a missing, failed, crashed, timed-out or outdated point: it is run again.
    """
    result = read_result(out, point)
    if result is None or result.get("fingerprint") != fingerprint:
        return False
    if result["status"] == "ok":
        return zipfile.is_zipfile(result_path(out, point).with_suffix(".npz"))
    return bool(result["status"] == "unsuited")


@contextlib.contextmanager
def only_run(out: Path) -> Iterator[None]:
    """Hold a folder against a second run at the same time.

    Parameters
    ----------
    out : Path
        Benchmark folder.

    Yields
    ------
    None
        While no other run can start there. The lock dies with the process.

    Raises
    ------
    ValueError
        If another run holds it.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on Windows
        yield
        return
    with (out / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            msg = f"another run is at work in {out}; wait for it, or give another --out"
            raise ValueError(msg) from error
        yield


@dataclass(frozen=True)
class Settings:
    """How points are run.

    Parameters
    ----------
    repeats : int
        Timed calls per point.
    threads : int
        Threads each method may use.
    timeout_s : float
        Limit per point, s.
    """

    repeats: int
    threads: int
    timeout_s: float

    def fingerprint(self, point: Point) -> str:
        """Fingerprint of a point under these settings."""
        targets = [spec.target for spec in specs_of(method_of(point.method))]
        return point_fingerprint(*targets, repeats=self.repeats, threads=self.threads)


def run_points(
    points: list[Point],
    out: Path,
    settings: Settings,
    progress: Callable[[Point, str], None],
) -> int:
    """Run what is not finished.

    Numba keeps compiled code on disk; a method of toftools is run once, untimed, before its first
    point, so that set-up and first call mean the same for every point.

    Parameters
    ----------
    points : list of Point
        The plan.
    out : Path
        Benchmark folder.
    settings : Settings
        Repeats, threads, limit.
    progress : callable
        ``progress(point, status)`` after each point.

    Returns
    -------
    int
        Number of points that failed, crashed or ran out of time.
    """
    bad, primed = 0, set()
    for point in points:
        status = "kept"
        if not is_finished(out, point, settings.fingerprint(point)):
            if point.method not in primed and is_ours(method_of(point.method)):
                primed.add(point.method)
                _prime(point, out, settings)
            status = str(_run(point, out, settings)["status"])
            bad += status not in ("ok", "unsuited")
        progress(point, status)
    return bad


def _prime(point: Point, out: Path, settings: Settings) -> None:
    with tempfile.TemporaryDirectory() as folder:
        _work(point, out, replace(settings, repeats=1), Path(folder) / "primed.json")


def _run(point: Point, out: Path, settings: Settings) -> dict[str, Any]:
    target = result_path(out, point).resolve()
    target.unlink(missing_ok=True)
    failure = _work(point, out, settings, target)
    result = read_result(out, point) or {"status": failure[0], "error": failure[1]}
    result.update(
        fingerprint=settings.fingerprint(point),
        machine=machine(settings.threads),
        versions=versions(),
    )
    write_json(target, result)
    return result


def _work(point: Point, out: Path, settings: Settings, target: Path) -> tuple[str, str]:
    """Run one worker; status and reason if it left no result of its own."""
    job = {
        **asdict(point),
        "capture": str((out / "captures" / f"{point.capture}.h5").resolve()),
        "repeats": settings.repeats,
        "answer": str(target.with_suffix(".npz")),
        "result": str(target),
        "parent": os.getpid(),
        "folder": str(Path.cwd()),
    }
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(settings.threads))}
    # Threads that spin while they wait make every figure depend on what else the machine does.
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    with tempfile.TemporaryDirectory() as folder:
        job_file = Path(folder) / "job.json"
        job_file.write_text(json.dumps(job), encoding="utf-8")
        return _spawn(job_file, environment, settings.timeout_s)


def _spawn(job_file: Path, environment: dict[str, str], timeout_s: float) -> tuple[str, str]:
    """Run one process; what to say of it if it left no result."""
    # -P: the current folder comes last, so that a stray h5py.py in it replaces nothing.
    command = [sys.executable, "-P", "-m", "toftools.bench.worker", str(job_file)]
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
