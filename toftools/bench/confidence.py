"""Error against coverage on the capture of a group with the largest error of the input."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from toftools.bench.figures import write_chart
from toftools.bench.pictures import best_per_method
from toftools.bench.table import label_of
from toftools.viz.figures import Coverage, coverage_svg


def confidence(out: Path, rows: Sequence[Mapping[str, Any]], *, stem: str) -> str:
    """Chart of the error of the pixels kept; written to ``figures`` too.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        Rows of one group.
    stem : str
        Stem of the files.

    Returns
    -------
    str
        SVG; empty where nothing can be drawn.
    """
    with_input = [row for row in rows if row["metrics"].get("input_mae_m") is not None]
    if not with_input:
        return ""
    hardest = max(with_input, key=lambda row: float(row["metrics"]["input_mae_m"]))["capture_id"]
    mine = [row for row in with_input if row["capture_id"] == hardest and row.get("coverage")]
    chosen = [row for row in best_per_method(mine) if len(row["coverage"]["coverage"]) > 1]
    if not chosen:
        return ""
    curves = [
        Coverage(label_of(row), row["coverage"]["coverage"], row["coverage"]["mae_m"])
        for row in chosen
    ]
    svg = coverage_svg(curves, title=f"Error against coverage: {mine[0]['capture']}")
    table = [
        {"capture": curve_of["capture"], "setting": curve.name, "coverage": share, "mae_m": mae_m}
        for curve_of, curve in zip(chosen, curves, strict=True)
        for share, mae_m in zip(curve.share, curve.mae_m, strict=True)
    ]
    write_chart(out, stem, svg, table)
    return svg
