"""Charts as files: ``DIR/figures/NAME.svg``, its twin ``.png``, what is behind it as ``.csv``."""

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from toftools.bench.fingerprint import digest
from toftools.io.atomic import atomic_path
from toftools.viz.raster import chart_png

MOST_LETTERS = 60
_PLAIN = re.compile(r"[A-Za-z0-9_]+((, | )[A-Za-z0-9_]+)*")


def slug(name: str) -> str:
    """A name as part of a file name and of an address in a page: never another's, never a path.

    Parameters
    ----------
    name : str
        Name of a group or an axis.

    Returns
    -------
    str
        Latin letters, digits, ``_`` and ``-``; with a digest of the name where more was lost than
        spaces and commas.

    Examples
    --------
    >>> slug("indirect light"), slug("scenes, opt8241")
    ('indirect-light', 'scenes--opt8241')
    >>> slug("../x")
    '---x-15584fa7'
    """
    plain = re.sub(r"[^A-Za-z0-9_]", "-", name)
    if _PLAIN.fullmatch(name) and len(name) <= MOST_LETTERS:
        return plain
    return f"{plain[:MOST_LETTERS]}-{digest([name])[:8]}"


def write_chart(out: Path, name: str, svg: str, table: Sequence[Mapping[str, Any]]) -> None:
    """Write a chart and the figures behind it.

    Parameters
    ----------
    out : Path
        Benchmark folder; its ``figures`` exists.
    name : str
        Stem of the files, a `slug`.
    svg : str
        The chart.
    table : sequence of mapping
        One line per point of the chart, all with the same keys.
    """
    with atomic_path(out / "figures" / f"{name}.svg") as path:
        path.write_text(svg, encoding="utf-8")
    with atomic_path(out / "figures" / f"{name}.png") as path:
        path.write_bytes(chart_png(svg))
    write_csv(out / "figures" / f"{name}.csv", table)


def write_csv(target: Path, table: Sequence[Mapping[str, Any]]) -> None:
    """Write a table; what is not finite, or None, is an empty field.

    Parameters
    ----------
    target : Path
        File.
    table : sequence of mapping
        Lines, all with the same keys.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]) if table else [], lineterminator="\n")
    writer.writeheader()
    for line in table:
        writer.writerow({key: _field(value) for key, value in line.items()})
    with atomic_path(target) as path:
        path.write_text(text.getvalue(), encoding="utf-8")


def write_tables(out: Path, name: str, lines: Sequence[Mapping[str, Any]]) -> None:
    """Write lines as ``OUT/NAME.csv`` and ``.json``; what is not finite is null there.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    name : str
        Stem of the files.
    lines : sequence of mapping
        Lines, all with the same keys; a tuple is a list in JSON, words in CSV.
    """
    plain = [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}
        for line in lines
    ]
    with atomic_path(out / f"{name}.json") as path:
        path.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
    flat = [
        {k: " ".join(v) if isinstance(v, tuple) else v for k, v in line.items()} for line in plain
    ]
    write_csv(out / f"{name}.csv", flat)


def _field(value: object) -> object:
    missing = isinstance(value, float) and not math.isfinite(value)
    return "" if missing or value is None else value
