"""Methods as a suite names them: corrections, chains with filters, reference rows; their sweeps."""

import itertools
from collections.abc import Mapping
from typing import Any

from toftools._params import checked_params
from toftools.bench.references import REFERENCES
from toftools.chain import Chain, find_method, own_dials
from toftools.registry import CORRECTIONS, FILTERS, Spec, find, parameters_of, parse_name

Grids = Mapping[str, Mapping[str, tuple[Any, ...]]]


def method_of(text: str) -> Spec | Chain:
    """What a suite means by a method.

    Parameters
    ----------
    text : str
        ``NAME[:k=v,...]``, ``mypkg.mine:make``, a reference row, or steps joined by ``>``.

    Returns
    -------
    Spec or Chain
        To be built for a sensor (a reference row: for a capture).

    Raises
    ------
    ValueError
        If a name is unknown or a step is in the wrong place.
    """
    if parse_name(text)[0] in REFERENCES:
        return find(REFERENCES, text)
    return find_method(text)


def specs_of(method: Spec | Chain) -> tuple[Spec, ...]:
    """Every step of a method.

    Parameters
    ----------
    method : Spec or Chain
        What `method_of` gave.

    Returns
    -------
    tuple of Spec
        One, or all of a chain.
    """
    return method.specs if isinstance(method, Chain) else (method,)


def is_ours(method: Spec | Chain) -> bool:
    """Whether all of a method comes with toftools and is timed.

    Parameters
    ----------
    method : Spec or Chain
        What `method_of` gave.

    Returns
    -------
    bool
        False for reference rows and for methods of the user.
    """
    return all(spec.name in CORRECTIONS or spec.name in FILTERS for spec in specs_of(method))


def points(text: str, grids: Grids) -> list[tuple[str, dict[str, Any]]]:
    """Method name and parameters of every point on one method's curve.

    Parameters
    ----------
    text : str
        Method as typed; typed parameters hold their step at one setting.
    grids : mapping
        Method or filter to a grid that replaces the registry's.

    Returns
    -------
    list of (str, dict)
        The grid, or the default point of a method without one. The name of a chain is its text
        and its dials are named ``step.key``.
    """
    method = method_of(text)
    if isinstance(method, Chain):
        name, dials = method.name, _chain_grid(method, grids)
    else:
        name, typed = parse_name(text)
        if typed:
            return [(name, typed)]
        dials = dict(grids.get(name, method.grid))
    return [
        (name, dict(zip(dials, values, strict=True)))
        for values in itertools.product(*dials.values())
    ]


def setting(text: str) -> tuple[str, dict[str, Any]]:
    """Method name and parameters of a method at one setting: as typed, else at its defaults.

    Parameters
    ----------
    text : str
        Method as typed.

    Returns
    -------
    str, dict
        As `points` gives them, without the grid.

    Examples
    --------
    >>> setting("crt"), setting("kde:window_px=5")
    (('crt', {}), ('kde', {'window_px': 5}))
    """
    method = method_of(text)
    return (method.name, {}) if isinstance(method, Chain) else parse_name(text)


def _chain_grid(chain: Chain, grids: Grids) -> dict[str, tuple[Any, ...]]:
    return {
        f"{spec.name}.{key}": values
        for part, spec in zip(chain.parts, chain.specs, strict=True)
        if not parse_name(part)[1]
        for key, values in grids.get(spec.name, spec.grid).items()
    }


def check_method(text: str, grids: Grids) -> None:
    """Refuse a method that cannot be loaded, or parameters and dials that it does not take.

    Parameters
    ----------
    text : str
        Method as typed.
    grids : mapping
        As for `points`.

    Raises
    ------
    ValueError
        If so: before anything runs, not once per capture.
    """
    for spec in specs_of(method_of(text)):
        known = parameters_of(spec.load())
        checked_params(spec.name, known, spec.params)
        for key, values in grids.get(spec.name, {}).items():
            for value in values:
                checked_params(spec.name, known, {key: value})


def labelled(name: str, params: Mapping[str, Any]) -> str:
    """A method with its parameters, as one would type it.

    Parameters
    ----------
    name : str
        Name of a point: a method or a chain.
    params : mapping
        Its parameters.

    Returns
    -------
    str
        One text.

    Examples
    --------
    >>> labelled("smooth:radius_px=2 > crt", {"crt.max_range_m": 5.0})
    'smooth:radius_px=2 > crt:max_range_m=5.0'
    """
    parts = name.split(" > ")
    if len(parts) == 1:
        return _with(name, params)
    return " > ".join(_with(part, own_dials(part, params)) for part in parts)


def _with(name: str, params: Mapping[str, Any]) -> str:
    text = ",".join(f"{key}={value}" for key, value in params.items())
    return f"{name}:{text}" if text else name
