"""Surfaces with holes, such as leaves cut out of rectangles: light passes where most of it would.

A mask lets light through straight on. What a pixel sees first, and what a source shines on, is
decided by the larger share: a point that lets more than half pass counts as a hole.
"""

from typing import Any

Jit = Any
"""A Dr.Jit array or structure; the package has no types."""

MAX_PASSED = 16
"""Surfaces with a hole that a ray may pass in a row."""


def has_holes(mi: Any, scene: Any) -> bool:  # noqa: ANN401 - modules and scenes of Mitsuba
    """Whether some surface of a scene has holes.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    scene : mitsuba.Scene
        Scene.

    Returns
    -------
    bool
        True if a material lets light pass straight on.
    """
    flags = (s.bsdf().flags() for s in scene.shapes() if s.bsdf() is not None)
    return any(mi.has_flag(flag, mi.BSDFFlags.Null) for flag in flags)


def is_hole(si: Jit, active: Jit) -> Jit:
    """Whether rays go on behind surface points.

    Parameters
    ----------
    si : SurfaceInteraction3f
        Points, or none.
    active : Bool
        Which of them count.

    Returns
    -------
    Bool
        True in a hole.
    """
    met = active & si.is_valid()
    return met & (si.bsdf().eval_null_transmission(si, met)[0] > 0.5)


def blocked(mi: Any, scene: Any, si: Jit, place: Jit, active: Jit) -> Jit:  # noqa: ANN401
    """Whether something stands between surface points and a place.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    scene : mitsuba.Scene
        Scene.
    si : SurfaceInteraction3f
        Points.
    place : Point3f
        The place.
    active : Bool
        Which points count.

    Returns
    -------
    Bool
        True in shadow; holes let light pass.
    """
    import drjit as dr

    ray = si.spawn_ray_to(place)
    if not has_holes(mi, scene):
        return scene.ray_test(ray, active)

    def body(going: Jit, ray: Jit, dark: Jit, passed: Jit) -> tuple[Jit, ...]:
        hit = scene.ray_intersect(ray, going)
        hole = is_hole(hit, going) & (passed < MAX_PASSED)
        dark |= going & hit.is_valid() & ~hole
        return hole, dr.select(hole, hit.spawn_ray_to(place), ray), dark, passed + 1

    state = (active, ray, active & False, mi.UInt32(0))
    return dr.while_loop(state, lambda going, *_: going, body)[2]
