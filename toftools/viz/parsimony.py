"""Chart of a ladder of models: error and time per rung, and which rung each pixel needs."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from toftools.viz._axes import WIDTH, Axis, number
from toftools.viz._series import empty, svg

F64 = NDArray[np.float64]

TOP, BOTTOM = 92.0, 330.0
ERRORS, TIMES = (84.0, 584.0), (676.0, 936.0)
"""Left and right of the two panels, px."""
BARS = (296.0, 790.0)
ROW_PX, LETTER_PX = 25.0, 6.6
MOST_LETTERS = 36
LONG = 9
"""Labels of more letters stand slanted."""
SIMPLE, COMPLEX = (198, 219, 239), (8, 48, 107)
"""Colours of the first and the last rung; what no rung explains is orange."""
NONE = "#d55e00"
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444")


@dataclass(frozen=True, eq=False)
class Scaled:
    """One scene along a ladder.

    Parameters
    ----------
    name : str
        Scene.
    mae_m : ndarray, (R, S)
        Mean absolute error per rung and seed, m; infinite where a rung failed.
    ms : ndarray, (R,)
        Time per frame, ms; NaN if not known.
    first : ndarray, (R,)
        Share of pixels for which each rung is the first that suffices.
    knee : int or None
        Number of the simplest rung that is as good as the best.
    """

    name: str
    mae_m: F64
    ms: F64
    first: F64
    knee: int | None


def parsimony_svg(
    labels: Sequence[str], scenes: Sequence[Scaled], *, title: str, name: str, within_m: float
) -> str:
    """Error, time and share of pixels along a ladder, the simplest rung on the left.

    Parameters
    ----------
    labels : sequence of str
        The rungs in words.
    scenes : sequence of Scaled
        Scenes; the last is drawn thick, and first among the bars: the mean of the others.
    title : str
        Title.
    name : str
        What the rungs are, with their unit.
    within_m : float
        Error up to which a rung suffices for a pixel, m.

    Returns
    -------
    str
        SVG, 960 px wide, that scales with the page.
    """
    known = [s.mae_m[np.isfinite(s.mae_m) & (s.mae_m > 0)] for s in scenes]
    if not scenes or not sum(part.size for part in known):
        return empty(title)
    slanted = max(map(len, labels)) > LONG
    foot = BOTTOM + (30 + 0.5 * LETTER_PX * min(max(map(len, labels)), MOST_LETTERS)
                     if slanted else 24)  # fmt: skip
    parts = [*_errors(labels, scenes, np.concatenate(known), slanted=slanted)]
    parts += _times(labels, scenes[-1], slanted=slanted)
    parts += [_text((ERRORS[0] + ERRORS[1]) / 2, foot + 18, name, anchor="middle", size=14)]
    bars, end = _bars(labels, scenes, within_m, foot + 56)
    note = (
        "Ring: the knee, the simplest rung within 10 % or 1 mm of the best. Thick: mean of all "
        "scenes. Upright: spread over seeds."
    )
    return svg(title, note, [*parts, *bars], end + 18)


def _text(
    x: float, y: float, text: str, *, anchor: str = "start", size: float = 12.5,
    fill: str = "#333", bold: bool = False, slant: bool = False, whole: bool = False,
) -> str:  # fmt: skip
    short = text
    if len(text) > MOST_LETTERS and anchor != "middle" and not whole:  # names differ at both ends
        short = text[: MOST_LETTERS // 2 - 3] + "…" + text[-(MOST_LETTERS // 2) :]
    tip = "" if short == text else f"<title>{escape(text)}</title>"
    turn = f' transform="rotate(-27 {x:.1f} {y:.1f})"' if slant else ""
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{fill}" '
        f'text-anchor="{anchor}"{weight}{turn}>{tip}{escape(short)}</text>'
    )


def _at(panel: tuple[float, float], count: int) -> F64:
    """Middles of the rungs in a panel, px."""
    step = (panel[1] - panel[0]) / count
    return np.asarray(panel[0] + step * (np.arange(count) + 0.5))


def _frame(
    panel: tuple[float, float], y: Axis, labels: Sequence[str], *, slanted: bool
) -> list[str]:
    """Grid, ticks and rungs of a panel."""
    left, right = panel
    parts = [_text(left - 4, TOP - 12, y.name, size=13, fill="#222")]
    for tick in y.ticks:
        at = float(y(tick))
        parts.append(f'<path d="M{left},{at:.1f}H{right}" stroke="#ececec"/>')
        parts.append(_text(left - 8, at + 4, number(tick), anchor="end"))
    parts.append(f'<path d="M{left},{TOP}V{BOTTOM}H{right}" fill="none" stroke="#888"/>')
    for x, label in zip(_at(panel, len(labels)), labels, strict=True):
        parts.append(
            _text(x + 8, BOTTOM + 16, label, anchor="end", slant=True, size=12)
            if slanted
            else _text(x, BOTTOM + 18, label, anchor="middle", size=13)
        )
    return parts


def _log(values: F64, name: str) -> Axis:
    low, high = float(values.min()), float(values.max())
    room = 1.3 * (high / low) ** 0.1
    return Axis(low / 1.3, high * room, BOTTOM, TOP, name, log=True)


def _errors(
    labels: Sequence[str], scenes: Sequence[Scaled], known: F64, *, slanted: bool
) -> list[str]:
    """Curves of all scenes, the mean thick."""
    unit, factor = ("mm", 1e3) if np.median(known) < 0.01 else ("cm", 1e2)
    y = _log(known * factor, f"mean absolute error, {unit}")
    across = _at(ERRORS, len(labels))
    parts = _frame(ERRORS, y, labels, slanted=slanted)
    for look, scene in enumerate(scenes):
        whole = scene is scenes[-1]
        colour = "#111" if whole else _COLOURS[look % len(_COLOURS)]
        mean = scene.mae_m.mean(axis=1)
        fine = np.flatnonzero(np.isfinite(mean) & (mean > 0)).tolist()
        if not fine:
            continue
        xy = list(zip(across[fine], y(mean[fine] * factor), strict=True))
        path = "M" + "L".join(f"{px:.1f},{py:.1f}" for px, py in xy)
        parts.append(f'<path d="{path}" fill="none" stroke="{colour}" stroke-linejoin="round" '
                     f'stroke-width="{2.6 if whole else 1.2}"/>')  # fmt: skip
        for at, (px, py) in zip(fine, xy, strict=True):
            low, high = (
                max(float(f), 1e-9) for f in (scene.mae_m[at].min(), scene.mae_m[at].max())
            )
            ends = [float(y(f * factor)) for f in (low, high)]
            tip = f"{scene.name}, {labels[at]}: {number(mean[at] * factor)} {unit}"
            tip += f", {number(scene.ms[at])} ms" if np.isfinite(scene.ms[at]) else ""
            parts.append(f'<path d="M{px:.1f},{ends[0]:.1f}V{ends[1]:.1f}" stroke="{colour}" '
                         'stroke-opacity="0.6"/>')  # fmt: skip
            parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="{4.2 if whole else 2.8}" '
                         f'fill="{colour}"><title>{escape(tip)}</title></circle>')  # fmt: skip
            if at == scene.knee:
                parts.append(f'<circle class="knee" cx="{px:.1f}" cy="{py:.1f}" '
                             f'r="{9 if whole else 6}" fill="none" stroke="{colour}" '
                             f'stroke-width="{2.2 if whole else 1.3}"/>')  # fmt: skip
    parts += [
        _text(across[at], TOP + 14, "fails", anchor="middle", fill=NONE)
        for at in np.flatnonzero(~np.isfinite(scenes[-1].mae_m.mean(axis=1)))
    ]
    return parts


def _times(labels: Sequence[str], whole: Scaled, *, slanted: bool) -> list[str]:
    """Time of every rung as a stem."""
    fine = np.flatnonzero(np.isfinite(whole.ms) & (whole.ms > 0)).tolist()
    if not fine:
        return [_text(TIMES[0], TOP + 20, "no times")]
    y = _log(whole.ms[fine], "time per frame, ms")
    parts = _frame(TIMES, y, labels, slanted=slanted)
    across = _at(TIMES, len(labels))
    for at in fine:
        top = float(y(whole.ms[at]))
        ring = ' stroke="#111" stroke-width="2.2"' if at == whole.knee else ""
        tip = escape(f"{labels[at]}: {number(whole.ms[at])} ms")
        parts.append(f'<path d="M{across[at]:.1f},{BOTTOM}V{top:.1f}" stroke="#9aa4b2"/>'
                     f'<circle cx="{across[at]:.1f}" cy="{top:.1f}" r="5" '
                     f'fill="{_rung_colour(at, len(labels))}"{ring}>'
                     f"<title>{tip}</title></circle>")  # fmt: skip
        parts.append(_text(across[at], top - 10, number(whole.ms[at]), anchor="middle", size=11.5))
    return parts


def _rung_colour(at: int, count: int) -> str:
    part = at / max(count - 1, 1)
    mixed = [round(a + part * (b - a)) for a, b in zip(SIMPLE, COMPLEX, strict=True)]
    return f"rgb({mixed[0]},{mixed[1]},{mixed[2]})"


def _bars(
    labels: Sequence[str], scenes: Sequence[Scaled], within_m: float, top: float
) -> tuple[list[str], float]:
    """Stacked shares of pixels by the first rung that suffices, and where they end."""
    said = f"share of pixels by the simplest rung within {number(1e3 * within_m)} mm"
    parts = [
        _text(24, top, said, size=14, fill="#222", whole=True),
        _text(BARS[1] + 12, top, "knee", size=14),
    ]
    chips, top = _legend(labels, top + 22)
    parts += chips
    ordered = [scenes[-1], *scenes[:-1]]
    for row, scene in enumerate(ordered):
        y = top + row * ROW_PX
        parts += _bar(scene, labels, y, whole=row == 0 and len(ordered) > 1)
        if row:
            parts.append(f'<path d="M24,{y + 10:.1f}h14" stroke-width="2.4" '
                         f'stroke="{_COLOURS[(row - 1) % len(_COLOURS)]}"/>')  # fmt: skip
    return parts, top + len(ordered) * ROW_PX


def _legend(labels: Sequence[str], y: float) -> tuple[list[str], float]:
    """A chip per rung, in as many rows as they need, and where the next thing may stand."""
    parts, x = [], 24.0
    colours = [_rung_colour(at, len(labels)) for at in range(len(labels))]
    for label, colour in zip([*labels, "none"], [*colours, NONE], strict=True):
        wide = 26 + LETTER_PX * min(len(label), MOST_LETTERS) + 14
        if x + wide > WIDTH - 16:
            x, y = 24.0, y + 20
        parts.append(f'<rect x="{x:.1f}" y="{y - 10:.1f}" width="13" height="13" fill="{colour}"/>')
        parts.append(_text(x + 18, y + 1, label))
        x += wide
    return parts, y + 18


def _bar(scene: Scaled, labels: Sequence[str], y: float, *, whole: bool) -> list[str]:
    parts = [_text(44, y + 14, scene.name, bold=whole)]
    shares = [*scene.first.tolist(), max(1 - float(scene.first.sum()), 0.0)]
    left, width = BARS[0], BARS[1] - BARS[0]
    for at, share in enumerate(shares):
        none = at == len(labels)
        colour = NONE if none else _rung_colour(at, len(labels))
        tip = f"{scene.name}: {share:.1%} " + ("no rung" if none else labels[at])
        parts.append(f'<rect x="{left:.1f}" y="{y:.1f}" width="{share * width:.1f}" height="19" '
                     f'fill="{colour}"><title>{escape(tip)}</title></rect>')  # fmt: skip
        if share > 0.06:
            ink = "#fff" if none or at > 0.45 * (len(labels) - 1) else "#222"
            parts.append(_text(left + share * width / 2, y + 14, f"{100 * share:.0f} %",
                               anchor="middle", size=11.5, fill=ink))  # fmt: skip
        left += share * width
    said = "none" if scene.knee is None else labels[scene.knee]
    return [*parts, _text(BARS[1] + 12, y + 14, said[:20], bold=whole)]
