"""Which stages a set of captures allows, in which order, and what is missing for the others."""

from collections.abc import Sequence
from dataclasses import dataclass

from toftools.calib.needs import NEEDS, slot_of
from toftools.calib.stage import SLOTS
from toftools.conditions import conditions_of
from toftools.registry import CALIBRATIONS
from toftools.types import Capture

HOLD_EVERY = 5
"""Of so many positions of a rail one is held out where there is no capture for the check."""
SPARE = ("rail", "delay")
"""Kinds of which one is enough for the first fit of wiggling."""
LEAST_RAIL = 10
"""Fewer positions than these are all needed for the fit."""


@dataclass(frozen=True, eq=False)
class Step:
    """One stage of a plan.

    Parameters
    ----------
    slot : str
        Its place in the chain.
    entry : str
        What fits it, as typed: ``wiggling:harmonics=4``.
    captures : tuple of Capture
        What it is fitted from; empty if it is skipped.
    reason : str
        Why it is skipped; empty if it is not.
    """

    slot: str
    entry: str
    captures: tuple[Capture, ...] = ()
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Plan:
    """What to fit from what, and what to hold out.

    Parameters
    ----------
    steps : tuple of Step
        One per slot, in order.
    held_out : tuple of Capture
        Captures for the verdict, in no step.
    how : str
        How these were chosen, as a sentence.
    spare : tuple of Capture
        Captures of known planes that no step asks for; the refinement takes them too.
    """

    steps: tuple[Step, ...]
    held_out: tuple[Capture, ...]
    how: str
    spare: tuple[Capture, ...] = ()


def plan(
    captures: Sequence[Capture], *, entries: Sequence[str] = (), skip: Sequence[str] = ()
) -> Plan:
    """Stages that a set of labelled captures allows.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with conditions.
    entries : sequence of str
        Which fit to take for a slot, as typed; the entry named as the slot otherwise.
    skip : sequence of str
        Slots to leave out.

    Returns
    -------
    Plan
        A step per slot, fitted or with the reason why not.

    Raises
    ------
    ValueError
        If an entry or a slot is unknown, or a capture has no conditions.
    """
    for slot in skip:
        if slot not in SLOTS:
            msg = f"there is no stage {slot!r}; stages are {', '.join(SLOTS)}"
            raise ValueError(msg)
    chosen: dict[str, str] = {}
    for entry in entries:
        slot = slot_of(entry)
        if slot in chosen:
            msg = f"got both {chosen[slot]} and {entry} for {slot}; wanted one"
            raise ValueError(msg)
        chosen[slot] = entry
    held, rest, how = held_out(captures)
    steps = []
    for slot in SLOTS:
        entry = chosen.get(slot, slot)
        if slot in skip:
            steps.append(Step(slot, entry, reason="left out by --skip"))
        else:
            steps.append(_step(slot, entry, rest))
    used = {id(capture) for step in steps for capture in step.captures}
    spare = [c for c in rest if id(c) not in used and conditions_of(c).kind in SPARE]
    return Plan(tuple(steps), held, how, tuple(spare))


def _step(slot: str, entry: str, captures: Sequence[Capture]) -> Step:
    need = NEEDS[slot]
    mine, most = need.taken(captures), need.most(captures)
    if mine and (entry != slot or slot in CALIBRATIONS):
        return Step(slot, entry, mine)
    if mine:
        return Step(slot, entry, reason=f"this toftools has no fit named {entry}")
    if not need.sources:
        return Step(slot, entry, reason=need.ask)
    least = need.sources[0][0]
    got = f"only {_count(most)} where it takes {least} or more" if most else "no captures for it"
    return Step(slot, entry, reason=f"{got}; {need.ask}")


def held_out(
    captures: Sequence[Capture],
) -> tuple[tuple[Capture, ...], tuple[Capture, ...], str]:
    """Captures that no stage may see, the others, and how they were told apart.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with conditions.

    Returns
    -------
    tuple of (tuple of Capture, tuple of Capture, str)
        Those of kind check; without any, every fifth position of a rail of ten or more, the ends
        excepted; then the rest, and a sentence.
    """
    held = tuple(c for c in captures if conditions_of(c).kind == "check")
    rest = tuple(c for c in captures if conditions_of(c).kind != "check")
    if held:
        return held, rest, f"{_count(held)} of kind check"
    rail = [c for c in rest if conditions_of(c).kind == "rail" and conditions_of(c).known]
    places = sorted({conditions_of(c).distance_m for c in rail})
    if len(places) < LEAST_RAIL:
        how = (
            f"nothing: no capture of kind check, and a rail of {len(places)} positions is too "
            f"short to give some away (wanted {LEAST_RAIL})"
        )
        return (), rest, how
    kept = set(places[HOLD_EVERY // 2 :: HOLD_EVERY])
    held = tuple(c for c in rail if conditions_of(c).distance_m in kept)
    own = {id(c) for c in held}
    rest = tuple(c for c in rest if id(c) not in own)
    how = f"{_count(held)} at every fifth position of the rail, for want of kind check"
    return held, rest, how


def _count(captures: Sequence[Capture]) -> str:
    return "1 capture" if len(captures) == 1 else f"{len(captures)} captures"
