"""Pictures of one capture for the report: error maps on one scale, and clouds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.plan import Point
from toftools.bench.results import read_result, result_path
from toftools.bench.score import read_answer, reference_of, uncorrected
from toftools.bench.table import label_of
from toftools.camera import points
from toftools.io.native import read_capture
from toftools.types import DepthMap
from toftools.viz.cloud import cloud_png
from toftools.viz.figures import maps_png
from toftools.viz.models import models_png

MOST_LETTERS = 42  # above a map: a longer label would run into the next one
MAX_MAPS = 7  # beside the truth: two rows of four


def best_per_method(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The row with the least MAE of each method (of a reference: every row), best first.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of one capture.

    Returns
    -------
    list of mapping
        At most one row per method.
    """
    best: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        mae = row["metrics"].get("mae_m")
        if row["status"] != "ok" or mae is None:
            continue
        name = label_of(row) if row.get("ms") is None else str(row["method"])
        if name not in best or mae < best[name]["metrics"]["mae_m"]:
            best[name] = row
    return sorted(best.values(), key=lambda row: float(row["metrics"]["mae_m"]))


def _answer(out: Path, row: Mapping[str, Any]) -> DepthMap | None:
    point = Point(str(row["capture_id"]), str(row["method"]), row["params"])
    if read_result(out, point) is None:
        return None
    return read_answer(result_path(out, point).with_suffix(".npz"))


def capture_pictures(
    out: Path, rows: Sequence[Mapping[str, Any]], max_range_m: float
) -> dict[str, bytes]:
    """Error maps and clouds of one capture.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        Its rows.
    max_range_m : float
        Range limit of the suite, m.

    Returns
    -------
    dict of str to bytes
        PNG by name: ``maps``, ``models`` where a method chose one per pixel, ``cloud_reference``,
        ``cloud_input``, ``cloud_best``; empty for a capture with nothing to compare with.
    """
    capture = read_capture(out / "captures" / f"{rows[0]['capture_id']}.h5")
    truth, against = reference_of(capture)
    chosen = best_per_method(rows)[:MAX_MAPS]
    if truth is None or not chosen:
        return {}
    depth = uncorrected(capture, max_range_m)
    error = np.abs(depth.range_m - truth.range_m)
    known = error[np.isfinite(error)]
    limit = max(float(np.percentile(known, 90)) if known.size else 0.1, 1e-3)
    name = "truth" if against == "truth" else "camera's own distance"
    panels = [(name, truth.range_m, "range")]
    answers = [(row, _answer(out, row)) for row in chosen]
    for row, answer in answers:
        if answer is not None:
            label = label_of(row)
            short = label if len(label) <= MOST_LETTERS else f"{label[: MOST_LETTERS - 1]}…"
            title = f"{short}\nMAE {100 * row['metrics']['mae_m']:.2f} cm"
            panels.append((title, answer.range_m - truth.range_m, "error"))
    pictures = {"maps": maps_png(panels, limits={"error": (None, limit)})}
    for row, answer in answers:
        if answer is not None and "model" in answer.info:
            pictures["models"] = models_png(
                np.asarray(answer.info["model"]),
                list(answer.info["models"]),
                np.isfinite(answer.range_m),
                title=f"model that {label_of(row)} chose",
            )
    best = next((a for row, a in answers if a is not None and row.get("ms") is not None), None)
    clouds = {"reference": truth.range_m, "input": depth.range_m}
    if best is not None:
        clouds["best"] = best.range_m
    top = float(np.nanpercentile(truth.range_m, 99))
    for key, range_m in clouds.items():
        shown = np.where(range_m < 1.2 * top, range_m, np.nan)
        xyz = points(capture.sensor.camera, np.asarray(shown, np.float32))
        pictures[f"cloud_{key}"] = cloud_png(xyz, shown, size=(560, 420))
    return pictures
