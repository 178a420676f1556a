"""A scene as plain data, ready for any rendering engine: geometry, materials, lamps, pose.

Scene builders and file loaders make a `World`; engines load it. Nothing here imports an engine.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from toftools._arrays import expect_shape, frozen, frozen_mapping, set_fields
from toftools.types import F64


@dataclass(frozen=True, eq=False)
class World:
    """Geometry, materials and lamps, with the place of the camera.

    Parameters
    ----------
    description : mapping or str
        A Mitsuba scene dictionary of shapes, materials and lamps (without integrator and sensor),
        or the text of a Mitsuba 3 scene file. A dictionary entry of type ``arrays`` is a mesh:
        ``vertices`` (N, 3), ``faces`` (M, 3), optional ``normals`` (N, 3) and ``uv`` (N, 2), and
        ``bsdf``. A (4, 4) array is a transformation.
    folder : Path or None
        Where relative file names of the description start.
    to_world : ndarray, (4, 4), or None
        Rigid pose: camera frame (x right, y down, z forward) to scene, both in scene units; None
        takes the pose of the description's own sensor.
    unit_m : float
        Length of one scene unit, m.
    ambient_e : float
        Unmodulated charge per tap on every pixel, electrons.
    lamp_gain : float
        Charge of the description's lamps: radiance 1 adds ``lamp_gain * Noise.signal_e`` electrons
        per tap; 0 switches lamps off.
    modulated_s : mapping of str to float
        Ids of lamps that carry the modulation, with the delay of each, s; all others are ambient.
    velocity_mps : mapping of str to ndarray, (3,)
        Velocity in the camera frame of shapes that move, by id, m/s; the id ``camera`` moves the
        camera itself.
    notes : tuple of str
        What a loader changed in the description of a file, a sentence each.
    """

    description: Mapping[str, Any] | str
    folder: Path | None = None
    to_world: F64 | None = field(default_factory=lambda: np.eye(4))
    unit_m: float = 1.0
    ambient_e: float = 0.0
    lamp_gain: float = 0.0
    modulated_s: Mapping[str, float] = field(default_factory=dict)
    velocity_mps: Mapping[str, F64] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.to_world is not None:
            pose = frozen(self.to_world, np.float64, "to_world", 2)
            expect_shape("to_world", pose, (4, 4))
            turn = pose[:3, :3]
            if not (np.isfinite(pose).all() and np.allclose(turn @ turn.T, np.eye(3), atol=1e-4)):
                msg = f"to_world must be a rotation and a translation, got {pose.tolist()}"
                raise ValueError(msg)
            set_fields(self, to_world=pose)
        if not (np.isfinite(self.unit_m) and self.unit_m > 0):
            msg = f"unit_m must be a positive number of metres, got {self.unit_m}"
            raise ValueError(msg)
        for name in ("ambient_e", "lamp_gain"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                msg = f"{name} must be 0 or more, got {value}"
                raise ValueError(msg)
        set_fields(self, modulated_s=frozen_mapping(self.modulated_s))
        velocity = {name: vector(name, value) for name, value in self.velocity_mps.items()}
        set_fields(self, velocity_mps=frozen_mapping(velocity))


def vector(name: str, value: ArrayLike) -> F64:
    """Three finite numbers, refused by their name if they are not."""
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        msg = f"{name} must be three finite numbers joined by +, such as 0+0+1.5, got {value!r}"
        raise ValueError(msg)
    return numbers


def look_at(camera: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 1.0, 0.0)) -> F64:
    """Pose of a camera that looks from one point at another.

    Parameters
    ----------
    camera, target : array_like, (3,)
        The two points, scene units.
    up : array_like, (3,)
        Direction that shall point upwards in the image.

    Returns
    -------
    ndarray, (4, 4)
        Camera frame (x right, y down, z forward) to scene.

    Raises
    ------
    ValueError
        If the points coincide, or `up` is along the line of sight.

    Examples
    --------
    >>> look_at((0, 0, 5), (0, 0, 0))[:3, :3] @ [1, 2, 3] + 0  # right, down, forward
    array([ 1., -2., -3.])
    """
    at, to, top = vector("camera", camera), vector("target", target), vector("up", up)
    forward = to - at
    right = np.cross(forward, top)
    if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(forward) * np.linalg.norm(top):
        msg = f"got camera={at}, target={to}, up={top}: the line of sight must not lie on up"
        raise ValueError(msg)
    pose: F64 = np.eye(4)
    pose[:3, 0] = right / np.linalg.norm(right)
    pose[:3, 2] = forward / np.linalg.norm(forward)
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    pose[:3, 3] = at
    return pose


def world_at(world: World, time_s: float) -> World:
    """The world after all that moves has moved.

    Parameters
    ----------
    world : World
        The world at time 0.
    time_s : float
        Time, s.

    Returns
    -------
    World
        The same world with moved shapes and camera.

    Raises
    ------
    ValueError
        If something moves that the description does not name, or in a frame that it leaves open.
    """
    if not world.velocity_mps:
        return world
    if world.to_world is None:
        msg = "motion needs the pose of the camera; give camera=x+y+z and target=x+y+z"
        raise ValueError(msg)
    pose: F64 = world.to_world.copy()
    named = {} if isinstance(world.description, str) else dict(world.description)
    for name, velocity in world.velocity_mps.items():
        step = world.to_world[:3, :3] @ velocity * (time_s / world.unit_m)
        if name == "camera":
            pose[:3, 3] += step
        elif name in named:
            named[name] = _shifted(named[name], step)
        else:
            msg = f"got a velocity for {name!r}, which moves nothing; wanted camera or one of: "
            raise ValueError(msg + (", ".join(named) or "no shape, as the scene is a file"))
    return replace(world, to_world=pose, description=named or world.description)


def _shifted(entry: Mapping[str, Any], step: F64) -> dict[str, Any]:
    if entry["type"] == "arrays":
        return {**entry, "vertices": np.asarray(entry["vertices"], np.float64) + step}
    pose = entry.get("to_world", np.eye(4))  # an array, or a transformation of Mitsuba's
    moved = np.array(getattr(pose, "matrix", pose), dtype=np.float64).reshape(4, 4)
    moved[:3, 3] += step
    return {**entry, "to_world": moved}
