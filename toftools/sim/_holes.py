"""Surfaces that let light pass straight on: leaves cut out of rectangles, thin panes, veils.

Where all light passes there is a hole, which needs no chance. Where a share passes, paths pass by
chance, and sources shine through with that share.
"""

from typing import Any

Jit = Any
"""A Dr.Jit array or structure; the package has no types."""

MAX_PASSED = 16
"""Surfaces with a hole that a ray may pass in a row."""
ALL, MOST = 0.999, 0.5
"""Shares of light that pass a hole, and what counts as one where a single range must be told."""


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


def share_passed(si: Jit, active: Jit) -> Jit:
    """Share of light that passes surface points straight on.

    Parameters
    ----------
    si : SurfaceInteraction3f
        Points, or none.
    active : Bool
        Which of them count.

    Returns
    -------
    Float
        From 0 for opaque to 1 for a hole; 0 where there is no surface.
    """
    import drjit as dr

    met = active & si.is_valid()
    return dr.select(met, si.bsdf().eval_null_transmission(si, met)[0], 0.0)


def share_seen(mi: Any, scene: Any, si: Jit, place: Jit, active: Jit) -> Jit:  # noqa: ANN401
    """Share of the light of a source that reaches surface points.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    scene : mitsuba.Scene
        Scene.
    si : SurfaceInteraction3f
        Points.
    place : Point3f
        Of the source.
    active : Bool
        Which points count.

    Returns
    -------
    Float
        0 in shadow, 1 in the open.
    """
    import drjit as dr

    ray = si.spawn_ray_to(place)
    blocked = scene.ray_test(ray, active)
    if not has_holes(mi, scene):
        return dr.select(blocked, 0.0, 1.0)

    def body(going: Jit, ray: Jit, share: Jit, passed: Jit) -> tuple[Jit, ...]:
        hit = scene.ray_intersect(ray, going)
        met = going & hit.is_valid()
        share = share * dr.select(met, share_passed(hit, met), 1.0)
        going = met & (share > 0) & (passed < MAX_PASSED)
        return going, dr.select(going, hit.spawn_ray_to(place), ray), share, passed + 1

    # Only what something blocks needs a closer look.
    state = (active & blocked, ray, dr.full(mi.Float, 1, dr.width(si.t)), mi.UInt32(0))
    return dr.while_loop(state, lambda going, *_: going, body)[2]
