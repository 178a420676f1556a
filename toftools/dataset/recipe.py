"""Recipes: a TOML file that says which scenes a data set has, and the captures that follow.

A recipe has families; a family has scenes, and a scene has paints (sets of albedos) and views. All
draws are seeded by the recipe's seed and by what is drawn, so that more scenes or more families
leave those that were there as they are.
"""

import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftools._recipe_file import read_toml
from toftools.bench.fingerprint import digest
from toftools.dataset._rules import (
    SPLITS,
    check_family,
    check_split,
    check_table,
    drawn,
)
from toftools.registry import parse_entry
from toftools.sensors import sensor
from toftools.sim.analytic import SCENES
from toftools.sim.scenes import WORLDS, world_of
from toftools.types import Scene

RECIPES = Path(__file__).parent / "recipes"
COUNTED = ("paint", "view")
"""Parameters of a scene that show the same geometry: they count up within it."""


@dataclass(frozen=True)
class Job:
    """One capture of a data set.

    Parameters
    ----------
    id : str
        What it is of, and a digest of all that it follows from, scene files included.
    family, group : str
        Family of the recipe, and scene within it: all paints and views of a scene are one group.
    split : str
        Part of the set that the scene belongs to: train, validation or test.
    scene, sensor : str
        As the command line takes them.
    seed : int
        Of noise and light.
    tol_mm : float
        Standard error of range that the light may have, mm.
    max_bounces : int or None
        Indirect bounces; None for all that matter.
    """

    id: str
    family: str
    group: str
    split: str
    scene: str
    sensor: str
    seed: int
    tol_mm: float
    max_bounces: int | None


@dataclass(frozen=True, eq=False)
class Recipe:
    """A data set to be made.

    Parameters
    ----------
    name, about : str
        Name, and what it is.
    jobs : tuple of Job
        Captures.
    text : str
        The recipe itself.
    """

    name: str
    about: str
    jobs: tuple[Job, ...]
    text: str


def read_recipe(source: Path | str) -> Recipe:
    """Read a recipe.

    Parameters
    ----------
    source : path or str
        TOML file, or the name of a recipe that comes with the package.

    Returns
    -------
    Recipe
        All captures, in the order of the file.

    Raises
    ------
    ValueError
        If there is no such recipe, or it asks for what is impossible.
    """
    path, text, given = read_toml(source, RECIPES, "recipe")
    families, shares = _families(given, path.stem), check_split(given)
    parts: dict[str, str] = {}
    jobs = tuple(
        job
        for name, family in families.items()
        for job in _jobs(name, {**family, "folder": path.parent}, shares, parts)
    )
    seen: dict[str, Job] = {}
    for job in jobs:
        if job.id in seen:
            msg = f"{path.name} asks twice for {job.scene}; let a parameter differ between scenes"
            raise ValueError(msg)
        seen[job.id] = job
    return Recipe(str(given.get("name", path.stem)), str(given.get("about", "")), jobs, text)


def _families(given: Mapping[str, Any], name: str) -> dict[str, dict[str, Any]]:
    """Families with all their keys, by name."""
    usual = check_table(given, name)
    found: dict[str, dict[str, Any]] = {}
    for number, family in enumerate(given.get("family", []), start=1):
        whole = check_family(family, usual, f"family {number} of the recipe {name}")
        called = whole.get("name", parse_entry(whole["scene"])[0])
        if called in found:
            msg = f"two families of the recipe {name} are called {called}; give one another name"
            raise ValueError(msg)
        found[called] = whole
    if not found:
        msg = f"the recipe {name} has no [[family]], so there is nothing to make"
        raise ValueError(msg)
    return found


def _jobs(
    name: str, family: Mapping[str, Any], shares: Mapping[str, float], parts: dict[str, str]
) -> Iterator[Job]:
    """Captures of a family; `parts` says to which part each geometry belongs."""
    seed, ordered = family["seed"], _parts(name, family, shares)
    for number in range(family["scenes"]):
        params = {key: drawn(rule, _rng(seed, f"{name} {number} {key}"), number, key)
                  for key, rule in family["params"].items()}  # fmt: skip
        shown, content = _located(_text(family["scene"], params), family["folder"])
        # Whatever else differs, what shows the same furniture is in the same part.
        split = parts.setdefault(_geometry(shown), ordered[number])
        for view in range(family["views"]):
            for paint in range(family["paints"]):
                counted = {"paint": paint, "view": view}
                scene = _text(shown, {k: v for k, v in counted.items() if family[f"{k}s"] > 1})
                rng = _rng(seed, _short(scene))
                device = family["sensors"][rng.integers(len(family["sensors"]))]
                if paint == 0:
                    _check_scene(scene)
                sensor(device)
                mark = int(rng.integers(1 << 31))
                facts = (mark, float(family["tol_mm"]), family["max_bounces"])
                key = digest(_short(scene), content, device, *facts)
                label = re.sub(r"[^A-Za-z0-9_.]+", "-", _short(scene)).strip("-.")[:60]
                yield Job(f"{label}-{key}", name, f"{name}-{number}", split, scene, device, *facts)


def _geometry(scene: str) -> str:
    """What a scene is known by: its seed if it has one, else all its parameters."""
    name, params = parse_entry(scene)
    return f"{name} {params['seed'] if 'seed' in params else sorted(params.items())}"


def _check_scene(scene: str) -> None:
    name, params = parse_entry(scene)
    if name in WORLDS or name not in SCENES:
        world_of(Scene(name, params))  # says what is wrong with it


def _located(scene: str, folder: Path) -> tuple[str, str]:
    """A scene whose file is found from anywhere, and a digest of that file."""
    name, mark, params = scene.partition(":")
    if name in WORLDS or name in SCENES:
        return scene, ""
    file = (folder / name).resolve()
    if not file.is_file():
        msg = f"got the scene {name!r}, which is no file in {folder} and not one of: " + ", ".join(
            sorted({*WORLDS, *SCENES})
        )
        raise ValueError(msg)
    return f"{file}{mark}{params}", digest(file.read_bytes())


def _short(scene: str) -> str:
    """A scene without the folder of its file."""
    name, mark, params = scene.partition(":")
    return f"{Path(name).name}{mark}{params}"


def _parts(name: str, family: Mapping[str, Any], shares: Mapping[str, float]) -> list[str]:
    """Part of the set of every scene: evenly through the family, from a start drawn by chance."""
    begin, count = float(_rng(family["seed"], name).random()), family["scenes"]
    # Multiples of the golden section fill every stretch evenly, so that more scenes change none.
    at = (begin + np.arange(count) * (np.sqrt(5) - 1) / 2) % 1
    names = [split for split in SPLITS if shares.get(split, 0) > 0]
    edges = np.cumsum([shares[split] for split in names])
    return [names[min(int(i), len(names) - 1)] for i in np.searchsorted(edges, at, side="right")]


def _text(scene: str, params: Mapping[str, Any]) -> str:
    more = ",".join(f"{key}={value}" for key, value in params.items())
    whole = f"{scene}{',' if ':' in scene else ':'}{more}" if more else scene
    found = parse_entry(whole)[1]
    if set(found) != {*parse_entry(scene)[1], *params}:
        msg = f"a parameter of {whole} holds another one; write each of them by its own name"
        raise ValueError(msg)
    return whole


def _rng(seed: int, what: str) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(what.encode())])
