"""The stress axes of a report: a matrix of methods and axes, a curve for each, and a table of all.

``DIR/stability.csv`` and ``DIR/stability.json`` hold the same figures for programs.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.figures import slug, write_tables
from toftools.bench.render import number
from toftools.bench.stability import Course, Stability, courses, stability
from toftools.types import F64
from toftools.viz._axes import number as written
from toftools.viz.stress import Strain, stress_svg

INPUT = "uncorrected input"
ORANGE, PALE, BLUE = (213, 94, 0), (247, 245, 240), (0, 114, 178)
"""Colours of nothing survived, half of the axis, all of it; told apart by all eyes."""
WHY = {
    "input": "it errs more than the uncorrected input",
    "own": "it errs twice as much as where the axis is easiest",
    "no answer": "it answers less than half of the pixels, or fails",
    "": "it does not break on this axis",
}


def stress(out: Path, rows: Sequence[Mapping[str, Any]], axes: Mapping[str, str]) -> dict[str, Any]:
    """What the report shows of the stress axes; writes tables beside it.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        Rows of results with an axis.
    axes : mapping of str to str
        What each axis is, with its unit.

    Returns
    -------
    dict
        For the template; empty without rows.
    """
    found = [(course, stability(course)) for course in courses(rows)]
    if not found:
        return {}
    write_tables(out, "stability", [asdict(told) for _, told in found])
    names = list(dict.fromkeys(course.axis for course, _ in found))
    labels = list(dict.fromkeys(course.label for course, _ in found))
    cells = {(told.axis, told.label): told for _, told in found}
    return {
        "axes": [{"name": name, "id": slug(name)} for name in names],
        "methods": [
            {"label": label, "cells": [_cell(cells.get((name, label))) for name in names]}
            for label in labels
        ],
        "curves": [_curves(name, found, axes.get(name, "")) for name in names],
    }


def _cell(told: Stability | None) -> dict[str, str]:
    """One field of the matrix."""
    if told is None:
        return {"text": "–", "style": "", "tip": "does not apply", "flags": "", "share": ""}
    text = "holds" if told.breaks_at is None else written(told.breaks_at)
    ends = ["beyond" if e is None else written(e) for e in (told.low, told.high)]
    one = told.low is not None and math.isnan(told.low)
    tip = f"{told.label} on {told.axis}: {WHY[told.why]}"
    if told.breaks_at is not None:
        tip += f" from {text}" + ("" if one else f" (95 %: {ends[0]} to {ends[1]})")
    tip += f"; benign error {number(told.benign_m, 100)} cm"
    if math.isfinite(told.inside_68):
        tip += f"; within one sigma {told.inside_68:.0%}, within 95 % {told.inside_95:.0%}"
    if told.flags:
        tip += "; " + ", ".join(told.flags)
    marks = {"unstable": "u", "overconfident": "o", "fails": "f", "unfinished": "n"}
    return {"text": text, "style": _colour(told.share), "tip": tip,
            "flags": "".join(marks[flag] for flag in told.flags),
            "share": f"{told.share:.4f}"}  # fmt: skip


def _colour(share: float) -> str:
    """Background and ink for a part of an axis that was survived."""
    first, second, part = (ORANGE, PALE, 2 * share) if share < 0.5 else (PALE, BLUE, 2 * share - 1)
    mixed = [round(a + part * (b - a)) for a, b in zip(first, second, strict=True)]
    ink = "#fff" if abs(share - 0.5) > 0.35 else "#1d2330"
    return f"background:rgb({mixed[0]},{mixed[1]},{mixed[2]});color:{ink}"


def _curves(name: str, found: Sequence[tuple[Course, Stability]], about: str) -> dict[str, Any]:
    """Chart and table of one axis."""
    mine = [(course, told) for course, told in found if course.axis == name]
    values = sorted({v for c, _ in mine for v in c.values}, key=_order(mine))
    raw = max((c for c, _ in mine), key=lambda c: int(np.isfinite(c.input_m).sum()))
    strains = [Strain(INPUT, _placed(raw.input_m, raw, values))]
    strains += [Strain(c.label, _placed(c.error_m, c, values)) for c, _ in mine]
    svg = stress_svg(values, strains, title=name, name=about or name)
    head = ["method", "benign cm", "breaks at", "95 % from", "to", "cm per unit", "in 68 %",
            "in 95 %", "worst 1 % benign, cm", "warnings"]  # fmt: skip
    body = [
        [t.label, number(t.benign_m, 100),
         *(_or_dash(x) for x in (t.breaks_at, t.low, t.high, 100 * t.slope_m)),
         number(t.inside_68, 100, ".0f"), number(t.inside_95, 100, ".0f"),
         number(_benign(c.worst_m), 100), ", ".join((*t.flags, *c.failures))]
        for c, t in mine
    ]  # fmt: skip
    return {"name": name, "id": slug(name), "about": about, "svg": svg,
            "table": {"head": head, "rows": body}}  # fmt: skip


def _or_dash(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else written(value)


def _benign(figures: Any) -> float | None:  # noqa: ANN401 - an array
    """Mean over the seeds of the easiest value."""
    first = figures[0][np.isfinite(figures[0])]
    return float(first.mean()) if first.size else None


def _order(mine: Sequence[tuple[Course, Stability]]) -> Callable[[float], int]:
    """Key that sorts values from easy to hard: as in the longest course; others after them."""
    longest = max((c.values.tolist() for c, _ in mine), key=len)
    return lambda value: longest.index(value) if value in longest else len(longest)


def _placed(table: F64, course: Course, values: Sequence[float]) -> F64:
    """A table of a course on all values of its axis, NaN where it has none."""
    whole = np.full((len(values), table.shape[1]), np.nan)
    whole[[values.index(value) for value in course.values]] = table
    return whole
