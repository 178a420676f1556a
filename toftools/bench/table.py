"""Rows of results to one line per method setting, over a capture or over a group of captures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.bench.methods import labelled

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
        MAE per capture id, m; NaN without an answer; empty if nothing can be scored.
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

    @property
    def complete(self) -> bool:
        """Whether every capture got an answer: only means over the same captures compare."""
        return bool(self.per_capture) and bool(np.isfinite(list(self.per_capture.values())).all())


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
    return labelled(str(row["method"]), row["params"])


def groups(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Rows by group and by what they are scored against, in order of appearance.

    Parameters
    ----------
    rows : iterable of mapping
        Rows of results.

    Returns
    -------
    dict of str to list
        Group name, with what it is scored against unless that is truth, to rows.
    """
    beside = {"truth": "", "camera": ", against the camera's own distance"}
    found: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        name = row["group"] + beside.get(row["against"], ", nothing to compare with")
        found.setdefault(name, []).append(row)
    return found


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[Line]:
    """One line per method setting of a group, the uncorrected input first.

    Settings that suit none of the captures have no line: `unsuited` names those.

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
    lines = [
        _line(label, mine)
        for label, mine in by_label.items()
        if any(row["status"] != "unsuited" for row in mine)
    ]
    first = _input_line(rows)
    return [first, *lines] if first else lines


def unsuited(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Methods that suit none of the captures of a group, each with its own words why.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of one group.

    Returns
    -------
    list of str
        One sentence per method.
    """
    methods = dict.fromkeys(str(row["method"]) for row in rows)
    by_method = {name: [row for row in rows if row["method"] == name] for name in methods}
    return [
        f"{name} does not apply here: {mine[0]['error']}"
        for name, mine in by_method.items()
        if all(row["status"] == "unsuited" for row in mine)
    ]


def _line(label: str, rows: Sequence[Mapping[str, Any]]) -> Line:
    good = [row for row in rows if row["status"] == "ok"]
    bad = [row for row in rows if row["status"] != "ok"]
    scored = any("mae_m" in row["metrics"] for row in good)
    empty = sum(scored and row["metrics"].get("mae_m") is None for row in good)
    notes = [f"no answer on {empty} of {len(rows)} captures"] if empty else []
    if bad:
        notes.append(f"{bad[0]['status']} on {len(bad)} of {len(rows)}: {bad[0]['error']}")
    names = dict.fromkeys(name for row in good for name in row["metrics"])
    return Line(
        label=label,
        method=str(rows[0]["method"]),
        timed=any(row.get("ms") is not None for row in good),
        metrics={name: _mean([row["metrics"].get(name) for row in good]) for name in names},
        per_capture={
            row["capture_id"]: _mean([row["metrics"].get("mae_m")]) for row in rows if scored
        },
        ms=_mean([row.get("ms") for row in good]),
        setup_s=_mean([row.get("setup_s") for row in good]),
        first_call_s=_mean([row.get("first_call_s") for row in good]),
        peak_mb=_mean([row.get("peak_mb") for row in good]),
        note="; ".join(notes),
    )


def _input_line(rows: Sequence[Mapping[str, Any]]) -> Line | None:
    """The uncorrected input, which every scored row carries beside its own metrics."""
    per_capture: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        if "input_mae_m" in row["metrics"]:
            per_capture.setdefault(row["capture_id"], row["metrics"])
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
