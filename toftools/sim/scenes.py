"""From the name of a scene to a `World`: the table of all scenes that an engine can render."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

from toftools.registry import checked_params, parameters_of
from toftools.sim.boxes import cornell, prism, vshape
from toftools.sim.planes import cavity, corner, disc, plates, slab, tilted, wall
from toftools.sim.rooms import room
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
    }
)
"""Scene name to its builder."""


def world_of(scene: Scene) -> World:
    """Geometry, materials and lamps of a scene.

    Parameters
    ----------
    scene : Scene
        Name out of `WORLDS` and its parameters (SI units, angles in degrees), plus ``ambient_e``,
        unmodulated electrons per tap.

    Returns
    -------
    World
        The scene as plain data.

    Raises
    ------
    ValueError
        If the scene or a parameter is unknown or out of range.
    """
    if scene.name not in WORLDS:
        msg = f"unknown scene {scene.name!r}; known: {', '.join(WORLDS)}"
        raise ValueError(msg)
    build = WORLDS[scene.name]
    defaults = {**parameters_of(build), "ambient_e": 0.0}
    params = checked_params(f"scene {scene.name}", defaults, scene.params)
    ambient_e = float(params.pop("ambient_e", 0.0))
    return replace(build(**params), ambient_e=ambient_e)
