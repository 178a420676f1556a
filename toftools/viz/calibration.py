"""Figures of a calibration as PNG: courses over phase, temperature and distance, views of a lens.

Drawn as `viz.figures` draws maps: through matplotlib's Figure and the Agg canvas.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.types import F64, Bool
from toftools.units import TWO_PI
from toftools.viz._plots import SOFT, labels, png, row

BEFORE, AFTER, FIT = "#c2410c", "#0b6b50", "#111827"
POINTS = 4000
"""Most points of a scatter; more are thinned evenly."""
BINS = 48


@dataclass(frozen=True, eq=False)
class Cyclic:
    """Residual over measured phase, one frequency.

    Parameters
    ----------
    title : str
        Frequency.
    phase_rad : ndarray, (N,)
        Measured phase, rad.
    before_mm, after_mm : ndarray, (N,)
        Range error without and with the stage, mm.
    curve_mm : ndarray, (M,)
        The fitted error over a turn, mm.
    covered : ndarray, (M,), bool, or None
        Where the fit had data; everywhere if None.
    """

    title: str
    phase_rad: F64
    before_mm: F64
    after_mm: F64
    curve_mm: F64
    covered: Bool | None = None


@dataclass(frozen=True, eq=False)
class Course:
    """Errors over one quantity, one frequency.

    Parameters
    ----------
    title : str
        Frequency.
    x : ndarray, (N,)
        Quantity, such as the temperature of the sensor.
    before_mm, after_mm : ndarray, (N,)
        Range error without and with the stage, mm.
    """

    title: str
    x: F64
    before_mm: F64
    after_mm: F64


def cyclic_png(panels: Sequence[Cyclic]) -> bytes:
    """Residuals over a turn of measured phase, before and after, and the fitted curve.

    Parameters
    ----------
    panels : sequence of Cyclic
        One per frequency.

    Returns
    -------
    bytes
        PNG.
    """
    figure, axes = row(len(panels), 3.1)
    for ax, panel in zip(axes, panels, strict=True):
        thin = slice(None, None, max(1, panel.phase_rad.size // POINTS))
        degrees = np.degrees(panel.phase_rad[thin])
        ax.plot(degrees, panel.before_mm[thin], ".", ms=1.5, color=BEFORE, alpha=0.25,
                rasterized=True)  # fmt: skip
        ax.plot(degrees, panel.after_mm[thin], ".", ms=1.5, color=AFTER, alpha=0.25)
        for values, color, name in (
            (panel.before_mm, BEFORE, "before"),
            (panel.after_mm, AFTER, "after"),
        ):
            centre, middle = _binned(panel.phase_rad, values)
            ax.plot(np.degrees(centre), middle, "-", lw=1.6, color=color, label=name)
        turn = np.linspace(0, 360, panel.curve_mm.size)
        known = panel.curve_mm
        if panel.covered is not None:
            known = np.where(panel.covered, known, np.nan)
            ax.plot(turn, panel.curve_mm, ":", lw=0.8, color=SOFT)
        ax.plot(turn, known, "--", lw=1.3, color=FIT, label="fitted")
        ax.set_xlim(0, 360)
        ax.set_xticks(range(0, 361, 60))
        ends = np.concatenate([panel.before_mm[thin], panel.after_mm[thin], panel.curve_mm])
        _limits(ax, ends)
        labels(ax, panel.title, "measured phase, degrees", "range error, mm")
        ax.legend(fontsize=8, frameon=False, ncols=3, loc="upper center")
    return png(figure)


def course_png(
    panels: Sequence[Course], name: str, *, error: str = "mean range error, mm", log: bool = False
) -> bytes:
    """Errors over a quantity, before and after.

    Parameters
    ----------
    panels : sequence of Course
        One per frequency.
    name : str
        The quantity with its unit.
    error : str
        What is drawn over it.
    log : bool
        Whether the quantity is drawn on a logarithmic axis.

    Returns
    -------
    bytes
        PNG.
    """
    figure, axes = row(len(panels), 3.0)
    for ax, panel in zip(axes, panels, strict=True):
        order = np.argsort(panel.x)
        for values, color, label in (
            (panel.before_mm, BEFORE, "before"),
            (panel.after_mm, AFTER, "after"),
        ):
            ax.plot(panel.x[order], values[order], "o-", ms=4, lw=1, color=color, label=label)
        labels(ax, panel.title, name, error)
        ax.set_xscale("log" if log else "linear")
        ax.legend(fontsize=8, frameon=False)
    return png(figure)


def distance_png(
    distance_m: F64, before_mm: F64, after_mm: F64, noise_mm: F64, *, good: float
) -> bytes:
    """Error over distance of held-out captures beside the noise floor, logarithmic.

    Parameters
    ----------
    distance_m : ndarray, (N,)
        Distances, m.
    before_mm, after_mm, noise_mm : ndarray, (N,)
        Root mean square range errors without and with the calibration, and by noise, mm.
    good : float
        Multiple of the noise floor that counts as good.

    Returns
    -------
    bytes
        PNG.
    """
    figure, (ax,) = row(1, 3.4)
    order = np.argsort(distance_m)
    x = distance_m[order]
    floor = np.maximum(noise_mm[order], 1e-6)
    ax.fill_between(x, floor, good * floor, color="#94a3b8", alpha=0.5, lw=0,
                    label=f"noise floor to {good:g} x")  # fmt: skip
    ax.plot(x, floor, color="#64748b", lw=1)
    ax.plot(x, before_mm[order], "s--", ms=4, lw=1, color=BEFORE, label="before")
    ax.plot(x, after_mm[order], "o-", ms=4, lw=1.2, color=AFTER, label="after")
    ax.set_yscale("log")
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    labels(ax, "Held-out captures", "distance along the axis, m", "range error, mm rms")
    ax.legend(fontsize=8, frameon=False, ncols=3)
    return png(figure)


def lens_png(corners_px: F64, errors_px: F64, size: tuple[int, int]) -> bytes:
    """Where the corners of all boards fell, and the reprojection error of every view.

    Parameters
    ----------
    corners_px : ndarray, (N, 2)
        Corners of all views, px.
    errors_px : ndarray, (V,)
        Root mean square reprojection error of each view, px.
    size : tuple of int
        Width and height of the image, px.

    Returns
    -------
    bytes
        PNG.
    """
    figure, (left, right) = row(2, 3.2)
    left.plot(corners_px[:, 0], corners_px[:, 1], ".", ms=2, color=AFTER, alpha=0.7)
    left.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), aspect="equal")
    labels(left, "Coverage: corners of all boards", "column, px", "row, px")
    right.bar(np.arange(1, len(errors_px) + 1), errors_px, color=AFTER)
    labels(right, "Reprojection error", "view", "px rms")
    return png(figure)


def _binned(phase_rad: F64, values: F64) -> tuple[F64, F64]:
    """Medians over equal parts of the turn that hold data."""
    known = np.isfinite(values)
    phase_rad, values = phase_rad[known], values[known]
    place = np.clip((phase_rad * (BINS / TWO_PI)).astype(int), 0, BINS - 1)
    parts = [values[place == n] for n in range(BINS)]
    middle = [np.median(part) if part.size > 3 else np.nan for part in parts]
    return np.asarray((np.arange(BINS) + 0.5) * (TWO_PI / BINS)), np.asarray(middle)


def _limits(ax: Any, values: F64) -> None:  # noqa: ANN401 - matplotlib has no types here
    """Vertical limits that a few outliers do not move."""
    finite = values[np.isfinite(values)]
    if finite.size:
        low, high = np.percentile(finite, [0.5, 99.5])
        room = 0.2 * max(high - low, 1e-3)
        ax.set_ylim(low - room, high + 1.6 * room)
