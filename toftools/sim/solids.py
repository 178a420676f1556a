"""Bricks of the procedural scenes: materials, planes, quads, boxes and spheres as plain data.

Every function gives entries of a Mitsuba scene dictionary, without Mitsuba. Lengths in m, in
whatever frame the caller uses; the procedural scenes use that of the camera (x right, y down, z
forward). Surfaces are two-sided unless they refract.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from toftools.types import F64

Entry = dict[str, Any]


def diffuse(albedo: float) -> Entry:
    """Lambertian surface, the same from both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": float(albedo)}}


def plane(at: ArrayLike, right: ArrayLike, up: ArrayLike, bsdf: Mapping[str, Any]) -> Entry:
    """A plane without an end, for all that a camera near it can tell.

    It is a grid whose cells grow eightfold with every ring, so that hits stay exact to single
    precision near its middle, where one huge triangle would cost four digits.

    Parameters
    ----------
    at : array_like, (3,)
        Point where the middle cell lies.
    right, up : array_like, (3,)
        Orthogonal vectors along the plane, as long as the middle cell's half side; the plane ends
        512 of them out, 89.9 degrees off a camera that stands one of them away.
    bsdf : mapping
        Material.

    Returns
    -------
    dict
        An ``arrays`` entry.
    """
    ticks = np.array([-512.0, -64.0, -8.0, -1.0, 1.0, 8.0, 64.0, 512.0])
    a, b = np.meshgrid(ticks, ticks, indexing="ij")
    vertices = (
        np.asarray(at, np.float64)
        + a.reshape(-1, 1) * np.asarray(right, np.float64)
        + b.reshape(-1, 1) * np.asarray(up, np.float64)
    )
    n = len(ticks)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    low = i * n + j
    faces = np.concatenate(
        [np.stack([low, low + n, low + n + 1], 1), np.stack([low, low + n + 1, low + 1], 1)]
    )
    uv = np.stack([a.ravel(), b.ravel()], axis=1)
    return {"type": "arrays", "vertices": vertices, "faces": faces, "uv": uv, "bsdf": dict(bsdf)}


def quad(centre: ArrayLike, right: ArrayLike, up: ArrayLike, bsdf: Mapping[str, Any]) -> Entry:
    """A rectangle, from its centre and the vectors to the middles of two sides."""
    pose: F64 = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 3] = right, up, centre
    normal = np.cross(pose[:3, 0], pose[:3, 1])
    pose[:3, 2] = normal / np.linalg.norm(normal)
    return {"type": "rectangle", "to_world": pose, "bsdf": dict(bsdf)}


def box(centre: ArrayLike, half: ArrayLike, yaw_deg: float, bsdf: Mapping[str, Any]) -> Entry:
    """A box, turned by `yaw_deg` about y; from its centre and half its sides."""
    turn = np.radians(yaw_deg)
    pose: F64 = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[:3, :3] *= np.asarray(half, np.float64)
    pose[:3, 3] = centre
    return {"type": "cube", "to_world": pose, "bsdf": dict(bsdf)}


def sphere(centre: ArrayLike, radius: float, bsdf: Mapping[str, Any]) -> Entry:
    """An exact sphere."""
    at = np.asarray(centre, np.float64).tolist()
    return {"type": "sphere", "center": at, "radius": float(radius), "bsdf": dict(bsdf)}
