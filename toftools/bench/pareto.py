"""Speed against accuracy of one group: the chart, with the spread over captures and over calls."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.figures import write_chart
from toftools.bench.render import number
from toftools.bench.rows import finite
from toftools.bench.table import Line, label_of
from toftools.viz.figures import Curve, pareto_svg

LEAST_CAPTURES = 2
"""Captures from which a spread over captures is drawn."""


def pareto(
    out: Path, rows: Sequence[Mapping[str, Any]], lines: Sequence[Line], *, title: str, stem: str
) -> str:
    """Chart of the settings that answer every capture; written to ``figures`` too.

    Vertical bars run from the first to the third quartile of the mean absolute error over the
    captures of the group: how much captures differ, not how sure the mean is. A mean may lie
    outside where a few captures err by far the most. Horizontal bars are as wide as the mean
    interquartile range of repeated calls.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        Rows of the group.
    lines : sequence of Line
        Their summary.
    title : str
        Name of the group.
    stem : str
        Stem of the files.

    Returns
    -------
    str
        SVG.
    """
    iqr_ms = _iqr_ms(rows)
    curves: dict[str, list[Line]] = {}
    for line in lines:
        if line.complete:
            curves.setdefault(line.method if line.timed else line.label, []).append(line)
    drawn = [
        Curve(
            name="uncorrected input" if name.startswith("input") else name,
            ms=[line.ms for line in mine],
            mae_m=[_mae_m(line) for line in mine],
            labels=[_tooltip(line) for line in mine],
            timed=mine[0].timed,
            spread_m=[_quartiles(line) for line in mine],
            iqr_ms=[iqr_ms.get(line.label, float("nan")) for line in mine],
        )
        for name, mine in curves.items()
    ]
    svg = pareto_svg(drawn, title=f"Speed against accuracy: {title}")
    table = [_figures(line, iqr_ms) for mine in curves.values() for line in mine]
    write_chart(out, stem, svg, table)
    return svg


def _mae_m(line: Line) -> float:
    return line.metrics.get("mae_m", float("nan"))


def _iqr_ms(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Mean over captures of the interquartile range of repeated calls, ms, by setting."""
    found: dict[str, list[float]] = {}
    for row in rows:
        iqr_ms = finite(row.get("ms_iqr"))
        if np.isfinite(iqr_ms):
            found.setdefault(label_of(row), []).append(iqr_ms)
    return {label: float(np.mean(values)) for label, values in found.items()}


def _quartiles(line: Line) -> tuple[float, float]:
    """First and third quartile of the error over captures, m; NaN for a single capture."""
    errors = list(line.per_capture.values())
    if len(errors) < LEAST_CAPTURES:
        return float("nan"), float("nan")
    low, high = np.percentile(errors, [25, 75])
    return float(low), float(high)


def _figures(line: Line, iqr_ms: Mapping[str, float]) -> dict[str, Any]:
    low, high = _quartiles(line)
    return {
        "method": line.method, "setting": line.label, "ms": line.ms,
        "ms_iqr": iqr_ms.get(line.label), "mae_m": _mae_m(line), "mae_q25_m": low,
        "mae_q75_m": high, "captures": len(line.per_capture),
        "valid_share": line.metrics.get("valid_share"),
    }  # fmt: skip


def _tooltip(line: Line) -> str:
    """The parameters, which the method's name stands before, and the share of pixels answered."""
    own = line.label.removeprefix(line.method).removeprefix(":")
    return f"{own} ({number(line.metrics.get('valid_share'), 100, '.1f')} % valid)".strip()
