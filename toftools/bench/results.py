"""Finished points: where their results lie, which of them count, and who may write there."""

import contextlib
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from toftools.bench.plan import Point


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
