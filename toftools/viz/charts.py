"""Charts as hand-written SVG: speed against accuracy, error against coverage.

Written by hand because a point then carries its own hover text, labels stand beside their curve,
and text stays text.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toftools.viz._axes import Axis, log_axis, number, share_axis
from toftools.viz._series import Chart, Flat, Series, draw, empty

_REAL_TIME_MS = 1000.0 / 30.0


@dataclass(frozen=True)
class Curve:
    """One method in the chart of speed against accuracy.

    Parameters
    ----------
    name : str
        Method.
    ms : sequence of float
        Time per frame, ms; ignored unless `timed`.
    mae_m : sequence of float
        Mean absolute error of each setting, m, in the order in which the line should run.
    labels : sequence of str
        Hover text of each setting, such as ``tol_mm=1``; may be empty.
    timed : bool
        False for an answer that nobody timed: it becomes a dashed horizontal line.
    spread_m : sequence of (float, float)
        Quartiles of the error over captures, m, for a vertical bar at each point; NaN or empty for
        none.
    iqr_ms : sequence of float
        Interquartile range of repeated calls, ms, for a horizontal bar around each point; NaN or
        empty for none.
    """

    name: str
    ms: Sequence[float]
    mae_m: Sequence[float]
    labels: Sequence[str] = field(default_factory=tuple)
    timed: bool = True
    spread_m: Sequence[tuple[float, float]] = ()
    iqr_ms: Sequence[float] = ()


@dataclass(frozen=True)
class Coverage:
    """One method in the chart of error against coverage.

    Parameters
    ----------
    name : str
        Method.
    share : sequence of float
        Share of the pixels kept, the most trusted first, 0 to 1.
    mae_m : sequence of float
        Mean absolute error of the pixels kept, m.
    """

    name: str
    share: Sequence[float]
    mae_m: Sequence[float]


@dataclass(frozen=True)
class _Errors:
    """The error axis of a chart: its unit, and the smallest error a logarithmic axis can show."""

    unit: str
    factor: float
    floor_m: float
    axis: Axis

    def pixels(self, errors_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.axis(np.maximum(errors_m, self.floor_m) * self.factor)

    def text(self, error_m: float) -> str:
        return f"{number(error_m * self.factor)} {self.unit}"


def pareto_svg(curves: Sequence[Curve], *, title: str) -> str:
    """Time per frame against mean absolute error, both logarithmic; lower left is better.

    Parameters
    ----------
    curves : sequence of Curve
        Methods; points that are not finite, or have no positive time, are left out.
    title : str
        Title.

    Returns
    -------
    str
        SVG, 960 px wide, that scales with the page.

    Raises
    ------
    ValueError
        If a curve does not have one time, one error and one label (or none) per point.
    """
    timed = [(curve, *_timed_points(curve)) for curve in curves if curve.timed]
    timed = [(curve, points, tips) for curve, points, tips in timed if len(points)]
    flat = [(c.name, float(e)) for c in curves if not c.timed for e in c.mae_m if np.isfinite(e)]
    shown = [points[:, 1] for _, points, _ in timed] + [np.array([e]) for _, e in flat]
    if not shown:
        return empty(title)
    errors = _errors(np.concatenate(shown), [points[:, 2:4].ravel() for _, points, _ in timed])
    times = [points[:, [0, 4, 5]].ravel() for _, points, _ in timed] or [np.array([1.0, 100.0])]
    at_ms = np.concatenate(times)
    x = log_axis(at_ms[np.isfinite(at_ms)], name="time per frame, ms", horizontal=True)

    series = []
    for look, (curve, points, settings) in enumerate(timed):
        tips = [
            f"{curve.name} {setting}".strip()
            + f": {number(point[0])} ms, {errors.text(point[1])}{_spread_text(point, errors)}"
            for point, setting in zip(points, settings, strict=True)
        ]
        xy = np.stack([x(points[:, 0]), errors.pixels(points[:, 1])], axis=1)
        series.append(Series(curve.name, xy, tips, look, _bars(points, x, errors)))
    flats = [
        Flat(name, float(errors.pixels(np.array(e))), f"{name}: {errors.text(e)}, not timed")
        for name, e in flat
    ]
    note = "Grey staircase: nothing is both faster and more accurate." if series else ""
    if any(one.bars for one in series):
        note += " Thin bars: middle half of the captures, and of repeated calls."
    under, corners = _real_time(x, errors.axis), _frontier(series, x, errors.axis)
    return draw(Chart(title, note, x, errors.axis, series, flats, under, corners))


def coverage_svg(curves: Sequence[Coverage], *, title: str) -> str:
    """Error of the pixels kept against the share kept; a good confidence makes a curve rise.

    Parameters
    ----------
    curves : sequence of Coverage
        Methods; points that are not finite are left out.
    title : str
        Title.

    Returns
    -------
    str
        SVG, 960 px wide, that scales with the page.

    Raises
    ------
    ValueError
        If a curve does not have one error per share.
    """
    kept = [(curve.name, _pairs(curve.name, curve.share, curve.mae_m)) for curve in curves]
    kept = [(name, points[np.isfinite(points).all(axis=1)]) for name, points in kept]
    kept = [(name, points) for name, points in kept if len(points)]
    if not kept:
        return empty(title)
    errors = _errors(np.concatenate([points[:, 1] for _, points in kept]))
    x = share_axis("pixels kept, most trusted first, %")
    series = []
    for look, (name, points) in enumerate(kept):
        tips = [f"{name}: {number(100 * share)} %, {errors.text(e)}" for share, e in points]
        xy = np.stack([x(100 * points[:, 0]), errors.pixels(points[:, 1])], axis=1)
        series.append(Series(name, xy, tips, look))
    note = "Rising from the left: the confidence knows which pixels are wrong."
    return draw(Chart(title, note, x, errors.axis, series))


def _pairs(name: str, x: Sequence[float], mae_m: Sequence[float]) -> NDArray[np.float64]:
    """Points (N, 2) of a curve, refused if they do not pair up."""
    across, errors = np.asarray(x, dtype=np.float64), np.asarray(mae_m, dtype=np.float64)
    if across.shape != errors.shape or errors.ndim != 1:
        msg = f"curve {name!r} has {across.size} x values and {errors.size} errors; pair them up"
        raise ValueError(msg)
    return np.stack([across, errors], axis=1)


def _timed_points(curve: Curve) -> tuple[NDArray[np.float64], list[str]]:
    """Points of a curve that can be drawn, with their hover texts.

    Columns: ms, error, quartiles of the error, ends of the bar in ms; NaN for no bar.
    """
    points = _pairs(curve.name, curve.ms, curve.mae_m)
    settings = list(curve.labels) or [""] * len(points)
    spread = np.array(list(curve.spread_m) or [(np.nan, np.nan)] * len(points)).reshape(-1, 2)
    iqr = np.array(list(curve.iqr_ms) or [np.nan] * len(points))
    for what, count in (("labels", len(settings)), ("bars", len(spread)), ("bars", len(iqr))):
        if count != len(points):
            msg = f"curve {curve.name!r} has {count} {what} for {len(points)} points"
            raise ValueError(msg)
    # A logarithmic axis has no zero: a bar that would reach it ends at a tenth of its point.
    left = np.maximum(points[:, 0] - iqr / 2, points[:, 0] / 10)
    every = np.column_stack([points, spread, left, points[:, 0] + iqr / 2])
    good = np.isfinite(points).all(axis=1) & (points[:, 0] > 0)
    return every[good], [text for text, ok in zip(settings, good, strict=True) if ok]


def _bars(
    points: NDArray[np.float64], x: Axis, errors: _Errors
) -> list[tuple[float, float, float, float]]:
    """Error bars of the points, ends in pixels."""
    bars = []
    for ms, error, low, high, left, right in points:
        if np.isfinite([low, high]).all():
            ends = errors.pixels(np.array([low, high]))
            bars.append((float(x(ms)), float(ends[0]), float(x(ms)), float(ends[1])))
        if np.isfinite([left, right]).all():
            height = float(errors.pixels(np.array(error)))
            bars.append((float(x(left)), height, float(x(right)), height))
    return bars


def _spread_text(point: NDArray[np.float64], errors: _Errors) -> str:
    """What the bars of a point say, for its hover text."""
    ms, _, low, high, _, right = point
    told = ""
    if np.isfinite([low, high]).all():
        told += f"; middle half of the captures {errors.text(low)} to {errors.text(high)}"
    if np.isfinite(right):
        told += f"; middle half of the calls within {number(2 * (right - ms))} ms"
    return told


def _errors(errors_m: NDArray[np.float64], bars_m: Sequence[NDArray[np.float64]] = ()) -> _Errors:
    """Axis for these errors and bars; an exact zero stands half below the smallest positive one."""
    unit, factor = ("mm", 1e3) if np.median(errors_m) < 0.01 else ("cm", 1e2)
    errors_m = np.concatenate([errors_m, *(bar[np.isfinite(bar)] for bar in bars_m)])
    positive = errors_m[errors_m > 0]
    floor_m = float(positive.min()) / 2 if positive.size else 1e-6
    axis = log_axis(np.maximum(errors_m, floor_m) * factor, name=f"mean absolute error, {unit}")
    return _Errors(unit, factor, floor_m, axis)


def _real_time(x: Axis, y: Axis) -> list[str]:
    """Thin line at 30 frames per second, where it lies inside the chart."""
    if not x.low < _REAL_TIME_MS < x.high:
        return []
    at = float(x(_REAL_TIME_MS))
    return [
        f'<path d="M{at:.1f},{y.end:.1f}V{y.start:.1f}" stroke="#999" stroke-dasharray="1 4"/>',
        f'<text x="{at:.1f}" y="{y.end - 6:.1f}" font-size="12" fill="#666" '
        'text-anchor="middle">30 fps</text>',
    ]


def _frontier(series: Sequence[Series], x: Axis, y: Axis) -> NDArray[np.float64] | None:
    """Corners of the staircase through the points that no other beats in time and error, px."""
    if not series:
        return None
    xy = np.concatenate([one.xy for one in series])
    xy = xy[np.lexsort((-xy[:, 1], xy[:, 0]))]  # by time; of equals the smaller error first
    best = np.maximum.accumulate(xy[:, 1])  # pixels grow downwards: larger is more accurate
    front = xy[np.r_[True, xy[1:, 1] > best[:-1]]]
    corners = [(front[0, 0], y.end)]
    for (px, py), after in zip(front, [*front[1:, 0], x.end], strict=True):
        corners += [(px, py), (after, py)]  # down to this point, then on until the next one
    return np.array(corners)
