"""What ``toftools calibrate`` does: opens, fits, judges, and only then writes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from toftools import registry
from toftools.calib.chain import Chain, chain_for, extended
from toftools.calib.fit import Outcome, check_frame, fit_plan, fit_stage, refuse_calibrated
from toftools.calib.needs import counted, for_stage, missing_before, slot_of
from toftools.calib.plan import Plan, Step, plan
from toftools.calib.residuals import same_sensor
from toftools.calib.store import load_chain, save_chain
from toftools.calib.verdict import Verdict, verdict
from toftools.cli._calibration import (
    chain_data,
    outcome_lines,
    plan_lines,
    stage_lines,
    verdict_lines,
)
from toftools.cli._progress import progress
from toftools.conditions import Conditions, conditions_of, name_of, with_conditions
from toftools.io.atomic import atomic_path, check_target
from toftools.io.conditions import NAME, labelled, read_conditions
from toftools.io.open import open_capture
from toftools.registry import find
from toftools.types import Capture

FACTORY = getattr(registry, "FACTORY", {})
LOG = logging.getLogger("toftools.calib")
USUAL_KIND = {
    "lens": "board", "response": "flat", "wiggling": "rail", "common_phase": "wall",
    "fixed_pattern": "wall", "amplitude": "gray", "temperature": "warmup", "extrinsics": "board",
}  # fmt: skip
"""Kind of captures that say none, by the stage that is fitted from them."""


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
    board : str or None
        Board of the lens.
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
    entries: tuple[str, ...]
    skip: tuple[str, ...]
    trust: tuple[str, ...]
    format_text: str | None
    conditions: Mapping[str, Any]
    verbose: bool
    say: Callable[[str], Any]


def calibrated(job: Job) -> dict[str, Any]:
    """Do a job; nothing is written if any of it fails.

    Parameters
    ----------
    job : Job
        What was typed.

    Returns
    -------
    dict
        Summary as plain JSON values.

    Raises
    ------
    ValueError
        If a file, an option or a fit is refused.
    """
    if job.out.suffix.lower() != ".json":
        msg = f"got --out {job.out.name}; a calibration is written as .json"
        raise ValueError(msg)
    for target in (job.out, job.report):
        if target is not None:
            check_target(target)
    if job.stage != "all" and (job.skip or job.entries):
        msg = "--skip and --stage choose among the stages of all; a single stage is named itself"
        raise ValueError(msg)
    if job.stage == "all":
        return _whole(job)
    if job.stage.startswith("factory:"):
        return _factory(job)
    return _single(job)


def _factory(job: Job) -> dict[str, Any]:
    """Tables of a vendor as a chain."""
    if len(job.captures) != 1:
        msg = f"got {len(job.captures)} paths, wanted the one of the vendor's tables"
        raise ValueError(msg)
    made: object = find(FACTORY, job.stage.removeprefix("factory:")).build(job.captures[0])
    if not isinstance(made, Chain):
        msg = f"{job.stage} gave {type(made).__name__}, wanted a Chain"
        raise ValueError(msg)
    save_chain(job.out, made)
    for line in [*stage_lines(made), f"wrote {job.out}"]:
        job.say(line)
    return {"out": str(job.out), **chain_data(made)}


def _single(job: Job) -> dict[str, Any]:
    """One stage, added to the chain so far."""
    entry, slot = job.stage, slot_of(job.stage)
    opened = _opened(job, USUAL_KIND[slot])
    captures = for_stage(slot, opened)
    if len(captures) < len(opened):
        LOG.warning("%s takes %s and leaves the others alone", slot, counted(captures))
    start = job.start or (job.out if job.out.exists() else None)
    chain = chain_for(captures[0].sensor) if start is None else load_chain(start, trusted=job.trust)
    missing = missing_before(slot, [stage.slot for stage in chain.stages])
    if missing:
        LOG.warning("%s", missing)
    with progress(verbose=job.verbose, engines="toftools.calib"):
        stage = fit_stage(chain, slot, entry, captures, _params(job).get(slot, {}))
        chain = _told(extended(chain, stage), captures)
        step = Step(slot, entry, captures)
        _write(job, chain, (Outcome(step, stage),), None)
    lines = stage_lines(replace(chain, stages=(stage,)))
    held = ", ".join(stage.slot for stage in chain.stages)
    for line in [*lines, f"wrote {job.out}, which holds {held}"]:
        job.say(line)
    return {"out": str(job.out), **chain_data(chain)}


def _whole(job: Job) -> dict[str, Any]:
    """Every stage that a folder allows, and the verdict."""
    captures = _opened(job, "")
    made = plan(captures, entries=job.entries, skip=job.skip)
    fitted = [step for step in made.steps if not step.reason]
    for line in plan_lines(made):
        job.say(line)
    if not fitted:
        msg = "nothing to fit: no stage has the captures it needs, see the plan"
        raise ValueError(msg)
    _check_held_out(made)
    chain = chain_for(captures[0].sensor)
    if job.start is not None:
        chain = load_chain(job.start, trusted=job.trust)
    with progress(verbose=job.verbose, engines="toftools.calib"):
        chain, outcomes = fit_plan(made, chain, _params(job))
        judged = verdict(chain, made.held_out)
        chain = _told(chain, captures, verdict=judged.sentence)
        _write(job, chain, outcomes, judged, made)
    for line in [*outcome_lines(chain, outcomes), *verdict_lines(judged), f"wrote {job.out}"]:
        job.say(line)
    return {
        "out": str(job.out),
        **chain_data(chain),
        "skipped": {o.step.slot: o.reason for o in outcomes if o.stage is None},
        "verdict": _verdict_data(judged),
    }


def _opened(job: Job, kind: str) -> list[Capture]:
    """All captures of a job with their conditions, of one camera."""
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


def _params(job: Job) -> dict[str, dict[str, Any]]:
    """Parameters by slot that options of their own set."""
    given = {} if job.board is None else {"board": job.board}
    return {"lens": given, "extrinsics": given}


def _check_held_out(made: Plan) -> None:
    """Refuse held-out captures that the verdict will stumble over, before the fits."""
    for capture in made.held_out:
        if not conditions_of(capture).known and conditions_of(capture).reference == "plane":
            msg = (
                f"{name_of(capture)} is held out for the verdict and does not say how far its "
                "target was; add distance_m"
            )
            raise ValueError(msg)


def _told(chain: Chain, captures: Sequence[Capture], **more: str) -> Chain:
    """The chain with a note about where it comes from."""
    from importlib.metadata import version

    files = list(dict.fromkeys([*chain.notes.get("files", []), *map(name_of, captures)]))
    return replace(chain, notes={**chain.notes, "files": files,
                                 "toftools": version("toftools"), **more})  # fmt: skip


def _write(
    job: Job,
    chain: Chain,
    outcomes: Sequence[Outcome],
    judged: Verdict | None,
    made: Plan | None = None,
) -> None:
    """The calibration and the report, both or none."""
    if job.report is None:
        save_chain(job.out, chain)
        return
    from toftools.viz.calibration_report import calibration_page

    LOG.info("drawing the report")
    page = calibration_page(chain, outcomes, judged, made.held_out if made else ())
    with atomic_path(job.report) as temporary:
        temporary.write_text(page, encoding="utf-8")
        save_chain(job.out, chain)


def _verdict_data(judged: Verdict) -> dict[str, Any]:
    """A verdict as plain JSON values."""
    return {
        "word": judged.word,
        "sentence": judged.sentence,
        "advice": list(judged.advice),
        "before": [_plain(score) for score in judged.before],
        "after": [_plain(score) for score in judged.after],
        "causes_mm": dict(judged.causes_mm),
        "captures": [_plain(spot) for spot in judged.spots],
    }


def _plain(value: object) -> dict[str, Any]:
    """Fields of a record; None for what is not a number, which JSON does not know."""
    return {k: None if isinstance(v, float) and v != v else v for k, v in vars(value).items()}
