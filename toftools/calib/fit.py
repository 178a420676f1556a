"""Fits stages one after another, each on captures that all stages before it have corrected."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from toftools.calib.chain import Chain, applied, check_fits, check_order, extended
from toftools.calib.plan import Plan, Step
from toftools.calib.refine import refine
from toftools.calib.stage import Stage
from toftools.conditions import conditions_of, name_of
from toftools.phasor import phasors_of
from toftools.registry import CALIBRATIONS, checked_params, find, parameters_of
from toftools.types import Capture

LOG = logging.getLogger("toftools.calib")
ANY_LIGHT = ("dark", "flat", "board")
"""Kinds whose frames may be black or saturated; their own fits judge them."""
PHASE_SLOTS = ("wiggling", "common_phase", "fixed_pattern", "amplitude", "temperature")
"""Stages that are refined together."""
LEAST_SHARE = 0.05
"""A frame with fewer valid pixels than this share is refused."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one step.

    Parameters
    ----------
    step : Step
        The step.
    stage : Stage or None
        What was fitted; None if nothing was.
    reason : str
        Why nothing was fitted; empty otherwise.
    """

    step: Step
    stage: Stage | None
    reason: str = ""


def fit_stage(
    chain: Chain,
    slot: str,
    entry: str,
    captures: Sequence[Capture],
    params: Mapping[str, Any] = MappingProxyType({}),
) -> Stage:
    """Fit one stage on what the stages before it leave.

    Parameters
    ----------
    chain : Chain
        What has been calibrated so far.
    slot : str
        Place of the new stage.
    entry : str
        Which fit, as typed: ``wiggling:harmonics=4`` or ``mypkg.mine:make``.
    captures : sequence of Capture
        Raw captures with conditions.
    params : mapping
        Parameters of the fit on top of those in `entry`.

    Returns
    -------
    Stage
        The fitted stage.

    Raises
    ------
    ValueError
        If the chain holds a later stage already, a capture is of another camera or shows nothing,
        or the fit refuses them.
    TypeError
        If a fit of the user's own returns no stage.
    """
    check_order(chain, slot)
    for capture in captures:
        check_fits(chain, capture)
        refuse_calibrated(capture)
        check_frame(capture)
    LOG.info("%s: fitting %d captures", slot, len(captures))
    before = chain.before(slot)
    stage: object = find(CALIBRATIONS, entry).build(
        [applied(before, c) for c in captures], **params
    )
    if not isinstance(stage, Stage) or stage.slot != slot:
        got = getattr(stage, "slot", type(stage).__name__)
        msg = f"{entry} gave {got}, wanted a stage for {slot}: see toftools.calib.stage"
        raise TypeError(msg)
    return stage


def fit_plan(
    plan: Plan, chain: Chain, params: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> tuple[Chain, tuple[Outcome, ...]]:
    """Fit all stages of a plan in order, then refine them together where that is possible.

    Parameters
    ----------
    plan : Plan
        What to fit from what.
    chain : Chain
        What to start from, usually a chain without stages.
    params : mapping of str to mapping
        Slot to parameters of its fit on top of those in the plan.

    Returns
    -------
    tuple of Chain and tuple of Outcome
        The calibration, and what became of every step.

    Raises
    ------
    ValueError
        If a fit blames a capture by name. A fit that lacks data otherwise leaves its stage out.
    """
    given = {stage.slot for stage in chain.stages}
    _check_plan(plan, chain, params)
    outcomes = []
    for step in plan.steps:
        if step.reason:
            outcomes.append(Outcome(step, None, step.reason))
            continue
        try:
            more = params.get(step.slot, {})
            stage = fit_stage(chain, step.slot, step.entry, step.captures, more)
        except ValueError as error:
            if _blames(error, step.captures) or step.entry != step.slot:
                msg = f"{error} (or leave the stage out with --skip {step.slot})"
                raise ValueError(msg) from error
            LOG.info("%s: left out: %s", step.slot, error)
            outcomes.append(Outcome(step, None, str(error)))
            continue
        chain = extended(chain, stage)
        outcomes.append(Outcome(step, stage))
    # Stages that were there before were fitted on captures that are not here: they stay.
    if not given & set(PHASE_SLOTS):
        fitted = [c for o in outcomes if o.stage for c in o.step.captures]
        chain = refine(chain, unique([*fitted, *plan.spare]))
    kept = tuple(Outcome(o.step, o.stage and chain.stage(o.step.slot), o.reason) for o in outcomes)
    return chain, kept


def _check_plan(plan: Plan, chain: Chain, params: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse, before any fit, stages out of order, wrong parameters and unknown temperatures."""
    for capture in plan.spare:
        check_fits(chain, capture)
        refuse_calibrated(capture)
        check_frame(capture)
    for step in plan.steps:
        if step.reason:
            continue
        check_order(chain, step.slot)
        spec = find(CALIBRATIONS, step.entry)
        known = parameters_of(spec.load())
        checked_params(step.entry, known, {**spec.params, **params.get(step.slot, {})})
        cold = [c for c in plan.held_out if step.slot == "temperature" and not _warm(c)]
        if cold:
            msg = (
                f"{name_of(cold[0])} is held out for the verdict and says no temperature, while a "
                "warm-up is there; add sensor_c and light_c to its line in conditions.csv, or use "
                "--skip temperature"
            )
            raise ValueError(msg)


def _warm(capture: Capture) -> bool:
    told = conditions_of(capture)
    return bool(np.isfinite(told.sensor_c) or np.isfinite(told.light_c))


def unique(captures: Sequence[Capture]) -> list[Capture]:
    """Captures without those that were there before, in order.

    Parameters
    ----------
    captures : sequence of Capture
        Captures, some perhaps several times.

    Returns
    -------
    list of Capture
        Each once.
    """
    return list({id(capture): capture for capture in captures}.values())


def check_frame(capture: Capture) -> None:
    """Refuse a frame that shows nothing.

    Parameters
    ----------
    capture : Capture
        Raw capture with conditions.

    Raises
    ------
    ValueError
        If all pixels are invalid (saturated, mostly), or none saw any light.
    """
    if conditions_of(capture).kind in ANY_LIGHT:
        return
    phasors = phasors_of(capture)
    share = float(phasors.valid.mean())
    if share < LEAST_SHARE:
        some = f"only {share:.1%} valid pixels" if share else "no valid pixel"
        msg = (
            f"{name_of(capture)} has {some}: saturated, or cut off by its reader; take it "
            "again with a shorter exposure"
        )
        raise ValueError(msg)
    if not (np.abs(phasors.values[:, phasors.valid]) > 0).any():
        msg = f"{name_of(capture)} is black: no pixel saw modulated light; take it again"
        raise ValueError(msg)


def refuse_calibrated(capture: Capture) -> None:
    """Refuse a capture that a calibration has corrected already.

    Parameters
    ----------
    capture : Capture
        Capture that is taken for raw.

    Raises
    ------
    ValueError
        If its provenance tells of stages.
    """
    told = capture.provenance.get("calibrated")
    if told:
        msg = (
            f"{name_of(capture)} is calibrated already ({', '.join(map(str, told))}); wanted the "
            "raw capture"
        )
        raise ValueError(msg)


def _blames(error: ValueError, captures: Sequence[Capture]) -> bool:
    """Whether a message names one of the captures, which is then the one to look at."""
    return any(name_of(capture) in str(error) for capture in captures)
