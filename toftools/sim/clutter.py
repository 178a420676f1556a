"""Cluttered tables from a seed, seen from as near as a hand: boxes, prisms, balls, bowls, vases.

The table stands before a wall, and half of them in a corner. The same seed gives the same table in
any paint and view. The frame is the table's own: x right, y down, z away from the one who sits at
it, the origin in the middle of its top.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from toftools.sim import solids
from toftools.sim._ground import ALBEDOS, Ground, painted
from toftools.sim.solids import Entry, box, lathe, quad, sphere
from toftools.sim.world import World, look_at
from toftools.types import F64

MOST = 60
SHINY = ("plastic", "rough_conductor")
FREE_M = 0.12
"""What a camera keeps from all things."""


def clutter(
    *, seed: int = 1, things: int = 12, gloss: float = 0.0, paint: int = 0, view: int = 0
) -> World:
    """Table with things on it, albedos 0.3 to 0.8, seen from 0.5 to 1.4 m.

    Parameters
    ----------
    seed : int
        Seed of everything, 0 or more.
    things : int
        How many stand on the table at the most, up to 60: fewer where there is no space.
    gloss : float
        Chance of a thing to be of plastic or of rough metal, 0..1.
    paint, view : int
        The same table with other albedos, and as another camera sees it.

    Returns
    -------
    World
        ``table``, ``floor``, ``wall``, ``side`` where it stands in a corner, and ``thing_1`` ...

    Raises
    ------
    ValueError
        If a number is out of range.
    """
    if min(seed, paint, view) < 0 or not (0 <= things <= MOST and 0 <= gloss <= 1):
        msg = (
            f"got seed={seed}, things={things}, gloss={gloss}, paint={paint}, view={view}; wanted "
            f"0 or more, up to {MOST} things and a gloss of 0..1"
        )
        raise ValueError(msg)
    root = np.random.default_rng([seed, 1])
    rng, *each = root.spawn(1 + things)
    half = rng.uniform([0.5, 0.3], [0.8, 0.45])
    shapes, beside = _around(rng, half)
    table, tops = Ground(np.zeros(3), 0.0, half), [0.0]
    for i, own in enumerate(each, start=1):
        radius = own.uniform(0.03, 0.14)
        spot = table.place(own, radius)
        if spot is not None:
            shapes[f"thing_{i}"], height = _thing(own, spot, radius, gloss)
            tops.append(height)
    shapes = painted(shapes, np.random.default_rng([seed, paint, 2]) if paint else None)
    pose = _camera(np.random.default_rng([seed, view, 3]), half, max(tops), beside)
    return World(shapes, to_world=pose)


def _paint(rng: np.random.Generator, gloss: float = 0.0) -> Any:  # noqa: ANN401
    """Material and albedo, which `painted` makes an entry of."""
    shiny, which, albedo = rng.random(), rng.integers(len(SHINY)), float(rng.uniform(*ALBEDOS))
    return (SHINY[which] if shiny < gloss else "diffuse"), albedo


def _around(rng: np.random.Generator, half: F64) -> tuple[dict[str, Entry], float]:
    """Table top, floor, the wall behind, and often one at the side; x of that, or 0."""
    x, z = half
    height, gap, beside = rng.uniform([0.70, 0.0, 0.0], [0.78, 0.3, 0.3])
    thick, far, wide = 0.02, z + 0.01 + gap, 2.0
    shapes = {
        "table": box([0, thick, 0], [x, thick, z], 0.0, _paint(rng)),
        "floor": quad([0, height, 0], [3, 0, 0], [0, 0, 3], _paint(rng)),
        "wall": quad([0, height - wide, far], [3, 0, 0], [0, -wide, 0], _paint(rng)),
    }
    at = 0.0
    if rng.random() < 1 / 2:
        at = float(rng.choice([-1, 1]) * (x + 0.01 + beside))
        forward = [0, 0, -np.sign(at) * 3]
        shapes["side"] = quad([at, height - wide, 0], forward, [0, -wide, 0], _paint(rng))
    return shapes, at


def _camera(rng: np.random.Generator, half: F64, top: float, side_x: float) -> F64:
    """Pose in front of the table, above all things and off the wall, looking at its middle."""
    away, side, up = rng.uniform([0.5, -50, 20], [1.4, 50, 60])
    side, up = np.radians([side, up])
    out = np.array([np.sin(side) * np.cos(up), -np.sin(up), -np.cos(side) * np.cos(up)])
    target = rng.uniform([-0.3, 0.0, -0.3], [0.3, 0.0, 0.3]) * [half[0], 0.0, half[1]]
    camera = target + away * out
    camera[1] = min(camera[1], -top - FREE_M)
    if side_x:
        camera[0] = np.sign(side_x) * min(np.sign(side_x) * camera[0], abs(side_x) - FREE_M)
    return look_at(camera, target - [0, 0.05, 0], (0.0, -1.0, 0.0))


def _thing(rng: np.random.Generator, spot: F64, radius: float, gloss: float) -> tuple[Entry, float]:
    """Something that fits into a circle, and how tall it is."""
    make = THINGS[rng.integers(len(THINGS))]
    return make(rng, spot, radius, _paint(rng, gloss))


def _box(rng: np.random.Generator, spot: F64, radius: float, paint: Entry) -> tuple[Entry, float]:
    side, up = rng.uniform(0.25, 0.75) * np.pi / 2, rng.uniform(0.3, 1.5)
    half = radius * np.array([np.cos(side), up, np.sin(side)])
    return box(spot - [0, half[1], 0], half, rng.uniform(0, 90), paint), 2 * half[1]


def _prism(rng: np.random.Generator, spot: F64, radius: float, paint: Entry) -> tuple[Entry, float]:
    height, sides = radius * rng.uniform(0.6, 3.0), int(rng.integers(3, 9))
    return solids.prism(spot, radius, height, sides, rng.uniform(0, 360), paint), height


def _ball(rng: np.random.Generator, spot: F64, radius: float, paint: Entry) -> tuple[Entry, float]:
    size = radius * rng.uniform(0.6, 1.0)
    return sphere(spot - [0, size, 0], size, paint), 2 * size


def _bowl(rng: np.random.Generator, spot: F64, radius: float, paint: Entry) -> tuple[Entry, float]:
    """Open upwards: light that falls into it comes out late."""
    height, foot, wall = radius * rng.uniform(0.4, 0.9), rng.uniform(0.3, 0.6), 0.004
    up = np.linspace(0, 1, 9)
    out = radius * (foot + (1 - foot) * np.sin(up * np.pi / 2))
    outer = np.stack([out, height * up], axis=1)
    inner = np.stack([out - wall, wall + (height - wall) * up], axis=1)
    profile = np.concatenate([[[0, 0]], outer, inner[::-1], [[0, wall]]])
    return lathe(spot, profile, paint), height


def _vase(rng: np.random.Generator, spot: F64, radius: float, paint: Entry) -> tuple[Entry, float]:
    """Closed, with a belly and a neck."""
    height, belly = radius * rng.uniform(1.5, 3.5), rng.uniform(0.25, 0.55)
    up = np.linspace(0, 1, 13)
    out = 0.35 + 0.65 * np.exp(-(((up - belly) / 0.28) ** 2))
    profile = np.stack([radius * out / out.max(), height * up], axis=1)
    return lathe(spot, np.concatenate([[[0, 0]], profile, [[0, height]]]), paint), height


THINGS: tuple[Callable[..., tuple[Entry, float]], ...] = (_box, _box, _prism, _ball, _bowl, _vase)
