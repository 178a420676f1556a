"""The summary as the report shows it: cells with a text, a small second figure and a hover text."""

import math
from collections.abc import Sequence
from typing import Any

from toftools.bench.render import number
from toftools.bench.summary import Cheapest, Standing


def summary_table(found: Sequence[Standing], cheap: Sequence[Cheapest]) -> dict[str, Any]:
    """What the template shows of the summary.

    Parameters
    ----------
    found : sequence of Standing
        Methods, in the order in which they stand.
    cheap : sequence of Cheapest
        Groups.

    Returns
    -------
    dict
        ``head``, ``rows`` of cells, ``settings`` and ``cheapest`` as plain tables; empty without a
        method.
    """
    if not found:
        return {}
    names = list(dict.fromkeys(name for one in found for name in one.ranks))
    best = min((one.mean_rank for one in found if math.isfinite(one.mean_rank)), default=None)
    axes = any(one.axes for one in found)
    head = ["method"]
    if names:
        head += [*names, "mean rank", "ms", "captures answered", "pixels %"]
    if axes:
        head += ["axes survived %", "rank on axes"]
    rows = []
    for one in found:
        cells = [_cell(one.method)]
        if names:
            cells += [_rank(one, name) for name in names]
            cells += _overall(one, len(names), best)
        if axes:
            cells += _stress(one)
        rows.append(cells)
    return {
        "head": head,
        "rows": rows,
        "settings": _settings(found, names, axes=axes),
        "cheapest": _cheapest(cheap),
    }


def _cell(text: str, small: str = "", tip: str = "", *, win: bool = False) -> dict[str, Any]:
    return {"text": text, "small": small, "tip": tip, "win": win}


def _rank(one: Standing, name: str) -> dict[str, Any]:
    if name not in one.ranks:
        return _cell("–", tip=f"{one.method} suits no capture of {name}")
    entry, rank = one.chosen[name], one.ranks[name]
    tip = (
        f"{entry.label}: MAE {number(entry.mae_m, 100)} cm, {number(entry.mean_ms)} ms, "
        f"{entry.answered} of {entry.captures} captures answered"
    )
    small = f"{number(entry.mae_m, 100)} cm" if entry.whole else "incomplete"
    return _cell(str(rank), small, tip, win=rank == 1 and entry.whole)


def _overall(one: Standing, groups: int, best: float | None) -> list[dict[str, Any]]:
    share = f"{one.answered} of {one.captures}" if one.captures else "–"
    few = f"in {len(one.ranks)} of {groups}" if 0 < len(one.ranks) < groups else ""
    return [
        _cell(number(one.mean_rank, 1, ".1f"), few, win=one.mean_rank == best),
        _cell(number(one.ms)),
        _cell(share),
        _cell(number(one.valid_share, 100, ".1f")),
    ]


def _stress(one: Standing) -> list[dict[str, Any]]:
    small = f"{one.axes} {'axis' if one.axes == 1 else 'axes'}" if one.axes else ""
    return [
        _cell(number(one.survived, 100, ".1f"), small, one.stress_setting),
        _cell(str(one.stress_rank or "–"), win=one.stress_rank == 1),
    ]


def _settings(found: Sequence[Standing], names: Sequence[str], *, axes: bool) -> dict[str, Any]:
    """Which setting stands for each method."""
    body = [
        [one.method, *(one.chosen[n].label if n in one.chosen else "–" for n in names),
         *([one.stress_setting or "–"] if axes else [])]
        for one in found
    ]  # fmt: skip
    return {"head": ["method", *names, *(["stress axes"] if axes else [])], "rows": body}


def _cheapest(cheap: Sequence[Cheapest]) -> dict[str, Any]:
    if not cheap:
        return {}
    head = ["group", "least error", "MAE cm", "ms", "cheapest within 10 %", "MAE cm", "ms",
            "times faster"]  # fmt: skip
    body = [
        [one.group, one.best.label, number(one.best.mae_m, 100), number(one.best.mean_ms),
         one.cheapest.label, number(one.cheapest.mae_m, 100), number(one.cheapest.mean_ms),
         number(one.best.mean_ms / one.cheapest.mean_ms if one.cheapest.mean_ms else math.nan,
                1, ".1f")]
        for one in cheap
    ]  # fmt: skip
    return {"head": head, "rows": body}
