"""One benchmark point in one process: ``python -m toftools.bench.worker JOB.json``.

Set-up, first call and steady calls are timed apart; the answer is stored, so that scoring needs
no rerun. The result file is written last and atomically: it exists if and only if the point is
finished.
"""

import contextlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.methods import method_of, specs_of
from toftools.bench.plan import write_json
from toftools.bench.references import REFERENCES
from toftools.io.atomic import atomic_path
from toftools.io.native import read_capture
from toftools.phasor import phasors_of
from toftools.types import Capture, DepthMap, Phasors

BUDGET_S = 8.0  # steady calls stop here if the repeats are not done; at least three are made


def resident_mb(field: str) -> float:
    """Resident memory of this process as the kernel counts it.

    Parameters
    ----------
    field : {"VmRSS", "VmHWM"}
        Now, or the highest since `forget_peak`.

    Returns
    -------
    float
        MB; NaN where the kernel does not tell. (ru_maxrss would also count the parent's memory
        at the moment of the fork.)
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(f"{field}:"):
                return float(line.split()[1]) / 1024
    return float("nan")


def forget_peak() -> float:
    """Start to count the peak anew.

    Returns
    -------
    float
        Memory in use now, MB: what is not the method's.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return resident_mb("VmRSS")


def die_with_parent(parent: int) -> None:
    """End this process when the benchmark that started it ends, however that ends.

    Parameters
    ----------
    parent : int
        Its process id.
    """
    if sys.platform == "linux":
        import ctypes
        import signal

        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent and os.getppid() != parent:  # it ended before we could ask
        sys.exit(1)


def measure(capture: Capture, method: str, params: dict[str, Any], repeats: int) -> dict[str, Any]:
    """Build a method, run it, time it.

    Parameters
    ----------
    capture : Capture
        Input.
    method : str
        Registry name, reference name, ``module:function`` or a chain.
    params : dict
        Parameters.
    repeats : int
        Steady calls wanted.

    Returns
    -------
    dict
        ``status``, ``depth`` and, for real methods, ``setup_s``, ``first_call_s``, ``ms``,
        ``ms_iqr``, ``calls``, and ``peak_mb``, the highest memory above what the process held
        before the method was loaded; or status ``unsuited`` and the method's reason.
    """
    phasors = phasors_of(capture)
    base_mb = forget_peak()
    start = time.perf_counter()
    wanted = method_of(method)
    for spec in specs_of(wanted):
        spec.load()  # what cannot be imported is a failure, not a method that does not suit
    try:
        run = wanted.build(capture if method in REFERENCES else capture.sensor, **params)
    except ValueError as error:
        # A method looks at the sensor when it is made: this one does not suit it.
        return {"status": "unsuited", "error": " ".join(str(error).split())}
    setup_s = time.perf_counter() - start
    if method in REFERENCES:
        return {"status": "ok", "depth": _checked(run(phasors), phasors)}
    start = time.perf_counter()
    depth = _checked(run(phasors), phasors)
    first_call_s = time.perf_counter() - start
    times: list[float] = []
    began = time.perf_counter()
    while len(times) < repeats:
        start = time.perf_counter()
        depth = run(phasors)
        times.append(1e3 * (time.perf_counter() - start))
        if len(times) >= 3 and time.perf_counter() - began > BUDGET_S:
            break
    low, mid, high = np.percentile(times, [25, 50, 75])
    return {
        "status": "ok",
        "depth": depth,
        "setup_s": setup_s,
        "first_call_s": first_call_s,
        "ms": float(mid),
        "ms_iqr": float(high - low),
        "calls": len(times),
        "peak_mb": max(resident_mb("VmHWM") - base_mb, 0.0),
    }


def _checked(depth: object, phasors: Phasors) -> DepthMap:
    if not isinstance(depth, DepthMap) or depth.range_m.shape != phasors.valid.shape:
        got = getattr(getattr(depth, "range_m", None), "shape", type(depth).__name__)
        msg = f"the method must return a DepthMap of shape {phasors.valid.shape}, got {got}"
        raise TypeError(msg)
    return depth


def _store_answer(path: Path, depth: DepthMap) -> None:
    arrays: dict[str, Any] = {"range_m": depth.range_m}
    for name in ("sigma_m", "confidence"):
        if getattr(depth, name) is not None:
            arrays[name] = getattr(depth, name)
    if "model" in depth.info and "models" in depth.info:
        arrays["model"] = np.asarray(depth.info["model"])
        arrays["models"] = np.asarray(depth.info["models"], dtype=np.str_)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def main(job_file: str) -> None:
    """Run the point described in a job file.

    Parameters
    ----------
    job_file : str
        JSON with capture, method, params, repeats, answer and result paths.
    """
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    die_with_parent(int(job["parent"]))
    sys.path.append(job["folder"])  # a user's own method lies where the command was typed
    capture = read_capture(job["capture"])
    try:
        result = measure(capture, job["method"], job["params"], int(job["repeats"]))
        if "depth" in result:
            _store_answer(Path(job["answer"]), result.pop("depth"))
    except Exception as error:  # a method's failure is a result, whatever it raises
        detail = f"{type(error).__name__}: {' '.join(str(error).split())}"
        result = {"status": "failed", "error": detail}
    write_json(Path(job["result"]), result)


if __name__ == "__main__":
    main(sys.argv[1])
