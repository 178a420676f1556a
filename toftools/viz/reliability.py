"""Chart of calibration: what the intervals of a sigma promise against what they hold."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.viz._axes import number, share_axis
from toftools.viz._series import Chart, Series, draw, empty


@dataclass(frozen=True)
class Reliability:
    """One method in the chart of calibration.

    Parameters
    ----------
    name : str
        Method.
    promised : sequence of float
        Levels of the central intervals, 0 to 1, rising.
    held : sequence of float
        Share of the answers whose truth lies within each, 0 to 1; what is not finite is left out.
    """

    name: str
    promised: Sequence[float]
    held: Sequence[float]


def reliability_svg(methods: Sequence[Reliability], *, title: str) -> str:
    """Share of the pixels within each interval against the share that the interval promises.

    On the dashed diagonal a sigma is honest; a curve above it is of a method that is better than
    it says, one below of a method that is worse.

    Parameters
    ----------
    methods : sequence of Reliability
        Methods.
    title : str
        Title.

    Returns
    -------
    str
        SVG, 960 px wide, that scales with the page.

    Raises
    ------
    ValueError
        If a method does not have one share per level.
    """
    x = share_axis("promised: level of the interval, %")
    y = share_axis("held: pixels with the truth inside, %", vertical=True)
    series: list[Series] = []
    for one in methods:
        if len(one.promised) != len(one.held):
            msg = f"{one.name!r} has {len(one.held)} shares for {len(one.promised)} levels"
            raise ValueError(msg)
        points = 100 * np.array([one.promised, one.held], dtype=np.float64).T
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            continue
        tips = [f"{one.name}: {number(got)} % within its {number(of)} % interval"
                for of, got in points]  # fmt: skip
        xy = np.column_stack([x(points[:, 0]), y(points[:, 1])])
        series.append(Series(one.name, xy, tips, len(series)))
    if not series:
        return empty(title)
    left, low, right, high = (float(v) for v in (x(0), y(0), x(100), y(100)))
    middle, quiet = float(y(52)), 'font-size="12.5" fill="#888"'
    under = [
        f'<path class="honest" d="M{left:.1f},{low:.1f}L{right:.1f},{high:.1f}" stroke="#777" '
        'stroke-width="1.3" stroke-dasharray="6 4"/>',
        f'<text x="{left + 14:.1f}" y="{high + 18:.1f}" {quiet}>above: more cautious than it need '
        "be</text>",
        f'<text x="{right - 4:.1f}" y="{middle + 190:.1f}" text-anchor="end" {quiet}>below: '
        "overconfident</text>",
    ]
    note = "On the dashed line a sigma is honest: as many pixels lie within as it promises."
    return draw(Chart(title, note, x, y, series, under=under))
