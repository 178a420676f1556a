"""Local sensitivities in a report: a line per method, and at the ends and breaks of stress axes.

``DIR/sensitivity.csv`` and ``DIR/sensitivity.json`` hold the medians over the seeds at every value
of every axis. What each figure is: `sensitivity`, `bound`, `toftools.correct._transport_radius`.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.figures import write_tables
from toftools.bench.render import number
from toftools.bench.sensitivity import NORMAL_MEDIAN
from toftools.bench.table import label_of
from toftools.viz._axes import number as written

COLUMNS = (
    ("noise", "noise", 1, ".2f"),
    ("jumps %", "jumps", 100, ".2f"),
    ("scale %", "scale", 100, ".2f"),
    ("shift mm", "shift_m", 1000, ".2f"),
    ("error / bound", "error_over_bound", 1, ".1f"),
    ("spectral radius", "spectral_radius", 1, ".3f"),
)
"""Heading, figure, factor, format."""
FIGURES = tuple(name for _, name, _, _ in COLUMNS)

Row = Mapping[str, Any]


def local(out: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """What the report shows of local sensitivity; writes the tables beside it.

    Parameters
    ----------
    out : Path
        Benchmark folder; where axes break is read from its ``stability.json``.
    rows : sequence of mapping
        Rows of results.

    Returns
    -------
    dict
        For the template; empty where no sensitivity was asked for.
    """
    asked = {
        label_of(row) for row in rows if row.get("sensitivity") or row.get("sensitivity_error")
    }
    by_label: dict[str, list[Row]] = {}
    for row in rows:
        # A point that failed has no figures, and counts.
        if label_of(row) in asked and row["status"] not in ("unsuited", "missing"):
            by_label.setdefault(label_of(row), []).append(row)
    if not by_label:
        return {}
    mine = [row for part in by_label.values() for row in part]
    lines = _lines([row for row in mine if "axis" in row], _breaks(out))
    if lines:
        write_tables(out, "sensitivity", lines)
    body = [[label, *_cells(_medians(part)), _failed(part)] for label, part in by_label.items()]
    return {
        "table": {"head": ["method", *(c[0] for c in COLUMNS), "failed"], "rows": body},
        "notes": _notes(by_label),
        "axes": [_axis(name, lines) for name in dict.fromkeys(line["axis"] for line in lines)],
    }


def figures_of(row: Row) -> dict[str, float]:
    """Local figures of one point.

    Parameters
    ----------
    row : mapping
        A row of results.

    Returns
    -------
    dict of str to float
        `FIGURES`; NaN where there is none. ``error_over_bound`` is the median absolute error over
        0.6745 bounds: 1 for an efficient estimator and nothing but noise.
    """
    told = row.get("sensitivity") or {}
    found = {name: told.get(name) for name in ("noise", "jumps", "scale", "shift_m")}
    error_m, bound_m = row["metrics"].get("median_m"), row.get("bound_m")
    if error_m is not None and bound_m:
        found["error_over_bound"] = error_m / (NORMAL_MEDIAN * bound_m)
    found["spectral_radius"] = row.get("spectral_radius")
    return {name: _number(found.get(name)) for name in FIGURES}


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _medians(rows: Iterable[Row]) -> dict[str, float]:
    """Median of every figure over the rows that have it."""
    found = [figures_of(row) for row in rows]
    known = {name: [one[name] for one in found if math.isfinite(one[name])] for name in FIGURES}
    return {name: float(np.median(k)) if k else float("nan") for name, k in known.items()}


def _cells(figures: Mapping[str, float]) -> list[str]:
    return [number(figures[name], scale, form) for _, name, scale, form in COLUMNS]


def _failed(rows: Sequence[Row]) -> str:
    """How many points have no sensitivities."""
    without = sum(not row.get("sensitivity") for row in rows)
    return f"{without} of {len(rows)}" if without else ""


def _notes(by_label: Mapping[str, Sequence[Row]]) -> list[str]:
    """What was said where something could not be had, once each."""
    return [
        f"{label}: {said}"
        for label, rows in by_label.items()
        for said in dict.fromkeys(r.get("sensitivity_error") for r in rows)
        if said
    ]


def _breaks(out: Path) -> dict[tuple[str, str], float]:
    """Where methods break, by axis and label, as the stress part of the report wrote it."""
    try:
        told = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    return {
        (one["axis"], one["label"]): float(one["breaks_at"])
        for one in told
        if one["breaks_at"] is not None
    }


def _lines(
    rows: Sequence[Row], breaks: Mapping[tuple[str, str], float]
) -> list[dict[str, Any]]:  # fmt: skip
    """One line per axis, method and value, in the order of the rows: easiest first."""
    found: dict[tuple[str, str], dict[float, list[Row]]] = {}
    for row in rows:
        course = found.setdefault((str(row["axis"]), label_of(row)), {})
        course.setdefault(float(row["value"]), []).append(row)
    lines = []
    for (axis, label), course in found.items():
        values = list(course)
        at_break = _nearest(values, breaks[axis, label]) if (axis, label) in breaks else None
        for value, mine in course.items():
            places = {"easiest": value == values[0], "breaks": value == at_break}
            lines.append({
                "axis": axis, "label": label, "value": value,
                "place": " ".join(name for name, so in places.items() if so),
                **_medians(mine), "errors": sum(not row.get("sensitivity") for row in mine),
            })  # fmt: skip
    return lines


def _nearest(values: Sequence[float], place: float) -> float:
    """The value next to a place, along the logarithm where all are positive."""
    positive = place > 0 and min(values) > 0
    return min(values, key=lambda v: abs(math.log(v / place) if positive else v - place))


def _axis(name: str, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Table of one axis: every method at the easy end, and where it breaks."""
    body = [
        [f"{line['label']} at {written(line['value'])}", line["place"].replace(" ", ", "),
         *_cells(line)]
        for line in lines
        if line["axis"] == name and line["place"]
    ]  # fmt: skip
    return {
        "name": name,
        "table": {"head": ["method", "where", *(c[0] for c in COLUMNS)], "rows": body},
    }
