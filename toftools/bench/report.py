"""Last stage: ``DIR/results.jsonl`` to one self-contained ``DIR/report.html`` and its figures."""

import base64
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from toftools.bench.calibration import calibration
from toftools.bench.choices import choices
from toftools.bench.confidence import confidence
from toftools.bench.figures import slug, write_chart, write_csv
from toftools.bench.pareto import pareto
from toftools.bench.parsimony_report import parsimony
from toftools.bench.pictures import best_per_method, capture_pictures
from toftools.bench.plan import read_plan
from toftools.bench.platforms import platforms
from toftools.bench.render import cells, headings, number
from toftools.bench.rows import read_rows
from toftools.bench.sensitivity_report import local
from toftools.bench.stress_report import stress
from toftools.bench.summary import cheapest, standings, write_summary
from toftools.bench.summary_table import summary_table
from toftools.bench.table import Line, groups, label_of, summarise, unsuited
from toftools.io.atomic import atomic_path
from toftools.registry import METRICS

AXIS_FIGURES = ("mae_m", "input_mae_m", "valid_share")
REGIONS = ("all", "edges", "corners", "dark", "far")
_TEMPLATE = Path(__file__).with_name("report.html.j2")
_SCRIPT = Path(__file__).with_name("report.js")


def report(out: Path) -> Path:
    """Write the report of a scored benchmark folder.

    Parameters
    ----------
    out : Path
        Folder with ``results.jsonl``.

    Returns
    -------
    Path
        ``report.html``.

    Raises
    ------
    ValueError
        If the folder was not scored.
    """
    rows, plan = read_rows(out), read_plan(out)[0]
    max_range_m = float(plan["mask"]["max_range_m"])
    figures = out / "figures"
    figures.mkdir(exist_ok=True)
    # Captures of an axis are too many for a section each: a matrix and a curve per axis instead.
    plain = [row for row in rows if "axis" not in row and "ladders" not in row]
    sections = [_group(out, name, mine, max_range_m) for name, mine in groups(plain).items()]
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        _TEMPLATE.read_text(encoding="utf-8")
    )
    axes = [row for row in rows if "axis" in row]
    strained = stress(out, axes, plan.get("axes", {}))
    _axis_files(out, axes, strained)
    script = _SCRIPT.read_text(encoding="utf-8")
    page = template.render(
        suite=rows[0]["suite"] if rows else "",
        sections=sections,
        stress=strained,
        local=local(out, rows),  # after stress, which writes where methods break
        summary=_summary(out, rows, strained),
        parsimony=parsimony(out, rows, plan),
        counts=_counts(rows),
        platforms=platforms(rows),
        problems=[row for row in rows if row["status"] not in ("ok", "unsuited")],
        label_of=label_of,
        script=script,
        # The page runs this script and no other, and loads nothing from anywhere.
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii"),
    )
    target = out / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _summary(
    out: Path, rows: Sequence[Mapping[str, Any]], strained: Mapping[str, Any]
) -> dict[str, Any]:
    survived = {
        method["label"]: [float(c["share"]) if c["share"] else None for c in method["cells"]]
        for method in strained.get("methods", [])
    }
    found, cheap = standings(rows, survived), cheapest(rows)
    write_summary(out, found, cheap)
    return summary_table(found, cheap)


def _axis_files(out: Path, rows: Sequence[Mapping[str, Any]], strained: Mapping[str, Any]) -> None:
    """Chart and figures of every stress axis as files."""
    for curve in strained.get("curves", []):
        table = [
            {"axis": row["axis"], "value": row["value"], "seed": row["seed"],
             "setting": label_of(row), "status": row["status"],
             **{name: row["metrics"].get(name) for name in AXIS_FIGURES}}
            for row in rows if row["axis"] == curve["name"]
        ]  # fmt: skip
        write_chart(out, f"axis-{curve['id']}", curve["svg"], table)


