"""Tables that people type, as rows of text: nothing is believed, every complaint has its line."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

MAX_BYTES = 1 << 23
LONGEST_NAME = 255
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def rows(table: Path, known: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Lines of a table with their numbers, cells by the names of their columns.

    Parameters
    ----------
    table : Path
        Comma-separated text, names of columns first; ``#`` begins a comment.
    known : sequence of str
        Columns that it may have; the first two it must.

    Yields
    ------
    int, dict of str to str
        Line number, and its cells without blanks around them; missing ones are empty.

    Raises
    ------
    ValueError
        If it is missing or is no such table.
    """
    reader = csv.reader(io.StringIO(_text(table), newline=""), strict=True)
    header: list[str] | None = None
    try:
        for cells in reader:
            row = [cell.strip() for cell in cells]
            if not any(row) or row[0].startswith("#"):
                continue
            if header is None:
                header = _header(table.name, row, known)
                continue
            if any(row[len(header) :]):
                msg = (
                    f"{table.name}, line {reader.line_num}: got {len(row)} cells under "
                    f"{len(header)} columns; write decimals with a point, quote names with commas"
                )
                raise ValueError(msg)
            named = dict(zip(header, row, strict=False))
            yield reader.line_num, {**dict.fromkeys(header, ""), **named}
    except csv.Error as error:
        msg = f"{table.name}, line {reader.line_num}: {error}; wanted comma-separated text"
        raise ValueError(msg) from error


def _text(table: Path) -> str:
    if not table.is_file():
        msg = f"no such file: {table}; wanted a table with a line per recording, file,kind,..."
        raise ValueError(msg)
    try:
        with table.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        msg = f"cannot read {table}: {error.strerror or error}; check its permissions"
        raise ValueError(msg) from error
    if len(data) > MAX_BYTES:
        msg = f"{table.name} is longer than {MAX_BYTES >> 20} MiB; that is no table of conditions"
        raise ValueError(msg)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        msg = f"{table.name}, line {line}: not UTF-8 text; save the table as CSV UTF-8"
        raise ValueError(msg) from error


def _header(name: str, columns: list[str], known: Sequence[str]) -> list[str]:
    while columns and not columns[-1]:  # spreadsheets leave empty columns at the end
        columns = columns[:-1]
    twice = sorted({column for column in columns if columns.count(column) > 1})
    unknown = [column for column in columns if column not in known]
    if unknown:
        got = ascii(unknown[0][:60])
        hint = "; separate columns by commas" if ";" in got or "\\t" in got else ""
        msg = f"{name}: there is no column {got}; known: {', '.join(known)}{hint}"
    elif twice:
        msg = f"{name} has the column {twice[0]} twice; wanted it once"
    elif not set(known[:2]) <= set(columns):
        got = ",".join(columns)
        msg = f"{name} lacks the columns {known[0]} and {known[1]}; its first line was {got}"
    else:
        return columns
    raise ValueError(msg)


def file_name(text: str) -> str:
    """A file name inside a folder, slashes forward.

    Parameters
    ----------
    text : str
        As typed.

    Returns
    -------
    str
        Relative name.

    Raises
    ------
    ValueError
        If it is none, or leads out of the folder.
    """
    name = PurePosixPath(text.replace("\\", "/"))
    if not text or not name.parts:
        msg = "the file has no name; fill in the column file"
        raise ValueError(msg)
    if not text.isprintable() or max(map(len, name.parts)) > LONGEST_NAME:
        msg = f"{text[:60]!a} is no file name"
        raise ValueError(msg)
    if name.is_absolute() or ".." in name.parts or re.match("[A-Za-z]:", text):
        msg = f"{text} lies outside of the folder; name files relative to it, without .."
        raise ValueError(msg)
    return str(name)


def number(key: str, text: str) -> float:
    """A plain decimal number.

    Parameters
    ----------
    key : str
        Column, for the message.
    text : str
        As typed.

    Returns
    -------
    float
        Its value.

    Raises
    ------
    ValueError
        If it is anything else, such as nan or 2,5.
    """
    if not _NUMBER.fullmatch(text.strip()):
        msg = f"got {key} {text[:60]!a}; wanted a plain number such as 2.5, or nothing"
        raise ValueError(msg)
    return float(text)
