"""Which stages a set of captures allows, in which order, and what is missing for the others."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_type_hints

from toftools.calib.stage import SLOTS
from toftools.conditions import conditions_of, name_of
from toftools.registry import CALIBRATIONS, find
from toftools.types import Capture

HOLD_EVERY = 5
"""Of so many positions of a rail one is held out where there is no capture for the check."""
LEAST_RAIL = 10
"""Fewer positions than these are all needed for the fit."""


@dataclass(frozen=True)
class Need:
    """What a stage is fitted from.

    Parameters
    ----------
    kinds : tuple of tuple of str
        Kinds of captures that go into the fit, the best source first; the first with enough of
        them is taken.
    least : int
        Captures of these kinds without which no fit is tried.
    ask : str
        What to capture, as a sentence for people.
    after : tuple of str
        Earlier stages whose errors would go into this one if they were left out.
    """

    kinds: tuple[tuple[str, ...], ...]
    least: int
    ask: str
    after: tuple[str, ...] = ()


NEEDS: Mapping[str, Need] = {
    "lens": Need(
        (("board",),), 3,
        "capture 15 to 30 views of a printed board (toftools board), tilted every way, some of "
        "them in the corners of the image (kind board)",
    ),
    "response": Need(
        (("dark", "flat"),), 2,
        "capture a few frames in the dark (kind dark), and an evenly lit surface at six or more "
        "exposures up to saturation (kind flat)",
    ),
    "wiggling": Need(
        (("delay",), ("rail",), ("wall",)), 1,
        "capture a wall at twenty or more distances along a rail (kind rail), or an electronic "
        "delay sweep over a whole turn of the lowest frequency (kind delay)",
        ("lens",),
    ),
    "common_phase": Need(
        (("wall",), ("rail",)), 1,
        "capture a flat wall at a measured distance (kind wall)",
        ("lens", "wiggling"),
    ),
    "fixed_pattern": Need(
        (("wall",),), 1,
        "capture several frames of a flat wall that fills the view, at a measured distance "
        "(kind wall)",
        ("lens", "wiggling", "common_phase"),
    ),
    "amplitude": Need(
        (("gray",),), 2,
        "capture planes of four or more brightnesses at known distances (kind gray)",
        ("lens", "wiggling", "common_phase", "fixed_pattern"),
    ),
    "temperature": Need(
        (("warmup",),), 3,
        "capture a plane at a known distance while the camera warms up, with the temperatures of "
        "sensor and light (kind warmup)",
        ("wiggling", "common_phase", "fixed_pattern"),
    ),
    "extrinsics": Need(
        (), 0,
        "give the pictures of the colour camera to toftools calibrate extrinsics",
    ),
}  # fmt: skip
"""Slot to what it needs."""


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
    """

    steps: tuple[Step, ...]
    held_out: tuple[Capture, ...]
    how: str


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
    return Plan(tuple(steps), held, how)


def _step(slot: str, entry: str, captures: Sequence[Capture]) -> Step:
    need = NEEDS[slot]
    most: tuple[Capture, ...] = ()
    for kinds in need.kinds:
        mine = tuple(c for c in captures if conditions_of(c).kind in kinds)
        if len(mine) >= need.least and (entry != slot or slot in CALIBRATIONS):
            return Step(slot, entry, mine)
        most = max(most, mine, key=len)
    got = f"only {len(most)} of at least {need.least} captures" if most else "no captures for it"
    return Step(slot, entry, reason=f"{got}; {need.ask}" if need.kinds else need.ask)


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


def slot_of(entry: str) -> str:
    """The place in the chain of what an entry fits.

    Parameters
    ----------
    entry : str
        ``wiggling_lut:knots=16`` or ``mypkg.mine:make``.

    Returns
    -------
    str
        The slot with which the name begins, or that of the class which the function says it
        returns.

    Raises
    ------
    ValueError
        If the name is unknown, or says no slot.

    Examples
    --------
    >>> slot_of("common_phase")
    'common_phase'
    """
    name = entry.strip().partition(":")[0]
    told = ""
    if name not in CALIBRATIONS and name not in SLOTS:
        spec = find(CALIBRATIONS, entry)
        name = spec.target.partition(":")[2]
        told = str(getattr(get_type_hints(spec.load()).get("return"), "slot", ""))
    for slot in SLOTS:
        if slot in (name, told) or name.startswith(f"{slot}_"):
            return slot
    msg = (
        f"cannot tell which stage {entry!r} is; annotate what the function returns, or begin its "
        f"name with one of {', '.join(SLOTS)}, such as wiggling_mine"
    )
    raise ValueError(msg)


def missing_before(slot: str, present: Sequence[str]) -> str:
    """What a user should know about stages that are not there, as one sentence.

    Parameters
    ----------
    slot : str
        Stage to be fitted.
    present : sequence of str
        Slots of the chain so far.

    Returns
    -------
    str
        Empty if nothing is missing.
    """
    gone = [name for name in NEEDS[slot].after if name not in present]
    if not gone:
        return ""
    what = gone[0] if len(gone) == 1 else ", ".join(gone[:-1]) + " and " + gone[-1]
    return (
        f"{slot} is fitted without {what}, so their errors go into it; a chain to which they are "
        f"added later needs {slot} fitted again"
    )


def check_temperatures(captures: Sequence[Capture], slots: Sequence[str]) -> None:
    """Refuse captures that will need a temperature and do not say any.

    Parameters
    ----------
    captures : sequence of Capture
        Captures to be corrected by a chain.
    slots : sequence of str
        Its slots.

    Raises
    ------
    ValueError
        If one says neither temperature, by name.
    """
    if "temperature" not in slots:
        return
    for capture in captures:
        told = conditions_of(capture)
        if math.isnan(told.sensor_c) and math.isnan(told.light_c):
            msg = (
                f"{name_of(capture)} says no temperature, which the temperature stage needs; fill "
                "in sensor_c and light_c, or leave the stage out with --skip temperature"
            )
            raise ValueError(msg)


def kinds_of(captures: Sequence[Capture]) -> dict[str, int]:
    """How many captures there are of every kind.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with conditions.

    Returns
    -------
    dict of str to int
        Kinds in the order of their names.
    """
    kinds = sorted(conditions_of(capture).kind for capture in captures)
    return {kind: len(list(group)) for kind, group in itertools.groupby(kinds)}
