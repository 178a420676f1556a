"""One worker process: started, watched from outside, ended with all that it started itself."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from toftools.bench.memory import resident_mb

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
KEPT_BYTES = 4096
"""How much of what a worker prints is kept: enough for its last line."""
LINE_CHARS = 400


@dataclass
class Worker:
    """A worker process and what its benchmark knows of it.

    Parameters
    ----------
    process : subprocess.Popen
        The process, leader of a session of its own.
    progress : Path
        File in which it says at which point it is.
    tail : bytearray
        The end of what it printed to stderr.
    at : str
        What it last said in `progress`.
    since_s : float
        When that changed, on the monotonic clock, s.
    """

    process: subprocess.Popen[bytes]
    progress: Path
    tail: bytearray = field(default_factory=bytearray)
    at: str = ""
    since_s: float = field(default_factory=time.monotonic)


def start(job: Mapping[str, Any], file: Path, threads: int) -> Worker:
    """Start a worker.

    Parameters
    ----------
    job : mapping
        What `toftools.bench.worker` reads, apart from the paths made here.
    file : Path
        Where the job is written to.
    threads : int
        Threads it may use.

    Returns
    -------
    Worker
        At work. It dies with the calling thread.
    """
    progress = file.with_suffix(".progress")
    whole = {**job, "parent": os.getpid(), "progress": str(progress)}
    file.write_text(json.dumps(whole), encoding="utf-8")
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(threads))}
    # Threads that spin while they wait make every figure depend on what else the machine does.
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    # -P: the current folder comes last, so that a stray h5py.py in it replaces nothing.
    command = [sys.executable, "-P", "-m", "toftools.bench.worker", str(file)]
    process = subprocess.Popen(
        command, env=environment, start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    worker = Worker(process, progress)
    if process.stderr is not None:
        # Somebody must read what a method prints, or it waits for ever; nobody must keep it all.
        threading.Thread(target=_drain, args=(process.stderr, worker.tail), daemon=True).start()
    return worker


def _drain(pipe: IO[bytes], tail: bytearray) -> None:
    with pipe:
        while chunk := os.read(pipe.fileno(), 1 << 16):
            tail += chunk
            del tail[:-KEPT_BYTES]


def trouble(worker: Worker, timeout_s: float, memory_mb: float) -> tuple[str, str] | None:
    """Why a worker's point will come to nothing, if so.

    Parameters
    ----------
    worker : Worker
        The worker.
    timeout_s : float
        Seconds a point may take; the first one's include the start.
    memory_mb : float
        Memory the worker may hold, MB.

    Returns
    -------
    (str, str), or None
        Status and reason; None while all is well.
    """
    code = worker.process.poll()
    if code is not None:
        return "crashed", _last_words(worker, code)
    with contextlib.suppress(OSError):
        at = worker.progress.read_text(encoding="ascii", errors="replace")
        if at != worker.at:
            worker.at, worker.since_s = at, time.monotonic()
    if time.monotonic() - worker.since_s > timeout_s:
        return "timeout", f"no answer within {timeout_s:g} s"
    if resident_mb("VmRSS", worker.process.pid) > memory_mb:
        return "failed", f"used more than {memory_mb:.0f} MB (--memory-mb)"
    return None


def _last_words(worker: Worker, code: int) -> str:
    time.sleep(0.05)  # what is still in the pipe
    lines = bytes(worker.tail).decode("utf-8", "replace").strip().splitlines()
    name = ""
    if code < 0:
        with contextlib.suppress(ValueError):
            name = f" ({signal.Signals(-code).name})"
    return f"exit code {code}{name}: {lines[-1][:LINE_CHARS] if lines else 'no message'}"


def end(worker: Worker) -> None:
    """End a worker and whatever it started, at once.

    Parameters
    ----------
    worker : Worker
        The worker; it may have ended by itself.
    """
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(worker.process.pid, signal.SIGKILL)
    worker.process.kill()
    worker.process.wait()
