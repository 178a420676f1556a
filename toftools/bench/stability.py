"""Along a stress axis: where a method breaks, how steeply it errs, whether its sigma stays honest.

A method breaks at the first value where its error exceeds that of the uncorrected input (by a
tenth), or twice its own at the easiest value, or where it answers less than half of the pixels.
Between two values the place is interpolated; its interval comes from drawing the seeds again
(bootstrap). What failed, crashed or ran out of time counts as broken there: nothing is dropped.
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
DRAWS = 400
"""Times that the seeds are drawn again."""
LEAST_INSIDE = 0.45
"""Share within one sigma at the easiest values (0.68 is right) below which it is overconfident."""
BENIGN = 2
"""Values of an axis that count as easy."""
UNSTABLE = 1.5
"""Error over that of the input that no method should reach anywhere on an axis."""
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
        Mean absolute error of the method and of the uncorrected input, per seed; infinite where
        there is no answer.
    valid : ndarray, (V, S)
        Share of pixels answered.
    worst_m : ndarray, (V, S)
        99th percentile of the absolute error.
    inside : ndarray, (V, S, 2)
        Share of answers within the intervals of 68 and 95 %; NaN without a sigma.
    failures : tuple of str
        What went wrong, once each.
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
        Percentiles 2.5 and 97.5 of that value over seeds drawn again: of few seeds about the
        smallest and the largest; None where that end lies beyond the axis.
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
        ``unstable``, ``overconfident``, ``fails``.
    """

    axis: str
    label: str
    breaks_at: float | None
    low: float | None
    high: float | None
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
        Rows of results; those of no axis, of methods that do not suit one, and what was not run yet
        are left out.

    Returns
    -------
    list of Course
        In the order of the rows.
    """
    found: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        if "axis" in row and row["status"] not in ("unsuited", "missing"):
            found.setdefault((str(row["axis"]), label_of(row)), []).append(row)
    return [_course(axis, label, mine) for (axis, label), mine in found.items()]


def _course(axis: str, label: str, rows: Sequence[Mapping[str, Any]]) -> Course:
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
        told = row.get("intervals") or {}
        inside[at] = [np.nan if told.get(k) is None else told[k] for k in ("68", "95")]
    error = np.where(np.isfinite(tables["mae_m"]), tables["mae_m"], np.inf)
    valid = np.nan_to_num(tables["valid_share"], nan=0.0)
    said = dict.fromkeys(str(row["error"]) for row in rows if row["status"] != "ok")
    return Course(
        axis, label, np.array(values), error, tables["input_mae_m"], valid, tables["p99_m"], inside,
        tuple(said),
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
    place, why = _place(course, np.arange(course.error_m.shape[1]))
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
        None if high > last else _value(course.values, high),
        float(min(place, last) / max(last, 1)), why, float(np.mean(course.error_m[0])),
        _slope(course), inside[0], inside[1], _flags(course, inside[0]),
    )  # fmt: skip


def _place(course: Course, seeds: Any) -> tuple[float, str]:  # noqa: ANN401 - an index array
    """Where the mean over some seeds breaks, in steps of the axis, and why; inf if nowhere."""
    with np.errstate(invalid="ignore"):
        error, raw = course.error_m[:, seeds].mean(axis=1), course.input_m[:, seeds].mean(axis=1)
        valid = course.valid[:, seeds].mean(axis=1)
        # How far beyond each limit, as a ratio: 1 is the limit itself.
        beyond = {
            "no answer": np.where(valid < LEAST_VALID, np.inf, 0.0),
            "input": np.nan_to_num(error / (SLACK * raw), nan=0.0, posinf=np.inf),
            "own": error / (WORSE * error[0]) if 0 < error[0] < np.inf else np.zeros_like(error),
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
    """Percentiles 2.5 and 97.5 of the place over seeds drawn again."""
    count = course.error_m.shape[1]
    rng = np.random.default_rng(0)
    places = [_place(course, rng.integers(count, size=count))[0] for _ in range(DRAWS)]
    low, high = np.quantile(np.minimum(places, course.values.size), [0.025, 0.975])
    return float(low), float(high)


def _value(values: F64, place: float) -> float:
    """The value at a place between two; along the logarithm where all are positive."""
    whole = np.arange(values.size)
    if (values > 0).all():
        return float(np.exp(np.interp(place, whole, np.log(values))))
    return float(np.interp(place, whole, values))


def _slope(course: Course) -> float:
    """Rise from the easy end to the first value that rises by more than its spread over seeds."""
    with np.errstate(invalid="ignore"):  # infinite where there is no answer
        mean, spread = course.error_m.mean(axis=1), course.error_m.std(axis=1)
    for at in range(1, mean.size):
        if np.isfinite(mean[at]) and mean[at] - mean[0] > spread[at] + spread[0]:
            return float((mean[at] - mean[0]) / abs(course.values[at] - course.values[0]))
    return float("nan")


def _flags(course: Course, inside: float) -> tuple[str, ...]:
    """What a reader must be warned of."""
    with np.errstate(invalid="ignore"):
        error, raw = course.error_m.mean(axis=1), course.input_m.mean(axis=1)
        worse = error > UNSTABLE * raw
    found = {
        "unstable": bool((worse & np.isfinite(error)).any()),
        "overconfident": inside < LEAST_INSIDE,
        "fails": bool(course.failures),
    }
    return tuple(name for name, so in found.items() if so)
