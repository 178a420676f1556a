"""Furnished rooms from a seed: a shell, table, cupboard, boxes, balls, a camera that sees them.

Everything stands on the floor or on the table, nothing overlaps, and the camera keeps its distance.
The same seed gives the same room, whatever its material; other numbers of boxes or balls leave
shell, furniture and camera as they are. Rooms are generated in a frame of their own: x right, y
down, z away from the camera's wall, the origin in the middle of the floor.
"""

from typing import Any

import numpy as np

from toftools.sim._ground import ALBEDOS, CLEAR_M, Ground, painted
from toftools.sim.planes import STILL, moving
from toftools.sim.solids import Entry, box, quad, sphere, turned
from toftools.sim.world import World, look_at
from toftools.types import F64

MOST = 100
CAMERA_CLEAR_M, CLEARS_M = 0.8, (0.6, 0.45, 0.3)
"""What is kept free around a camera, and around others as far as there is space."""


def room(
    *,
    seed: int = 7,
    boxes: int = 5,
    balls: int = 3,
    material: str = "diffuse",
    paint: int = 0,
    view: int = 0,
    velocity: tuple[float, float, float] = STILL,
) -> World:
    """Room of 3.5 to 6 m with table, cupboard, boxes and balls, albedos 0.3 to 0.8.

    Parameters
    ----------
    seed : int
        Seed of everything, 0 or more.
    boxes, balls : int
        How many of each, up to 100; a third stands on the table while there is space.
    material : str
        Of boxes and balls, a name out of `solids.SOLID`.
    paint, view : int
        The same room with other albedos, and as another camera sees it.
    velocity : tuple of 3 floats
        Velocity of the first box in the camera frame, m/s.

    Returns
    -------
    World
        The shell ``floor``, ``ceiling``, ``wall_1`` to ``wall_4``, the furniture ``table``,
        ``leg_1`` to ``leg_4`` and ``cupboard``, then ``box_1`` ... and ``ball_1`` ...

    Raises
    ------
    ValueError
        If so many things, or another camera, find no place.
    """
    if min(seed, paint, view) < 0 or not (0 <= boxes <= MOST and 0 <= balls <= MOST):
        msg = (
            f"got seed={seed}, boxes={boxes}, balls={balls}, paint={paint}, view={view}; wanted 0 "
            f"or more, things up to {MOST}"
        )
        raise ValueError(msg)
    if np.any(velocity) and not boxes:
        msg = f"got velocity={velocity} of the first box in a room with boxes=0"
        raise ValueError(msg)
    root = np.random.default_rng(seed)
    rng, box_rng, ball_rng = root.spawn(3)
    width, height, depth = rng.uniform([3.5, 2.4, 3.5], [6.0, 3.0, 6.0])
    camera = np.array(
        [rng.uniform(-0.3, 0.3) * width, -rng.uniform(1.2, 1.7), rng.uniform(0.3, 0.6) - depth / 2]
    )
    floor = Ground(np.zeros(3), 0.0, np.array([width, depth]) / 2)
    floor.taken.append((camera[0], camera[2], CAMERA_CLEAR_M))
    shapes = _shell(rng, width, height, depth)
    shapes |= _cupboard(rng, floor)
    table, entries = _table(rng, floor)
    shapes |= entries
    target = table.centre * [0.5, 0.0, 0.5] + [0.0, -rng.uniform(0.4, 0.8), 0.0]
    for i in range(1, boxes + 1):
        shapes[f"box_{i}"] = _box(box_rng, (table, floor), material)
    for i in range(1, balls + 1):
        shapes[f"ball_{i}"] = _ball(ball_rng, (table, floor), material)
    shapes = painted(shapes, np.random.default_rng([seed, paint]) if paint else None)
    if view:
        camera, target = _viewed(np.random.default_rng([seed, 0, view]), floor, table)
    pose = look_at(camera, target, (0.0, -1.0, 0.0))
    return World(shapes, to_world=pose, velocity_mps=moving("box_1", velocity))


def _viewed(rng: np.random.Generator, floor: Ground, table: Ground) -> tuple[F64, F64]:
    """Another camera: anywhere on the floor where it is free, turned to the table or beside it."""
    for clear in CLEARS_M:
        spot = floor.place(rng, clear)
        if spot is not None:
            break
    else:
        msg = "the room has no place for another camera; give fewer boxes or balls, or view=0"
        raise ValueError(msg)
    camera = spot - [0.0, rng.uniform(0.8, 1.8), 0.0]
    beside = rng.uniform([-0.8, -0.2, -0.8], [0.8, 0.4, 0.8])
    return camera, np.asarray(table.centre * [1.0, 0.5, 1.0] + beside)


