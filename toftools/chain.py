"""A correction with filters before and after it: ``smooth:radius_px=2 > crt > flying_pixels``.

Steps before a correction turn phasors into phasors; steps after it turn its depth map into another
one and see the phasors that it saw. A chain is data, and is built and called like a single method.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from toftools.registry import CORRECTIONS, FILTERS, Spec, find, parse_name
from toftools.types import DepthMap, Phasors

Kind = TypeVar("Kind", Phasors, DepthMap)


@dataclass(frozen=True)
class Chain:
    """Steps in the order in which data walk through them.

    Parameters
    ----------
    parts : tuple of str
        Every step as typed, ``NAME[:k=v,...]``.
    at : int
        Which of them is the correction.
    """

    parts: tuple[str, ...]
    at: int

    @property
    def name(self) -> str:
        """The chain as one would type it."""
        return " > ".join(self.parts)

    @property
    def specs(self) -> tuple[Spec, ...]:
        """The spec of every step, its typed parameters fixed."""
        return tuple(
            find(CORRECTIONS if i == self.at else FILTERS, part)
            for i, part in enumerate(self.parts)
        )

    def build(self, context: object, **dials: object) -> Callable[[Phasors], DepthMap]:
        """Make every step for a sensor and join them.

        Parameters
        ----------
        context : Sensor
            Sensor of the capture.
        **dials
            Parameters named ``step.key``, as `own_dials` reads them.

        Returns
        -------
        callable
            ``run(Phasors) -> DepthMap``.

        Raises
        ------
        ValueError
            If a step refuses the sensor or a parameter; or, when called, if a step gives something
            else than its place wants.
        """
        runs = [
            spec.build(context, **own_dials(part, dials))
            for part, spec in zip(self.parts, self.specs, strict=True)
        ]
        steps = list(zip(self.parts, runs, strict=True))
        correction, correct = steps[self.at]

        def run(phasors: Phasors) -> DepthMap:
            for part, before in steps[: self.at]:
                phasors = _checked(before(phasors), Phasors, part)
            depth = _checked(correct(phasors), DepthMap, correction)
            for part, after in steps[self.at + 1 :]:
                # An after-step takes two inputs, which the type of a Spec's run does not know.
                two: Callable[..., DepthMap] = after
                depth = _checked(two(depth, phasors), DepthMap, part)
            return depth

        return run


def find_method(
    text: str, *, before: Sequence[str] = (), after: Sequence[str] = ()
) -> Spec | Chain:
    """The method behind ``NAME[:k=v,...]``, ``mypkg.mine:make``, or such steps joined by ``>``.

    The correction of a chain is its one registered correction, or else the one step that is no
    registered filter.

    Parameters
    ----------
    text : str
        As typed.
    before, after : sequence of str
        Further steps around it.

    Returns
    -------
    Spec or Chain
        A spec if there is nothing but a correction.

    Raises
    ------
    ValueError
        If a name is unknown, a step is in the wrong place, or the correction is not clear.

    Examples
    --------
    >>> find_method("smooth > crt", after=["flying_pixels"]).name
    'smooth > crt > flying_pixels'
    """
    parts = [part.strip() for part in text.split(">")]
    if not all(parts):
        msg = f"got {text!r}, wanted a method, or steps joined by >, such as 'smooth > crt'"
        raise ValueError(msg)
    at = len(before) + _correction_of(parts, text)
    chain = Chain(tuple(part.strip() for part in (*before, *parts, *after)), at)
    if len(chain.parts) == 1:
        return find(CORRECTIONS, chain.parts[0])
    for i, part in enumerate(chain.parts):
        if i != at:
            _check_place(part, "before" if i < at else "after")
    chain.specs  # noqa: B018 - an unknown name is refused here, not when the chain is built
    return chain


def own_dials(part: str, dials: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of one step among the dials of its chain.

    Parameters
    ----------
    part : str
        The step as typed.
    dials : mapping
        ``step.key`` to value.

    Returns
    -------
    dict
        Key to value; empty for a step whose parameters were typed, which stay.

    Examples
    --------
    >>> own_dials("smooth", {"smooth.radius_px": 2, "crt.max_range_m": 5.0})
    {'radius_px': 2}
    """
    name, typed = parse_name(part)
    if typed:
        return {}
    mark = f"{name}."
    return {key.removeprefix(mark): dials[key] for key in dials if key.startswith(mark)}


def _correction_of(parts: Sequence[str], text: str) -> int:
    """Index of the correction."""
    names = [part.partition(":")[0].strip() for part in parts]
    registered = [i for i, name in enumerate(names) if name in CORRECTIONS]
    found = registered or [i for i, name in enumerate(names) if name not in FILTERS]
    if len(found) == 1:
        return found[0]
    if len(registered) > 1:
        got, advice = " and ".join(names[i] for i in registered), "one correction"
    elif found:
        got = f"{len(found)} steps that are no registered ones"
        advice = "one; say the places of the others by --before and --after"
    else:
        got, advice = "no correction", f"one of {', '.join(CORRECTIONS)}"
    msg = f"got {got} in {text!r}, wanted {advice}"
    raise ValueError(msg)


def _check_place(part: str, place: str) -> None:
    """Refuse a registered step on the wrong side of the correction."""
    name = part.partition(":")[0].strip()
    if name in FILTERS and FILTERS[name].place == place:
        return
    if name in FILTERS or name in CORRECTIONS:
        fit = ", ".join(other for other, spec in FILTERS.items() if spec.place == place)
        kind = "phasors to phasors" if place == "before" else "depth map to depth map"
        msg = f"got {name} {place} the correction, wanted a step from {kind}, such as {fit}"
        raise ValueError(msg)


def _checked(result: object, wanted: type[Kind], part: str) -> Kind:
    if not isinstance(result, wanted):
        msg = f"the step {part!r} gave {type(result).__name__}, wanted {wanted.__name__} there"
        raise ValueError(msg)
    return result
