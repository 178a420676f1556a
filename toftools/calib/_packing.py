"""Stages and their values as plain JSON, with large arrays apart, and back.

Arrays of at most `INLINE` finite numbers stand in the JSON itself; classes are made by name, out of
`toftools.calib`, the types, and modules that the caller trusts.
"""

import importlib
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.calib.stage import Residual
from toftools.types import Camera

INLINE = 64
"""Arrays of at most as many numbers stand in the JSON itself."""
HOME = "toftools.calib."
SPECIAL = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
KINDS = {"f": np.float64, "i": np.int64, "b": np.bool_}


def packed(value: Any, place: str, arrays: dict[str, NDArray[Any]]) -> Any:  # noqa: ANN401
    """Plain JSON of a stage or one of its values.

    Parameters
    ----------
    value : object
        Stage, number, word, tuple, array, or a dataclass of those.
    place : str
        Name for arrays that do not stand in the JSON.
    arrays : dict
        Where those go.

    Returns
    -------
    object
        What ``json`` writes.

    Raises
    ------
    ValueError
        If the value is of another kind.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        number = float(value)
        return number if math.isfinite(number) else {"number": repr(number)}
    if isinstance(value, tuple):
        return [packed(item, f"{place}.{n}", arrays) for n, item in enumerate(value)]
    if isinstance(value, np.ndarray):
        return _packed_array(value, place, arrays)
    if is_dataclass(value) and not isinstance(value, type):
        named = {f.name: getattr(value, f.name) for f in fields(value)}
        content = {key: packed(item, f"{place}.{key}", arrays) for key, item in named.items()}
        cls = type(value)
        return {"class": f"{cls.__module__}:{cls.__qualname__}".removeprefix(HOME), **content}
    msg = f"a stage holds a {type(value).__name__} at {place}, which cannot be saved"
    raise ValueError(msg)


def _packed_array(
    value: NDArray[Any], place: str, arrays: dict[str, NDArray[Any]]
) -> dict[str, Any]:
    kind = KINDS.get(value.dtype.kind)
    plain = kind is not None and value.dtype == kind and bool(np.isfinite(value).all())
    if plain and value.size <= INLINE:
        return {"array": value.tolist(), "shape": list(value.shape), "kind": value.dtype.kind}
    arrays[place] = value
    return {"stored": place}


def stored_names(value: Any) -> list[str]:  # noqa: ANN401 - out of JSON
    """Names of all arrays that stand apart.

    Parameters
    ----------
    value : object
        Out of JSON.

    Returns
    -------
    list of str
        Names.
    """
    if isinstance(value, list):
        return [name for item in value for name in stored_names(item)]
    if isinstance(value, dict):
        if "stored" in value:
            return [str(value["stored"])]
        return [name for item in value.values() for name in stored_names(item)]
    return []


def unpacked(value: Any, arrays: Mapping[str, NDArray[Any]], trusted: tuple[str, ...]) -> Any:  # noqa: ANN401
    """The value that `packed` made plain.

    Parameters
    ----------
    value : object
        Out of JSON.
    arrays : mapping
        Arrays that stand apart.
    trusted : tuple of str
        Modules of a user's own stages.

    Returns
    -------
    object
        Stage or value.

    Raises
    ------
    ValueError
        If a class is unknown, or refuses its fields.
    """
    if isinstance(value, list):
        return tuple(unpacked(item, arrays, trusted) for item in value)
    if not isinstance(value, dict):
        return value
    if "number" in value:
        return SPECIAL[value["number"]]
    if "stored" in value:
        return arrays[value["stored"]]
    if "array" in value:
        array: NDArray[Any] = np.asarray(value["array"], dtype=KINDS[value["kind"]])
        return array.reshape(value["shape"])
    content = {k: unpacked(v, arrays, trusted) for k, v in value.items() if k != "class"}
    return _class(str(value.get("class")), trusted)(**content)


def _class(text: str, trusted: tuple[str, ...]) -> Any:  # noqa: ANN401 - a dataclass
    """A dataclass by name, out of toftools.calib, the types, or a trusted module."""
    for known in (Camera, Residual):
        if text == f"{known.__module__}:{known.__qualname__}".removeprefix(HOME):
            return known
    module, _, name = text.partition(":")
    own = not module.startswith(".") and all(part.isidentifier() for part in module.split("."))
    if module not in trusted:
        module = HOME + module
    if not own or not name.isidentifier():
        msg = f"it names the class {text!r}, which cannot be"
        raise ValueError(msg)
    try:
        found = getattr(importlib.import_module(module), name)
    except ImportError as error:
        msg = f"this toftools has no {text!r}; trust the module of a stage of your own by name"
        raise ValueError(msg) from error
    if not (isinstance(found, type) and is_dataclass(found)):
        msg = f"{text!r} is no stage"
        raise ValueError(msg)
    return found
