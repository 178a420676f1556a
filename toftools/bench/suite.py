"""A suite: which captures, which methods, which dials; read from TOML and checked once."""

import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from toftools.bench.ladder import ladder_sources
from toftools.bench.methods import method_of, specs_of
from toftools.bench.source import (
    Source,
    check_keys,
    flag_of,
    list_of,
    number_of,
    table_of,
)
from toftools.bench.stress import axis_sources
from toftools.registry import SIMULATORS, find, parse_name

BUILT_IN = Path(__file__).parent / "suites"
_KEYS = ("name", "captures", "scenes", "axis", "ladder", "sensor", "engine", "tol_mm", "methods",
         "grid", "repeats", "batch", "sensitivity", "mask")  # fmt: skip
_SCENE_KEYS = ("scene", "sensor", "engine", "tol_mm", "group")


@dataclass(frozen=True)
class Suite:
    """What to run.

    Parameters
    ----------
    name : str
        Suite name.
    folder : Path
        Folder that relative patterns start from.
    sources : tuple of Source
        Captures, scenes, and scenes of axes and ladders.
    methods : tuple of str
        ``name``, ``name:key=val,...``, ``mypkg.mine:make``, or a chain of such joined by ``>``.
    grid : mapping
        Method or filter to parameter to values; replaces the registry's grid.
    repeats : int
        Timed runs per point.
    batch : bool
        Points of one method share a process.
    sensitivity : bool
        Each method is run on perturbed input too, after it was timed.
    min_range_m, max_range_m : float
        Truth outside is not scored.
    """

    name: str
    folder: Path
    sources: tuple[Source, ...]
    methods: tuple[str, ...]
    grid: Mapping[str, Mapping[str, tuple[Any, ...]]] = field(default_factory=dict)
    repeats: int = 11
    batch: bool = False
    sensitivity: bool = False
    min_range_m: float = 0.0
    max_range_m: float = float("inf")


def built_in() -> list[str]:
    """Names of the suites that ship with toftools.

    Returns
    -------
    list of str
        Names for `load_suite`.
    """
    return sorted(path.stem for path in BUILT_IN.glob("*.toml"))


def load_suite(name_or_path: str) -> Suite:
    """Suite by name or from a TOML file.

    Parameters
    ----------
    name_or_path : str
        A built-in name or a path.

    Returns
    -------
    Suite
        Checked suite.

    Raises
    ------
    ValueError
        If there is no such suite or the file is not a suite.
    """
    path = BUILT_IN / f"{name_or_path}.toml"
    if name_or_path not in built_in():
        path = Path(name_or_path)
    if not path.is_file():
        msg = f"no suite {name_or_path!r}; built in: {', '.join(built_in())}; or give a TOML file"
        raise ValueError(msg)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        return _suite(table, path)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, TypeError) as error:
        msg = f"{path.name} is not a suite: {error}"
        raise ValueError(msg) from error


def _suite(table: Mapping[str, Any], path: Path) -> Suite:
    where = path.name
    check_keys(table, _KEYS, where)
    sources = [
        *_files(list_of(table, "captures", where), where),
        *_scenes(table, where),
        *axis_sources(list_of(table, "axis", where), where),
    ]
    methods = tuple(str(m) for m in list_of(table, "methods", where))
    ladders = tuple(ladder_sources(list_of(table, "ladder", where), where))
    if bool(sources) != bool(methods) or not (sources or ladders):
        msg = (
            f"{where} needs methods, and captures or scenes or axes, or else ladders; "
            f"got {sorted(table)}"
        )
        raise ValueError(msg)
    names = {spec.name for method in methods for spec in specs_of(method_of(method))}
    grid = table_of(table, "grid", where)
    check_keys(grid, names, f"[grid] of {where}")
    mask = table_of(table, "mask", where)
    check_keys(mask, ("min_range_m", "max_range_m"), f"[mask] of {where}")
    low = number_of(mask, "min_range_m", 0.0, where)
    high = number_of(mask, "max_range_m", float("inf"), where)
    repeats = table.get("repeats", 11)
    if not isinstance(repeats, int) or repeats < 1 or not 0 <= low < high:
        msg = (
            f"{where} wants repeats >= 1 and 0 <= min_range_m < max_range_m, "
            f"got {repeats!r}, {low:g} and {high:g}"
        )
        raise ValueError(msg)
    return Suite(
        name=str(table.get("name") or path.stem),
        folder=path.parent,
        sources=(*sources, *ladders),
        methods=methods,
        grid={
            name: {key: tuple(list_of(dials, key, where)) for key in dials}
            for name in grid
            for dials in [table_of(grid, name, where)]
        },
        repeats=repeats,
        batch=flag_of(table, "batch", where),
        sensitivity=flag_of(table, "sensitivity", where),
        min_range_m=low,
        max_range_m=high,
    )