def _counts(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    return {
        "captures": len({row["capture_id"] for row in rows}),
        "methods": len({row["method"] for row in rows}),
        "points": len(rows),
        "problems": sum(row["status"] not in ("ok", "unsuited") for row in rows),
    }


def _group(
    out: Path, name: str, rows: Sequence[Mapping[str, Any]], max_range_m: float
) -> dict[str, Any]:
    lines = summarise(rows)
    captures: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        captures.setdefault(str(row["capture_id"]), []).append(row)
    scored = any(line.per_capture for line in lines)
    stem = slug(name)
    chosen = choices(out, rows)
    if chosen:
        write_csv(out / "figures" / f"models-{stem}.csv", chosen["table"])
    return {
        "name": name,
        "id": f"group-{stem}",
        "against": str(rows[0]["against"]),
        "table": _table(lines),
        "notes": [*_notes(lines), *unsuited(rows)],
        "pareto": pareto(out, rows, lines, title=name, stem=f"pareto-{stem}") if scored else "",
        "platforms": platforms(rows),
        "coverage": confidence(out, rows, stem=f"coverage-{stem}") if scored else "",
        "sigma": calibration(out, rows, title=name, stem=f"calibration-{stem}"),
        "choices": chosen,
        "captures": [_capture(out, mine, max_range_m) for mine in captures.values()],
    }


def _notes(lines: Sequence[Line]) -> list[str]:
    notes = [f"{line.label}: {line.note}" for line in lines if line.note]
    left_out = [
        line.label for line in lines if line.timed and line.per_capture and not line.complete
    ]
    if left_out:
        notes.append(
            "Not in the chart, since a mean over fewer captures does not compare: "
            + ", ".join(left_out)
        )
    return notes


def _table(lines: Sequence[Line]) -> dict[str, Any]:
    many = max((len(line.per_capture) for line in lines), default=0) > 1
    best = min((line.metrics["mae_m"] for line in lines if line.timed and line.complete),
               default=None)  # fmt: skip
    return {
        "head": headings(per_capture=many),
        "rows": [
            {
                "cells": [line.label, *cells(line, per_capture=many)],
                "kind": "timed" if line.timed else "reference",
                "best": line.timed and line.complete and line.metrics["mae_m"] == best,
            }
            for line in lines
        ],
    }


def _capture(out: Path, rows: Sequence[Mapping[str, Any]], max_range_m: float) -> dict[str, Any]:
    pictures = capture_pictures(out, rows, max_range_m)
    for name, png in pictures.items():
        (out / "figures" / f"{rows[0]['capture_id']}-{name}.png").write_bytes(png)
    return {
        "name": rows[0]["capture"],
        "against": rows[0]["against"],
        "table": _table(summarise(rows)),
        "regions": _regions(rows),
        "statistics": _statistics(rows),
        "pictures": {name: _embedded(png) for name, png in pictures.items()},
    }


def _embedded(png: bytes) -> str:
    """A picture as a data URL; WebP, since noisy error maps as PNG are five times as large."""
    from PIL import Image

    small = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").save(small, "WEBP", quality=85)
    return "data:image/webp;base64," + base64.b64encode(small.getvalue()).decode("ascii")


def _regions(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """MAE by region, every method at its best setting."""
    chosen = best_per_method(rows)
    if not chosen:
        return {}
    pixels = chosen[0].get("pixels") or {}
    prefix = {region: "" if region == "all" else f"{region}." for region in REGIONS}
    head = ["MAE cm", *(f"{region} ({pixels.get(region, 0)} px)" for region in REGIONS)]
    first = chosen[0]["metrics"]
    body = [["input", *(number(first.get(f"{prefix[r]}input_mae_m"), 100) for r in REGIONS)]]
    body += [
        [label_of(row), *(number(row["metrics"].get(f"{prefix[r]}mae_m"), 100) for r in REGIONS)]
        for row in chosen
    ]
    return {"head": head, "rows": body}


def _statistics(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Depth statistics of thesis 7.B, every method at its best setting."""
    chosen = best_per_method(rows)
    names = [name for name in METRICS if name.endswith(("_chi2", "_js", "_pearson"))]
    kinds = list(dict.fromkeys(name.rpartition("_")[0] for name in names))
    if not chosen:
        return {}

    def triple(metrics: Mapping[str, Any], kind: str, prefix: str) -> str:
        return " / ".join(
            number(metrics.get(f"{prefix}{kind}_{m}"), 1, ".3f") for m in ("chi2", "js", "pearson")
        )

    body = [["input", *(triple(chosen[0]["metrics"], kind, "input_") for kind in kinds)]]
    body += [[label_of(row), *(triple(row["metrics"], kind, "") for kind in kinds)]
             for row in chosen]  # fmt: skip
    return {"head": ["χ² / JS / Pearson", *kinds], "rows": body}
