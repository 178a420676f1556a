"""Labels of the recordings in a folder: ``conditions.csv``, one line a file.

Columns are ``file``, ``kind`` and any field of `Conditions`, units in their names, in any order; an
empty cell is unknown. The table is typed by people, or comes from elsewhere: nothing in it is
believed, and every complaint names file and line.
"""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from toftools.conditions import DEFAULTS, Conditions, conditions_of, with_conditions
from toftools.io._hdf5 import is_cut_off
from toftools.io._labels import file_name, number, rows
from toftools.io.atomic import atomic_path
from toftools.io.native import is_capture
from toftools.io.open import open_capture
from toftools.types import Capture

NAME = "conditions.csv"
COLUMNS = ("file", "kind", *DEFAULTS)
SUFFIXES = (".h5", ".hdf5")
"""Suffixes of capture files, which are found without a line in the table."""


def read_conditions(
    folder_or_csv: Path | str, *, home: Path | str | None = None
) -> Mapping[str, Conditions]:
    """Conditions of the recordings of a folder, out of its table.

    Parameters
    ----------
    folder_or_csv : path
        The folder, which then holds ``conditions.csv``, or the table itself.
    home : path or None
        Folder in which the recordings lie; None is that of the table.

    Returns
    -------
    mapping of str to Conditions
        File name relative to the folder, in the order of the table.

    Raises
    ------
    ValueError
        If the table is missing or no table, names a file twice or one that is not there, or holds
        an unknown column or a bad value; the sentence names file and line.
    """
    table = Path(folder_or_csv)
    table = table / NAME if table.is_dir() else table
    folder = table.parent if home is None else Path(home)
    found: dict[str, Conditions] = {}
    lines: dict[str, int] = {}
    for line, row in rows(table, COLUMNS):
        try:
            name = file_name(row.pop("file"))
            if name in found:
                msg = f"{name} has a line already, line {lines[name]}; every file has one"
                raise ValueError(msg)
            if not _there(folder / name):
                msg = f"there is no file {name} in {folder}; correct its name or take the line out"
                raise ValueError(msg)
            found[name] = _conditions(row)
        except ValueError as error:
            msg = f"{table.name}, line {line}: {error}"
            raise ValueError(msg) from error
        lines[name] = line
    if not found:
        msg = f"{table.name} names no file; wanted a line for each, such as wall.h5,wall"
        raise ValueError(msg)
    return found


def _there(path: Path) -> bool:
    """Whether there is such a file, or a recording of several files with this prefix."""
    try:
        if path.exists():
            return True
        return any(entry.name.startswith(path.name) for entry in path.parent.iterdir())
    except OSError:
        return False


def _conditions(row: Mapping[str, str]) -> Conditions:
    """Conditions out of the cells of a line, empty ones left out."""
    given: dict[str, Any] = {}
    for key, text in row.items():
        if not text:
            continue
        default = DEFAULTS.get(key, "")
        if isinstance(default, str):
            given[key] = text
        elif isinstance(default, tuple):
            parts = text.split("+")
            if len(parts) != len(default):
                msg = f"got {key} {text[:60]!a}; wanted three numbers joined by +: 0+0.1+-1"
                raise ValueError(msg)
            given[key] = tuple(number(key, part) for part in parts)
        else:
            given[key] = number(key, text)
    if "kind" not in given:
        msg = "the kind is empty; say what the recording shows"
        raise ValueError(msg)
    return Conditions(**given)


def write_conditions(folder_or_csv: Path | str, conditions: Mapping[str, Conditions]) -> Path:
    """Write the table of a folder; columns that would say nothing are left out.

    Parameters
    ----------
    folder_or_csv : path
        The folder, or the table itself.
    conditions : mapping of str to Conditions
        Conditions by file name relative to the folder.

    Returns
    -------
    Path
        The table.

    Raises
    ------
    ValueError
        If it cannot be written, or a name is none.
    """
    table = Path(folder_or_csv)
    table = table / NAME if table.is_dir() else table
    cells = [{"file": file_name(name), **_cells(told)} for name, told in conditions.items()]
    plain = _cells(Conditions("wall"))
    columns = [
        key
        for key in COLUMNS
        if key in ("file", "kind") or any(r[key] != plain[key] for r in cells)
    ]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([row[key] for key in columns] for row in cells)
    with atomic_path(table) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8", newline="")
    return table


def _cells(conditions: Conditions) -> dict[str, str]:
    return {key: _cell(getattr(conditions, key)) for key in COLUMNS if key != "file"}


def _cell(value: object) -> str:
    if isinstance(value, tuple):
        return "+".join(map(_cell, value))
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)


def labelled(folder: Path | str) -> list[Path]:
    """Recordings of a folder: those that its table names, then all other capture files in it.

    Parameters
    ----------
    folder : path
        Folder with recordings.

    Returns
    -------
    list of Path
        Files; capture files that the table does not name must carry conditions of their own.

    Raises
    ------
    ValueError
        If there is no such folder, its table is refused, or it holds no recording.
    """
    folder = Path(folder)
    if not folder.is_dir():
        msg = f"{folder} is no folder; wanted one with recordings and {NAME}"
        raise ValueError(msg)
    named = [folder / name for name in read_conditions(folder)] if _has_table(folder) else []
    others = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES
        and path not in named
        and (is_capture(path) or is_cut_off(path))  # opening the latter says what it is
    )
    if not named and not others:
        msg = f"{folder} holds neither {NAME} nor capture files; put both there"
        raise ValueError(msg)
    return [*named, *others]


def _has_table(folder: Path) -> bool:
    return (folder / NAME).is_file()


def open_labelled(
    path: Path | str, conditions: Conditions | None = None, *, format: str | None = None
) -> Capture:
    """A recording of any format with its conditions and its name.

    Parameters
    ----------
    path : path
        Recording.
    conditions : Conditions or None
        What the table says of it; None takes what the file carries.
    format : str or None
        As for `toftools.io.open.open_capture`.

    Returns
    -------
    Capture
        Capture whose provenance holds ``conditions`` and ``file``.

    Raises
    ------
    ValueError
        If the file cannot be read, or nobody says its conditions.
    """
    path = Path(path)
    capture = open_capture(path, format)
    if conditions is not None:
        return with_conditions(capture, conditions, file=path.name)
    named = replace(capture, provenance={**capture.provenance, "file": path.name})
    return with_conditions(named, conditions_of(named))
