"""Whether the sigma of each method is honest over a group: the chart and the table beside it.

Each method stands with its best setting of the group (`best`); a figure is the mean over the
captures on which that setting gives a sigma: a large capture counts no more than a small one.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.best import best_of_each, entries
from toftools.bench.figures import write_chart
from toftools.bench.render import number
from toftools.bench.rows import finite
from toftools.bench.table import label_of
from toftools.viz.reliability import Reliability, reliability_svg


def calibration(
    out: Path, rows: Sequence[Mapping[str, Any]], *, title: str, stem: str
) -> dict[str, Any]:
    """Chart and table of a group; the chart is written to ``figures`` too.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        Rows of one group.
    title : str
        Name of the group.
    stem : str
        Stem of the files.

    Returns
    -------
    dict
        ``svg`` and ``table``; empty if no method gives a sigma.
    """
    found = held(rows)
    if not found:
        return {}
    methods = [
        Reliability(label, list(shares), list(shares.values()))
        for label, (shares, _, _) in found.items()
    ]
    svg = reliability_svg(methods, title=f"Calibration of sigma: {title}")
    spreads = {label: (rms, robust) for label, (_, rms, robust) in found.items()}
    table = [
        {"setting": one.name, "promised": level, "held": share, "rms_z": spreads[one.name][0],
         "robust_z": spreads[one.name][1]}
        for one in methods
        for level, share in zip(one.promised, one.held, strict=True)
    ]  # fmt: skip
    write_chart(out, stem, svg, table)
    levels = sorted({level for one in methods for level in one.promised})
    head = ["method", *(f"in {100 * level:g} %" for level in levels), "rms z", "median |z| / 0.674"]
    body = [
        [label, *(number(shares.get(level), 100, ".1f") for level in levels),
         number(rms), number(robust)]
        for label, (shares, rms, robust) in found.items()
    ]  # fmt: skip
    return {"svg": svg, "table": {"head": head, "rows": body}}


def held(
    rows: Sequence[Mapping[str, Any]],
) -> dict[str, tuple[dict[float, float], float, float]]:
    """What the sigma of each method held, at its best setting.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of one group.

    Returns
    -------
    dict of str to (dict of float to float, float, float)
        By setting: share held by level promised, both 0..1; the two spreads of `z_spread`, NaN
        where the results of an older version do not have them.
    """
    chosen = [one.label for one in best_of_each(entries(rows)).values()]
    found = {}
    for label in chosen:
        mine = [row for row in rows if label_of(row) == label]
        tables = [row.get("intervals") or {} for row in mine]
        names = sorted({n for t in tables for n in t if _level(n) is not None}, key=float)
        shares = {float(n) / 100: _mean([t.get(n) for t in tables]) for n in names}
        shares = {level: share for level, share in shares.items() if np.isfinite(share)}
        if shares:
            z = [row.get("z") or {} for row in mine]
            spreads = [_mean([one.get(name) for one in z]) for name in ("rms", "robust")]
            found[label] = (shares, spreads[0], spreads[1])
    return found


def _level(name: str) -> float | None:
    """The level that a key of ``intervals`` names, %; None for a key that is no level."""
    try:
        level = float(name)
    except ValueError:
        return None
    return level if 0 < level < 100 else None


def _mean(values: Sequence[float | None]) -> float:
    known = [v for v in map(finite, values) if np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")
