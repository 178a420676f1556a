"""Bricks of the procedural scenes: materials, planes, quads, boxes, prisms, spheres, turned bodies.

Every function gives an entry of a Mitsuba scene dictionary as plain data, without Mitsuba. Lengths
are in m; the procedural scenes use the frame of the camera (x right, y down, z forward).
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from toftools.sim.shapes import check_albedo
from toftools.types import F64

Entry = dict[str, Any]


def _sided(**bsdf: object) -> Entry:
    return {"type": "twosided", "bsdf": bsdf}


def _checker(albedo: float) -> Entry:
    squares = {
        "type": "checkerboard",
        "color0": albedo,
        "color1": albedo / 4,
        "to_uv": np.diag([5.0, 5.0, 1.0, 1.0]),  # two squares in a fifth of a unit of uv
    }
    return _sided(type="diffuse", reflectance=squares)


MATERIALS: Mapping[str, Callable[[float], Entry]] = MappingProxyType(
    {
        "diffuse": lambda albedo: _sided(type="diffuse", reflectance=albedo),
        "rough_conductor": lambda albedo: _sided(
            type="roughconductor", material="none", alpha=0.2, specular_reflectance=albedo
        ),
        "mirror": lambda albedo: _sided(
            type="conductor", material="none", specular_reflectance=albedo
        ),
        "plastic": lambda albedo: _sided(
            type="roughplastic", diffuse_reflectance=albedo, alpha=0.1, int_ior=1.5, ext_ior=1.0
        ),
        "checker": _checker,
        "dielectric": lambda _albedo: glass(1.5),
    }
)
"""Material name to its entry for an albedo, which scales the reflection of metals and mirrors and
the body of plastic; a checker board is four times darker on every other square."""

OPAQUE = tuple(name for name in MATERIALS if name != "dielectric")
SOLID = tuple(MATERIALS)


def glass(index: float) -> Entry:
    """Smooth glass in vacuum: light is slower inside by `index`."""
    return {"type": "dielectric", "int_ior": float(index), "ext_ior": 1.0}


def material(name: str, albedo: float, *, allowed: tuple[str, ...] = OPAQUE) -> Entry:
    """A material out of `MATERIALS`, refused where the shape cannot have it.

    Parameters
    ----------
    name : str
        Name of the material.
    albedo : float
        Albedo, 0..1.
    allowed : tuple of str
        Names that the shape can have: glass needs a closed one, a checker board coordinates.

    Returns
    -------
    dict
        The entry of a ``bsdf``.

    Raises
    ------
    ValueError
        If there is no such material here, or the albedo is none.
    """
    check_albedo(albedo)
    if name not in allowed:
        msg = f"got material {name!r}, wanted one of: {', '.join(allowed)}"
        raise ValueError(msg)
    return MATERIALS[name](float(albedo))


def plane(
    at: ArrayLike, right: ArrayLike, up: ArrayLike, bsdf: Entry, *, reach: float = 512.0
) -> Entry:
    """A plane without an end, for all that a camera near it can tell.

    It is a grid whose cells grow eightfold with every ring, so that hits stay exact to single
    precision near its middle, where one huge triangle would cost four digits.

    Parameters
    ----------
    at : array_like, (3,)
        Middle of the plane.
    right, up : array_like, (3,)
        Orthogonal vectors along the plane, as long as half the middle cell; it faces their cross
        product.
    bsdf : dict
        Material; textures have coordinates in m.
    reach : float
        Where the plane ends, in lengths of `right`; 512 is 89.9 degrees off a camera that stands
        one of them away.

    Returns
    -------
    dict
        An ``arrays`` entry.
    """
    rings = [r for r in (1.0, 8.0, 64.0) if r < reach] + [reach]
    ticks = np.array([-r for r in reversed(rings)] + rings)
    a, b = (x.reshape(-1, 1) for x in np.meshgrid(ticks, ticks, indexing="ij"))
    right, up = np.asarray(right, np.float64), np.asarray(up, np.float64)
    n = len(ticks)
    low = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = [[low, low + n, low + n + 1], [low, low + n + 1, low + 1]]
    return {
        "type": "arrays",
        "vertices": np.asarray(at, np.float64) + a * right + b * up,
        "faces": np.concatenate([np.stack(corners, axis=1) for corners in faces]),
        "uv": np.hstack([a * np.linalg.norm(right), b * np.linalg.norm(up)]),
        "bsdf": bsdf,
    }


def quad(centre: ArrayLike, right: ArrayLike, up: ArrayLike, bsdf: Entry) -> Entry:
    """A rectangle, from its centre and the vectors to the middles of two sides."""
    pose: F64 = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 3] = right, up, centre
    normal = np.cross(pose[:3, 0], pose[:3, 1])
    pose[:3, 2] = normal / np.linalg.norm(normal)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf}


def turned(yaw_deg: float) -> F64:
    """Rotation about y, the vertical."""
    turn = np.radians(yaw_deg)
    return np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])


def box(centre: ArrayLike, half: ArrayLike, yaw_deg: float, bsdf: Entry) -> Entry:
    """A box, turned by `yaw_deg` about y; from its centre and half its sides."""
    pose: F64 = np.eye(4)
    pose[:3, :3] = turned(yaw_deg) * np.asarray(half, np.float64)
    pose[:3, 3] = centre
    return {"type": "cube", "to_world": pose, "bsdf": bsdf}


def sphere(centre: ArrayLike, radius: float, bsdf: Entry) -> Entry:
    """An exact sphere."""
    at = np.asarray(centre, np.float64).tolist()
    return {"type": "sphere", "center": at, "radius": float(radius), "bsdf": bsdf}


def prism(
    foot: ArrayLike, radius: float, height: float, sides: int, yaw_deg: float, bsdf: Entry
) -> Entry:
    """An upright prism over a regular polygon: `foot` is the middle of its lower end, y downwards.

    Parameters
    ----------
    foot : array_like, (3,)
        Middle of the lower end, m.
    radius, height : float
        Circumradius of the polygon and length of the prism, m.
    sides : int
        Corners of the polygon.
    yaw_deg : float
        Turn about y, degrees.
    bsdf : dict
        Material.

    Returns
    -------
    dict
        An ``arrays`` entry with normals outwards.
    """
    angle = np.radians(yaw_deg) + np.arange(sides) * (2 * np.pi / sides)
    ring = np.stack([radius * np.cos(angle), np.zeros(sides), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring, ring - [0, height, 0]]) + np.asarray(foot, np.float64)
    faces = []
    for i in range(sides):
        j = (i + 1) % sides
        faces += [[i, j, i + sides], [j, j + sides, i + sides]]
        if 0 < i < sides - 1:
            faces += [[0, j, i], [sides, i + sides, j + sides]]
    return {"type": "arrays", "vertices": vertices, "faces": np.array(faces), "bsdf": bsdf}


def lathe(foot: ArrayLike, profile: ArrayLike, bsdf: Entry, *, sides: int = 32) -> Entry:
    """A body turned about the vertical: `foot` is where its axis stands, y downwards.

    Parameters
    ----------
    foot : array_like, (3,)
        Lower end of the axis, m.
    profile : array_like, (N, 2)
        Distances from the axis and heights, m; a body is closed where both ends lie on the axis.
    bsdf : dict
        Material.
    sides : int
        Flat sides all around.

    Returns
    -------
    dict
        An ``arrays`` entry.
    """
    radius, height = np.asarray(profile, np.float64).T
    angle = np.arange(sides) * (2 * np.pi / sides)
    rows = [np.outer(radius, np.cos(angle)), np.repeat(-height[:, None], sides, axis=1),
            np.outer(radius, np.sin(angle))]  # fmt: skip
    vertices = np.stack(rows, axis=-1).reshape(-1, 3) + np.asarray(foot, np.float64)
    low = (np.arange(len(radius) - 1)[:, None] * sides + np.arange(sides)).ravel()
    beside = low - low % sides + (low + 1) % sides
    faces = np.concatenate([
        np.stack([low, beside, beside + sides], axis=1),
        np.stack([low, beside + sides, low + sides], axis=1),
    ])  # fmt: skip
    corner = vertices[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    return {"type": "arrays", "vertices": vertices, "faces": faces[area > 0], "bsdf": bsdf}


def backdrop(z: float, nearer: float, albedo: float) -> dict[str, Entry]:
    """Endless wall behind a scene that ends at `nearer`, or nothing for z = 0."""
    if z == 0:
        return {}
    if z <= nearer:
        msg = f"got wall={z}, wanted 0 for none or more than {nearer:.6g} m, where the scene ends"
        raise ValueError(msg)
    return {"wall": plane([0, 0, z], [z, 0, 0], [0, -z, 0], material("diffuse", albedo))}
