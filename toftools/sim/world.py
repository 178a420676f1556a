"""A scene as plain data, ready for any rendering engine: geometry, materials, lamps, pose.

Scene builders and file loaders make a `World`; engines load it. Nothing here imports an engine.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

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
        ``vertices`` (N, 3), ``faces`` (M, 3), optional ``normals`` (N, 3), and ``bsdf``.
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
    """

    description: Mapping[str, Any] | str
    folder: Path | None = None
    to_world: F64 | None = field(default_factory=lambda: np.eye(4))
    unit_m: float = 1.0
    ambient_e: float = 0.0
    lamp_gain: float = 0.0
    modulated_s: Mapping[str, float] = field(default_factory=dict)
    velocity_mps: Mapping[str, F64] = field(default_factory=dict)

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
        set_fields(self, velocity_mps=frozen_mapping(self.velocity_mps))