def _files(entries: list[Any], where: str) -> Iterator[Source]:
    for entry in entries:
        item = {"path": entry} if isinstance(entry, str) else entry
        if not isinstance(item, Mapping) or "path" not in item:
            msg = f"captures in {where} must be paths or tables with a path, got {entry!r}"
            raise ValueError(msg)
        check_keys(item, ("path", "format", "group", "unless"), f"captures of {where}")
        pattern = str(item["path"])
        group = str(item.get("group") or Path(pattern).parent.name or "captures")
        yield Source(pattern, group, item.get("format"), unless=str(item.get("unless", "")))


def _scenes(table: Mapping[str, Any], where: str) -> Iterator[Source]:
    usual = {"sensor": "deeptof", "engine": "auto", "tol_mm": 1.0}
    usual |= {key: table[key] for key in usual if key in table}
    entries = [_scene(entry, usual, where) for entry in list_of(table, "scenes", where)]
    ordered = dict.fromkeys(sensor for entry in entries for sensor in entry["sensor"])
    for sensor in ordered:
        for entry in (e for e in entries if sensor in e["sensor"]):
            engine, tol_mm = str(entry["engine"]), number_of(entry, "tol_mm", 1.0, where)
            if engine != "auto":
                find(SIMULATORS, engine)
            if not 0 < tol_mm < float("inf"):
                msg = f"tol_mm in {where} must be a positive number, got {tol_mm:g}"
                raise ValueError(msg)
            group = str(entry.get("group") or f"scenes, {parse_name(sensor)[0]}")
            yield Source(entry["scene"], group, None, sensor, engine, tol_mm)


def _scene(entry: Any, usual: Mapping[str, Any], where: str) -> dict[str, Any]:  # noqa: ANN401
    """One entry of scenes with all its keys; its sensors as a list."""
    item = {"scene": entry} if isinstance(entry, str) else entry
    if not isinstance(item, Mapping) or "scene" not in item:
        msg = f"scenes in {where} must be names or tables with a scene, got {entry!r}"
        raise ValueError(msg)
    check_keys(item, _SCENE_KEYS, f"scenes of {where}")
    full = {**usual, **item}
    named = full["sensor"]
    sensors = [named] if isinstance(named, str) else list_of(full, "sensor", where)
    return {**full, "scene": str(full["scene"]), "sensor": [str(s) for s in sensors]}


def expand(source: Source, folder: Path) -> list[Path] | None:
    """Files behind a pattern.

    Parameters
    ----------
    source : Source
        A file source.
    folder : Path
        Where relative patterns start.

    Returns
    -------
    list of Path, or None
        Sorted files; None if the pattern names an environment variable that is not set.
    """
    text = os.path.expandvars(source.text)
    if "$" in text:
        return None
    path = Path(text)
    root, pattern = (Path(path.anchor), path.relative_to(path.anchor)) if path.is_absolute() else (
        folder, path)  # fmt: skip
    return sorted(p for p in root.glob(str(pattern)) if p.is_file() and not p.name.startswith("."))
