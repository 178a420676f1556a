"""Absolute error of every pixel of the stored answers of a benchmark folder."""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.plan import Point
from toftools.bench.results import read_result, result_path
from toftools.bench.score import read_answer, reference_of
from toftools.io.native import read_capture
from toftools.metrics.regions import regions
from toftools.phasor import phasors_of
from toftools.types import F64, Capture, Truth


def key_of(row: Mapping[str, Any]) -> str:
    """Key of the point of a row.

    Parameters
    ----------
    row : mapping
        Row of results.

    Returns
    -------
    str
        As `plan.Point.key`.
    """
    return Point(str(row["capture_id"]), str(row["method"]), row["params"]).key


def pixel_errors(
    out: Path, rows: Mapping[str, Mapping[str, Any]], limits: Mapping[str, float]
) -> Callable[[str], F64 | None]:
    """What reads the errors of a point.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : mapping
        Key of a point to its row.
    limits : mapping
        ``min_range_m`` and ``max_range_m`` of the suite.

    Returns
    -------
    callable
        Key to absolute error (H, W), m: infinite without an answer, NaN where nothing is scored;
        None if the point has no answer or the capture no truth.
    """

    @cache
    def truth_m(capture_id: str) -> F64 | None:
        capture = read_capture(out / "captures" / f"{capture_id}.h5")
        truth, against = reference_of(capture)
        if truth is None or against != "truth":
            return None
        scored = Capture(
            sensor=capture.sensor, phasors=phasors_of(capture), truth=Truth(truth.range_m)
        )
        return np.where(regions(scored, **limits)["all"], truth.range_m.astype(float), np.nan)

    def errors(key: str) -> F64 | None:
        row = rows.get(key)
        if row is None or row["status"] != "ok":
            return None
        point = Point(str(row["capture_id"]), str(row["method"]), row["params"])
        known = truth_m(point.capture)
        if known is None or read_result(out, point) is None:
            return None
        range_m = read_answer(result_path(out, point).with_suffix(".npz")).range_m
        off_m = np.abs(range_m.astype(np.float64) - known)
        answered = np.where(np.isfinite(range_m), off_m, np.inf)
        return np.where(np.isnan(known), np.nan, answered)

    return errors
