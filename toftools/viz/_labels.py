"""Where to put the name of a curve: beside the curve, on nothing else.

Each label tries a fixed set of places around each of its anchors and takes the cheapest: overlap
with another label costs most, then a covered point, then a covered line, then distance.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CHAR_EM = 0.6  # average advance of a sans-serif letter; on the wide side, so boxes are never short
LEADER_PX = 16.0  # a label farther from its anchor than this gets a line to it
MOST_LETTERS = 72  # of a label: the width of a chart holds about a hundred
_RINGS_PX = (8.0, 20.0, 36.0, 56.0, 80.0, 110.0)
_BEARINGS = ((1, 0), (0, -1), (0, 1), (-1, 0), (1, -1), (1, 1), (-1, -1), (-1, 1))


@dataclass(frozen=True)
class Label:
    """A text and the points it may stand beside, in pixels."""

    text: str
    anchors: Sequence[tuple[float, float]]
    colour: str
    size: float = 13.0

    @property
    def shown(self) -> str:
        """The text, cut where it would leave the chart."""
        most = MOST_LETTERS
        return self.text if len(self.text) <= most else f"{self.text[: most - 1]}…"

    @property
    def width(self) -> float:
        """Estimated width, px."""
        return CHAR_EM * self.size * len(self.shown)


@dataclass(frozen=True)
class Placed:
    """A label with its box (left, top, right, bottom) and the anchor it belongs to, px."""

    label: Label
    box: tuple[float, float, float, float]
    anchor: tuple[float, float]

    @property
    def far(self) -> bool:
        """Whether a leader is needed to see what the label belongs to."""
        return float(np.hypot(*np.subtract(self.nearest, self.anchor))) > LEADER_PX

    @property
    def nearest(self) -> tuple[float, float]:
        """Point of the box nearest to the anchor."""
        left, top, right, bottom = self.box
        return min(max(self.anchor[0], left), right), min(max(self.anchor[1], top), bottom)


def place(
    labels: Sequence[Label],
    *,
    points: NDArray[np.float64],
    lines: NDArray[np.float64],
    area: tuple[float, float, float, float],
) -> list[Placed]:
    """Place all labels, one after the other.

    Parameters
    ----------
    labels : sequence of Label
        What to place; earlier ones choose first.
    points, lines : ndarray, (N, 2)
        Markers to keep clear of, and samples of the lines to keep clear of if possible, px.
    area : tuple of float
        Left, top, right, bottom of the region labels may use, px.

    Returns
    -------
    list of Placed
        One per label, in the same order.
    """
    placed: list[Placed] = []
    for label in labels:
        best: Placed | None = None
        best_cost = np.inf
        for candidate, distance in _candidates(label, area):
            cost = _cost(candidate.box, distance, placed, points, lines)
            if cost < best_cost:
                best, best_cost = candidate, cost
        if best is not None:
            placed.append(best)
    return placed


def _candidates(
    label: Label, area: tuple[float, float, float, float]
) -> Iterator[tuple[Placed, float]]:
    """Every place the label could take, pushed back inside the area, with its distance."""
    width, height = label.width, 1.25 * label.size
    for x, y in label.anchors:
        for ring in _RINGS_PX:
            for dx, dy in _BEARINGS:
                left = x + dx * ring + width * (dx - 1) / 2
                top = y + dy * ring + height * (dy - 1) / 2
                left = min(max(left, area[0]), area[2] - width)
                top = min(max(top, area[1]), area[3] - height)
                yield (
                    Placed(label, (left, top, left + width, top + height), (x, y)),
                    float(np.hypot(dx, dy) * ring),
                )


def _cost(
    box: tuple[float, float, float, float],
    distance: float,
    placed: Sequence[Placed],
    points: NDArray[np.float64],
    lines: NDArray[np.float64],
) -> float:
    covered = sum(_overlap(box, other.box) for other in placed)
    marks = _inside(box, points, 6.0)
    return distance + 50.0 * covered + 200.0 * marks + 12.0 * _inside(box, lines, 1.0)


def _overlap(a: Sequence[float], b: Sequence[float]) -> float:
    """Common area of two boxes in pixels, a small margin included."""
    width = min(a[2], b[2]) - max(a[0], b[0]) + 4
    height = min(a[3], b[3]) - max(a[1], b[1]) + 2
    return max(width, 0.0) * max(height, 0.0)


def _inside(box: Sequence[float], points: NDArray[np.float64], margin: float) -> int:
    x, y = points[:, 0], points[:, 1]
    inside = (x > box[0] - margin) & (x < box[2] + margin)
    return int((inside & (y > box[1] - margin) & (y < box[3] + margin)).sum())
