"""What a loaded Mitsuba scene must be before anything is traced in it; one sentence if it is not.

Mitsuba itself takes albedos above 1 and NaN, and renders black from inside of things.
"""

import re
from typing import Any

import numpy as np

from toftools.types import F64

SLACK = 1e-5
"""What rounding may add to an albedo of 1."""
RULES = (
    (re.compile(r"(reflectance|transmittance|base_color)(\.|$)"), 0.0, 1 + SLACK, "0..1"),
    (re.compile(r"\.(radiance|intensity|irradiance)(\.|$)"), 0.0, np.inf, "0 or more"),
    (re.compile(r"\.(vertex_positions|alpha|eta|k|opacity)(\.|$)"), -np.inf, np.inf, "finite ones"),
)
"""Scene parameters by name, their least and most, and that in words."""
TOUCH_M = 1e-3
DIRECTIONS = 4096
ALL = 0.95
"""Share of all directions that counts as practically all: meshes have small holes."""


def bounds_hold(scene: Any) -> bool:  # noqa: ANN401 - Mitsuba has no types
    """Whether every mesh lies in its own bounding box.

    Mitsuba 3.9 forgets rectangles in the box of a mesh that it merged from them, and then the light
    of a sky shines through the walls of a closed room.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene.

    Returns
    -------
    bool
        False if a box is wrong.
    """
    for shape in scene.shapes():
        if not shape.is_mesh() or not shape.face_count():
            continue
        corners = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
        low, high = np.array(shape.bbox().min), np.array(shape.bbox().max)
        if (corners < low).any() or (corners > high).any():
            return False
    return True


def check_values(mi: Any, scene: Any) -> None:  # noqa: ANN401 - Mitsuba has no types
    """Refuse albedos outside 0..1, negative lamps and numbers that are none.

    Parameters
    ----------
    mi : module
        Mitsuba.
    scene : mitsuba.Scene
        The scene.

    Raises
    ------
    ValueError
        If a value is not possible.
    """
    for key, value in mi.traverse(scene):
        for pattern, least, most, wanted in RULES:
            values = _numbers(value) if pattern.search(key) else np.zeros(0)
            good = np.isfinite(values) & (values >= least) & (values <= most)
            if not good.all():
                msg = f"{key} of the scene holds {values[~good][0]:g}, wanted numbers: {wanted}"
                raise ValueError(msg)


def _numbers(value: Any) -> F64:  # noqa: ANN401
    """Real numbers of a parameter; none of bytes, which textures keep unscaled, and of others."""
    array = np.asarray(value)
    return array.ravel().astype(np.float64) if array.dtype.kind == "f" else np.zeros(0)


def check_view(mi: Any, scene: Any, to_world: F64, unit_m: float) -> None:  # noqa: ANN401
    """Refuse a camera with nothing before it, that touches a surface, or stands inside a thing.

    Inside is where practically every direction ends on the back of one opaque shape, or on black
    backs of one-sided surfaces. A room of several walls, and one whose normals look inwards, are
    no things in this sense.

    Parameters
    ----------
    mi : module
        Mitsuba.
    scene : mitsuba.Scene
        The scene.
    to_world : ndarray, (4, 4)
        Pose of the camera, scene units.
    unit_m : float
        Length of a scene unit, m.

    Raises
    ------
    ValueError
        If the camera cannot see.
    """
    import drjit

    _check_extent(scene)
    centre, away, touch = to_world[:3, 3], _directions(), TOUCH_M / unit_m
    if _nothing_in_front(scene, to_world):
        msg = "the camera sees nothing: all shapes lie behind it; move it or turn it"
        raise ValueError(msg)
    # From behind the camera to before it, so that a surface right at it is met as well.
    near = _cast(mi, scene, centre - touch * away, away, 2 * touch)
    met = np.flatnonzero(np.asarray(near.is_valid()))
    if met.size:
        msg = f"the camera touches {_name(near, met[0])}; wanted 1 mm or more between them, move it"
        raise ValueError(msg)
    hits = _cast(mi, scene, centre + 0 * away, away, np.inf)
    back = np.asarray(hits.is_valid()) & ((np.array(hits.n).T * away).sum(axis=1) > 0)
    flags = hits.bsdf().flags()
    back &= ~np.asarray(mi.has_flag(flags, mi.BSDFFlags.Transmission))
    if back.mean() < ALL:
        return
    black = back & ~np.asarray(mi.has_flag(flags, mi.BSDFFlags.BackSide))
    shape = np.array(drjit.reinterpret_array(mi.UInt32, hits.shape))
    if black.mean() >= ALL or np.bincount(shape[back]).max() >= ALL * len(away):
        msg = (
            f"the camera stands inside {_name(hits, np.flatnonzero(back)[0])}; move it, or turn "
            "the normals (flip_normals) of what is meant to be seen from inside"
        )
        raise ValueError(msg)


def _check_extent(scene: Any) -> None:  # noqa: ANN401
    """Refuse a scene without surfaces, or with surfaces that lie nowhere."""
    if not scene.shapes():
        msg = "the scene has no shapes; wanted at least one surface to look at"
        raise ValueError(msg)
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() == 0:
            msg = f"the mesh {shape.id()!r} of the scene has no faces; wanted at least one"
            raise ValueError(msg)
        box = shape.bbox()
        if not np.isfinite([*box.min, *box.max]).all():
            msg = f"the shape {shape.id()!r} of the scene has no finite place and size"
            raise ValueError(msg)


def _directions() -> F64:
    """Unit vectors all around, evenly spread along a Fibonacci spiral."""
    i = np.arange(DIRECTIONS) + 0.5
    z = 1 - 2 * i / DIRECTIONS
    turn = i * np.pi * (1 + np.sqrt(5))
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _nothing_in_front(scene: Any, to_world: F64) -> bool:  # noqa: ANN401
    """Whether the whole bounding box lies behind the image plane through the camera centre."""
    box = scene.bbox()
    corners = np.array(np.meshgrid(*zip(box.min, box.max, strict=True))).reshape(3, -1)
    return bool((to_world[:3, 2] @ (corners - to_world[:3, 3:]) <= 0).all())


def _cast(mi: Any, scene: Any, origins: F64, directions: F64, reach: float) -> Any:  # noqa: ANN401
    ray = mi.Ray3f(
        mi.Point3f(np.ascontiguousarray(origins.T, dtype=np.float32)),
        mi.Vector3f(np.ascontiguousarray(directions.T, dtype=np.float32)),
    )
    ray.maxt = reach
    return scene.ray_intersect(ray)


def _name(hits: Any, index: int) -> str:  # noqa: ANN401
    """What a ray has met, in words."""
    name = hits.shape[int(index)].id()
    return f"the shape {name!r}" if name else "a shape"
