"""A picture of a point cloud as PNG.

The picture is drawn by Open3D in a process of its own (viz/_render.py), or by matplotlib with the
same projection where Open3D cannot; which one it was is logged.
"""

import io
import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.viz import _process
from toftools.viz._view import F64, View, oblique

log = logging.getLogger(__name__)

MAPS = {"range": "viridis", "amplitude": "cividis"}


def cloud_png(
    points: NDArray[Any],
    values: NDArray[Any],
    *,
    size: tuple[int, int] = (960, 640),
    title: str = "",
    kind: str = "range",
) -> bytes:
    """Picture of a cloud, coloured by a value, with a colour bar.

    Parameters
    ----------
    points : ndarray, (..., 3)
        Points x right, y down, z forward, m; rows that are not finite are left out.
    values : ndarray, (...)
        What the colour shows.
    size : (int, int)
        Width and height, px.
    title : str
        Title.
    kind : str
        ``range`` (m) or ``amplitude``.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    ValueError
        If there is no finite point, or shapes or kind do not fit.
    """
    xyz, shade = flat(points, values, kind)
    bar, head = 96, 40 if title else 12
    view = oblique(xyz, (size[0] - bar, size[1] - head))
    norm = scale(shade, kind)
    colours = _colours(shade, norm, kind)
    # Points just close the gaps of a surface that fills the picture, and are always to be seen.
    point_px = float(np.clip(np.sqrt(0.6 * view.size[0] * view.size[1] / len(xyz)), 2, 7))
    try:
        picture = _process.draw(xyz, colours, view, point_px)
        log.info("drew the cloud with Open3D")
    except RuntimeError as error:
        log.warning("drew the cloud with matplotlib, because Open3D failed: %s", error)
        picture = _draw_matplotlib(xyz, colours, view, point_px)
    return _finish(picture, norm, title, kind, size)


def show(points: NDArray[Any], values: NDArray[Any], *, kind: str = "range") -> None:
    """Open a cloud in a window and wait until it is closed.

    Parameters
    ----------
    points : ndarray, (..., 3)
        Points x right, y down, z forward, m; rows that are not finite are left out.
    values : ndarray, (...)
        What the colour shows.
    kind : str
        ``range`` or ``amplitude``.

    Raises
    ------
    ValueError
        If there is no finite point, or shapes or kind do not fit.
    RuntimeError
        If there is no display, or Open3D fails.
    """
    xyz, shade = flat(points, values, kind)
    colours = _colours(shade, scale(shade, kind), kind)
    _process.show(xyz, colours, oblique(xyz, (1280, 800)), 2.0)


def flat(points: NDArray[Any], values: NDArray[Any], kind: str) -> tuple[F64, F64]:
    """Finite points and their values, in rows.

    Parameters
    ----------
    points : ndarray, (..., 3)
        Points, m.
    values : ndarray, (...)
        What the colour shows.
    kind : str
        ``range`` or ``amplitude``.

    Returns
    -------
    ndarray (N, 3) and ndarray (N,)
        Points and values.

    Raises
    ------
    ValueError
        If there is no finite point, or shapes or kind do not fit.
    """
    if kind not in MAPS:
        msg = f"got colour {kind!r}, wanted one of {', '.join(MAPS)}"
        raise ValueError(msg)
    if np.shape(points) != (*np.shape(values), 3):
        msg = f"points {np.shape(points)} must have the shape of values {np.shape(values)} and 3"
        raise ValueError(msg)
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    shade = np.asarray(values, dtype=np.float64).reshape(-1)
    known = np.isfinite(xyz).all(axis=1)
    if not known.any():
        msg = "no point is finite, so there is no cloud to draw; look at the status of the pixels"
        raise ValueError(msg)
    return xyz[known], shade[known]


def scale(values: F64, kind: str) -> Any:  # noqa: ANN401 - matplotlib has no types
    """Colour scale whose ends nearly all values lie between.

    Parameters
    ----------
    values : ndarray
        Values, NaN where unknown.
    kind : str
        ``range``, or ``amplitude``, which falls with the square of the range and gets a
        logarithmic scale.

    Returns
    -------
    matplotlib.colors.Normalize
        Values to 0..1, clipped.
    """
    from matplotlib.colors import LogNorm, Normalize

    known = values[np.isfinite(values) & ((kind == "range") | (values > 0))]
    low, high = (float(end) for end in np.percentile(known, [1, 99])) if known.size else (1.0, 2.0)
    high = max(high, low + 1e-6 * max(abs(low), 1.0))
    return (Normalize if kind == "range" else LogNorm)(low, high, clip=True)


def shares(values: F64, norm: Any) -> F64:  # noqa: ANN401
    """Values on a colour scale.

    Parameters
    ----------
    values : ndarray
        Values, NaN where unknown.
    norm : matplotlib.colors.Normalize
        The scale.

    Returns
    -------
    ndarray
        0..1, NaN where unknown.
    """
    # What lies below the scale, zero on a logarithmic one included, gets its lower end.
    inside = np.asarray(norm(np.fmax(values, norm.vmin)), dtype=np.float64)
    return np.where(np.isfinite(values), inside, np.nan)


def _colours(values: F64, norm: Any, kind: str) -> F64:  # noqa: ANN401
    """RGB (N, 3) in 0..1; grey where the value is unknown."""
    from matplotlib import colormaps

    share = shares(values, norm)
    rgb = colormaps[MAPS[kind]](np.nan_to_num(share))[:, :3]
    return np.where(np.isfinite(share)[:, None], rgb, 0.6)


def _draw_matplotlib(points: F64, colours: F64, view: View, point_px: float) -> NDArray[np.uint8]:
    """The same projection as dots, the farthest first."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    pixels, depth = view.project(points)
    order = np.argsort(-depth)
    width, height = view.size
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.axis("off")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    area_pt2 = (point_px * 0.72) ** 2
    u, v = pixels[order].T
    axes.scatter(u, v, c=colours[order], s=area_pt2, marker="s", linewidths=0)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _finish(
    picture: NDArray[np.uint8],
    norm: Any,  # noqa: ANN401
    title: str,
    kind: str,
    size: tuple[int, int],
) -> bytes:
    """The drawn cloud with its title and colour bar."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

    width, height = size
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor="white")
    figure.figimage(picture, xo=0, yo=0, origin="upper")
    figure.text(12 / width, 1 - 10 / height, title, fontsize=11.5, fontweight="bold",
                va="top", color="#222")  # fmt: skip
    box = ((width - 84) / width, 0.2, 14 / width, 0.6)
    mappable = ScalarMappable(norm, cmap=MAPS[kind])
    bar = figure.colorbar(mappable, cax=figure.add_axes(box))
    bar.outline.set(linewidth=0.6, edgecolor="#999")
    bar.ax.tick_params(labelsize=9, length=3, color="#666", labelcolor="#222")
    name = "range, m" if kind == "range" else kind
    figure.text(box[0], 0.8 + 12 / height, name, fontsize=9, va="bottom", color="#222")
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()
