"""All groups of a suite in one table: ranks, times, answers, axes survived, what is cheap enough.

In each group every method stands with its best setting (`best`: least mean absolute error among the
settings that answer every capture). Ranks go by that error rounded to three significant digits;
equal errors have equal ranks, and the next rank counts all before it (1, 1, 3). Methods that do not
answer every capture share the place after all that do. Methods that suit none of the captures of a
group, and references, have no rank there; the mean rank is over the groups that a method suits.
Groups without truth are left out: to be near the camera's own distance is to share its multipath.

On stress axes a method stands with the setting that survives most: the mean over its axes of the
share of the axis before it breaks, rounded to a tenth of a percent.

The cheapest method within a tenth of the best is, of all settings of a group that answer every
capture, the one of least time whose error is at most 1.1 times the least.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.best import Entry, best_of_each, entries
from toftools.bench.figures import write_csv
from toftools.bench.references import REFERENCES
from toftools.bench.table import groups, label_of

NEAR = 1.1
"""Error over the least error up to which a cheaper setting is as good."""


@dataclass(frozen=True)
class Standing:
    """One method over all groups and axes.

    Parameters
    ----------
    method : str
        Method.
    chosen : mapping of str to Entry
        Its best setting per group that it suits.
    ranks : mapping of str to int
        Its rank in each of those.
    mean_rank : float
        Mean of those; NaN without one.
    ms : float
        Median time over all captures of those settings, ms.
    answered, captures : int
        Captures of those groups that it answers, of all.
    valid_share : float
        Mean over those groups of its share of the pixels answered.
    axes : int
        Stress axes that it suits.
    survived : float
        Mean share of those that it survives, 0..1; NaN without one.
    stress_setting : str
        Setting that survives that share.
    stress_rank : int
        Its place by that share; 0 for none.
    """

    method: str
    chosen: Mapping[str, Entry] = field(default_factory=dict)
    ranks: Mapping[str, int] = field(default_factory=dict)
    mean_rank: float = math.nan
    ms: float = math.nan
    answered: int = 0
    captures: int = 0
    valid_share: float = math.nan
    axes: int = 0
    survived: float = math.nan
    stress_setting: str = ""
    stress_rank: int = 0


@dataclass(frozen=True)
class Cheapest:
    """The best setting of a group, and the cheapest that is as good within a tenth."""

    group: str
    best: Entry
    cheapest: Entry


def ranked(errors: Mapping[str, float]) -> dict[str, int]:
    """Ranks by error; what is not finite shares the place after all that is.

    Parameters
    ----------
    errors : mapping of str to float
        Error by name, less is better; rounded to three significant digits here.

    Returns
    -------
    dict of str to int
        Rank by name.

    Examples
    --------
    >>> ranked({"a": 0.02, "b": 0.0100, "c": 0.010001, "d": float("nan"), "e": float("nan")})
    {'a': 3, 'b': 1, 'c': 1, 'd': 4, 'e': 4}
    """
    rounded = {name: float(f"{e:.3g}") if math.isfinite(e) else math.inf
               for name, e in errors.items()}  # fmt: skip
    return {name: 1 + sum(o < e for o in rounded.values()) for name, e in rounded.items()}


def standings(
    rows: Sequence[Mapping[str, Any]], survived: Mapping[str, Sequence[float | None]]
) -> list[Standing]:
    """All methods of a suite, the best mean rank first.

    Parameters
    ----------
    rows : sequence of mapping
        All rows, those of axes too.
    survived : mapping of str to sequence of float or None
        By setting, the share of each axis that it survives, 0..1; None where it does not suit.

    Returns
    -------
    list of Standing
        One per method that has a rank anywhere.
    """
    chosen = {name: best_of_each(entries(mine)) for name, mine in _groups(rows).items()}
    chosen = {name: best for name, best in chosen.items() if best}
    ranks = {
        name: ranked({m: e.mae_m if e.whole else math.nan for m, e in best.items()})
        for name, best in chosen.items()
    }
    axes = _axes(rows, survived)
    places = ranked({method: 1.0 - round(share, 3) for method, (_, share, _) in axes.items()})
    methods = dict.fromkeys(str(row["method"]) for row in rows)
    found = []
    for method in methods:
        mine = {name: best[method] for name, best in chosen.items() if method in best}
        if mine or method in axes:
            own = {name: ranks[name][method] for name in mine}
            setting, share, count = axes.get(method, ("", math.nan, 0))
            found.append(_standing(method, mine, own, count, share, setting, places.get(method, 0)))
    return sorted(found, key=lambda one: (_last(one.mean_rank), one.stress_rank or math.inf))


def _groups(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Rows by group; those of axes, of ladders and without truth left out."""
    # Each rung of a ladder has captures of its own: their means do not compare.
    return groups(
        row
        for row in rows
        if "axis" not in row and "ladders" not in row and row["against"] == "truth"
    )


