"""Along a stress axis: where a method breaks, how steeply it errs, whether its sigma stays honest.

A method breaks at the first value where its error exceeds that of the uncorrected input (by a
tenth), or twice its own at the easiest value, or where it answers less than half of the pixels.
Between two values the place is interpolated. Every seed breaks at a place of its own: their t
interval (Student 1908) is the interval of the place, in steps of the axis; a seed that holds to the
end counts as one step beyond it. What failed, crashed, ran out of time or does not suit the sensor
of one value counts as broken there: nothing is dropped.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.bench.table import label_of
from toftools.types import F64

WORSE = 2.0
"""Times its own benign error from which a method counts as broken."""
SLACK = 1.1
"""Error over that of the input that still counts as no worse: methods that only unwrap equal it."""
LEAST_VALID = 0.5
LEAST_INSIDE = 0.45
"""Share within one sigma at the easiest values (0.68 is right) below which it is overconfident."""
BENIGN = 2
"""Values of an axis that count as easy."""
UNSTABLE = 1.5
"""Error over that of the input that no method should reach anywhere on an axis."""
NOTICED_M = 0.01
"""And the error itself, m: what is lost on a perfect input is no instability."""
FIGURES = ("mae_m", "input_mae_m", "valid_share", "p99_m")


@dataclass(frozen=True, eq=False)
class Course:
    """One method along one axis.

    Parameters
    ----------
    axis, label : str
        Axis, and the method with its parameters.
    values : ndarray, (V,)
        Values, easiest first.
    error_m, input_m : ndarray, (V, S)
        Mean absolute error of the method and of the uncorrected input, per seed; NaN where there is
        none.
    valid : ndarray, (V, S)
        Share of pixels answered; 0 where the method failed.
    worst_m : ndarray, (V, S)
        99th percentile of the absolute error.
    inside : ndarray, (V, S, 2)
        Share of answers within the intervals of 68 and 95 %; NaN without a sigma.
    failures : tuple of str
        What went wrong, once each.
    unfinished : bool
        Whether points of it were not run yet; they are left out.
    """

    axis: str
    label: str
    values: F64
    error_m: F64
    input_m: F64
    valid: F64
    worst_m: F64
    inside: F64
    failures: tuple[str, ...] = ()
    unfinished: bool = False


@dataclass(frozen=True)
class Stability:
    """What a course amounts to.

    Parameters
    ----------
    axis, label : str
        Axis and method.
    breaks_at : float or None
        Value where it breaks; None if it does not.
    low, high : float or None
        Interval of 95 % of that value; None where that end lies beyond the axis, NaN of one seed.
    seeds : int
        Captures per value.
    share : float
        Part of the axis that it survives, 0..1, in steps of its values.
    why : str
        ``input``, ``own``, ``no answer``, or empty.
    benign_m : float
        Error at the easiest value, m.
    slope_m : float
        Error per unit of the axis, from its easy end to where the error first rises, m; NaN where
        it does not.
    inside_68, inside_95 : float
        Shares within the intervals at the easiest values; NaN without a sigma.
    flags : tuple of str
        ``unstable``, ``overconfident``, ``fails``, ``unfinished``.
    """

    axis: str
    label: str
    breaks_at: float | None
    low: float | None
    high: float | None
    seeds: int
    share: float
    why: str
    benign_m: float
    slope_m: float
    inside_68: float
    inside_95: float
    flags: tuple[str, ...] = ()


def courses(rows: Iterable[Mapping[str, Any]]) -> list[Course]:
    """Courses of all methods along all axes.

    Parameters
    ----------
    rows : iterable of mapping
        Rows of results; those of no axis, what was not run yet, and methods that suit no value of
        an axis are left out.

    Returns
    -------
    list of Course
        In the order of the rows.
    """
    axes: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if "axis" in row:
            axes.setdefault(str(row["axis"]), []).append(row)
    found = []
    for axis, every in axes.items():
        before = _inputs(every)
        by_label: dict[str, list[Mapping[str, Any]]] = {}
        for row in every:
            by_label.setdefault(label_of(row), []).append(row)
        found += [
            _course(axis, label, mine, before)
            for label, mine in by_label.items()
            if any(row["status"] not in ("unsuited", "missing") for row in mine)
        ]
    return found


def _inputs(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[float, int], float]:
    """Error of the uncorrected input of every capture of an axis: any finished row tells it."""
    known = {}
    for row in rows:
        if row["metrics"].get("input_mae_m") is not None:
            known[float(row["value"]), int(row["seed"])] = float(row["metrics"]["input_mae_m"])
    return known


def _course(
    axis: str, label: str, rows: Sequence[Mapping[str, Any]], before: Mapping[Any, float]
) -> Course:
    planned, rows = len(rows), [row for row in rows if row["status"] != "missing"]
    values = list(dict.fromkeys(float(row["value"]) for row in rows))
    seeds = sorted({int(row["seed"]) for row in rows})
    shape = (len(values), len(seeds))
    tables = {name: np.full(shape, np.nan) for name in FIGURES}
    inside = np.full((*shape, 2), np.nan)
    for row in rows:
        at = values.index(float(row["value"])), seeds.index(int(row["seed"]))
        for name in FIGURES:
            got = row["metrics"].get(name)
            tables[name][at] = np.nan if got is None else got
        if row["status"] != "ok":
            tables["valid_share"][at] = 0.0
        tables["input_mae_m"][at] = before.get((float(row["value"]), int(row["seed"])), np.nan)
        told = row.get("intervals") or {}
        inside[at] = [np.nan if told.get(k) is None else told[k] for k in ("68", "95")]
    said = dict.fromkeys(str(row["error"]) for row in rows if row["status"] != "ok")
    return Course(
        axis, label, np.array(values), tables["mae_m"], tables["input_mae_m"],
        tables["valid_share"], tables["p99_m"], inside, tuple(said),
        len(rows) < planned,
    )  # fmt: skip


def stability(course: Course) -> Stability:
    """Where a method breaks, and what to warn of.

    Parameters
    ----------
    course : Course
        The course.

    Returns
    -------
    Stability
        Its figures.
    """
    place, why = _place(_mean(course.error_m), _mean(course.input_m), course.valid)
    why = why if np.isfinite(place) else ""
    low, high = _interval(course)
    last = course.values.size - 1
    easy = course.inside[:BENIGN]
    inside = [float(np.nanmean(part)) if np.isfinite(part).any() else float("nan")
              for part in (easy[..., 0], easy[..., 1])]  # fmt: skip
    return Stability(
        course.axis, course.label,
        None if place > last else _value(course.values, place),
        None if low > last else _value(course.values, low),
        None if high > last else _value(course.values, high), course.error_m.shape[1],
        float(min(place, last) / max(last, 1)), why, float(_mean(course.error_m)[0]),
        _slope(course), inside[0], inside[1], _flags(course, inside[0]),
    )  # fmt: skip


def _mean(table: F64) -> F64:
    """Mean over the seeds that there are; NaN where there is none."""
    known = np.isfinite(table)
    count = known.sum(axis=1)
    total = np.where(known, table, 0).sum(axis=1)
    return np.asarray(np.divide(total, count, out=np.full(len(table), np.nan), where=count > 0))


def _place(error: F64, raw: F64, valid: F64) -> tuple[float, str]:
    """Where errors (V,) break, in steps of the axis, and why; inf if nowhere."""
    answered = _mean(valid) >= LEAST_VALID
    benign = WORSE * error[0]
    # How far beyond each limit, as a ratio: 1 is the limit itself.
    with np.errstate(invalid="ignore", divide="ignore"):
        beyond = {
            "no answer": np.where(answered & np.isfinite(error), 0.0, np.inf),
            "input": np.nan_to_num(error / (SLACK * raw), nan=0.0, posinf=np.inf),
            "own": np.nan_to_num(error / benign) if benign > 0 else np.zeros_like(error),
        }
    return min((_crossing(ratio), why) for why, ratio in beyond.items())


def _crossing(ratio: F64) -> float:
    """Where a ratio first passes 1, in steps, linear in its logarithm; inf if nowhere."""
    broken = np.flatnonzero(ratio > 1)
    if not broken.size:
        return np.inf
    at = int(broken[0])
    if at == 0:
        return 0.0
    before, after = np.log(max(ratio[at - 1], 1e-3)), np.log(ratio[at])
    part = -before / (after - before) if np.isfinite(after) else 0.5
    return at - 1 + float(np.clip(part, 0, 1))


def _interval(course: Course) -> tuple[float, float]:
    """Ends of the t interval of the places of the seeds, in steps; NaN of one seed."""
    from scipy.stats import t

    beyond = float(course.values.size)
    # A crash where the other seeds have answers says nothing of where the method breaks.
    crashed = (course.valid == 0) & (_mean(course.valid) >= LEAST_VALID)[:, None]
    whole = np.flatnonzero(~(crashed | np.isnan(course.valid)).any(axis=0))
    if whole.size < 2:
        return np.nan, np.nan
    places = np.array([
        min(_place(course.error_m[:, s], course.input_m[:, s], course.valid[:, s : s + 1])[0],
            beyond)
        for s in whole
    ])  # fmt: skip
    half = float(t.ppf(0.975, whole.size - 1)) * places.std(ddof=1) / np.sqrt(whole.size)
    return float(max(places.mean() - half, 0.0)), float(min(places.mean() + half, beyond))


def _value(values: F64, place: float) -> float:
    """The value at a place between two; along the logarithm where all are positive."""
    if np.isnan(place):
        return float("nan")
    whole = np.arange(values.size)
    if (values > 0).all():
        return float(np.exp(np.interp(place, whole, np.log(values))))
    return float(np.interp(place, whole, values))


def _slope(course: Course) -> float:
    """Rise from the easy end to the first value that rises by more than its spread over seeds."""
    mean = _mean(course.error_m)
    spread = np.sqrt(_mean((course.error_m - mean[:, None]) ** 2))
    for at in range(1, mean.size):
        if np.isfinite(mean[at]) and mean[at] - mean[0] > spread[at] + spread[0]:
            return float((mean[at] - mean[0]) / abs(course.values[at] - course.values[0]))
    return float("nan")


def _flags(course: Course, inside: float) -> tuple[str, ...]:
    """What a reader must be warned of."""
    error, raw = _mean(course.error_m), _mean(course.input_m)
    found = {
        "unstable": bool(((error > UNSTABLE * raw) & (error > NOTICED_M)).any()),
        "overconfident": inside < LEAST_INSIDE,
        "fails": bool(course.failures),
        "unfinished": course.unfinished,
    }
    return tuple(name for name, so in found.items() if so)
