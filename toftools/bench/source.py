"""One entry of a suite, and how its TOML is read: what a suite and its stress axes share."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any


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
        What the axis is, with its unit.
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


def flag_of(table: Mapping[str, Any], key: str, where: str) -> bool:
    """A flag of a table, false if it is not there; ValueError for anything else."""
    value = table.get(key, False)
    if not isinstance(value, bool):
        msg = f"{key} in {where} must be true or false, got {value!r}"
        raise ValueError(msg)
    return value
