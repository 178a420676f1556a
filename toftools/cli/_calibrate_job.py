"""One call of ``toftools calibrate`` as typed, and the captures that it names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from toftools.calib.fit import check_frame, refuse_calibrated
from toftools.calib.residuals import same_sensor
from toftools.conditions import Conditions, conditions_of, with_conditions
from toftools.io.conditions import NAME, labelled, read_conditions
from toftools.io.open import open_capture
from toftools.types import Capture


@dataclass(frozen=True)
class Job:
    """One call of the command, as typed.

    Parameters
    ----------
    stage : str
        ``all``, a stage, or ``factory:NAME``.
    captures : tuple of Path
        Files, or one folder.
    out, report, start, table : Path or None
        Calibration to write, report to write, calibration to extend, labels.
    board, sensor : str or None
        Board of the lens, and camera of pictures.
    entries, skip, trust : tuple of str
        Entries for slots, slots to leave out, modules to trust.
    format_text : str or None
        Forced input format.
    conditions : mapping
        Conditions of all captures of this call.
    verbose : bool
        Messages are printed as lines.
    say : callable
        Takes a line for people.
    """

    stage: str
    captures: tuple[Path, ...]
    out: Path
    report: Path | None
    start: Path | None
    table: Path | None
    board: str | None
    sensor: str | None
    entries: tuple[str, ...]
    skip: tuple[str, ...]
    trust: tuple[str, ...]
    format_text: str | None
    conditions: Mapping[str, Any]
    verbose: bool
    say: Callable[[str], Any]


def opened_captures(job: Job, kind: str) -> list[Capture]:
    """All captures of a job with their conditions, of one camera.

    Parameters
    ----------
    job : Job
        What was typed.
    kind : str
        Kind of captures of which nobody says it; empty if somebody must.

    Returns
    -------
    list of Capture
        Raw captures.

    Raises
    ------
    ValueError
        If one cannot be read, says no conditions, shows nothing, is calibrated already, or is of
        another camera than the first.
    """
    captures = [_labelled(job, *found, kind) for found in _files(job)]
    same_sensor(captures)
    for capture in captures:
        refuse_calibrated(capture)
        check_frame(capture)
    return captures


def _files(job: Job) -> list[tuple[Path, Conditions | None]]:
    """Every file with the conditions that a table says for it."""
    found: list[tuple[Path, Conditions | None]] = []
    for path in job.captures:
        home = path if path.is_dir() else path.parent
        table = job.table or home / NAME
        told = read_conditions(table, home=home) if job.table or table.is_file() else {}
        files = [path]
        if path.is_dir():
            files = [home / name for name in told] if job.table else labelled(home)
        found += [(file, told.get(file.relative_to(home).as_posix())) for file in files]
    return found


def _labelled(job: Job, file: Path, told: Conditions | None, kind: str) -> Capture:
    """One capture with what the table, the file itself and the options say, the last first."""
    capture = open_capture(file, job.format_text)
    if told is not None:
        capture = with_conditions(capture, told)
    elif "conditions" not in capture.provenance and (kind or "kind" in job.conditions):
        capture = with_conditions(capture, Conditions(job.conditions.get("kind", kind)))
    capture = replace(capture, provenance={**capture.provenance, "file": file.name})
    known = conditions_of(capture)
    return with_conditions(capture, replace(known, **job.conditions))
