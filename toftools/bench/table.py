"""Rows of results to tables: per capture, per group, as text for a terminal or as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

INPUT = "input (unwrapped, uncorrected)"


@dataclass(frozen=True)
class Line:
    """One method setting over the captures of a group.

    Parameters
    ----------
    label : str
        Method and parameters.
    method : str
        Method alone.
    timed : bool
        False for reference rows.
    metrics : mapping of str to float
        Mean over captures; NaN where nothing was scored.
    per_capture : mapping of str to float
        MAE per capture, m.
    ms, setup_s, first_call_s, peak_mb : float
        Mean time and memory; NaN if not timed.
    note : str
        What went wrong on some captures, or empty.
    """

    label: str
    method: str
    timed: bool
    metrics: Mapping[str, float]
    per_capture: Mapping[str, float]
    ms: float = float("nan")
    setup_s: float = float("nan")
    first_call_s: float = float("nan")
    peak_mb: float = float("nan")
    note: str = ""


def label_of(row: Mapping[str, Any]) -> str:
    """Method with its parameters, as one would type it.

    Parameters
    ----------
    row : mapping
        Row of results.

    Returns
    -------
    str
        ``name:key=val,...``.

    Examples
    --------
    >>> label_of({"method": "kde", "params": {"window_px": 5}})
    'kde:window_px=5'
    """
    params = ",".join(f"{key}={value}" for key, value in row["params"].items())
    return f"{row['method']}:{params}" if params else str(row["method"])


def groups(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Rows by group, in order of appearance.

    Parameters
    ----------
    rows : iterable of mapping
        Rows of results.

    Returns
    -------
    dict of str to list
        Group name to rows.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault(str(row["group"]), []).append(row)
    return found


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[Line]:
    """One line per method setting of a group, the uncorrected input first.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of one group, or of one capture.

    Returns
    -------
    list of Line
        In the order of the plan.
    """
    by_label: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_label.setdefault(label_of(row), []).append(row)
    lines = [_line(label, mine) for label, mine in by_label.items()]
    first = _input_line(rows)
    return [first, *lines] if first else lines


def _line(label: str, rows: Sequence[Mapping[str, Any]]) -> Line:
    good = [row for row in rows if row["status"] == "ok"]
    bad = [row for row in rows if row["status"] != "ok"]
    note = ""
    if bad:
        note = f"{bad[0]['status']} on {len(bad)} of {len(rows)}: {bad[0].get('error') or ''}"
    names = dict.fromkeys(name for row in good for name in row["metrics"])
    return Line(
        label=label,
        method=str(rows[0]["method"]),
        timed=any(row.get("ms") is not None for row in good),
        metrics={name: _mean([row["metrics"].get(name) for row in good]) for name in names},
        per_capture={
            row["capture"]: _mean([row["metrics"].get("mae_m")]) for row in good if row["metrics"]
        },
        ms=_mean([row.get("ms") for row in good]),
        setup_s=_mean([row.get("setup_s") for row in good]),
        first_call_s=_mean([row.get("first_call_s") for row in good]),
        peak_mb=_mean([row.get("peak_mb") for row in good]),
        note=note,
    )


def _input_line(rows: Sequence[Mapping[str, Any]]) -> Line | None:
    """The uncorrected input, which every scored row carries beside its own metrics."""
    per_capture: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        if "input_mae_m" in row["metrics"]:
            per_capture.setdefault(row["capture"], row["metrics"])
    if not per_capture:
        return None
    names = [name for name in next(iter(per_capture.values())) if "input_" in name]
    return Line(
        label=INPUT,
        method="input",
        timed=False,
        metrics={
            name.replace("input_", ""): _mean([m.get(name) for m in per_capture.values()])
            for name in names
        },
        per_capture={key: _mean([m.get("input_mae_m")]) for key, m in per_capture.items()},
    )


def _mean(values: Iterable[Any]) -> float:
    known = [float(v) for v in values if v is not None and np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")


COLUMNS = (
    ("MAE cm", "mae_m", 100, ".2f"),
    ("median cm", "median_m", 100, ".2f"),
    ("p95 cm", "p95_m", 100, ".2f"),
    ("bias cm", "bias_m", 100, "+.2f"),
    ("< 1 cm %", "under_1cm", 100, ".1f"),
    ("wraps %", "wrap_share", 100, ".2f"),
    ("valid %", "valid_share", 100, ".1f"),
    ("coherence", "coherence", 1, ".4f"),
)
"""Heading, metric, factor, format of the summary columns."""


def cells(line: Line, *, per_capture: bool) -> list[str]:
    """Text of one line, without its label.

    Parameters
    ----------
    line : Line
        The line.
    per_capture : bool
        Whether the MAE of every capture follows.

    Returns
    -------
    list of str
        Mean MAE, MAE per capture, the other summary columns, times, memory.
    """
    found = [number(line.metrics.get(name), scale, form) for _, name, scale, form in COLUMNS]
    if per_capture:
        found.insert(1, " / ".join(number(v, 100, ".2f") for v in line.per_capture.values()))
    found += [number(line.ms, 1, ".2f"), number(line.setup_s, 1, ".2f"),
              number(line.first_call_s, 1, ".2f"), number(line.peak_mb, 1, ".0f")]  # fmt: skip
    return found


def headings(*, per_capture: bool) -> list[str]:
    """Headings of `cells`, the label's included.

    Parameters
    ----------
    per_capture : bool
        As in `cells`.

    Returns
    -------
    list of str
        Column headings.
    """
    found = ["method", *(heading for heading, *_ in COLUMNS)]
    if per_capture:
        found.insert(2, "of each")
    return [*found, "ms", "set-up s", "first s", "MB"]


def number(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
    """A figure for a table; a dash for none.

    Parameters
    ----------
    value : float or None
        Figure.
    scale : float
        Factor.
    form : str
        Format.

    Returns
    -------
    str
        Text.
    """
    return "–" if value is None or not np.isfinite(value) else format(value * scale, form)


def text_table(lines: Sequence[Line]) -> str:
    """Aligned table for a terminal.

    Parameters
    ----------
    lines : sequence of Line
        Lines of one group.

    Returns
    -------
    str
        Text with a heading line.
    """
    many = max((len(line.per_capture) for line in lines), default=0) > 1
    rows = [headings(per_capture=many)]
    rows += [[line.label, *cells(line, per_capture=many)] for line in lines]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    out = []
    for row, line in zip(rows, [None, *lines], strict=True):
        padded = [row[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        out.append("  ".join(padded).rstrip() + (f"  ({line.note})" if line and line.note else ""))
    return "\n".join(out)


def markdown_table(lines: Sequence[Line]) -> str:
    """The same table for README and docs.

    Parameters
    ----------
    lines : sequence of Line
        Lines of one group.

    Returns
    -------
    str
        Markdown.
    """
    many = max((len(line.per_capture) for line in lines), default=0) > 1
    head = headings(per_capture=many)
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    rows += [[f"`{line.label}`", *cells(line, per_capture=many)] for line in lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
