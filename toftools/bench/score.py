"""Third stage: stored answers to ``DIR/results.jsonl``; no method runs here.

Every metric stands beside the same metric of the uncorrected input: the camera's phasors unwrapped
(`crt` within the suite's range limit, or `single` for one frequency) with nothing done about
multipath. Captures without truth are compared with the camera's own distance, and the row says so
(``against``).
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.bound import median_bound_m
from toftools.bench.plan import Point, read_plan
from toftools.bench.results import read_result, result_path
from toftools.bench.rows import read_rows as read_rows
from toftools.io.atomic import atomic_path
from toftools.io.native import read_capture
from toftools.metrics.coverage import coverage_curve
from toftools.metrics.interval import inside_interval
from toftools.metrics.regions import regions
from toftools.metrics.spread import z_spread
from toftools.phasor import phasors_of
from toftools.registry import CORRECTIONS, METRICS, parameters_of
from toftools.types import Bool, Capture, DepthMap, Truth
from toftools.units import ambiguity_m

LEVELS = (0.1, 0.3, 0.5, 0.68, 0.8, 0.9, 0.95, 0.99)
"""Intervals of sigma whose promise is checked."""
AXIS = ("axis", "value", "seed")
# Distributions compare whole images; a region of one has too few pixels to fill a histogram.
WHOLE_IMAGE = ("range_", "gradient_", "cooccurrence_", "haar_")


def reference_of(capture: Capture) -> tuple[Truth | None, str]:
    """What to score a capture against.

    Parameters
    ----------
    capture : Capture
        The capture.

    Returns
    -------
    Truth or None, str
        Truth and ``"truth"``; or the camera's own distance and ``"camera"``; or None.
    """
    if capture.truth is not None:
        return capture.truth, "truth"
    raw = capture.taps is not None or capture.phasors is not None
    # A depth-only capture is its own input: scored against itself every method would be perfect.
    if raw and capture.depth is not None and np.isfinite(capture.depth.range_m).any():
        return Truth(capture.depth.range_m), "camera"
    return None, "nothing"


def uncorrected(capture: Capture, max_range_m: float = float("inf")) -> DepthMap:
    """The input of every correction: unwrapped, multipath left in.

    Parameters
    ----------
    capture : Capture
        The capture.
    max_range_m : float
        Where the scene is known to end, m; infinite for the joint ambiguity range.

    Returns
    -------
    DepthMap
        `crt` for several frequencies, `single` for one.
    """
    if capture.sensor.modulation.n_freqs > 1:
        limit = max_range_m if np.isfinite(max_range_m) else 0.0
        run = CORRECTIONS["crt"].build(capture.sensor, max_range_m=limit)
    else:
        run = CORRECTIONS["single"].build(capture.sensor)
    depth: DepthMap = run(phasors_of(capture))
    return depth


def evaluate(
    depth: DepthMap, truth: Truth, masks: Mapping[str, Bool], wrap_m: float
) -> dict[str, float]:
    """All metrics of an answer, error metrics also by region.

    Parameters
    ----------
    depth : DepthMap
        Answer.
    truth : Truth
        What it should be.
    masks : mapping of str to ndarray, (H, W), bool
        Regions; ``all`` among them.
    wrap_m : float
        Smallest ambiguity range, m.

    Returns
    -------
    dict
        ``name`` for the whole image, ``region.name`` for a region.
    """
    scores = {}
    for region, mask in masks.items():
        for name, spec in METRICS.items():
            if region != "all" and name.startswith(WHOLE_IMAGE):
                continue
            takes = parameters_of(spec.load())
            extra = {"ambiguity_m": wrap_m} if "ambiguity_m" in takes else {}
            value = spec.build(truth, mask=mask, **extra)(depth)
            scores[name if region == "all" else f"{region}.{name}"] = float(value)
    return scores


def score(out: Path) -> list[dict[str, Any]]:
    """Score every point of a benchmark folder and write ``results.jsonl``.

    Parameters
    ----------
    out : Path
        Folder that ``bench run`` filled.

    Returns
    -------
    list of dict
        One row per point, in the order of the plan.

    Raises
    ------
    ValueError
        If the folder holds no benchmark.
    """
    plan, points = read_plan(out)
    limits, own = plan["mask"], _owned(plan)
    rows = []
    for item in plan["captures"]:
        mine = [point for point in points if point.capture == item["id"]]
        scorer = _Scorer.of(out, item, limits)
        for point in mine:
            row = _row(plan["suite"], item, point, out, scorer)
            if point.key in own:  # no point of an axis, even if its capture is
                row = {k: v for k, v in row.items() if k not in AXIS} | {"ladders": own[point.key]}
            rows.append(row)
    with atomic_path(out / "results.jsonl") as temporary:
        text = "".join(json.dumps(_finite(row)) + "\n" for row in rows)
        temporary.write_text(text, encoding="utf-8")
    return rows


def _owned(plan: Mapping[str, Any]) -> dict[str, list[str]]:
    """Points that only ladders ask for, with the names of those."""
    found: dict[str, list[str]] = {}
    for name, ladder in plan.get("ladders", {}).items():
        for key in ladder["own"]:
            found.setdefault(key, []).append(name)
    return found


class _Scorer:
    """Truth, masks and input scores of one capture, made once for all its points."""

    def __init__(self, truth: Truth | None, against: str) -> None:
        self.truth, self.against = truth, against
        self.masks: dict[str, Bool] = {}
        self.input: dict[str, float] = {}
        self.wrap_m = float("inf")
        self.bound_m: float | None = None

    @classmethod
    def of(cls, out: Path, item: Mapping[str, Any], limits: Mapping[str, float]) -> "_Scorer":
        capture = read_capture(out / "captures" / f"{item['id']}.h5")
        truth, against = reference_of(capture)
        scorer = cls(truth, against)
        if truth is not None:
            scorer.wrap_m = float(ambiguity_m(capture.sensor.modulation.freqs_hz).min())
            scored = Capture(
                sensor=capture.sensor,
                phasors=phasors_of(capture),
                depth=capture.depth,
                truth=Truth(truth.range_m),
            )
            scorer.masks = regions(scored, **limits)
            freqs_hz = capture.sensor.modulation.freqs_hz
            scorer.bound_m = median_bound_m(phasors_of(scored), freqs_hz, scorer.masks["all"])
            plain = uncorrected(capture, limits["max_range_m"])
            scorer.input = evaluate(plain, truth, scorer.masks, scorer.wrap_m)
        return scorer


def _row(
    suite: str, item: Mapping[str, Any], point: Point, out: Path, scorer: _Scorer
) -> dict[str, Any]:
    result = read_result(out, point) or {"status": "missing", "error": "not run yet"}
    row: dict[str, Any] = {
        "suite": suite,
        "capture": item["name"],
        "capture_id": item["id"],
        "group": item["group"],
        **{key: item[key] for key in AXIS if key in item},
        "method": point.method,
        "params": dict(point.params),
        "against": scorer.against,
        "bound_m": scorer.bound_m,
        "metrics": {},
        **{key: result.get(key) for key in ("status", "error", "setup_s", "first_call_s", "ms",
                                           "ms_iqr", "peak_mb", "versions", "machine",
                                           "sensitivity", "sensitivity_error",
                                           "spectral_radius")},
    }  # fmt: skip
    if result["status"] != "ok":
        return row
    depth = read_answer(result_path(out, point).with_suffix(".npz"))
    if scorer.truth is not None:
        scores = evaluate(depth, scorer.truth, scorer.masks, scorer.wrap_m)
        beside = {_input_name(name): value for name, value in scorer.input.items()}
        row["metrics"] = {**scores, **beside}
        row["pixels"] = {name: int(mask.sum()) for name, mask in scorer.masks.items()}
        row["intervals"] = {
            f"{100 * level:.0f}": inside_interval(
                scorer.truth, level=level, mask=scorer.masks["all"]
            )(depth)
            for level in LEVELS
        }
        rms, robust = z_spread(scorer.truth, mask=scorer.masks["all"])(depth)
        row["z"] = {"rms": rms, "robust": robust}
        curve = coverage_curve(depth=depth, truth=scorer.truth, mask=scorer.masks["all"],
                               max_points=40)  # fmt: skip
        row["coverage"] = {name: getattr(curve, name).tolist() for name in ("coverage", "mae_m")}
    else:
        row["metrics"] = {"valid_share": float(np.isfinite(depth.range_m).mean())}
    return row


def _input_name(name: str) -> str:
    region, dot, metric = name.rpartition(".")
    return f"{region}{dot}input_{metric}"


def read_answer(path: Path) -> DepthMap:
    """Answer of a point as the worker stored it.

    Parameters
    ----------
    path : Path
        npz file.

    Returns
    -------
    DepthMap
        Range, sigma, confidence; ``info`` holds the map of models where the method chose.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            maps = {name: stored[name] for name in stored.files}
            info = {name: maps.pop(name) for name in ("model", "models") if name in maps}
            return DepthMap(**maps, info=info)
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        msg = f"{path} is damaged; delete it and run the suite again"
        raise ValueError(msg) from error


def _finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """The value with NaN and infinity as null: JSON has neither."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
