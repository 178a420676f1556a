"""Drawing of the SVG charts: curves with hover texts, dashed lines, labels, the whole picture.

No style element is used: in a page it would reach beyond the chart.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from toftools.viz._axes import HEIGHT, WIDTH, Axis, frame
from toftools.viz._labels import Label, Placed, place

# Okabe and Ito's colour-blind-safe colours without yellow; shape tells apart what colour cannot.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444")
_SHAPES = (
    "M-4.5,0a4.5,4.5 0 1,0 9,0a4.5,4.5 0 1,0 -9,0z",
    "M-4,-4h8v8h-8z",
    "M0,-5.2L5,3.6H-5z",
    "M0,-5.6L5.6,0L0,5.6L-5.6,0z",
    "M0,5.2L5,-3.6H-5z",
)


@dataclass(frozen=True)
class Series:
    """One curve in pixels (N, 2), a hover text per point, and the number that picks its look.

    `bars` are thin error bars: both ends of each, as x, y, x, y in pixels.
    """

    name: str
    xy: NDArray[np.float64]
    tips: Sequence[str]
    look: int
    bars: Sequence[tuple[float, float, float, float]] = ()

    @property
    def colour(self) -> str:
        """Colour of line and markers."""
        return _COLOURS[self.look % len(_COLOURS)]

    @property
    def shape(self) -> str:
        """SVG path of a marker."""
        return _SHAPES[self.look % len(_SHAPES)]


@dataclass(frozen=True)
class Flat:
    """A dashed horizontal line at a height in pixels."""

    name: str
    at: float
    tip: str


@dataclass(frozen=True)
class Chart:
    """All that is in one picture; `under` lies below the curves, `corners` is the frontier."""

    title: str
    note: str
    x: Axis
    y: Axis
    series: Sequence[Series]
    flats: Sequence[Flat] = ()
    under: Sequence[str] = ()
    corners: NDArray[np.float64] | None = None


def draw(chart: Chart) -> str:
    """The picture.

    Parameters
    ----------
    chart : Chart
        What to draw.

    Returns
    -------
    str
        SVG.
    """
    x = chart.x
    parts = [*frame(x, chart.y), *chart.under]
    if chart.corners is not None:
        parts.append(
            f'<path class="frontier" d="{_path(chart.corners)}" fill="none" stroke="#d4d4d4" '
            'stroke-width="5" stroke-linejoin="round"/>'
        )
    parts += [
        f'<path data-series="{escape(flat.name)}" d="M{x.start:.1f},{flat.at:.1f}H{x.end:.1f}" '
        f'stroke="#777" stroke-width="1.3" stroke-dasharray="6 4">'
        f"<title>{escape(flat.tip)}</title></path>"
        for flat in chart.flats
    ]
    for one in chart.series:
        parts += _draw_series(one)
    for placed in _place(chart):
        parts += _draw_label(placed)
    return svg(chart.title, chart.note, parts)


def empty(title: str) -> str:
    """A picture that says that there is nothing to draw.

    Parameters
    ----------
    title : str
        Title.

    Returns
    -------
    str
        SVG.
    """
    text = (
        f'<text x="{WIDTH / 2}" y="{HEIGHT / 2}" font-size="15" fill="#555" '
        'text-anchor="middle">Nothing to chart: no finite error.</text>'
    )
    return svg(title, "", [text])


def svg(title: str, note: str, parts: Sequence[str], height: float = HEIGHT) -> str:
    """The outer element: white ground, one font, title, note.

    Parameters
    ----------
    title, note : str
        Two lines at the top.
    parts : sequence of str
        SVG elements.
    height : float
        Height, px.

    Returns
    -------
    str
        SVG.
    """
    head = [
        f'<text x="24" y="30" font-size="17" font-weight="bold" fill="#222">{escape(title)}</text>',
        f'<text x="24" y="49" font-size="12.5" fill="#666">{escape(note)}</text>',
    ]
    body = "\n".join([*head, *parts])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" '
        f'width="{WIDTH}" style="max-width:100%;height:auto" role="img" '
        'font-family="Helvetica,Arial,sans-serif">\n'
        f"<title>{escape(title)}</title>\n"
        f'<rect width="{WIDTH}" height="{height:g}" fill="#fff"/>\n{body}\n</svg>\n'
    )


def _path(xy: NDArray[np.float64]) -> str:
    return "M" + "L".join(f"{px:.1f},{py:.1f}" for px, py in xy)


def _draw_series(one: Series) -> list[str]:
    """Line and markers of one series; an unseen wider disc makes a marker easy to hover."""
    mine = f'data-series="{escape(one.name)}"'  # by which a page finds all that belongs together
    parts = []
    if one.bars:
        ends = "".join(f"M{a:.1f},{b:.1f}L{c:.1f},{d:.1f}" for a, b, c, d in one.bars)
        parts.append(
            f'<path class="bars" {mine} d="{ends}" fill="none" stroke="{one.colour}" '
            'stroke-opacity="0.45"/>'
        )
    parts.append(
        f'<path class="curve" {mine} d="{_path(one.xy)}" fill="none" stroke="{one.colour}" '
        'stroke-width="1.8" stroke-linejoin="round"/>'
    )
    for (px, py), tip in zip(one.xy, one.tips, strict=True):
        parts.append(
            f'<g {mine} transform="translate({px:.1f},{py:.1f})"><title>{escape(tip)}</title>'
            f'<circle r="10" fill="#fff" fill-opacity="0"/><path d="{one.shape}" '
            f'fill="{one.colour}" stroke="#fff" stroke-width="1"/></g>'
        )
    return parts


def _place(chart: Chart) -> list[Placed]:
    """A label beside each curve and on each horizontal line."""
    x, y = chart.x, chart.y
    labels = [
        Label(one.name, [(float(px), float(py)) for px, py in one.xy[::-1]], _darker(one.colour))
        for one in chart.series
    ]
    across = np.linspace(x.end - 60, x.start + 60, 9)
    labels += [Label(f.name, [(float(px), f.at) for px in across], "#444", 12) for f in chart.flats]
    drawn = [one.xy for one in chart.series]
    drawn += [np.array([[x.start, flat.at], [x.end, flat.at]]) for flat in chart.flats]
    if chart.corners is not None:
        drawn.append(chart.corners)
    return place(
        labels,
        points=np.concatenate([np.empty((0, 2)), *(one.xy for one in chart.series)]),
        lines=np.concatenate([np.empty((0, 2)), *(_along(path) for path in drawn)]),
        area=(min(x.start, x.end) + 4, y.end + 4, max(x.start, x.end) - 4, y.start - 4),
    )


def _along(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points every few pixels of a polyline."""
    samples = [np.empty((0, 2))]
    for a, b in itertools.pairwise(path):
        n = max(int(np.hypot(*(b - a)) / 4), 1)
        samples.append(a + (b - a) * np.linspace(0, 1, n + 1)[:, None])
    return np.concatenate(samples)


def _darker(colour: str) -> str:
    """The same hue dark enough to read as text on white."""
    return "#" + "".join(f"{int(int(colour[i : i + 2], 16) * 0.72):02x}" for i in (1, 3, 5))


def _draw_label(placed: Placed) -> list[str]:
    """The text, with a thin line to what it names where it stands apart."""
    label, (left, top, _, _) = placed.label, placed.box
    mine = f'data-series="{escape(label.text)}"'
    shown = label.shown
    parts = []
    if placed.far:
        leader = _path(np.array([placed.anchor, placed.nearest]))
        parts.append(
            f'<path {mine} d="{leader}" stroke="{label.colour}" stroke-width="0.8" opacity="0.7"/>'
        )
    parts.append(
        f'<text class="label" {mine} x="{left:.1f}" y="{top + label.size:.1f}" '
        f'font-size="{label.size:g}" fill="{label.colour}" paint-order="stroke" stroke="#fff" '
        f'stroke-width="3" stroke-linejoin="round">{escape(shown)}</text>'
    )
    return parts
