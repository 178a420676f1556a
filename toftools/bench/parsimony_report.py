"""Ladders of models in a report: a chart and a table each, and what each group of captures needs.

``DIR/parsimony.csv`` and ``DIR/parsimony.json`` hold the same figures for programs.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from toftools.bench.best import best_of_each, entries
from toftools.bench.figures import slug, write_tables
from toftools.bench.light_models import light_model
from toftools.bench.parsimony import ALL, Climb, climbs
from toftools.bench.pixels import key_of, pixel_errors
from toftools.bench.render import number
from toftools.bench.table import groups, label_of
from toftools.io.atomic import atomic_path
from toftools.viz.parsimony import Scaled, parsimony_svg

WITHIN_M = 0.01
"""Error up to which a method suffices for a pixel, for suites without ladders."""
MOST_BARS = 12
"""Captures of a group that get a bar of their own."""
_TEMPLATE = Path(__file__).with_name("parsimony.html.j2")


def parsimony(out: Path, rows: Sequence[Mapping[str, Any]], plan: Mapping[str, Any]) -> str:
    """The part of a report on how simple models may be; writes figures and tables beside it.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        All rows of results.
    plan : mapping
        Plan of the folder.

    Returns
    -------
    str
        HTML; empty if there are neither ladders nor groups with two methods.
    """
    by_key = {key_of(row): row for row in rows}
    pixels = pixel_errors(out, by_key, plan["mask"])
    ladders = dict(plan.get("ladders", {}))
    told = [("ladder", name, ladder) for name, ladder in ladders.items()]
    plain = [row for row in rows if "axis" not in row and "ladders" not in row]
    told += [("group", name, group_ladder(mine)) for name, mine in groups(plain).items()
             if mine[0]["against"] == "truth"]  # fmt: skip
    told = [(kind, name, ladder) for kind, name, ladder in told if len(ladder["rungs"]) > 1]
    if not told:
        return ""
    found = [(kind, ladder, climbs(name, ladder, by_key, pixels)) for kind, name, ladder in told]
    told_of = [line for _, _, mine in found for climb in mine for line in lines(climb)]
    write_tables(out, "parsimony", told_of)
    (out / "figures").mkdir(exist_ok=True)
    parts = [_part(out, kind, ladder, mine) for kind, ladder, mine in found]
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        _TEMPLATE.read_text(encoding="utf-8")
    )
    return template.render(
        ladders=[part for part in parts if part["kind"] == "ladder"],
        groups=[part for part in parts if part["kind"] == "group"],
        summary=_summary([mine for kind, _, mine in found if kind == "ladder"]),
    )


def group_ladder(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The methods of a group of captures as a ladder: each at its best setting, quickest first.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of the group.

    Returns
    -------
    dict
        As `plan` has ladders; methods that nobody timed are left out.
    """
    best = [one for one in best_of_each(entries(rows)).values() if one.ms and one.answered]
    ordered = sorted(best, key=lambda one: one.mean_ms)
    names = {str(row["capture_id"]): str(row["capture"]) for row in rows}
    alone = Counter(names.values())
    keys: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        mine = keys.setdefault(label_of(row), {})
        name, mark = str(row["capture"]), str(row["capture_id"])
        mine.setdefault(name if alone[name] == 1 else mark, []).append(key_of(row))
    return {
        "about": "methods, quickest first",
        "within_m": WITHIN_M,
        "rungs": [
            {"rung": one.mean_ms, "label": one.method, "method": one.label,
             "scenes": keys[one.label]}
            for one in ordered
        ],
    }  # fmt: skip


def lines(climb: Climb) -> list[dict[str, Any]]:
    """A climb as lines of a table.

    Parameters
    ----------
    climb : Climb
        The climb.

    Returns
    -------
    list of dict
        One per rung, with the same keys; what is not finite is None.
    """
    cumulative = np.cumsum(climb.first)
    found = [
        {
            "ladder": climb.ladder,
            "scene": climb.scene or "all scenes",
            "rung": float(climb.rungs[at]),
            "label": climb.labels[at],
            "model": climb.methods[at],
            "light": light_model(climb.methods[at]),
            "mae_m": float(climb.mean_m[at]),
            "least_m": float(climb.error_m[at].min()),
            "most_m": float(climb.error_m[at].max()),
            "ms": float(climb.ms[at]),
            "valid_share": float(climb.valid[at]),
            "within_share": float(climb.within[at]),
            "first_share": float(climb.first[at]),
            "cumulative_share": float(cumulative[at]),
            "knee": climb.knee == at,
            "failure": climb.failures[at],
        }
        for at in range(climb.rungs.size)
    ]
    return [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}
        for line in found
    ]


def _part(
    out: Path, kind: str, ladder: Mapping[str, Any], found: Sequence[Climb]
) -> dict[str, Any]:
    """Chart and table of one ladder."""
    name = found[0].ladder
    shown = found if kind == "ladder" or len(found) <= MOST_BARS + 1 else found[-1:]
    word = "scenes" if kind == "ladder" else "captures"
    drawn = [Scaled(c.scene or f"all {word}", c.error_m, c.ms, c.first, c.knee) for c in shown]
    svg = parsimony_svg(found[0].labels, drawn, title=name, name=str(ladder["about"]),
                        within_m=float(ladder["within_m"]))  # fmt: skip
    mark = f"{'ladder' if kind == 'ladder' else 'suffices'}-{slug(name)}"
    with atomic_path(out / "figures" / f"{mark}.svg") as path:
        path.write_text(svg, encoding="utf-8")
    whole = found[-1]
    return {
        "kind": kind, "name": name, "id": mark, "svg": svg,
        "within_mm": number(ladder["within_m"], 1e3, "g"),
        "knee": "" if whole.knee is None else whole.labels[whole.knee],
        "none": f"{max(1 - float(whole.first.sum()), 0):.0%}",
        "table": _table(shown),
    }  # fmt: skip


def _summary(found: Sequence[Sequence[Climb]]) -> dict[str, Any]:
    """One line per ladder: the knee over all scenes, and those of the easiest and hardest scene."""
    head = ["ladder", "knee over all scenes", "of the easiest scene", "of the hardest scene",
            "no rung suffices, %"]  # fmt: skip
    body = []
    for mine in found:
        whole = mine[-1]
        knees = [climb.knee for climb in mine if climb.scene != ALL and climb.knee is not None]
        ends = [whole.knee, *((min(knees), max(knees)) if knees else (None, None))]
        body.append([
            whole.ladder, *("–" if end is None else whole.labels[end] for end in ends),
            f"{100 * max(1 - float(whole.first.sum()), 0):.0f}",
        ])  # fmt: skip
    return {"head": head, "rows": body}


def _table(found: Sequence[Climb]) -> dict[str, Any]:
    head = ["model", "light it knows", "scene", "rung", "MAE cm", "from", "to", "ms", "valid %",
            "suffices %", "first %", "first so far %", "knee", "failures"]  # fmt: skip
    # All scenes first, then each: what a reader wants first.
    ordered = [climb for climb in found if climb.scene == ALL]
    ordered += [climb for climb in found if climb.scene != ALL]
    body = [
        [line["model"], line["light"], line["scene"], line["label"],
         *(number(line[key], 100) for key in ("mae_m", "least_m", "most_m")),
         number(line["ms"]),
         *(number(line[key], 100, ".1f") for key in
           ("valid_share", "within_share", "first_share", "cumulative_share")),
         "knee" if line["knee"] else "", line["failure"]]
        for climb in ordered for line in lines(climb)
    ]  # fmt: skip
    return {"head": head, "rows": body}
