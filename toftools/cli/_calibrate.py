"""What ``toftools calibrate`` does: opens, fits, judges, and only then writes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from toftools.calib.chain import Chain, chain_for, check_order, extended
from toftools.calib.fit import Outcome, fit_plan, fit_stage
from toftools.calib.needs import counted, for_stage, missing_before, slot_of
from toftools.calib.plan import Plan, Step, plan
from toftools.calib.stage import Stage
from toftools.calib.store import load_chain, save_chain
from toftools.calib.verdict import Verdict, verdict
from toftools.cli._calibrate_job import Job, opened_captures
from toftools.cli._calibrate_pictures import are_pictures, lens_of_pictures
from toftools.cli._calibration import (
    chain_data,
    outcome_lines,
    plan_lines,
    stage_lines,
    verdict_lines,
)
from toftools.cli._progress import progress
from toftools.conditions import conditions_of, name_of
from toftools.io.atomic import atomic_path, check_target
from toftools.registry import FACTORY, find
from toftools.types import Capture

LOG = logging.getLogger("toftools.calib")
USUAL_KIND = {
    "lens": "board", "response": "flat", "wiggling": "rail", "common_phase": "wall",
    "fixed_pattern": "wall", "amplitude": "gray", "temperature": "warmup", "extrinsics": "board",
}  # fmt: skip
"""Kind of captures that say none, by the stage that is fitted from them."""


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
    if job.report is not None and job.report.suffix.lower() not in (".html", ".htm"):
        msg = f"got --report {job.report.name}; a report is written as .html"
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
    start = job.start or (job.out if job.out.exists() else None)
    before = None if start is None else load_chain(start, trusted=job.trust)
    captures: tuple[Capture, ...] = ()
    with progress(verbose=job.verbose, engines="toftools.calib"):
        if are_pictures(entry, job.captures, job.format_text):
            chain, stage = _pictured(job, before)
        else:
            captures = _chosen(job, slot)
            chain = before or chain_for(captures[0].sensor)
            _warn(missing_before(slot, [one.slot for one in chain.stages]))
            stage = fit_stage(chain, slot, entry, captures, _params(job).get(slot, {}))
        names = [name_of(c) for c in captures] or [path.name for path in job.captures]
        chain = _told(extended(chain, stage), names)
        _write(job, chain, (Outcome(Step(slot, entry, captures), stage),), None)
    lines = stage_lines(replace(chain, stages=(stage,)))
    held = ", ".join(stage.slot for stage in chain.stages)
    for line in [*lines, f"wrote {job.out}, which holds {held}"]:
        job.say(line)
    return {"out": str(job.out), **chain_data(chain)}


def _pictured(job: Job, before: Chain | None) -> tuple[Chain, Stage]:
    if before is not None:
        check_order(before, "lens")
    LOG.info("lens: fitting %d pictures", len(job.captures))
    return lens_of_pictures(job.stage, job.captures, job.board, job.sensor, before)


def _chosen(job: Job, slot: str) -> tuple[Capture, ...]:
    """Captures that a stage is fitted from, out of those that were given."""
    opened = opened_captures(job, USUAL_KIND[slot])
    captures = for_stage(slot, opened)
    if len(captures) < len(opened):
        job.say(f"{slot} takes {counted(captures)} out of {len(opened)} captures")
    return captures


def _warn(sentence: str) -> None:
    if sentence:
        LOG.warning("%s", sentence)


def _whole(job: Job) -> dict[str, Any]:
    """Every stage that a folder allows, and the verdict."""
    captures = opened_captures(job, "")
    made = plan(captures, entries=job.entries, skip=job.skip)
    fitted = [step for step in made.steps if not step.reason]
    chain = chain_for(captures[0].sensor)
    if job.start is not None:
        chain = load_chain(job.start, trusted=job.trust)
    for line in plan_lines(made, chain):
        job.say(line)
    if not fitted:
        msg = "nothing to fit: no stage has the captures it needs, see the plan"
        raise ValueError(msg)
    _check_held_out(made)
    present = [stage.slot for stage in chain.stages] + [step.slot for step in fitted]
    missing = dict.fromkeys(missing_before(step.slot, present) for step in fitted)
    for sentence in [one for one in missing if one][:1]:  # the others say the same of later stages
        _warn(sentence)
    with progress(verbose=job.verbose, engines="toftools.calib"):
        chain, outcomes = fit_plan(made, chain, _params(job))
        judged = verdict(chain, made.held_out)
        chain = _told(chain, [name_of(c) for c in captures], verdict=judged.sentence)
        _write(job, chain, outcomes, judged, made)
    for line in [*outcome_lines(chain, outcomes), *verdict_lines(judged), f"wrote {job.out}"]:
        job.say(line)
    return {
        "out": str(job.out),
        **chain_data(chain),
        "skipped": {o.step.slot: o.reason for o in outcomes if o.stage is None},
        "verdict": _verdict_data(judged),
    }


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


def _told(chain: Chain, names: Sequence[str], **more: str) -> Chain:
    """The chain with a note about where it comes from."""
    from importlib.metadata import version

    files = list(dict.fromkeys([*chain.notes.get("files", []), *names]))
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
