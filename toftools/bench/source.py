"""One entry of a suite, and how its TOML is read: what a suite, its axes and ladders share."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

MOST_SEEDS = 1000


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
    engine : str
        What makes the capture of a scene: ``auto`` or a simulator.
    tol_mm : float
        Standard error of range that it may leave, mm.
    unless : str
        Environment variable that, if set, makes a file superfluous; empty for none.
    claimed : str
        Sensor that methods are told instead of the one of the scene; empty for the truth.
    seed : int
        Of noise and light of a scene.
    axis : str
        Stress axis that the scene is a point of; empty for none.
    value : float
        Where on it.
    about : str
        What the axis or the ladder is, with its unit.
    ladder : str
        Ladder of models that the scene is climbed by; empty for none.
    rung : float
        Complexity of the model of this source.
    label : str
        The rung in words.
    method : str
        The model of the rung: the only method that runs here.
    within_m : float
        Error up to which the model suffices for a pixel, m.
    """

    text: str
    group: str
    format: str | None = None
    sensor: str | None = None
    engine: str = "auto"
    tol_mm: float = 1.0
    unless: str = ""
    claimed: str = ""
    seed: int = 0
    axis: str = ""
    value: float = 0.0
    about: str = ""
    ladder: str = ""
    rung: float = 0.0
    label: str = ""
    method: str = ""
    within_m: float = 0.0


def check_keys(table: Mapping[str, Any], known: Collection[str], where: str) -> None:
    """Refuse a key that nothing reads: ValueError."""
    for key in table:
        if key not in known:
            msg = f"{where} has an unknown key {key!r}; known: {', '.join(known)}"
            raise ValueError(msg)


def table_of(table: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """A table of a table, empty if it is not there; ValueError for anything else."""
    value = table.get(key, {})
    if not isinstance(value, Mapping):
        msg = f"{key} in {where} must be a table, got {value!r}"
        raise ValueError(msg)
    return value


def list_of(table: Mapping[str, Any], key: str, where: str) -> list[Any]:
    """A list of a table, empty if it is not there; ValueError for anything else."""
    value = table.get(key, [])
    if not isinstance(value, list):
        msg = f"{key} in {where} must be a list, got {value!r}"
        raise ValueError(msg)
    return value


def number_of(table: Mapping[str, Any], key: str, default: float, where: str) -> float:
    """A number of a table, or the default; ValueError for anything else."""
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        msg = f"{key} in {where} must be a number, got {value!r}"
        raise ValueError(msg)
    return float(value)


def seeds_of(table: Mapping[str, Any], default: int, where: str) -> int:
    """How many seeds a table asks for, or the default; ValueError for anything else."""
    seeds = table.get("seeds", default)
    if isinstance(seeds, bool) or not isinstance(seeds, int) or not 1 <= seeds <= MOST_SEEDS:
        msg = f"{where} wants seeds from 1 to {MOST_SEEDS}, got {seeds!r}"
        raise ValueError(msg)
    return seeds


def filled(text: str, row: Mapping[str, Any], where: str) -> str:
    """A text with its braces replaced by the entries of a row; ValueError for an unknown one."""

    def found(match: re.Match[str]) -> str:
        key = match.group(1)
        if key not in row:
            msg = f"{where} asks for {{{key}}}, known: " + ", ".join(f"{{{k}}}" for k in row)
            raise ValueError(msg)
        value = row[key]
        return f"{value:.12g}" if isinstance(value, int | float) else str(value)

    return re.sub(r"\{([^{}]*)\}", found, text)


def flag_of(table: Mapping[str, Any], key: str, where: str) -> bool:
    """A flag of a table, false if it is not there; ValueError for anything else."""
    value = table.get(key, False)
    if not isinstance(value, bool):
        msg = f"{key} in {where} must be true or false, got {value!r}"
        raise ValueError(msg)
    return value
