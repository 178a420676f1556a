"""Points of one method in one process: ``python -m toftools.bench.worker JOB.json``.

The answer is stored, so that scoring needs no rerun. A result file is written last and atomically:
it exists if and only if its point is finished. `toftools.bench.crew` starts workers and watches.
"""

import contextlib
import ctypes
import gc
import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.measure import measure, prime, sentence
from toftools.bench.memory import go_first
from toftools.bench.methods import method_of
from toftools.bench.plan import write_json
from toftools.bench.references import REFERENCES
from toftools.bench.sensitivity import local_measures
from toftools.io.atomic import atomic_path
from toftools.io.native import read_capture
from toftools.types import DepthMap


def die_with_parent(parent: int) -> None:
    """End this process when the benchmark that started it ends, however that ends.

    Parameters
    ----------
    parent : int
        Its process id.
    """
    if sys.platform == "linux":
        import signal

        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent and os.getppid() != parent:  # it ended before we could ask
        sys.exit(1)


def _store_answer(path: Path, depth: DepthMap) -> None:
    arrays: dict[str, Any] = {"range_m": depth.range_m}
    for name in ("sigma_m", "confidence"):
        if getattr(depth, name) is not None:
            arrays[name] = getattr(depth, name)
    if "model" in depth.info and "models" in depth.info:
        arrays["model"], arrays["models"] = _models(depth)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def _models(depth: DepthMap) -> tuple[Any, Any]:
    """The map of models and their names, checked: the report draws them."""
    model = np.asarray(depth.info["model"])
    names = np.asarray(depth.info["models"], dtype=np.str_)
    whole = model.dtype.kind in "iu" and model.shape == depth.range_m.shape and names.ndim == 1
    if not whole or not 0 <= int(model.min()) <= int(model.max()) < names.size:
        msg = (
            f"info['model'] must be a map {depth.range_m.shape} of whole numbers below the "
            f"{names.size} names in info['models'], got {model.dtype} {model.shape}"
        )
        raise ValueError(msg)
    return model, names


def _finish(job: Mapping[str, Any], point: Mapping[str, Any], ends_s: float) -> dict[str, Any]:
    """Run a point to its end; its result."""
    try:
        capture = read_capture(point["capture"])
        result = measure(capture, job["method"], point["params"], int(job["repeats"]))
        run, depth = result.pop("run", None), result.pop("depth", None)
        if depth is not None:
            _store_answer(Path(point["answer"]), depth)
        if job["sensitivity"] and "ms" in result:  # references are not timed
            left_s = ends_s - time.monotonic()
            result |= local_measures(run, capture, depth, call_s=1e-3 * result["ms"], left_s=left_s)
    except BaseException as error:  # a method's failure is a result, whatever it raises
        return {"status": "failed", "error": sentence(error)}
    return result


def _tidy() -> None:
    """Give back what the last point left, so that the next one's memory is its own."""
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):  # glibc's alone
        ctypes.CDLL(None).malloc_trim(0)


def _warm(job: Mapping[str, Any]) -> None:
    """Run the method of a batch once, on the first capture that it suits."""
    for point in job["points"]:
        try:
            prime(read_capture(point["capture"]), method_of(job["method"]), point["params"])
        except ValueError:  # perhaps the sensor of this capture alone
            continue
        except BaseException:  # the point itself will say what is wrong
            return
        return


def main(job_file: str) -> None:
    """Run the points described in a job file, one after another.

    Parameters
    ----------
    job_file : str
        JSON with method, repeats, whether sensitivities are wanted, the limit of time, a stamp
        for all results, a progress file, and for each point capture, params, answer and result
        paths.
    """
    began_s = time.monotonic()
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    die_with_parent(int(job["parent"]))
    go_first()
    sys.path.append(job["folder"])  # a user's own method lies where the command was typed
    if job["batch"] and job["method"] not in REFERENCES:
        # All points of a batch find the method warm, the first one too.
        _warm(job)
    for number, point in enumerate(job["points"]):
        if job["batch"]:
            _tidy()
            Path(job["progress"]).write_text(str(number), encoding="ascii")
            began_s = time.monotonic()
        ends_s = began_s + float(job["timeout_s"])
        write_json(Path(point["result"]), {**_finish(job, point, ends_s), **job["stamp"]})


if __name__ == "__main__":
    main(sys.argv[1])
