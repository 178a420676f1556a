"""From the name of a scene to a `World`: the table of all scenes that an engine can render."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from toftools.registry import checked_params, parameters_of
from toftools.sim.boxes import cornell, prism, vshape
from toftools.sim.clutter import clutter
from toftools.sim.mesh import MESHES, mesh_world
from toftools.sim.planes import cavity, corner, disc, plates, slab, tilted, wall
from toftools.sim.rooms import room
from toftools.sim.scene_xml import xml_world
from toftools.sim.world import World
from toftools.types import Scene

WORLDS: Mapping[str, Callable[..., World]] = MappingProxyType(
    {
        "wall": wall,
        "tilted": tilted,
        "plates": plates,
        "disc": disc,
        "corner": corner,
        "cavity": cavity,
        "slab": slab,
        "cornell": cornell,
        "vshape": vshape,
        "prism": prism,
        "room": room,
        "clutter": clutter,
    }
)
"""Scene name to its builder."""


FILES: Mapping[str, Callable[..., World]] = MappingProxyType(
    {".xml": xml_world, **dict.fromkeys(MESHES, mesh_world)}
)
"""Suffix of a scene file to its loader."""


def world_of(scene: Scene) -> World:
    """Geometry, materials and lamps of a scene.

    Parameters
    ----------
    scene : Scene
        Name out of `WORLDS`, or a file with a suffix out of `FILES`, and its parameters (SI units,
        angles in degrees), plus ``ambient_e``, unmodulated electrons per tap.

    Returns
    -------
    World
        The scene as plain data.

    Raises
    ------
    ValueError
        If the scene, the file or a parameter is unknown or out of range.
    """
    build = _builder(scene.name)
    defaults = {**parameters_of(build), "ambient_e": 0.0}
    params = checked_params(f"scene {scene.name}", defaults, scene.params)
    ambient_e = float(params.pop("ambient_e", 0.0))
    return replace(build(**params), ambient_e=ambient_e)


def _builder(name: str) -> Callable[..., World]:
    """What makes the world of a name or file."""
    path = Path(name)
    if name in WORLDS:
        return WORLDS[name]
    if path.suffix.lower() in FILES and not path.is_dir():
        return partial(FILES[path.suffix.lower()], path)
    known = f"scenes: {', '.join(WORLDS)}; files: {', '.join(FILES)}"
    if name in ("two_returns", "returns"):
        msg = f"{name} plants what follows the first and has no geometry, take analytic; {known}"
    elif path.is_dir():
        msg = f"got the folder {name!r}, wanted a scene file in it; {known}"
    elif path.suffix or path.exists() or "/" in name:
        msg = f"got the file {name!r}, whose kind is not known; {known}"
    else:
        msg = f"unknown scene {name!r}; {known}"
    raise ValueError(msg)


def from_dict(
    description: Mapping[str, Any],
    *,
    to_world: ArrayLike | None = None,
    folder: Path | None = None,
    unit_m: float = 1.0,
    lamp_gain: float = 1.0,
    ambient_e: float = 0.0,
    modulated_s: Mapping[str, float] = MappingProxyType({}),
    velocity_mps: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> World:
    """World of a Mitsuba scene dictionary, as `mitsuba.load_dict` takes it.

    Parameters
    ----------
    description : mapping
        The dictionary; its integrator does not count, and of its sensor only the pose.
    to_world : array_like, (4, 4), or None
        Pose of the camera, as `world.look_at` makes it; None takes that of the dictionary's sensor.
    folder : Path or None
        Where relative file names start.
    unit_m : float
        Length of one scene unit, m.
    lamp_gain : float
        Radiance 1 of a lamp counts as ``lamp_gain * Noise.signal_e`` electrons per tap.
    ambient_e : float
        Unmodulated charge per tap on every pixel, electrons.
    modulated_s : mapping of str to float
        Ids of the lamps that are modulated, with the delay of each, s.
    velocity_mps : mapping of str to array_like, (3,)
        Velocity in the camera frame of what moves, by id, m/s; ``camera`` moves the camera.

    Returns
    -------
    World
        The scene.

    Raises
    ------
    ValueError
        If it is no dictionary, or a pose, a length or a gain is impossible.
    """
    if not isinstance(description, Mapping):
        msg = (
            f"got {type(description).__name__}, wanted a Mitsuba dictionary such as {{'ball': ...}}"
        )
        raise ValueError(msg)
    entries = {key: value for key, value in description.items() if key != "integrator"}
    return World(
        entries,
        folder=folder,
        to_world=None if to_world is None else np.asarray(to_world, np.float64),
        unit_m=unit_m,
        lamp_gain=lamp_gain,
        ambient_e=ambient_e,
        modulated_s=modulated_s,
        velocity_mps={k: np.asarray(v, np.float64) for k, v in velocity_mps.items()},
    )
