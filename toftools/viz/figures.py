"""Depth and error maps as PNG bytes; the charts of viz/charts.py under the same name.

Maps go through matplotlib's Figure and the Agg canvas, never through pyplot, so nothing global
changes and no display is needed. Maps that will be compared share one colour scale. A pixel
without an answer is hatched grey, which no colour map holds.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.viz._grid import BAR_PX, GAP_PX, KEY_PX, Layout, Panel, layout
from toftools.viz.charts import Coverage as Coverage
from toftools.viz.charts import Curve as Curve
from toftools.viz.charts import coverage_svg as coverage_svg
from toftools.viz.charts import pareto_svg as pareto_svg

Limits = Mapping[str, tuple[float | None, float | None]]
"""Ends of the colour scale per kind; None is taken from the images."""

DPI = 100  # so that a point of text is 1.4 px and a figure inch 100 px


@dataclass(frozen=True)
class _Kind:
    """How one kind of map is drawn: colour map, name, and whether it spreads around zero."""

    cmap: str
    name: str
    diverging: bool = False
    metres: bool = False


_KINDS = {
    "range": _Kind("viridis", "range", metres=True),
    "error": _Kind("RdBu_r", "error", diverging=True, metres=True),
    "sigma": _Kind("magma", "sigma", metres=True),
    "amplitude": _Kind("gray", "amplitude"),
    "confidence": _Kind("cividis", "confidence"),
}


def depth_png(
    range_m: NDArray[Any],
    *,
    vmin_m: float | None = None,
    vmax_m: float | None = None,
    title: str = "",
) -> bytes:
    """Map of ranges with a colour bar in metres.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Radial range (or axial z), m; NaN is drawn hatched.
    vmin_m, vmax_m : float or None
        Ends of the colour scale, m; None takes the 1st and 99th percentile.
    title : str
        Title.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    ValueError
        If the image is not two-dimensional.
    """
    limits: Limits = {"range": (vmin_m, vmax_m)}
    return maps_png([(title, range_m, "range")], limits=limits, columns=1, width_px=640)


def error_png(error_m: NDArray[Any], *, limit_m: float | None = None, title: str = "") -> bytes:
    """Map of signed range errors: red too far, blue too near, white right.

    Parameters
    ----------
    error_m : ndarray, (H, W)
        Answer minus truth, m; NaN is drawn hatched.
    limit_m : float or None
        The scale is ``-limit_m .. limit_m``, m; None takes the 95th percentile. Give all maps of
        a capture the same one.
    title : str
        Title.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    ValueError
        If the image is not two-dimensional.
    """
    limits: Limits = {"error": (None, limit_m)}
    return maps_png([(title, error_m, "error")], limits=limits, columns=1, width_px=640)


def maps_png(
    panels: Sequence[Panel],
    *,
    limits: Limits | None = None,
    title: str = "",
    columns: int = 4,
    width_px: int = 1200,
) -> bytes:
    """Grid of small maps with one shared colour bar per kind.

    Parameters
    ----------
    panels : sequence of (str, ndarray (H, W), str)
        Title, image and kind of each map: ``range``, ``error``, ``sigma`` (m), ``amplitude`` or
        ``confidence``.
    limits : dict of str to (float or None, float or None)
        Ends of the colour scale per kind; None is taken from the images. Errors use the upper
        end only, symmetrically.
    title : str
        Title above the grid.
    columns : int
        Maps side by side, at most.
    width_px : int
        Width of the picture.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    ValueError
        If there is no panel, a kind is unknown, or an image is not two-dimensional.
    """
    from matplotlib.figure import Figure

    _check(panels, columns)
    kinds = list(dict.fromkeys(kind for _, _, kind in panels))
    scales = {kind: _scale(kind, panels, (limits or {}).get(kind, (None, None))) for kind in kinds}
    grid = layout(panels, min(columns, len(panels)), width_px, bool(title), len(kinds))
    size = (width_px / DPI, grid.height_px / DPI)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")
    figure.text(GAP_PX / width_px, 1 - 8 / grid.height_px, title, fontsize=11.5, va="top",
                fontweight="bold", color="#222")  # fmt: skip
    for index, (text, image, kind) in enumerate(panels):
        _draw_map(figure.add_axes(grid.cell(index)), text, image, kind, scales[kind])
    _draw_bars(figure, scales, grid)
    if any(not np.isfinite(image).all() for _, image, _ in panels):
        _draw_key(figure, grid)
    return _png(figure)


def _check(panels: Sequence[Panel], columns: int) -> None:
    if not panels or columns < 1:
        msg = f"got {len(panels)} panels in {columns} columns, wanted at least one of each"
        raise ValueError(msg)
    for text, image, kind in panels:
        if kind not in _KINDS:
            msg = f"panel {text!r} is of kind {kind!r}; wanted one of {', '.join(_KINDS)}"
            raise ValueError(msg)
        if np.ndim(image) != 2 or 0 in np.shape(image):
            msg = f"panel {text!r} must be an image (H, W), got shape {np.shape(image)}"
            raise ValueError(msg)


def _scale(
    kind: str, panels: Sequence[Panel], given: tuple[float | None, float | None]
) -> tuple[float, float, float]:
    """Ends of a kind's colour scale and the share of its pixels that lie beyond them."""
    values = np.concatenate([np.ravel(image) for _, image, its in panels if its == kind])
    values = values[np.isfinite(values)].astype(np.float64)
    if not values.size:
        low, high = 0.0, 1.0
    elif _KINDS[kind].diverging:
        low, high = 0.0, float(np.percentile(np.abs(values), 95))
    else:
        low, high = (float(end) for end in np.percentile(values, [1, 99]))
    low = low if given[0] is None else given[0]
    high = high if given[1] is None else given[1]
    low = -high if _KINDS[kind].diverging else low
    high = high if high > low else low + 1e-3
    beyond = float(np.mean((values < low) | (values > high))) if values.size else 0.0
    return low, high, beyond


