"""Procedural scenes that need no download, as plain data in the frame of the camera.

Names, parameters and defaults are those of the closed forms in `sim.shapes` where there is one, so
that a renderer and a closed form can be asked about the same scene.
"""

import numpy as np

from toftools.sim.shapes import _check, _check_albedo
from toftools.sim.solids import box, diffuse, plane, quad, sphere
from toftools.sim.world import World


def wall(*, range: float = 2.0, albedo: float = 0.5) -> World:
    """Fronto-parallel Lambertian plane.

    Parameters
    ----------
    range : float
        Distance along the optical axis, m.
    albedo : float
        Diffuse albedo, 0..1.

    Returns
    -------
    World
        The plane.
    """
    return tilted(range=range, tilt=0.0, albedo=albedo)


def tilted(*, range: float = 2.0, tilt: float = 30.0, albedo: float = 0.5) -> World:
    """Lambertian plane turned about the vertical axis through its point on the optical axis.

    Parameters
    ----------
    range : float
        Distance of the plane along the optical axis, m.
    tilt : float
        Angle between the plane's normal and the optical axis, degrees.
    albedo : float
        Diffuse albedo, 0..1.

    Returns
    -------
    World
        The plane.
    """
    _check(range=range)
    _check_albedo(albedo)
    if not -89 <= tilt <= 89:
        msg = f"tilt must lie within +-89 degrees, got {tilt}"
        raise ValueError(msg)
    turn = np.radians(tilt)
    along = range * np.array([np.cos(turn), 0.0, -np.sin(turn)])
    shape = plane([0, 0, range], along, [0, -range, 0], diffuse(albedo))
    return World({"wall": shape})


def cavity(*, radius: float = 2.0, albedo: float = 0.8) -> World:
    """Lambertian sphere seen from its centre.

    Parameters
    ----------
    radius : float
        Sphere radius, m.
    albedo : float
        Diffuse albedo, 0..1, below 1.

    Returns
    -------
    World
        The sphere.
    """
    _check(radius=radius)
    _check_albedo(albedo)
    if albedo >= 1:
        msg = f"a closed cavity needs albedo below 1, got {albedo}"
        raise ValueError(msg)
    return World({"cavity": sphere([0, 0, 0], radius, diffuse(albedo))})


def corner(
    *,
    range: float = 2.0,
    angle: float = 90.0,
    albedo: float = 0.7,
    size: float = 2.0,
    height: float = 3.0,
) -> World:
    """Concave corner of two Lambertian walls with a vertical edge on the optical axis.

    Parameters
    ----------
    range : float
        Distance of the edge along the optical axis, m.
    angle : float
        Angle between the walls, degrees.
    albedo : float
        Diffuse albedo of both walls, 0..1.
    size, height : float
        Extent of each wall away from the edge, and along it, m.

    Returns
    -------
    World
        The walls ``left`` and ``right``.
    """
    _check(range=range, size=size, height=height)
    _check_albedo(albedo)
    if not 10 <= angle < 180:
        msg = f"angle must lie in 10..180 degrees, got {angle}"
        raise ValueError(msg)
    half = np.radians(angle) / 2
    shapes = {}
    for name, side in (("left", -1), ("right", 1)):
        out = np.array([side * np.sin(half), 0.0, -np.cos(half)]) * size / 2
        shapes[name] = quad(
            np.array([0, 0, range]) + out, out, [0, -height / 2, 0], diffuse(albedo)
        )
    return World(shapes)


def cornell(*, size: float = 2.0) -> World:
    """Cornell box with two boxes inside, open towards the camera, without a lamp.

    The proportions are those of the original (C. Goral et al., SIGGRAPH 1984; boxes as in the
    measured data of Cornell University, recalled), the walls a cube. The colours of the original
    end at 700 nm; chosen for 850 nm: white paint 0.8, red 0.75, green 0.5, boxes 0.8.

    Parameters
    ----------
    size : float
        Side of the box, m.

    Returns
    -------
    World
        The box; its opening fills a field of view of 39.3 degrees.
    """
    _check(size=size)
    s = size / 2
    near = s / np.tan(np.radians(39.3077) / 2)
    z = near + s  # centre of the box
    white = diffuse(0.8)
    shapes = {
        "back": quad([0, 0, z + s], [s, 0, 0], [0, -s, 0], white),
        "floor": quad([0, s, z], [s, 0, 0], [0, 0, s], white),
        "ceiling": quad([0, -s, z], [s, 0, 0], [0, 0, s], white),
        "left": quad([-s, 0, z], [0, 0, s], [0, s, 0], diffuse(0.75)),
        "right": quad([s, 0, z], [0, 0, s], [0, s, 0], diffuse(0.5)),
        "small": box([0.33 * s, 0.7 * s, z - 0.4 * s], [0.3 * s] * 3, -17, white),
        "large": box([-0.33 * s, 0.4 * s, z + 0.25 * s], [0.3 * s, 0.6 * s, 0.3 * s], 17, white),
    }
    return World(shapes)
