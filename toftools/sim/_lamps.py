"""Lamps of the scene itself: sampled on purpose and by chance, weighted by the balance heuristic.

Lamps are ambient light unless the world marks them modulated; then they carry their own delay.

References
----------
E. Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, chapter 9 (multiple
importance sampling, balance heuristic).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim.stage import Stage
from toftools.units import phase_to_range

Jit = Any
"""A Dr.Jit array or structure; the package has no types."""


@dataclass(frozen=True, eq=False)
class LampLight:
    """Radiance that lamps add to a path.

    Parameters
    ----------
    modulated, ambient : Float
        Radiance with and without modulation, in units of `Noise.signal_e`.
    far_m : Float
        Optical way from the lamp to the surface, the lamp's delay included, m.
    """

    modulated: Jit
    ambient: Jit
    far_m: Jit


def lamps_at(
    mi: Any,  # noqa: ANN401 - the module mitsuba
    stage: Stage,
    si: Jit,
    point: Jit,
    choice: Jit,
    ior: Jit,
    active: Jit,
) -> LampLight:
    """Light of a lamp sampled on purpose, by way of surface points.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    stage : Stage
        Scene.
    si : SurfaceInteraction3f
        Points; ``si.wi`` looks to the viewer.
    point : Point2f
        Random numbers for the place on the lamp.
    choice : Float
        Random number that chooses the lamp.
    ior : Float
        Refractive index on the viewer's side of the points; beyond them is air.
    active : Bool
        Which points count.

    Returns
    -------
    LampLight
        Estimate of the light that is not left to `lamps_hit`.
    """
    import drjit as dr

    scene = stage.scene
    count = len(scene.emitters())
    # Mitsuba takes the lamp from the first number; give it one of its own, kept below one.
    place = mi.Point2f(dr.minimum((dr.floor(choice * count) + point.x) / count, 1 - 1e-7), point.y)
    sample, weight = scene.sample_emitter_direction(si, place, True, active)
    active = active & (sample.pdf > 0)
    wo = si.to_local(sample.d)
    value, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo, active)
    share = dr.select(sample.delta, 1.0, sample.pdf / (sample.pdf + pdf))
    radiance = dr.select(active, value[0] * weight[0] * share, 0.0)
    index = dr.select(si.wi.z * wo.z < 0, 1.0, ior)
    return _split(mi, stage, radiance, sample.emitter, index * sample.dist)


def lamps_hit(
    mi: Any,  # noqa: ANN401
    stage: Stage,
    si: Jit,
    nearby: Jit,
    sample: Jit,
    ior: Jit,
    active: Jit,
) -> LampLight:
    """Light of a lamp that a path met by chance.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    stage : Stage
        Scene.
    si, nearby : SurfaceInteraction3f
        Where the ray left, and what it met (perhaps nothing: then the sky).
    sample : BSDFSample3f
        How its direction was chosen.
    ior : Float
        Refractive index along the ray.
    active : Bool
        Which rays count.

    Returns
    -------
    LampLight
        Estimate of the light that is not left to `lamps_at`.
    """
    import drjit as dr

    lamp = nearby.emitter(stage.scene, active)
    met = active & (lamp != None)  # noqa: E711 - Dr.Jit compares pointers lane by lane
    radiance = lamp.eval(nearby, met)[0]
    towards = mi.DirectionSample3f(stage.scene, nearby, si)
    chance = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    chance |= mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    rival = stage.scene.pdf_emitter_direction(si, towards, met & ~chance)
    share = dr.select(chance, 1.0, sample.pdf / (sample.pdf + rival))
    return _split(mi, stage, dr.select(met, radiance * share, 0.0), lamp, ior * nearby.t)


def lamps_seen(mi: Any, stage: Stage, si: Jit, active: Jit) -> LampLight:  # noqa: ANN401
    """Light of lamps that the camera looks into.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    stage : Stage
        Scene.
    si : SurfaceInteraction3f
        What each pixel sees first (perhaps nothing: then the sky).
    active : Bool
        Which pixels count.

    Returns
    -------
    LampLight
        Radiance; `far_m` is the distance of the lamp.
    """
    import drjit as dr

    lamp = si.emitter(stage.scene, active)
    met = active & (lamp != None)  # noqa: E711 - as above
    return _split(mi, stage, dr.select(met, lamp.eval(si, met)[0], 0.0), lamp, si.t)


def _split(mi: Any, stage: Stage, radiance: Jit, lamp: Jit, far: Jit) -> LampLight:  # noqa: ANN401
    """Radiance by kind of lamp."""
    import drjit as dr

    modulated, delay_m = mi.Bool(False), mi.Float(0)
    for number in np.flatnonzero(stage.lamp_modulated):
        mine = lamp == mi.EmitterPtr(stage.scene.emitters()[int(number)])
        modulated |= mine
        # One turn at 1 Hz is one second of light.
        path_m = 2 * float(phase_to_range(2 * np.pi * stage.lamp_delay_s[number], 1.0))
        delay_m = dr.select(mine, path_m, delay_m)
    radiance = radiance * stage.lamp_gain
    far_m = dr.select(dr.isfinite(far), far * stage.unit_m, 0.0) + delay_m
    return LampLight(dr.select(modulated, radiance, 0), dr.select(modulated, 0, radiance), far_m)
