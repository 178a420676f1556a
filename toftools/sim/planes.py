"""Procedural scenes of planes and spheres, those with a closed form above all.

Names, parameters and defaults are those of the closed forms in `sim.shapes` where there is one, so
that a renderer and a closed form can be asked about the same scene. All are in the frame of the
camera, which stands at the origin.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from toftools.sim import solids
from toftools.sim.shapes import check_albedo, check_positive
from toftools.sim.solids import glass, plane, quad, sphere
from toftools.sim.world import World

STILL = (0.0, 0.0, 0.0)


def moving(name: str, velocity: ArrayLike) -> dict[str, Any]:
    """Field `velocity_mps` of a world where one thing may move."""
    return {name: velocity} if np.any(velocity) else {}


def wall(
    *,
    range: float = 2.0,
    albedo: float = 0.5,
    material: str = "diffuse",
    velocity: tuple[float, float, float] = STILL,
) -> World:
    """Fronto-parallel plane.

    Parameters
    ----------
    range : float
        Distance along the optical axis, m.
    albedo : float
        Diffuse albedo, 0..1.
    material : str
        Name out of `solids.OPAQUE`.
    velocity : tuple of 3 floats
        Velocity in the camera frame, m/s.

    Returns
    -------
    World
        The plane ``wall``.
    """
    return tilted(range=range, tilt=0.0, albedo=albedo, material=material, velocity=velocity)


def tilted(
    *,
    range: float = 2.0,
    tilt: float = 30.0,
    albedo: float = 0.5,
    material: str = "diffuse",
    velocity: tuple[float, float, float] = STILL,
) -> World:
    """Plane turned about the vertical axis through its point on the optical axis.

    Parameters
    ----------
    range : float
        Distance of the plane along the optical axis, m.
    tilt : float
        Angle between the plane's normal and the optical axis, degrees.
    albedo : float
        Diffuse albedo, 0..1.
    material : str
        Name out of `solids.OPAQUE`.
    velocity : tuple of 3 floats
        Velocity in the camera frame, m/s.

    Returns
    -------
    World
        The plane ``wall``.
    """
    check_positive(range=range)
    if not -89 <= tilt <= 89:
        msg = f"tilt must lie within +-89 degrees, got {tilt}"
        raise ValueError(msg)
    turn = np.radians(tilt)
    along = range * np.array([np.cos(turn), 0.0, -np.sin(turn)])
    shape = plane([0, 0, range], along, [0, -range, 0], solids.material(material, albedo))
    return World({"wall": shape}, velocity_mps=moving("wall", velocity))


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
        The sphere ``cavity``.
    """
    check_positive(radius=radius)
    check_albedo(albedo)
    if albedo >= 1:
        msg = f"a closed cavity needs albedo below 1, got {albedo}"
        raise ValueError(msg)
    shape = sphere([0, 0, 0], radius, solids.material("diffuse", albedo))
    return World({"cavity": {**shape, "flip_normals": True}})


def corner(
    *,
    range: float = 2.0,
    angle: float = 90.0,
    albedo: float = 0.7,
    size: float = 2.0,
    height: float = 3.0,
    material: str = "diffuse",
) -> World:
    """Concave corner of two walls with a vertical edge on the optical axis.

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
    material : str
        Name out of `solids.OPAQUE`.

    Returns
    -------
    World
        The walls ``left`` and ``right``.
    """
    check_positive(range=range, size=size, height=height)
    if not 10 <= angle < 180:
        msg = f"angle must lie in 10..180 degrees, got {angle}"
        raise ValueError(msg)
    half, edge = np.radians(angle) / 2, np.array([0.0, 0.0, range])
    shapes = {}
    for name, side in (("left", -1), ("right", 1)):
        out = np.array([side * np.sin(half), 0.0, -np.cos(half)]) * size / 2
        up = [0.0, side * height / 2, 0.0]  # both face each other
        shapes[name] = quad(edge + out, -out, up, solids.material(material, albedo))
    return World(shapes)