def _paint(rng: np.random.Generator, name: str = "diffuse") -> Any:  # noqa: ANN401
    """Material and albedo, which `painted` makes an entry of."""
    return name, float(rng.uniform(*ALBEDOS))


def _shell(rng: np.random.Generator, width: float, height: float, depth: float) -> dict[str, Entry]:
    """Six faces that look inwards; the four walls share their paint."""
    x, y, z = width / 2, height / 2, depth / 2
    paint = _paint(rng)
    return {
        "floor": quad([0, 0, 0], [x, 0, 0], [0, 0, z], _paint(rng)),
        "ceiling": quad([0, -height, 0], [x, 0, 0], [0, 0, -z], _paint(rng)),
        "wall_1": quad([0, -y, z], [x, 0, 0], [0, -y, 0], paint),
        "wall_2": quad([x, -y, 0], [0, 0, -z], [0, -y, 0], paint),
        "wall_3": quad([0, -y, -z], [-x, 0, 0], [0, -y, 0], paint),
        "wall_4": quad([-x, -y, 0], [0, 0, z], [0, -y, 0], paint),
    }


def _cupboard(rng: np.random.Generator, floor: Ground) -> dict[str, Entry]:
    """A tall box with its back to the far wall."""
    half = rng.uniform([0.3, 0.6, 0.15], [0.6, 1.0, 0.25])
    x = rng.uniform(-1, 1) * (floor.half[0] - half[0] - 0.05)
    z = floor.half[1] - half[2] - 0.01
    floor.taken.append((x, z, float(np.hypot(half[0], half[2]))))
    return {"cupboard": box([x, -half[1] - CLEAR_M, z], half, 0.0, _paint(rng))}


def _table(rng: np.random.Generator, floor: Ground) -> tuple[Ground, dict[str, Entry]]:
    """A table top on four legs around the middle of the room, and what can stand on it."""
    half, height = rng.uniform([0.5, 0.3], [0.8, 0.45]), rng.uniform(0.70, 0.78)
    x, z = rng.uniform([-0.4, 0.0], [0.4, 0.25]) * floor.half
    yaw, wood = rng.uniform(-30, 30), _paint(rng)
    floor.taken.append((x, z, float(np.hypot(*half))))
    thick, leg = 0.02, 0.025  # half of each
    at = np.array([x, 0.0, z])
    shapes = {"table": box(at - [0, height - thick, 0], [half[0], thick, half[1]], yaw, wood)}
    legs = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    tall = (height - 2 * thick) / 2 - CLEAR_M
    for i, (u, v) in enumerate(legs, start=1):
        foot = turned(yaw) @ [u * (half[0] - 2 * leg), 0.0, v * (half[1] - 2 * leg)]
        middle = at + foot - [0, tall + CLEAR_M, 0]
        shapes[f"leg_{i}"] = box(middle, [leg, tall, leg], yaw, wood)
    return Ground(at - [0, height, 0], yaw, half), shapes


def _spot(
    rng: np.random.Generator, grounds: tuple[Ground, Ground], small: float, large: float
) -> tuple[F64, float]:
    """Where a thing stands and how wide it is, smaller on the table than on the floor."""
    table, floor = grounds
    share = rng.uniform()
    if rng.uniform() < 1 / 3:
        radius = small * (0.5 + 0.5 * share)
        spot = table.place(rng, radius)
        if spot is not None:
            return spot, radius
    radius = large * (0.4 + 0.6 * share)
    spot = floor.place(rng, radius)
    if spot is None:
        msg = "the room has no place for so many things; give fewer boxes or balls"
        raise ValueError(msg)
    return spot, radius


def _box(rng: np.random.Generator, grounds: tuple[Ground, Ground], material: str) -> Entry:
    spot, radius = _spot(rng, grounds, 0.14, 0.40)
    side, up = rng.uniform(0.35, 0.65) * np.pi / 2, rng.uniform(0.4, 1.4)
    half = radius * np.array([np.cos(side), up, np.sin(side)])
    middle = spot - [0, half[1], 0]
    return box(middle, half, rng.uniform(0, 90), _paint(rng, material))


def _ball(rng: np.random.Generator, grounds: tuple[Ground, Ground], material: str) -> Entry:
    spot, radius = _spot(rng, grounds, 0.10, 0.25)
    return sphere(spot - [0, radius, 0], radius, _paint(rng, material))
