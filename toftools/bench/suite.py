"""A suite: which captures, which methods, which dials; read from TOML and checked once."""

import itertools
import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from toftools.bench.references import REFERENCES
from toftools.registry import CORRECTIONS, Spec, find, parse_name

BUILT_IN = Path(__file__).parent / "suites"
_KEYS = ("name", "captures", "scenes", "sensor", "methods", "grid", "repeats", "mask", "title")


@dataclass(frozen=True)
class Source:
    """One entry of a suite: a file pattern or a scene.

    Parameters
    ----------
    text : str
        Path pattern (environment variables are expanded) or ``scene:key=val,...``.
    group : str
        Captures of one group share a chart and a mean.
    format : str or None
        Foreign format to force for a file.
    sensor : str or None
        Sensor of a scene; None for a file.
    """

    text: str
    group: str
    format: str | None = None
    sensor: str | None = None


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
        Captures and scenes.
    methods : tuple of str
        ``name``, ``name:key=val,...`` or ``mypkg.mine:make``.
    grid : mapping
        Method to parameter to values; replaces the registry's grid for that method.
    repeats : int
        Timed runs per point.
    min_range_m, max_range_m : float
        Truth outside is not scored.
    """

    name: str
    folder: Path
    sources: tuple[Source, ...]
    methods: tuple[str, ...]
    grid: Mapping[str, Mapping[str, tuple[Any, ...]]] = field(default_factory=dict)
    repeats: int = 11
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
    unknown = [key for key in table if key not in _KEYS]
    if unknown:
        msg = f"{path.name} has an unknown key {unknown[0]!r}; known: {', '.join(_KEYS)}"
        raise ValueError(msg)
    sources = [*_files(table.get("captures", [])), *_scenes(table)]
    methods = tuple(str(m) for m in table.get("methods", []))
    if not sources or not methods:
        msg = f"{path.name} needs methods, and captures or scenes; got {sorted(table)}"
        raise ValueError(msg)
    for method in methods:
        spec_of(method)
    mask = table.get("mask", {})
    return Suite(
        name=str(table.get("name", path.stem)),
        folder=path.parent,
        sources=tuple(sources),
        methods=methods,
        grid={
            name: {key: tuple(values) for key, values in grid.items()}
            for name, grid in table.get("grid", {}).items()
        },
        repeats=int(table.get("repeats", 11)),
        min_range_m=float(mask.get("min_range_m", 0.0)),
        max_range_m=float(mask.get("max_range_m", float("inf"))),
    )


def _files(entries: list[Any]) -> Iterator[Source]:
    for entry in entries:
        item = {"path": entry} if isinstance(entry, str) else dict(entry)
        pattern = str(item["path"])
        yield Source(pattern, str(item.get("group", Path(pattern).parent.name)),
                     item.get("format"))  # fmt: skip


def _scenes(table: Mapping[str, Any]) -> Iterator[Source]:
    sensors = table.get("sensor", "deeptof")
    for sensor in [sensors] if isinstance(sensors, str) else sensors:
        for scene in table.get("scenes", []):
            yield Source(str(scene), f"scenes, {parse_name(sensor)[0]}", None, str(sensor))


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
    return sorted(p for p in root.glob(str(pattern)) if p.is_file())


def spec_of(text: str) -> Spec:
    """Spec of a method or of a reference row.

    Parameters
    ----------
    text : str
        As typed in a suite.

    Returns
    -------
    Spec
        Entry with the typed parameters fixed.
    """
    name = parse_name(text)[0]
    return find(REFERENCES if name in REFERENCES else CORRECTIONS, text)


def points(suite: Suite, text: str) -> list[tuple[str, dict[str, Any]]]:
    """Method name and parameters of every point on one method's curve.

    Parameters
    ----------
    suite : Suite
        Gives grids that replace the registry's.
    text : str
        Method as typed; typed parameters make a single point.

    Returns
    -------
    list of (str, dict)
        The default point first, then the grid.
    """
    name, typed = parse_name(text)
    if typed:
        return [(name, typed)]
    grid = suite.grid.get(name, spec_of(text).grid)
    sweep = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    return [(name, params) for params in (sweep if grid else [{}])]
