"""The SVG charts of this package as PNG, drawn with matplotlib.

Reads what `charts`, `stress` and `reliability` write, no more of SVG: paths of straight
lines and half circles, rectangles, discs, texts, groups that are shifted. Hover texts are lost.
"""

import io
import re
import warnings
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

SCALE = 2
"""Pixels of the picture per unit of the SVG."""
_POINT = 0.72  # points of text per unit, at 100 units per inch
_SVG = "{http://www.w3.org/2000/svg}"
_ARC_STEPS = 12
_ALIGN = {"middle": "center", "end": "right", "start": "left"}
Shift = tuple[float, float]


def chart_png(svg: str) -> bytes:
    """Picture of a chart.

    Parameters
    ----------
    svg : str
        A chart of this package.

    Returns
    -------
    bytes
        PNG, twice as wide and high as the SVG says.

    Raises
    ------
    ValueError
        If it is no SVG, or holds what no chart of this package holds.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    try:
        root = ElementTree.fromstring(svg)
        _, _, width, height = (float(v) for v in root.attrib["viewBox"].split())
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        msg = f"got no chart of this package ({error}); wanted what pareto_svg and its like write"
        raise ValueError(msg) from error
    figure = Figure(figsize=(width / 100, height / 100), dpi=100 * SCALE, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    for order, (element, shift) in enumerate(_elements(root, (0.0, 0.0))):
        _draw(axes, element, shift, order)
    picture = io.BytesIO()
    with warnings.catch_warnings():
        # A letter that the font does not have is drawn as a box; a name may hold any.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        FigureCanvasAgg(figure).print_png(picture, metadata={"Software": None})
    return picture.getvalue()


def _elements(
    parent: ElementTree.Element, shift: Shift
) -> Iterator[tuple[ElementTree.Element, Shift]]:
    """All elements to draw, each with the shift of the groups around it."""
    for element in parent:
        if element.tag == f"{_SVG}g":
            dx, dy = _shift(element)
            yield from _elements(element, (shift[0] + dx, shift[1] + dy))
        elif element.tag != f"{_SVG}title":
            yield element, shift


def _shift(element: ElementTree.Element) -> Shift:
    found = re.search(r"translate\(([-\d.]+),([-\d.]+)\)", element.get("transform", ""))
    return (float(found[1]), float(found[2])) if found else (0.0, 0.0)


def _draw(axes: Any, element: ElementTree.Element, shift: Shift, order: int) -> None:  # noqa: ANN401
    """One element above those before it."""
    kind = element.tag.removeprefix(_SVG)
    if kind == "text":
        _text(axes, element, shift, order)
    elif kind == "path":
        _lines(axes, element, shift, order)
    elif kind not in ("rect", "circle"):  # white ground, and discs that only catch the pointer
        msg = f"no chart of this package holds <{kind}>; wanted paths and texts"
        raise ValueError(msg)


def _text(axes: Any, element: ElementTree.Element, shift: Shift, order: int) -> None:  # noqa: ANN401
    from matplotlib.patheffects import withStroke

    dx, dy = _shift(element)
    turned = "rotate(-90)" in element.get("transform", "")
    halo = [withStroke(linewidth=2, foreground="white")] if element.get("paint-order") else None
    axes.text(
        shift[0] + dx + float(element.get("x", 0)), shift[1] + dy + float(element.get("y", 0)),
        element.text or "", parse_math=False,
        fontsize=float(element.get("font-size", 13)) * _POINT * 0.94, zorder=order,
        color=element.get("fill", "#000"), rotation=90 if turned else 0, rotation_mode="anchor",
        ha=_ALIGN[element.get("text-anchor", "start")], va="baseline", path_effects=halo,
        fontweight=element.get("font-weight", "normal"),
    )  # fmt: skip


def _lines(axes: Any, element: ElementTree.Element, shift: Shift, order: int) -> None:  # noqa: ANN401
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    corners, closed = _corners(element.get("d", ""))
    pieces = [Path(np.asarray(piece) + shift, closed=False) for piece in corners]
    width = float(element.get("stroke-width", 1)) * _POINT
    dashes = [float(v) * _POINT / max(width, 0.5) for v in
              element.get("stroke-dasharray", "").split()]  # fmt: skip
    fill = element.get("fill", "none")
    opacity = float(element.get("stroke-opacity", element.get("opacity", 1)))
    axes.add_patch(
        PathPatch(
            Path.make_compound_path(*pieces), facecolor=fill if closed else "none", zorder=order,
            edgecolor=element.get("stroke", "none"), linewidth=width, alpha=opacity,
            linestyle=(0, tuple(dashes)) if dashes else "-", joinstyle="round", clip_on=False,
        )
    )  # fmt: skip


def _corners(d: str) -> tuple[list[NDArray[np.float64]], bool]:
    """Polylines of a path, and whether the last is closed."""
    tokens = re.findall(r"([A-Za-z])([^A-Za-z]*)", d)
    pieces: list[list[Shift]] = []
    closed = False
    for command, text in tokens:
        values = [float(v) for v in re.findall(r"-?\d+\.?\d*", text)]
        if command == "M":
            pieces.append([])
        x, y = pieces[-1][-1] if pieces and pieces[-1] else (0.0, 0.0)
        if command in "ML":
            pieces[-1] += zip(values[::2], values[1::2], strict=True)
        elif command in "Hh":
            pieces[-1].append((values[0] + (x if command == "h" else 0.0), y))
        elif command in "Vv":
            pieces[-1].append((x, values[0] + (y if command == "v" else 0.0)))
        elif command == "a":
            for at in range(0, len(values), 7):
                pieces[-1] += _half_circle(pieces[-1][-1], values[at : at + 7])
        elif command == "z":
            pieces[-1].append(pieces[-1][0])
            closed = True
        else:
            msg = f"no chart of this package holds the path command {command!r}"
            raise ValueError(msg)
    return [np.array(piece, dtype=np.float64) for piece in pieces], closed


def _half_circle(start: Shift, arc: list[float]) -> list[Shift]:
    """Points of a half circle whose ends lie side by side, as the round marker is made of."""
    radius, across = arc[0], arc[5]
    if abs(abs(across) - 2 * radius) > 1e-6 or arc[6]:
        msg = "no chart of this package holds an arc that is no half circle"
        raise ValueError(msg)
    turn = np.linspace(0, np.pi, _ARC_STEPS)[1:]
    middle = start[0] + across / 2
    side = np.sign(across)
    return [(float(middle - side * radius * np.cos(t)), float(start[1] - side * radius * np.sin(t)))
            for t in turn]  # fmt: skip
