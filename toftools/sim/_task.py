"""What every pass of the tracer shares, and the first surface of every pixel."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toftools.sim._flash import Flash, opaque
from toftools.sim._holes import ALL, MAX_PASSED, has_holes, share_passed
from toftools.sim.stage import Stage
from toftools.types import F64

Jit = Any
"""A Dr.Jit array or structure; the package has no types."""

LEAST_COSINE = 0.03
"""Rays that graze a surface more than this start closer to it."""


@dataclass(frozen=True, eq=False)
class Task:
    """What does not change from pass to pass.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    stage : Stage
        Scene.
    flashes : tuple of Flash
        The camera's own sources.
    """

    mi: Any
    stage: Stage
    flashes: tuple[Flash, ...]

    @property
    def lamps(self) -> bool:
        """Whether the scene's own lamps shine."""
        return self.stage.lamp_gain > 0 and len(self.stage.scene.emitters()) > 0

    @property
    def chance_direct(self) -> bool:
        """Whether some direct light can only be met by chance."""
        return self.lamps or self.holes

    def without_lamps(self) -> "Task":
        """The same under the camera's own sources alone."""
        return replace(self, stage=replace(self.stage, lamp_gain=0.0))

    def without_flashes(self) -> "Task":
        """The same under the scene's lamps alone."""
        return replace(self, flashes=())

    @property
    def holes(self) -> bool:
        """Whether some surface has holes, so that even direct light is met by chance."""
        return has_holes(self.mi, self.stage.scene)


def next_hit(task: Task, si: Jit, away: Jit, active: Jit) -> Jit:
    """First surface along a direction from other surfaces.

    Parameters
    ----------
    task : Task
        Scene.
    si : SurfaceInteraction3f
        Where the rays start.
    away : Vector3f
        Unit vectors in the scene frame.
    active : Bool
        Which rays count.

    Returns
    -------
    SurfaceInteraction3f
        Hits; ``t`` is measured from the surface itself.
    """
    import drjit as dr

    mi = task.mi
    # Mitsuba shifts rays sideways off the surface, by 1e-4 of its coordinates: millimetres of path
    # where those are large. Along the ray itself a shift moves nothing but the start; a twentieth
    # is still above rounding, and misses next to nothing in corners.
    height = (1 + dr.max(dr.abs(si.p))) * (mi.math.RayEpsilon / 20)
    skipped = height / dr.maximum(dr.abs(dr.dot(si.n, away)), LEAST_COSINE)
    ray = mi.Ray3f(dr.fma(away, skipped, si.p), away, si.time, si.wavelengths)
    nearby = task.stage.scene.ray_intersect(ray, active)
    nearby.t += skipped
    return nearby


def first_hits(task: Task, directions: F64, *, hole: float = ALL) -> Jit:
    """First surface along each viewing direction; holes of masks are seen through.

    Parameters
    ----------
    task : Task
        Scene.
    directions : ndarray, (N, 3)
        Unit vectors in the camera frame; NaN sees nothing.
    hole : float
        Share of light from which a surface is a hole.

    Returns
    -------
    SurfaceInteraction3f
        Hits; ``t`` is measured from the camera centre, in scene units.
    """
    import drjit as dr

    mi, pose = task.mi, task.stage.to_world
    known = np.asarray(np.isfinite(directions).all(axis=-1))
    world = np.where(known[:, None], directions, [0.0, 0.0, 1.0]) @ pose[:3, :3].T
    columns = [mi.Float(np.ascontiguousarray(world[:, i], dtype=np.float32)) for i in range(3)]
    ray = mi.Ray3f(mi.Point3f(*opaque(mi, pose[:3, 3])), mi.Vector3f(*columns))
    seen = mi.Bool(np.ascontiguousarray(known))
    si = task.stage.scene.ray_intersect(ray, seen)
    passed = dr.zeros(mi.Float, len(directions))
    if not task.holes:
        dr.eval(si)
        return si
    for _ in range(MAX_PASSED):
        through = share_passed(si, seen) > hole
        if not dr.any(through):
            break
        passed = passed + dr.select(through, si.t, 0.0)
        beyond = next_hit(task, si, ray.d, through)
        si = dr.select(through, beyond, si)
    si.t = si.t + passed
    dr.eval(si)
    return si