def plates(
    *, gap: float = 2.0, range: float = 1.0, albedo: float = 0.8, size: float = 100.0
) -> World:
    """Two parallel square plates across the optical axis, with the camera between them.

    Parameters
    ----------
    gap : float
        Distance between the plates, m.
    range : float
        Distance from the camera to the plate in front, below `gap`, m.
    albedo : float
        Diffuse albedo of both, 0..1.
    size : float
        Side of the plates, m.

    Returns
    -------
    World
        The plates ``front`` and ``back``.
    """
    check_positive(gap=gap, range=range, size=size)
    if range >= gap:
        msg = f"the camera stands between the plates: got range={range}, wanted less than gap={gap}"
        raise ValueError(msg)
    cell = min(gap, size / 4)
    return World(
        {
            name: plane(
                [0, 0, z],
                [cell, 0, 0],
                [0, up * cell, 0],
                solids.material("diffuse", albedo),
                reach=size / 2 / cell,
            )
            for name, z, up in (("front", range, -1), ("back", range - gap, 1))
        }
    )


def disc(
    *,
    range: float = 1.0,
    gap: float = 2.0,
    radius: float = 0.5,
    albedo: float = 0.8,
    radiance: float = 0.0,
) -> World:
    """A disc that faces an endless wall; the camera looks at the wall from between, on the axis.

    As a uniform lamp (`radiance` above 0) it lights the point of the wall on the axis by
    ``2 gap^2 / d^3`` per length of leg d from gap to sqrt(gap^2 + radius^2): the integrand of
    parallel plates, cut short.

    Parameters
    ----------
    range : float
        Distance from the camera to the wall, below `gap`, m.
    gap : float
        Distance between wall and disc, m.
    radius : float
        Radius of the disc, m.
    albedo : float
        Diffuse albedo of both, 0..1.
    radiance : float
        Radiance of the disc, modulated without delay: 1 is what a white surface at 1 m sends back
        of the camera's own light.

    Returns
    -------
    World
        The shapes ``wall`` and ``disc``.
    """
    check_positive(range=range, gap=gap, radius=radius)
    if range >= gap or not radiance >= 0:
        msg = (
            "the camera stands between wall and disc: got "
            f"range={range}, radiance={radiance}, wanted range below gap={gap} and radiance >= 0"
        )
        raise ValueError(msg)
    pose = np.diag([radius, radius, 1.0, 1.0])
    pose[2, 3] = range - gap
    surface = solids.material("diffuse", albedo)
    plate = {"type": "disk", "to_world": pose, "bsdf": surface}
    if radiance > 0:
        plate["emitter"] = {"type": "area", "radiance": float(radiance)}
    front = plane([0, 0, range], [gap, 0, 0], [0, -gap, 0], surface)
    lit = {"disc": 0.0} if radiance > 0 else {}
    return World({"wall": front, "disc": plate}, lamp_gain=float(bool(lit)), modulated_s=lit)


def slab(
    *,
    range: float = 2.0,
    thickness: float = 0.1,
    index: float = 1.5,
    gap: float = 0.5,
    albedo: float = 0.5,
) -> World:
    """An endless pane of glass in front of a wall: on the axis it adds (index - 1) thickness.

    Parameters
    ----------
    range : float
        Distance from the camera to the wall, m.
    thickness : float
        Thickness of the glass, m.
    index : float
        Its refractive index, above 1.
    gap : float
        Distance between glass and wall, m.
    albedo : float
        Diffuse albedo of the wall, 0..1.

    Returns
    -------
    World
        The wall ``wall``, and the faces ``near`` and ``far`` of the glass.
    """
    check_positive(range=range, thickness=thickness, gap=gap)
    if not (1 < index <= 4 and gap + thickness < range):
        msg = (
            f"got index={index}, thickness={thickness}, gap={gap}; wanted an index in (1, 4] and "
            f"glass in front of the camera, so gap + thickness below range={range}"
        )
        raise ValueError(msg)
    far, across = range - gap, [range, 0, 0]
    shapes = {
        "wall": plane([0, 0, range], across, [0, -range, 0], solids.material("diffuse", albedo)),
        "near": plane([0, 0, far - thickness], across, [0, -range, 0], glass(index)),
        "far": plane([0, 0, far], across, [0, range, 0], glass(index)),
    }
    return World(shapes)