def _draw_map(
    axes: Any,  # noqa: ANN401 - matplotlib has no types here
    text: str,
    image: NDArray[Any],
    kind: str,
    scale: tuple[float, float, float],
) -> None:
    """One map; what is not finite shows the hatched ground behind it."""
    axes.add_patch(no_answer((0, 0, 1, 1), axes.transAxes))
    axes.imshow(
        np.ma.masked_invalid(np.asarray(image, dtype=np.float64)),
        cmap=_KINDS[kind].cmap, vmin=scale[0], vmax=scale[1],
    )  # fmt: skip
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(color="#999", linewidth=0.6)
    axes.set_title(text, fontsize=9, loc="left", pad=4, color="#222", linespacing=1.25)
    if not np.isfinite(image).any():
        axes.text(0.5, 0.5, "no answer", transform=axes.transAxes, ha="center", va="center",
                  fontsize=10, color="#444",
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 3})  # fmt: skip


def no_answer(box: tuple[float, float, float, float], transform: Any) -> Any:  # noqa: ANN401
    """The hatching that stands for no answer.

    Parameters
    ----------
    box : tuple of 4 floats
        Left, bottom, width and height.
    transform : matplotlib.transforms.Transform
        Coordinates of the box.

    Returns
    -------
    matplotlib.patches.Rectangle
        The patch, behind everything else.
    """
    from matplotlib.patches import Rectangle

    left, bottom, width, height = box
    return Rectangle((left, bottom), width, height, transform=transform, facecolor="#e2e2e2",
                     edgecolor="#bdbdbd", hatch="////", linewidth=0, zorder=-1)  # fmt: skip


def _draw_key(figure: Any, grid: Layout) -> None:  # noqa: ANN401
    """What the hatching means, at the foot of the colour bars."""
    left = grid.width_px - BAR_PX + 12
    figure.add_artist(no_answer(grid.box(left, GAP_PX, 14, 14), figure.transFigure))
    x, y, _, _ = grid.box(left + 21, GAP_PX + 7, 0, 0)
    figure.text(x, y, "no answer", fontsize=9, va="center", color="#222")


def _draw_bars(
    figure: Any,  # noqa: ANN401
    scales: dict[str, tuple[float, float, float]],
    grid: Layout,
) -> None:
    """The colour bars, one below the other in the right-hand column."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    slot = (grid.height_px - grid.top_px - GAP_PX - KEY_PX) / len(scales)
    height = min(slot - 62, 320)
    for index, (kind, (low, high, beyond)) in enumerate(scales.items()):
        look = _KINDS[kind]
        unit, factor = _unit(max(abs(low), abs(high)), kind) if look.metres else ("", 1.0)
        bottom = grid.height_px - grid.top_px - index * slot - 46 - height
        axes = figure.add_axes(grid.box(grid.width_px - BAR_PX + 12, bottom, 14, height))
        mappable = ScalarMappable(Normalize(low * factor, high * factor), cmap=look.cmap)
        extend = "both" if beyond > 0.002 and look.diverging else "neither"
        figure.colorbar(mappable, cax=axes, extend=extend).outline.set(lw=0.6, edgecolor="#999")
        axes.tick_params(labelsize=9, length=3, color="#666", labelcolor="#222")
        name = f"{look.name}, {unit}" if unit else look.name
        note = "red: too far" if look.diverging else ""
        x, y, _, _ = grid.box(grid.width_px - BAR_PX + 12, bottom + height + 12, 0, 0)
        figure.text(x, y, f"{name}\n{note}".strip(), fontsize=9, va="bottom", color="#222",
                    linespacing=1.25)  # fmt: skip


def _unit(largest_m: float, kind: str) -> tuple[str, float]:
    """Unit in which a length scale reads well, and metres to that unit."""
    if kind == "range" or largest_m >= 1.0:
        return "m", 1.0
    return ("cm", 100.0) if largest_m >= 0.01 else ("mm", 1000.0)


def _png(figure: Any) -> bytes:  # noqa: ANN401
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(
        buffer, metadata={"Software": None}, pil_kwargs={"optimize": True}
    )
    return buffer.getvalue()
