"""What a recipe may say: its keys with their types, and rules by which parameters are drawn."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from toftools.registry import parse_entry

SPLITS = ("train", "validation", "test")
TOP: Mapping[str, Any] = {"name": str, "about": str, "split": dict, "family": list}
KEYS: Mapping[str, Any] = {
    "name": str, "scene": str, "scenes": int, "paints": int, "views": int, "params": dict,
    "sensors": list, "tol_mm": (int, float), "max_bounces": int, "seed": int,
}  # fmt: skip
OWN = ("name", "scene", "params")
"""Keys that a family has for itself; a recipe may give the others for all its families."""
USUAL: Mapping[str, Any] = {
    "scenes": 1, "paints": 1, "views": 1, "params": {}, "tol_mm": 5.0, "max_bounces": None,
    "seed": 0,
}  # fmt: skip
LEAST = {"scenes": 1, "paints": 1, "views": 1, "max_bounces": 0, "seed": 0}
SCALARS = (str, int, float)


def check_table(given: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Refuse a recipe with keys or types that are none.

    Parameters
    ----------
    given : mapping
        The recipe.
    name : str
        What it is called.

    Returns
    -------
    dict
        What its families have in common.

    Raises
    ------
    ValueError
        If a key is unknown, or a value of the wrong type.
    """
    shared = {key: kind for key, kind in KEYS.items() if key not in OWN}
    _check(given, {**TOP, **shared}, f"the recipe {name}")
    return {**USUAL, **{key: value for key, value in given.items() if key in shared}}


def check_family(family: object, usual: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Refuse a family that asks for what is impossible.

    Parameters
    ----------
    family : object
        The family's table.
    usual : mapping
        What it leaves to the recipe.
    what : str
        How it is called.

    Returns
    -------
    dict
        All its keys.

    Raises
    ------
    ValueError
        If a key is unknown or missing, or a value impossible.
    """
    if not isinstance(family, Mapping):
        msg = f"{what} is no table; write [[family]]"
        raise ValueError(msg)
    _check(family, KEYS, what)
    whole = {**usual, **family}
    for key in ("scene", "sensors"):
        if not whole.get(key):
            msg = f"{what} names no {key}"
            raise ValueError(msg)
    if not all(isinstance(text, str) for text in whole["sensors"]):
        msg = f"{what}: sensors = {whole['sensors']}, wanted names such as deeptof:width=160"
        raise ValueError(msg)
    for key in ("paint", "view"):
        if key in whole["params"] or key in parse_entry(whole["scene"])[1]:
            msg = f"{what} sets {key}; write {key}s = N, so that a scene stays in one part"
            raise ValueError(msg)
    return whole


def check_split(given: Mapping[str, Any]) -> dict[str, float]:
    """Shares of the parts of a set.

    Parameters
    ----------
    given : mapping
        The recipe.

    Returns
    -------
    dict of str to float
        Shares that add up to 1.

    Raises
    ------
    ValueError
        If they do not.
    """
    shares = given.get("split", {"train": 0.8, "validation": 0.1, "test": 0.1})
    good = all(_number(v) and v >= 0 for v in shares.values()) and set(shares) <= set(SPLITS)
    if not good or abs(sum(shares.values()) - 1) > 1e-6:
        msg = f"got split = {shares}, wanted shares of {', '.join(SPLITS)} that add up to 1"
        raise ValueError(msg)
    return dict(shares)


def drawn(rule: object, rng: np.random.Generator, number: int, key: str) -> Any:  # noqa: ANN401
    """Value of a parameter: as it stands, one of a list, between two numbers, or counted.

    Parameters
    ----------
    rule : object
        A value, a list, ``{from, to}`` or ``{first}``.
    rng : Generator
        Draws.
    number : int
        Number of the scene.
    key : str
        Name of the parameter.

    Returns
    -------
    str, int or float
        The value.

    Raises
    ------
    ValueError
        If the rule is none.
    """
    if isinstance(rule, Sequence) and not isinstance(rule, str) and len(rule):
        rule = rule[int(rng.integers(len(rule)))]
    if isinstance(rule, SCALARS) and not isinstance(rule, bool):
        return rule
    if isinstance(rule, Mapping) and set(rule) == {"first"} and _whole(rule["first"]):
        return rule["first"] + number
    if isinstance(rule, Mapping) and set(rule) == {"from", "to"}:
        low, high = rule["from"], rule["to"]
        if _whole(low) and _whole(high) and low <= high:
            return int(rng.integers(low, high + 1))
        if _number(low) and _number(high) and low <= high:
            return round(float(rng.uniform(low, high)), 6)
    msg = (
        f"{key} = {rule!r}, wanted a value, a list of them, {{from = a, to = b}} with a up to b, "
        "or {first = whole number}"
    )
    raise ValueError(msg)


def _check(table: Mapping[str, Any], known: Mapping[str, Any], what: str) -> None:
    for key, value in table.items():
        if key not in known:
            msg = f"{what} has the key {key!r}; known: {', '.join(known)}"
            raise ValueError(msg)
        kind = known[key]
        least = LEAST.get(key, -math.inf)
        if not isinstance(value, kind) or isinstance(value, bool):
            names = {str: "text", int: "a whole number", list: "a list", dict: "a table"}
            msg = f"{what}: {key} = {value!r}, wanted {names.get(kind, 'a number')}"
            raise ValueError(msg)
        if (key in LEAST and value < least) or (key == "tol_mm" and not 0 < value < math.inf):
            wish = f"{least} or more" if key in LEAST else "a positive number of millimetres"
            msg = f"{what}: {key} = {value}, wanted {wish}"
            raise ValueError(msg)


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _number(value: object) -> bool:
    return _whole(value) or (isinstance(value, float) and math.isfinite(value))
