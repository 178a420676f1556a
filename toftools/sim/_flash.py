"""The camera's own light sources as the tracer sees them: points with a beam, in the scene.

A source of strength 1 has radiant intensity pi on its axis, so that a white, fronto-parallel
surface at 1 m has radiance 1: the unit of `Noise.signal_e`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._holes import share_seen
from toftools.sim.stage import Stage
from toftools.types import Sensor
from toftools.units import phase_to_range

Jit = Any
"""A Dr.Jit array; the package has no types."""

_TABLE = 2048  # entries of a resampled beam, 0.09 degrees apart


@dataclass(frozen=True, eq=False)
class Flash:
    """One point source, placed in the scene.

    Parameters
    ----------
    position : ndarray, (3,)
        Place, scene units.
    axis : ndarray, (3,)
        Unit vector along the optical axis.
    at_camera : bool
        Whether it sits in the camera centre, where what the camera sees is lit.
    beam : Float or None
        Intensity from 0 to 180 degrees off the axis in equal steps; None is isotropic.
    strength : float
        Intensity on the axis.
    modulated : bool
        Whether it carries the modulation.
    delay_m : float
        Its delay as a path, m.
    """

    position: Any
    axis: Any
    at_camera: bool
    beam: Jit
    strength: float
    modulated: bool
    delay_m: float


def flashes_of(mi: Any, stage: Stage, sensor: Sensor) -> tuple[Flash, ...]:  # noqa: ANN401
    """All sources of a sensor, placed in a scene.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    stage : Stage
        Scene and pose.
    sensor : Sensor
        Its `sources`.

    Returns
    -------
    tuple of Flash
        One per source.
    """
    turn, origin = stage.to_world[:3, :3], stage.to_world[:3, 3]
    made = []
    for source in sensor.sources:
        offset = np.asarray(source.offset_m)
        beam = None
        if source.beam is not None:
            angles = np.linspace(0, 180, _TABLE)
            values = np.interp(angles, source.beam[:, 0], source.beam[:, 1], right=0.0)
            beam = mi.Float(values.astype(np.float32))
        made.append(
            Flash(
                position=origin + turn @ offset / stage.unit_m,
                axis=turn[:, 2],
                at_camera=not offset.any(),
                beam=beam,
                strength=source.strength,
                modulated=source.modulated,
                # One turn at 1 Hz is one second of light.
                delay_m=2 * float(phase_to_range(2 * np.pi * source.delay_s, 1.0)),
            )
        )
    return tuple(made)


def flash_light(
    mi: Any,  # noqa: ANN401
    stage: Stage,
    flash: Flash,
    si: Jit,
    active: Jit,
    *,
    lit: bool = False,
    ior: Jit = 1.0,
) -> tuple[Jit, Jit]:
    """Light that one source sends to the viewer by way of surface points.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    stage : Stage
        Scene.
    flash : Flash
        Source.
    si : SurfaceInteraction3f
        Points; ``si.wi`` looks to the viewer.
    active : Bool
        Which of them count.
    lit : bool
        Whether the source is known to see the points, which saves its shadow rays.
    ior : Float
        Refractive index on the viewer's side of the points; beyond them is air.

    Returns
    -------
    Float
        Radiance towards the viewer, 0 where the point lies in shadow.
    Float
        Optical path from the source, its delay included, m.
    """
    import drjit as dr

    place = mi.Point3f(*opaque(mi, flash.position))
    away = place - si.p
    far = dr.norm(away)
    to = away / far
    local = si.to_local(to)
    value = si.bsdf().eval(mi.BSDFContext(), si, local, active)[0]
    dist_m = far * stage.unit_m
    strength, delay_m = opaque(mi, (flash.strength, flash.delay_m))
    value *= dr.pi * strength / dr.square(dist_m)
    if flash.beam is not None:
        axis = mi.Vector3f(*opaque(mi, flash.axis))
        value *= beam_at(mi, flash.beam, dr.safe_acos(-dr.dot(to, axis)), active)
    seen = active & (value > 0)
    if not lit:
        value *= share_seen(mi, stage.scene, si, place, seen)
    optical_m = dr.select(si.wi.z * local.z < 0, 1.0, ior) * dist_m
    return dr.select(seen, value, 0.0), optical_m + delay_m


def opaque(mi: Any, values: Any) -> list[Jit]:  # noqa: ANN401 - module, numbers
    """Numbers that kernels read, so that others do not need other kernels.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    values : iterable of float
        Numbers.

    Returns
    -------
    list of Float
        The same.
    """
    import drjit as dr

    return [dr.opaque(mi.Float, float(value)) for value in values]


def beam_at(mi: Any, beam: Jit, angle: Jit, active: Jit) -> Jit:  # noqa: ANN401
    """Linear interpolation in a beam table."""
    import drjit as dr

    x = angle * ((_TABLE - 1) / np.pi)
    low = dr.minimum(mi.UInt32(x), _TABLE - 2)
    part = x - mi.Float(low)
    first = dr.gather(mi.Float, beam, low, active)
    return first + part * (dr.gather(mi.Float, beam, low + 1, active) - first)
