"""Ladders of models: the same scenes corrected by ever more complex models, simplest first.

A ladder is a table of a suite. Its method, its sensor and the sensor that methods are told of
(``claimed``) are texts in which ``{rung}`` stands for the complexity; other lists of the table are
columns beside it, by their names. Every scene is simulated with several seeds, once for all rungs
whose sensor is the same. A ladder's captures meet the methods of their own rung alone.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from toftools.bench.methods import check_method
from toftools.bench.source import (
    Source,
    check_keys,
    filled,
    list_of,
    number_of,
    seeds_of,
)
from toftools.bench.stress import check_scene
from toftools.sensors import sensor
from toftools.types import Camera

_KEYS = ("name", "about", "unit", "rungs", "labels", "method", "scenes", "sensor", "claimed",
         "engine", "tol_mm", "within_mm", "seeds")  # fmt: skip
LEAST_RUNGS = 2
"""One rung is no ladder."""
SEEDS = 2
WITHIN_MM = 10.0
"""Error of a pixel up to which a model suffices, unless the ladder says another."""
GROUP = "ladders"
"""Group of all captures of ladders."""


def ladder_sources(entries: Sequence[Any], where: str) -> Iterator[Source]:
    """The scenes of ladders, once per rung and seed.

    Parameters
    ----------
    entries : sequence
        Tables ``[[ladder]]`` of a suite: ``name``, ``rungs`` (rising numbers: complexity),
        ``method``, ``scenes``, ``sensor``; optional ``about``, ``unit``, ``labels`` (the rungs in
        words), ``claimed``, ``engine``, ``tol_mm``, ``within_mm`` (10), ``seeds`` (2), and further
        lists of as many entries as there are rungs.
    where : str
        The suite, for messages.

    Yields
    ------
    Source
        One per rung, scene and seed.

    Raises
    ------
    ValueError
        If a table is no ladder.

    Examples
    --------
    >>> ladder = {"name": "window", "rungs": [3, 5], "method": "kde:window_px={rung}",
    ...           "scenes": ["wall:range=2"], "sensor": "opt8241", "seeds": 1}
    >>> [source.method for source in ladder_sources([ladder], "mine.toml")]
    ['kde:window_px=3', 'kde:window_px=5']
    """
    seen: set[str] = set()
    for entry in entries:
        name = _checked(entry, where)
        if name in seen:
            msg = f"{where} has two ladders {name!r}; give each a name of its own"
            raise ValueError(msg)
        seen.add(name)
        yield from _sources(entry, f"ladder {name} of {where}")


def _checked(entry: object, where: str) -> str:
    """The name of a ladder whose table is whole."""
    if not isinstance(entry, Mapping) or not all(isinstance(key, str) for key in entry):
        msg = f"ladder in {where} must be a table [[ladder]], got {entry!r}"
        raise ValueError(msg)
    name, rungs = str(entry.get("name", "")), list_of(entry, "rungs", where)
    numbers = all(
        isinstance(r, int | float) and not isinstance(r, bool) and math.isfinite(r) for r in rungs
    )
    if not name or len(rungs) < LEAST_RUNGS or not numbers or rungs != sorted(set(rungs)):
        msg = (
            f"a ladder of {where} needs a name and {LEAST_RUNGS} or more rising numbers as rungs; "
            f"got name={name!r} and rungs={rungs!r}"
        )
        raise ValueError(msg)
    mine = f"ladder {name} of {where}"
    columns = [key for key in entry if key not in _KEYS and isinstance(entry[key], list)]
    check_keys(entry, (*_KEYS, *columns), mine)
    if "rung" in columns:
        msg = f"{mine} has a list named rung, which {{rung}} already is; rename it"
        raise ValueError(msg)
    for key in (*columns, *(["labels"] if "labels" in entry else [])):
        if len(list_of(entry, key, mine)) != len(rungs):
            msg = f"{mine} has {len(entry[key])} {key} for {len(rungs)} rungs"
            raise ValueError(msg)
    _check_texts(entry, mine)
    return name


def _check_texts(entry: Mapping[str, Any], mine: str) -> None:
    scenes = list_of(entry, "scenes", mine)
    if not scenes or not all(isinstance(s, str) for s in scenes) or len(set(scenes)) < len(scenes):
        msg = f"{mine} needs a list of different scenes, got {scenes!r}"
        raise ValueError(msg)
    for key in ("method", "sensor"):
        if not isinstance(entry.get(key), str) or not entry[key]:
            msg = f"{mine} needs a {key}, got {entry.get(key)!r}"
            raise ValueError(msg)
    for key in ("tol_mm", "within_mm"):
        value = number_of(entry, key, 1.0, mine)
        if not 0 < value < math.inf:
            msg = f"{key} of {mine} must be a positive number, got {value:g}"
            raise ValueError(msg)


def _sources(entry: Mapping[str, Any], mine: str) -> Iterator[Source]:
    engine, unit = str(entry.get("engine", "auto")), str(entry.get("unit", ""))
    about = str(entry.get("about", entry["name"])) + (f", {unit}" if unit else "")
    labels = [str(v) for v in entry.get("labels", [f"{r:.12g}" for r in entry["rungs"]])]
    seeds = seeds_of(entry, SEEDS, mine)
    steps = list(_steps(entry, mine))
    for scene in entry["scenes"]:
        _check_scene(scene, engine, steps[0]["sensor"], mine)
    for rung, label, told in zip(entry["rungs"], labels, steps, strict=True):
        for scene in entry["scenes"]:
            for seed in range(seeds):
                yield Source(
                    scene, GROUP, None, told["sensor"], engine,
                    number_of(entry, "tol_mm", 1.0, mine), claimed=told["claimed"], seed=seed,
                    about=about, ladder=str(entry["name"]), rung=float(rung), label=label,
                    method=told["method"],
                    within_m=1e-3 * number_of(entry, "within_mm", WITHIN_MM, mine),
                )  # fmt: skip


def _steps(entry: Mapping[str, Any], mine: str) -> Iterator[dict[str, str]]:
    """The texts of every rung, each checked before anything is simulated."""
    columns = {key: entry[key] for key in entry if key not in _KEYS}
    first: Camera | None = None
    for number, rung in enumerate(entry["rungs"]):
        row = {"rung": rung, **{key: column[number] for key, column in columns.items()}}
        texts = {key: str(entry.get(key, "")) for key in ("method", "sensor", "claimed")}
        told = {key: filled(text, row, mine) for key, text in texts.items()}
        check_method(told["method"], {})
        camera = sensor(told["sensor"]).camera
        first = first or camera
        if camera.shape != first.shape or not np.array_equal(camera.K, first.K):
            msg = (
                f"{mine} has cameras of different pixels: rungs are compared pixel by pixel, so "
                "width, height and angle of view must be the same for all"
            )
            raise ValueError(msg)
        if told["claimed"]:
            sensor(told["claimed"])
        yield told


def _check_scene(text: str, engine: str, first_sensor: str, mine: str) -> None:
    """Refuse a scene that its engine does not know: ValueError."""
    try:
        check_scene(text, sensor(first_sensor), engine)
    except ValueError as error:
        msg = f"{mine}: {error}"
        raise ValueError(msg) from error
