"""Chart of a stress axis: error of every method from easy to hard, with its spread over seeds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.viz._axes import LEFT, RIGHT, Axis, log_axis, number
from toftools.viz._series import Chart, Series, draw, empty

RATIO = 8.0
"""Positive values that span more than this stand on a logarithmic axis."""
ROOM = 0.22
"""Part of the axis beyond the hardest value: the labels of curves stand there."""


@dataclass(frozen=True, eq=False)
class Strain:
    """One method along an axis.

    Parameters
    ----------
    name : str
        Method.
    mae_m : ndarray, (V, S)
        Mean absolute error per value and seed, m; what is not finite is left out.
    """

    name: str
    mae_m: NDArray[np.float64]


def stress_svg(values: Sequence[float], strains: Sequence[Strain], *, title: str, name: str) -> str:
    """Errors along an axis, easiest on the left.

    Parameters
    ----------
    values : sequence of float
        Values of the axis, easiest first.
    strains : sequence of Strain
        Methods.
    title : str
        Title.
    name : str
        What the values are, with their unit.

    Returns
    -------
    str
        SVG, 960 px wide, that scales with the page.
    """
    at = np.asarray(values, dtype=np.float64)
    kept = [(s, np.where(np.isfinite(s.mae_m), s.mae_m, np.nan)) for s in strains]
    kept = [(s, e) for s, e in kept if np.isfinite(e).any()]
    if not kept:
        return empty(title)
    every = np.concatenate([e[np.isfinite(e)] for _, e in kept])
    unit, factor = ("mm", 1e3) if np.median(every) < 0.01 else ("cm", 1e2)
    floor = every[every > 0].min() / 2 if (every > 0).any() else 1e-6
    y = log_axis(np.maximum(every, floor) * factor, name=f"mean absolute error, {unit}")
    x = _across(at, name)
    series = []
    for look, (strain, errors) in enumerate(kept):
        known = np.asarray(np.isfinite(errors).any(axis=1))
        mean = np.nanmean(np.where(known[:, None], errors, 0), axis=1)[known]
        heights = y(np.maximum(mean, floor) * factor)
        tips = [
            f"{strain.name} at {number(value)}: {number(factor * error)} {unit}"
            for value, error in zip(at[known], mean, strict=True)
        ]
        bars = []
        for value, row in zip(at[known], errors[known], strict=True):
            low, high = (y(max(f, floor) * factor) for f in (np.nanmin(row), np.nanmax(row)))
            bars.append((float(x(value)), float(low), float(x(value)), float(high)))
        across = np.stack([x(at[known]), heights], axis=1)
        series.append(Series(strain.name, across, tips, look, bars))
    note = "Easiest on the left. Thin bars: smallest and largest of the seeds."
    return draw(Chart(title, note, x, y, series))


def _across(values: NDArray[np.float64], name: str) -> Axis:
    """Axis of the values, the first of them on the left whether it is the smallest or not."""
    low, high = float(values.min()), float(values.max())
    log = low > 0 and high / low > RATIO
    rising = values[-1] >= values[0]
    if log:
        span = high / low
        low, high = (low / span**0.03, high * span**ROOM) if rising else (
            low / span**ROOM, high * span**0.03)  # fmt: skip
    else:
        span = high - low
        low, high = (low - 0.03 * span, high + ROOM * span) if rising else (
            low - ROOM * span, high + 0.03 * span)  # fmt: skip
    start, end = (LEFT, RIGHT) if rising else (RIGHT, LEFT)
    return Axis(low, high, start, end, name, log)
