"""What every stage is fitted from, what else to capture, and what should come before it."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_type_hints

from toftools.calib.stage import SLOTS
from toftools.conditions import conditions_of
from toftools.registry import CALIBRATIONS, find
from toftools.types import Capture


@dataclass(frozen=True)
class Need:
    """What a stage is fitted from.

    Parameters
    ----------
    sources : tuple of (int, str, ...)
        Kinds of captures that go into the fit after the number of them that it takes at least,
        the best source first; the first with enough is used.
    ask : str
        What to capture, as a sentence for people.
    after : tuple of str
        Earlier stages whose errors would go into this one if they were left out.
    beside : tuple of str
        Kinds that the fit takes a reference from, beside its source.
    """

    sources: tuple[tuple[int, *tuple[str, ...]], ...]
    ask: str
    after: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()

    def taken(self, captures: Sequence[Capture]) -> tuple[Capture, ...]:
        """Captures of the best source with enough of them, and those beside it; none if none."""
        for least, *kinds in self.sources:
            if sum(conditions_of(c).kind in kinds for c in captures) >= least:
                wanted = (*kinds, *self.beside)
                return tuple(c for c in captures if conditions_of(c).kind in wanted)
        return ()

    def most(self, captures: Sequence[Capture]) -> tuple[Capture, ...]:
        """Captures of the source with most of them."""
        kinds = [kinds for _, *kinds in self.sources]
        sets = [tuple(c for c in captures if conditions_of(c).kind in some) for some in kinds]
        return max(sets, key=len, default=())


NEEDS: Mapping[str, Need] = {
    "lens": Need(
        ((4, "board"),),
        "capture 15 to 30 views of a printed board (toftools board), tilted every way, some of "
        "them in the corners of the image (kind board)",
    ),
    "response": Need(
        ((2, "dark", "flat"),),
        "capture a few frames in the dark (kind dark), and an evenly lit surface at six or more "
        "exposures up to saturation (kind flat)",
    ),
    "wiggling": Need(
        ((8, "delay"), (8, "rail"), (3, "delay"), (3, "rail"), (1, "wall")),
        "capture a wall at twenty or more distances along a rail (kind rail), or an electronic "
        "delay sweep over a whole turn of the lowest frequency (kind delay)",
        ("lens",),
    ),
    "common_phase": Need(
        ((1, "wall"), (1, "rail")),
        "capture a flat wall at a measured distance (kind wall)",
        ("lens", "wiggling"),
    ),
    "fixed_pattern": Need(
        ((1, "wall"),),
        "capture several frames of a flat wall that fills the view, at a measured distance "
        "(kind wall)",
        ("lens", "wiggling", "common_phase"),
    ),
    "amplitude": Need(
        ((2, "gray"),),
        "capture planes of four or more brightnesses at known distances (kind gray)",
        ("lens", "wiggling", "common_phase", "fixed_pattern"),
    ),
    "temperature": Need(
        ((4, "warmup"),),
        "capture a plane at a known distance while the camera warms up, with the temperatures of "
        "sensor and light (kind warmup)",
        ("wiggling", "common_phase", "fixed_pattern"),
        ("wall",),
    ),
    "extrinsics": Need(
        (),
        "give the pictures of the second camera and its intrinsics: toftools calibrate "
        "extrinsics:colour=FOLDER,intrinsics=FILE BOARDS...",
        ("lens",),
    ),
}  # fmt: skip
"""Slot to what it needs."""


def for_stage(slot: str, captures: Sequence[Capture]) -> tuple[Capture, ...]:
    """Those of some captures that a stage is fitted from.

    Parameters
    ----------
    slot : str
        Stage.
    captures : sequence of Capture
        Captures with conditions.

    Returns
    -------
    tuple of Capture
        Those of its best source; all of its kinds where no source has enough.

    Raises
    ------
    ValueError
        If none is of a kind that it uses.
    """
    need = NEEDS[slot]
    mine = need.taken(captures) or need.most(captures)
    if need.sources and not mine:
        usable = dict.fromkeys(kind for _, *kinds in need.sources for kind in kinds)
        msg = f"{slot} is fitted from the kinds {', '.join(usable)}, got {counted(captures)}"
        raise ValueError(msg)
    return mine or tuple(captures)


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
    whose, they = ("its errors go", "it is") if len(gone) == 1 else ("their errors go", "they are")
    return f"{slot} is fitted without {what}, so {whose} into it; fit it again once {they} there"


def counted(captures: Sequence[Capture]) -> str:
    """How many captures there are of every kind, in words.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with conditions.

    Returns
    -------
    str
        Such as ``24 rail, 3 wall``.
    """
    kinds = sorted(conditions_of(capture).kind for capture in captures)
    return ", ".join(f"{len(list(group))} {kind}" for kind, group in itertools.groupby(kinds))
