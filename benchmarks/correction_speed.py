"""Speed against accuracy: every method over its grid, on the same captures."""

import numpy as np
from correction_frames import (
    SU_HINTS,
    by_method,
    first_set,
    means,
    scored,
    su_frames,
    unsuited,
)
from correction_methods import number, sentences, table

from toftools.viz.charts import Curve, pareto_svg

SHOWN = ("cornell", "corner-angle-90-range-2-albedo-0.8", "room-seed-5", "vshape")
BUDGET_S = 0.5


def measure(job):
    own = {name: capture for name, capture in first_set(job).items() if name in SHOWN or job.quick}
    captures = {**su_frames(job), **own}
    rows = scored(job, captures, grid=True, budget_s=BUDGET_S, **SU_HINTS)
    pixels = {name: capture.truth.range_m.size for name, capture in captures.items()}
    timed_on = [name for name, size in pixels.items() if size == max(pixels.values())]
    return {"captures": list(captures), "timed_on": timed_on, "rows": rows}


def settings(result):
    """(label, name, mean MAE, ms) of every setting that answered on all captures.

    Times come from the largest captures alone: in small ones starting the threads counts.
    """
    found, largest = [], set(result["timed_on"])
    for label, rows in by_method(result["rows"]).items():
        if len(rows) == len(result["captures"]):
            ms = means([row for row in rows if row["capture"] in largest], "ms_frame")
            found.append((label, rows[0]["name"], means(rows, "mae_m"), ms))
    return found


def write(result, folder):
    """Chart as SVG, the best settings as a table."""
    points = settings(result)
    curves = []
    for name in dict.fromkeys(name for _, name, _, _ in points):
        mine = sorted((p for p in points if p[1] == name), key=lambda p: p[3])
        tips = [label.partition(":")[2] for label, *_ in mine]
        curves.append(Curve(name, [p[3] for p in mine], [p[2] for p in mine], tips))
    title = f"Mean error over {len(result['captures'])} captures, time per 320 x 240 pixels"
    (folder / "speed.svg").write_text(pareto_svg(curves, title=title), encoding="utf-8")
    body = []
    for name in dict.fromkeys(name for _, name, _, _ in points):
        mine = [p for p in points if p[1] == name and np.isfinite(p[2])]
        if not mine:
            continue
        best, quick = min(mine, key=lambda p: p[2]), min(mine, key=lambda p: p[3])
        body.append([f"`{best[0]}`", number(best[2], ".2f", 100), number(best[3], ".3g"),
                     number(quick[2], ".2f", 100), number(quick[3], ".3g")])  # fmt: skip
    body.sort(key=lambda row: float(row[1]))
    head = ["best setting", "MAE cm", "ms", "fastest setting: MAE cm", "ms"]
    text = (
        f"Captures: {', '.join(result['captures'])}; each counts alike. Times are the least of a "
        f"few calls on this machine, per 320 x 240 pixels, on {', '.join(result['timed_on'])}; "
        "slow methods ran on every fourth, 16th or 64th pixel. Each curve is a method over its "
        "grid in the registry."
    )
    parts = [text, "![Time against error](speed.svg)", table(head, body)]
    refused = unsuited(result["rows"])
    parts.append(sentences(refused))
    return "\n\n".join(filter(None, parts))
