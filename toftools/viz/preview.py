"""First look at a capture: six maps that show whether it is what was meant.

Every map has a scale of its own with its unit; a pixel without an answer is hatched, as in all maps
of toftools. Nothing here goes into a result.
"""

import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.io.answer import depth_of, measured_amplitude
from toftools.phasor import phasors_of
from toftools.types import F64, Capture
from toftools.units import ambiguity_m
from toftools.viz.figures import no_answer

WIDTH_PX, HEAD_PX, COLUMNS, DPI = 1260, 34, 3, 100
LEFT_PX, MAP_PX, BAR_GAP_PX, BAR_PX = 12, 320, 8, 12
TITLE_PX, GAP_PX = 24, 12


@dataclass(frozen=True, eq=False)
class _Map:
    """One map: title with unit, image in that unit, colours, ends of the scale."""

    title: str
    image: F64
    cmap: str
    low: float
    high: float
    logarithmic: bool = False


def preview_png(capture: Capture, *, title: str = "") -> bytes:
    """Maps of amplitude, measured and true range, error, indirect light and sigma.

    Parameters
    ----------
    capture : Capture
        Any capture; maps that need a truth are left out where there is none.
    title : str
        Title above the maps.

    Returns
    -------
    bytes
        PNG.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    maps = _maps(capture)
    height, width = capture.sensor.camera.shape
    map_px = round(MAP_PX * height / width)
    rows = -(-len(maps) // COLUMNS)
    total_px = HEAD_PX + rows * (TITLE_PX + map_px + GAP_PX)
    figure = Figure((WIDTH_PX / DPI, total_px / DPI), dpi=DPI, facecolor="white")
    figure.text(LEFT_PX / WIDTH_PX, 1 - 9 / total_px, title, fontsize=11.5, fontweight="bold",
                va="top", color="#222")  # fmt: skip
    step_px = (WIDTH_PX - LEFT_PX) / COLUMNS
    for i, shown in enumerate(maps):
        left = LEFT_PX + (i % COLUMNS) * step_px
        top = HEAD_PX + (i // COLUMNS) * (TITLE_PX + map_px + GAP_PX) + TITLE_PX
        bottom = 1 - (top + map_px) / total_px
        tall = map_px / total_px
        axes = figure.add_axes((left / WIDTH_PX, bottom, MAP_PX / WIDTH_PX, tall))
        beside = (left + MAP_PX + BAR_GAP_PX) / WIDTH_PX
        bar = figure.add_axes((beside, bottom, BAR_PX / WIDTH_PX, tall))
        _draw(figure, axes, bar, shown)
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(
        buffer, metadata={"Software": None}, pil_kwargs={"optimize": True}
    )
    return buffer.getvalue()


def _maps(capture: Capture) -> list[_Map]:
    depth, method = depth_of(capture)
    measured = np.asarray(depth.range_m, np.float64)
    truth = capture.truth
    true_m = None if truth is None else np.asarray(truth.range_m, np.float64)
    ends = _ends(measured if true_m is None else true_m)
    freq = f"{capture.sensor.modulation.freqs_hz[0] / 1e6:.4g} MHz"
    maps = []
    amplitude = measured_amplitude(capture)
    if amplitude is not None:
        unit = "e-" if capture.taps is None else capture.taps.unit
        maps.append(_amplitude(amplitude, f"amplitude at {freq}, {unit}"))
    how = f" ({method})" if method else ""
    maps.append(_Map(f"measured range{how}, m", measured, "viridis", *ends))
    if true_m is not None:
        maps.append(_Map("true range, m", true_m, "viridis", *ends))
        maps.append(_error(measured - true_m, capture))
    share = _indirect(capture)
    if share is not None:
        maps.append(_Map(f"light that came indirectly, at {freq}, %", share, "inferno", 0.0,
                         max(_ends(share)[1], 1.0)))  # fmt: skip
    if depth.sigma_m is not None:
        seen = True if true_m is None else np.isfinite(true_m)
        maps.append(_sigma(np.where(seen, depth.sigma_m, np.nan)))
    return maps


def _amplitude(values: Any, title: str) -> _Map:  # noqa: ANN401 - an array
    """Amplitude falls with the square of the range: a logarithmic grey."""
    image = np.where(values > 0, values, np.nan).astype(np.float64)
    low, high = _ends(image)
    return _Map(title, image, "gray", max(low, high / 1e4), high, logarithmic=True)


def _error(error_m: F64, capture: Capture) -> _Map:
    """Errors on a scale for multipath; those of whole wraps lie beyond its ends."""
    known = np.abs(error_m[np.isfinite(error_m)])
    wrap_m = float(ambiguity_m(capture.sensor.modulation.freqs_hz.max()))
    near = known[known < wrap_m / 2]
    most = float(np.percentile(near, 95)) if near.size else wrap_m
    unit, factor = _unit(most)
    limit = max(most * factor, 1e-3)
    title = f"measured - true range, {unit} (red: too far)"
    return _Map(title, factor * error_m, "RdBu_r", -limit, limit)


def _sigma(sigma_m: F64) -> _Map:
    low, high = _ends(sigma_m)
    unit, factor = _unit(high)
    title = f"sigma of range from sensor noise, {unit}"
    return _Map(title, factor * sigma_m, "magma", factor * low, factor * high)


def _indirect(capture: Capture) -> F64 | None:
    """Share of the light that came indirectly, percent of the moduli at the first frequency."""
    truth = capture.truth
    if truth is None or truth.direct is None or (capture.taps is None and capture.phasors is None):
        return None
    direct = np.abs(truth.direct[0]).astype(np.float64)
    if truth.one_bounce is not None and truth.rest is not None:
        indirect = np.abs(truth.one_bounce[0] + truth.rest[0])
    else:  # closed forms keep no bounces apart: what is not direct, noise included
        indirect = np.abs(phasors_of(capture).values[0] - truth.direct[0])
    total = direct + indirect
    share = np.divide(indirect, total, out=np.full(total.shape, np.nan), where=total > 0)
    return np.asarray(100 * share)


def _ends(image: F64) -> tuple[float, float]:
    """Ends of a scale between which nearly all values lie."""
    known = image[np.isfinite(image)]
    if not known.size:
        return 0.0, 1.0
    low, high = (float(end) for end in np.percentile(known, [1, 99]))
    return low, max(high, low + 1e-6 * max(abs(low), 1e-3))


def _unit(largest_m: float) -> tuple[str, float]:
    if largest_m >= 1.0:
        return "m", 1.0
    return ("cm", 100.0) if largest_m >= 0.01 else ("mm", 1000.0)


def _draw(figure: Any, axes: Any, bar: Any, shown: _Map) -> None:  # noqa: ANN401 - matplotlib
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    norm = (LogNorm if shown.logarithmic else Normalize)(shown.low, shown.high)
    axes.add_patch(no_answer((0, 0, 1, 1), axes.transAxes))
    # Pixels stay pixels where there is room for them.
    kind = "nearest" if shown.image.shape[1] <= MAP_PX else "auto"
    image = axes.imshow(
        np.ma.masked_invalid(shown.image), cmap=shown.cmap, norm=norm, interpolation=kind
    )
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color="#999", linewidth=0.6)
    axes.set_title(shown.title, fontsize=9, loc="left", pad=4, color="#222")
    figure.colorbar(image, cax=bar).outline.set(linewidth=0.6, edgecolor="#999")
    bar.tick_params(labelsize=8, length=3, color="#666", labelcolor="#222")
    if shown.logarithmic:
        subs = (1, 2, 3, 5) if shown.high < 30 * shown.low else (1, 3)
        bar.yaxis.set_major_locator(LogLocator(subs=subs))
        bar.yaxis.set_minor_locator(NullLocator())
        bar.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
