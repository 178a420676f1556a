"""Stress axes: families of simulated captures in which one figure goes from easy to hard.

An axis is a table of a suite. Its scene, its sensor, and the sensor that methods are told of
(``claimed``: a detuned clock, wrong intrinsics, an uncalibrated waveform) are texts in which
``{value}`` stands for the figure; other lists of the table are columns beside it, by their names.
Every value is simulated with several seeds of noise, so that a curve has a spread; captures that
differ in electronics alone share their light.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from toftools.bench.source import (
    Source,
    check_keys,
    filled,
    list_of,
    number_of,
    seeds_of,
)
from toftools.registry import SIMULATORS, find, parse_entry
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.sim.choice import choose
from toftools.sim.scenes import world_of
from toftools.types import Scene, Sensor

_KEYS = (
    "name",
    "about",
    "unit",
    "values",
    "scene",
    "sensor",
    "claimed",
    "engine",
    "tol_mm",
    "seeds",
)
LEAST_VALUES = 3
"""Fewer points make no curve."""
GROUP = "axis: "
"""What the groups of axes start with."""


def axis_sources(entries: Sequence[Any], where: str) -> Iterator[Source]:
    """The scenes of stress axes.

    Parameters
    ----------
    entries : sequence
        Tables ``[[axis]]`` of a suite: ``name``, ``values`` (easiest first), ``scene``, ``sensor``;
        optional ``about``, ``unit``, ``claimed``, ``engine``, ``tol_mm``, ``seeds`` (3), and
        further lists of as many entries as there are values.
    where : str
        The suite, for messages.

    Yields
    ------
    Source
        One per value and seed.

    Raises
    ------
    ValueError
        If a table is no axis.

    Examples
    --------
    >>> axis = {"name": "ambient", "values": [0, 100, 1e4], "scene": "wall:ambient_e={value}",
    ...         "sensor": "deeptof", "seeds": 1}
    >>> [source.text for source in axis_sources([axis], "mine.toml")]
    ['wall:ambient_e=0', 'wall:ambient_e=100', 'wall:ambient_e=10000']
    """
    seen: set[str] = set()
    for entry in entries:
        name = _checked(entry, where)
        if name in seen:
            msg = f"{where} has two axes {name!r}; give each a name of its own"
            raise ValueError(msg)
        seen.add(name)
        yield from _sources(entry, name, where)


def _checked(entry: object, where: str) -> str:
    """The name of an axis whose table is whole."""
    if not isinstance(entry, Mapping) or not all(isinstance(key, str) for key in entry):
        msg = f"axis in {where} must be a table [[axis]], got {entry!r}"
        raise ValueError(msg)
    name = str(entry.get("name", ""))
    values = list_of(entry, "values", where)
    numbers = all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values
    )
    if not name or len(values) < LEAST_VALUES or not numbers or len(set(values)) < len(values):
        msg = (
            f"an axis of {where} needs a name and {LEAST_VALUES} or more different numbers as "
            f"values, easiest first; got name={name!r} and values={values!r}"
        )
        raise ValueError(msg)
    columns = [key for key in entry if key not in _KEYS and isinstance(entry[key], list)]
    check_keys(entry, (*_KEYS, *columns), f"axis {name} of {where}")
    if "value" in columns:
        msg = (
            f"axis {name} of {where} has a list named value, which {{value}} already is; rename it"
        )
        raise ValueError(msg)
    for key in columns:
        if len(entry[key]) != len(values):
            msg = f"axis {name} of {where} has {len(entry[key])} {key} for {len(values)} values"
            raise ValueError(msg)
    seeds_of(entry, 3, f"axis {name} of {where}")
    return name


def _sources(entry: Mapping[str, Any], name: str, where: str) -> Iterator[Source]:
    engine, tol_mm = str(entry.get("engine", "auto")), number_of(entry, "tol_mm", 1.0, where)
    if not 0 < tol_mm < math.inf:
        msg = f"tol_mm of axis {name} in {where} must be a positive number, got {tol_mm:g}"
        raise ValueError(msg)
    texts = {key: str(entry.get(key, "")) for key in ("scene", "sensor", "claimed")}
    if not texts["scene"] or not texts["sensor"]:
        msg = f"axis {name} of {where} needs a scene and a sensor, got {sorted(entry)}"
        raise ValueError(msg)
    columns = {key: entry[key] for key in entry if key not in _KEYS}
    unit = str(entry.get("unit", ""))
    about = str(entry.get("about", name)) + (f", {unit}" if unit else "")
    for number, value in enumerate(entry["values"]):
        row = {"value": value, **{key: column[number] for key, column in columns.items()}}
        told = {k: filled(text, row, f"axis {name} of {where}") for k, text in texts.items()}
        for key in ("sensor", "claimed"):
            if told[key]:
                sensor(told[key])  # a wrong figure is told before anything is simulated
        check_scene(told["scene"], sensor(told["sensor"]), engine)
        for seed in range(seeds_of(entry, 3, where)):
            yield Source(
                told["scene"], f"{GROUP}{name}", None, told["sensor"], engine, tol_mm,
                claimed=told["claimed"], seed=seed, axis=name, value=float(value), about=about,
            )  # fmt: skip


def check_scene(text: str, device: Sensor, engine: str) -> None:
    """Refuse engines, scenes and parameters that do not exist, before any light: ValueError."""
    scene = Scene(*parse_entry(text))
    name = choose(scene, device)[0] if engine == "auto" else engine
    find(SIMULATORS, name)
    if name == "analytic":
        analytic(scene)
    elif parse_entry(name)[0] in SIMULATORS:  # an engine of the user's knows scenes of its own
        world_of(scene)
