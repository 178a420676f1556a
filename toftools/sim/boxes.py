"""Procedural scenes of panels, boxes and prisms at the scale of a time-of-flight camera.

All are in the frame of the camera, which stands at the origin; sizes that come from elsewhere say
so, all others are our own choice.
"""

import numpy as np

from toftools.sim import solids
from toftools.sim.shapes import check_positive
from toftools.sim.solids import Entry, box, quad
from toftools.sim.world import World


def _open_box(
    half: tuple[float, float, float], z: float, albedos: dict[str, float]
) -> dict[str, Entry]:
    """Five walls around (0, 0, z), open towards the camera, all facing inwards."""
    x, y, d = half
    sides = {
        "back": ([0, 0, z + d], [x, 0, 0], [0, -y, 0]),
        "floor": ([0, y, z], [x, 0, 0], [0, 0, d]),
        "ceiling": ([0, -y, z], [x, 0, 0], [0, 0, -d]),
        "left": ([-x, 0, z], [0, 0, d], [0, -y, 0]),
        "right": ([x, 0, z], [0, 0, d], [0, y, 0]),
    }
    return {
        name: quad(*side, solids.material("diffuse", albedos[name])) for name, side in sides.items()
    }


def cornell(*, size: float = 2.0, material: str = "diffuse") -> World:
    """Cornell box with two boxes inside, open towards the camera, without a lamp.

    Proportions are those of the measured data of Cornell University (recalled), made a cube. Its
    spectra end at 700 nm; the albedos here are chosen for 850 nm, where pigments differ less than
    to the eye: white paint 0.8, red wall (left) 0.75, green wall (right) 0.5.

    Parameters
    ----------
    size : float
        Side of the box, m; its opening fills a field of view of 39.3 degrees.
    material : str
        Of the two boxes, a name out of `solids.SOLID`.

    Returns
    -------
    World
        The walls ``back``, ``floor``, ``ceiling``, ``left``, ``right``, the boxes ``small`` and
        ``large``.
    """
    check_positive(size=size)
    s = size / 2
    z = s / np.tan(np.radians(39.3077) / 2) + s
    white = dict.fromkeys(("back", "floor", "ceiling"), 0.8)
    shell = _open_box((s, s, s), z, {**white, "left": 0.75, "right": 0.5})
    surface = solids.material(material, 0.8, allowed=solids.SOLID)
    # Both stand 0.1 mm clear of the floor: shared faces would be hit at random.
    floor = s - 1e-4 * s
    small = box([0.33 * s, floor - 0.3 * s, z - 0.39 * s], [0.3 * s] * 3, 17, surface)
    tall = [0.3 * s, 0.6 * s, 0.3 * s]
    large = box([-0.33 * s, floor - 0.6 * s, z + 0.26 * s], tall, -17, surface)
    return World({**shell, "small": small, "large": large})


def vshape(
    *,
    range: float = 1.5,
    angle: float = 90.0,
    size: float = 0.6,
    height: float = 0.8,
    albedo: float = 0.85,
    wall: float = 2.5,
) -> World:
    """V of two panels with a flat panel beside it, before a wall.

    Panels of 0.4 to 1.2 m with an albedo of about 0.85, seen from 0.5 to 2.4 m, are those of the
    real scenes of the reference; their places are our own.

    Parameters
    ----------
    range : float
        Distance to the edge of the V, m.
    angle : float
        Angle between its panels, degrees.
    size, height : float
        Width and height of each panel, m.
    albedo : float
        Diffuse albedo of the panels, 0..1; the wall has 0.5.
    wall : float
        Distance of the wall, m; 0 for none.

    Returns
    -------
    World
        The panels ``left``, ``right`` and ``flat``, and the ``wall``.

    References
    ----------
    J. Marco, "Transient light transport" (thesis, 2018), section 7.7.4.
    """
    check_positive(range=range, size=size, height=height)
    half = np.radians(angle) / 2
    if not (10 <= angle < 180 and size * np.cos(half) < range):
        msg = (
            f"got angle={angle}, size={size}; wanted an angle in 10..180 degrees and panels that "
            f"end in front of the camera, range={range} m from the edge"
        )
        raise ValueError(msg)
    paint, edge = solids.material("diffuse", albedo), np.array([0.0, 0.0, range])
    shapes = solids.backdrop(wall, range, 0.5)
    for name, side in (("left", -1), ("right", 1)):
        out = np.array([side * np.sin(half), 0.0, -np.cos(half)]) * size / 2
        shapes[name] = quad(edge + out, -out, [0, side * height / 2, 0], paint)
    beside = [size * np.sin(half) + 0.6 * size, 0, range - 0.2 * size]
    shapes["flat"] = quad(beside, [size / 3, 0, 0], [0, -height / 2, 0], paint)
    return World(shapes)


def prism(*, range: float = 1.0, albedo: float = 0.85, wall: float = 2.5) -> World:
    """Open box of 600 x 500 x 640 mm with three prisms and a letter E in it, before a wall.

    The box, the kind of its contents and the albedo of about 0.85 are those of the real scenes of
    the reference; sizes and places of the contents are our own.

    Parameters
    ----------
    range : float
        Distance to the opening of the box, m.
    albedo : float
        Diffuse albedo of the box and its contents, 0..1; the wall has 0.5.
    wall : float
        Distance of the wall, m; 0 for none.

    Returns
    -------
    World
        The walls ``back``, ``floor``, ``ceiling``, ``left``, ``right``, the prisms ``prism_3``,
        ``prism_4`` and ``prism_6`` by their corners, the letter ``e_0`` to ``e_3``, and the
        ``wall``.

    References
    ----------
    J. Marco, "Transient light transport" (thesis, 2018), section 7.7.4.
    """
    check_positive(range=range)
    paint = solids.material("diffuse", albedo)
    half = (0.30, 0.25, 0.32)
    names = ("back", "floor", "ceiling", "left", "right")
    shell = _open_box(half, range + half[2], dict.fromkeys(names, albedo))
    floor = half[1] - 1e-4
    shapes: dict[str, Entry] = {
        **shell,
        **solids.backdrop(wall, range + 2 * half[2], 0.5),
        "prism_3": solids.prism([-0.17, floor, range + 0.36], 0.09, 0.22, 3, 20, paint),
        "prism_4": solids.prism([0.02, floor, range + 0.50], 0.08, 0.34, 4, 30, paint),
        "prism_6": solids.prism([0.10, floor, range + 0.22], 0.06, 0.12, 6, 0, paint),
    }
    # The letter stands upright: a stem and three bars, 0.2 mm apart.
    stem = np.array([0.185, floor - 0.10, range + 0.36])
    shapes["e_0"] = box(stem, [0.015, 0.10, 0.015], 0, paint)
    for i, up in enumerate((-0.085, 0.0, 0.085), start=1):
        at = stem + np.array([0.0452, up, 0.0])
        shapes[f"e_{i}"] = box(at, [0.03, 0.015, 0.015], 0, paint)
    return World(shapes)