def _standing(
    method: str,
    chosen: Mapping[str, Entry],
    ranks: Mapping[str, int],
    *stress: Any,  # noqa: ANN401
) -> Standing:
    count, share, setting, place = stress
    times = [ms for one in chosen.values() for ms in one.ms]
    valid = [one.valid_share for one in chosen.values() if math.isfinite(one.valid_share)]
    return Standing(
        method, chosen, ranks,
        mean_rank=float(np.mean(list(ranks.values()))) if ranks else math.nan,
        ms=float(np.median(times)) if times else math.nan,
        answered=sum(one.answered for one in chosen.values()),
        captures=sum(one.captures for one in chosen.values()),
        valid_share=float(np.mean(valid)) if valid else math.nan,
        axes=count, survived=share, stress_setting=setting, stress_rank=place,
    )  # fmt: skip


def _last(rank: float) -> float:
    return rank if math.isfinite(rank) else math.inf


def _axes(
    rows: Iterable[Mapping[str, Any]], survived: Mapping[str, Sequence[float | None]]
) -> dict[str, tuple[str, float, int]]:
    """By method: the setting that survives most, its mean share, and on how many axes."""
    method_of = {label_of(row): str(row["method"]) for row in rows if "axis" in row}
    best: dict[str, tuple[str, float, int]] = {}
    for label, shares in survived.items():
        method = method_of.get(label, label)
        known = [share for share in shares if share is not None]
        if not known or method in REFERENCES:
            continue
        mean = float(np.mean(known))
        if method not in best or (len(known), mean) > (best[method][2], best[method][1]):
            best[method] = label, mean, len(known)
    return best


def cheapest(rows: Sequence[Mapping[str, Any]]) -> list[Cheapest]:
    """By group, the best setting and the cheapest that is as good within a tenth.

    Parameters
    ----------
    rows : sequence of mapping
        All rows; those of axes and those without truth are left out.

    Returns
    -------
    list of Cheapest
        One per group in which a timed setting answers every capture.
    """
    found = []
    for name, mine in _groups(rows).items():
        whole = [one for one in entries(mine) if one.timed and one.whole and one.ms]
        if whole:
            best = min(whole, key=lambda one: (one.mae_m, one.mean_ms))
            near = [one for one in whole if one.mae_m <= NEAR * best.mae_m]
            found.append(Cheapest(name, best, min(near, key=lambda one: (one.mean_ms, one.mae_m))))
    return found


def write_summary(out: Path, found: Sequence[Standing], cheap: Sequence[Cheapest]) -> None:
    """Write ``DIR/summary.csv``, one line per method, and ``DIR/cheapest.csv``, one per group.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    found : sequence of Standing
        Methods.
    cheap : sequence of Cheapest
        Groups.
    """
    names = list(dict.fromkeys(name for one in found for name in one.ranks))
    lines = []
    for one in found:
        line: dict[str, Any] = {
            "method": one.method, "mean_rank": one.mean_rank, "groups": len(one.ranks),
            "ms": one.ms, "answered": one.answered, "captures": one.captures,
            "valid_share": one.valid_share, "survived": one.survived, "axes": one.axes,
            "stress_rank": one.stress_rank or None, "stress_setting": one.stress_setting,
        }  # fmt: skip
        for name in names:
            entry = one.chosen.get(name)
            line[f"rank: {name}"] = one.ranks.get(name)
            line[f"mae_m: {name}"] = entry.mae_m if entry else None
            line[f"setting: {name}"] = entry.label if entry else None
        lines.append(line)
    write_csv(out / "summary.csv", lines)
    write_csv(
        out / "cheapest.csv",
        [
            {"group": one.group, "best": one.best.label, "best_mae_m": one.best.mae_m,
             "best_ms": one.best.mean_ms, "cheapest": one.cheapest.label,
             "cheapest_mae_m": one.cheapest.mae_m, "cheapest_ms": one.cheapest.mean_ms}
            for one in cheap
        ],
    )  # fmt: skip
