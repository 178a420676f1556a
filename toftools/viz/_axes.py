"""Axes of the SVG charts: data to pixels, ticks that read well, the frame around the plot."""

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

WIDTH, HEIGHT = 960, 560
LEFT, RIGHT, TOP, BOTTOM = 84, WIDTH - 24, 84, HEIGHT - 62


@dataclass(frozen=True)
class Axis:
    """One axis: data from `low` to `high` lie from pixel `start` to pixel `end`."""

    low: float
    high: float
    start: float
    end: float
    name: str
    log: bool

    def __call__(self, values: ArrayLike) -> NDArray[np.float64]:
        """Pixels of data values."""
        v = np.asarray(values, dtype=np.float64)
        low, high = self.low, self.high
        if self.log:
            v, low, high = np.log10(v), np.log10(low), np.log10(high)
        return np.asarray(self.start + (v - low) / (high - low) * (self.end - self.start))

    @property
    def ticks(self) -> list[float]:
        """Values to label: powers of ten, or 1-2-5, or even steps, by how much is shown."""
        decades = np.log10(self.high / self.low) if self.log else 0.0
        if decades < 0.8:
            step = _nice((self.high - self.low) / 6)
            ticks = np.arange(np.ceil(self.low / step), self.high / step + 1e-9) * step
        else:
            powers = 10.0 ** np.arange(np.floor(np.log10(self.low)), np.log10(self.high) + 1)
            ticks = np.outer(powers, [1.0] if decades > 3.5 else [1.0, 2.0, 5.0]).ravel()
        inside = (ticks >= self.low * (1 - 1e-9)) & (ticks <= self.high * (1 + 1e-9))
        return [float(tick) + 0.0 for tick in ticks[inside]]  # no minus before a zero


def log_axis(values: NDArray[np.float64], *, name: str, horizontal: bool = False) -> Axis:
    """Logarithmic axis around positive values, with room for labels on the right of a wide one.

    Parameters
    ----------
    values : ndarray
        Positive data.
    name : str
        Axis title with its unit.
    horizontal : bool
        True for the x axis.

    Returns
    -------
    Axis
        The axis.
    """
    low, high = float(values.min()), float(values.max())
    room = (high / low) ** 0.08
    if horizontal:
        low, high = low / max(room, 1.3), high * max(room**1.6, 1.8)
        return Axis(low, high, LEFT, RIGHT, name, log=True)
    room = max(room, 1.25)
    return Axis(low / room, high * room, BOTTOM, TOP, name, log=True)


def share_axis(name: str, *, vertical: bool = False) -> Axis:
    """Linear axis from 0 to 100 %, with room for labels beyond where it is horizontal.

    Parameters
    ----------
    name : str
        Axis title with its unit.
    vertical : bool
        True for the y axis.

    Returns
    -------
    Axis
        The axis.
    """
    if vertical:
        return Axis(0.0, 103.0, BOTTOM, TOP, name, log=False)
    return Axis(0.0, 116.0, LEFT, RIGHT, name, log=False)


def number(value: float) -> str:
    """Number with three significant digits and thin spaces between thousands.

    Parameters
    ----------
    value : float
        What to print.

    Returns
    -------
    str
        Text.

    Examples
    --------
    >>> number(0.01234), number(3.0), number(98.76)
    ('0.0123', '3', '98.8')
    """
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.10g}".replace(",", "\u2009")


def _nice(step: float) -> float:
    """The next 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * next(m for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9)))


def frame(x: Axis, y: Axis) -> list[str]:
    """Grid, tick labels and axis titles.

    Parameters
    ----------
    x, y : Axis
        The two axes.

    Returns
    -------
    list of str
        SVG elements.
    """
    parts = []
    for tick in x.ticks:
        at = float(x(tick))
        parts.append(f'<path d="M{at:.1f},{TOP}V{BOTTOM}" stroke="#ececec"/>')
        parts.append(f'<text x="{at:.1f}" y="{BOTTOM + 19}" font-size="13" fill="#444" '
                     f'text-anchor="middle">{number(tick)}</text>')  # fmt: skip
    for tick in y.ticks:
        at = float(y(tick))
        parts.append(f'<path d="M{LEFT},{at:.1f}H{RIGHT}" stroke="#ececec"/>')
        parts.append(f'<text x="{LEFT - 9}" y="{at + 4.5:.1f}" font-size="13" fill="#444" '
                     f'text-anchor="end">{number(tick)}</text>')  # fmt: skip
    middle_x, middle_y = (LEFT + RIGHT) / 2, (TOP + BOTTOM) / 2
    parts += [
        f'<path d="M{LEFT},{TOP}V{BOTTOM}H{RIGHT}" fill="none" stroke="#888"/>',
        f'<text x="{middle_x}" y="{BOTTOM + 46}" font-size="14" fill="#222" '
        f'text-anchor="middle">{escape(x.name)}</text>',
        f'<text transform="translate(22,{middle_y}) rotate(-90)" font-size="14" fill="#222" '
        f'text-anchor="middle">{escape(y.name)}</text>',
    ]
    return parts
