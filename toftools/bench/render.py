"""Lines of a table as cells, as text for a terminal, and as Markdown."""

from collections.abc import Sequence

import numpy as np

from toftools.bench.table import Line

COLUMNS = (
    ("MAE cm", "mae_m", 100, ".2f"),
    ("median cm", "median_m", 100, ".2f"),
    ("p95 cm", "p95_m", 100, ".2f"),
    ("bias cm", "bias_m", 100, "+.2f"),
    ("< 1 cm %", "under_1cm", 100, ".1f"),
    ("wraps %", "wrap_share", 100, ".2f"),
    ("valid %", "valid_share", 100, ".1f"),
    ("coherence", "coherence", 1, ".4f"),
)
"""Heading, metric, factor, format of the summary columns."""


def cells(line: Line, *, per_capture: bool) -> list[str]:
    """Text of one line, without its label.

    Parameters
    ----------
    line : Line
        The line.
    per_capture : bool
        Whether the MAE of every capture follows.

    Returns
    -------
    list of str
        Mean MAE, MAE per capture, the other summary columns, times, memory.
    """
    found = [number(line.metrics.get(name), scale, form) for _, name, scale, form in COLUMNS]
    if per_capture:
        found.insert(1, " / ".join(number(v, 100, ".2f") for v in line.per_capture.values()))
    found += [number(line.ms, 1, ".2f"), number(line.setup_s, 1, ".2f"),
              number(line.first_call_s, 1, ".2f"), number(line.peak_mb, 1, ".0f")]  # fmt: skip
    return found


def headings(*, per_capture: bool) -> list[str]:
    """Headings of `cells`, the label's included.

    Parameters
    ----------
    per_capture : bool
        As in `cells`.

    Returns
    -------
    list of str
        Column headings.
    """
    found = ["method", *(heading for heading, *_ in COLUMNS)]
    if per_capture:
        found.insert(2, "of each")
    return [*found, "ms", "set-up s", "first s", "MB"]


def number(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
    """A figure for a table; a dash for none.

    Parameters
    ----------
    value : float or None
        Figure.
    scale : float
        Factor.
    form : str
        Format.

    Returns
    -------
    str
        Text.
    """
    return "–" if value is None or not np.isfinite(value) else format(value * scale, form)


def text_table(lines: Sequence[Line]) -> str:
    """Aligned table for a terminal.

    Parameters
    ----------
    lines : sequence of Line
        Lines of one group.

    Returns
    -------
    str
        Text with a heading line.
    """
    many = max((len(line.per_capture) for line in lines), default=0) > 1
    rows = [headings(per_capture=many)]
    rows += [[line.label, *cells(line, per_capture=many)] for line in lines]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    out = []
    for row, line in zip(rows, [None, *lines], strict=True):
        padded = [row[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        out.append("  ".join(padded).rstrip() + (f"  ({line.note})" if line and line.note else ""))
    return "\n".join(out)


def markdown_table(lines: Sequence[Line]) -> str:
    """The same table for README and docs.

    Parameters
    ----------
    lines : sequence of Line
        Lines of one group.

    Returns
    -------
    str
        Markdown.
    """
    many = max((len(line.per_capture) for line in lines), default=0) > 1
    head = headings(per_capture=many)
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    rows += [[f"`{line.label}`", *cells(line, per_capture=many)] for line in lines]
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    notes = "".join(f"\n- `{line.label}`: {line.note}" for line in lines if line.note)
    return f"{table}\n{notes}" if notes else table
