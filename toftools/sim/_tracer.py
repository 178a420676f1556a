"""Phasor path tracing in one kernel: all frequencies and harmonics of every path, no time bins.

Paths start at the first surface that a pixel sees, which is found once. At every further surface
the camera's point sources are connected without chance; lamps of the scene are sampled (with
multiple importance sampling). One lane of the kernel serves one pixel and starts a new path as soon
as one ends, so that lanes stay busy and nothing is stored per path. There is no Russian roulette:
a path ends after the last bounce asked for, in the open, or in black.

References
----------
E. Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, chapter 9 (the balance
between sampling lamps and materials). Fails for light that reaches a surface by way of a mirror or
of clear glass from a point source: no path finds it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._flash import Flash, flash_light
from toftools.sim._lamps import lamps_at, lamps_hit
from toftools.sim._sobol import hashed, pair, single
from toftools.sim.stage import Stage
from toftools.types import F64

Jit = Any
"""A Dr.Jit array or structure; the package has no types."""
Deposit = Callable[[Jit, Jit, Jit, Jit, Jit, Jit], Jit]
"""(sums, lane, path number, bounce, radiance, path in m) -> sums with one contribution more."""

MAX_PASSED = 16  # surfaces with a hole that a ray may pass in a row


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
    def holes(self) -> bool:
        """Whether some surface has holes, so that even direct light is met by chance."""
        flags = (s.bsdf().flags() for s in self.stage.scene.shapes() if s.bsdf() is not None)
        return any(self.mi.has_flag(flag, self.mi.BSDFFlags.Null) for flag in flags)


def first_hits(task: Task, directions: F64) -> Jit:
    """First surface along each viewing direction; holes of masks are seen through.

    Parameters
    ----------
    task : Task
        Scene.
    directions : ndarray, (N, 3)
        Unit vectors in the camera frame; NaN sees nothing.

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
    ray = mi.Ray3f(mi.Point3f(*(float(x) for x in pose[:3, 3])), mi.Vector3f(*columns))
    seen = mi.Bool(np.ascontiguousarray(known))
    si = task.stage.scene.ray_intersect(ray, seen)
    passed = dr.zeros(mi.Float, len(directions))
    if not task.holes:
        dr.eval(si)
        return si
    for _ in range(MAX_PASSED):
        hole = si.is_valid() & (si.bsdf().eval_null_transmission(si, seen)[0] > 0.5)
        if not dr.any(hole):
            break
        passed = passed + dr.select(hole, si.t, 0.0)
        beyond = task.stage.scene.ray_intersect(si.spawn_ray(ray.d), hole)
        si = dr.select(hole, beyond, si)
    si.t = si.t + passed
    dr.eval(si)
    return si


@dataclass
class _Path:
    """Where a path stands; a structure that Dr.Jit can loop over."""

    si: Jit
    throughput: Jit
    length_m: Jit
    ior: Jit
    bounce: Jit


@dataclass(frozen=True, eq=False)
class _Draw:
    """Random numbers of one step of one path."""

    mi: Any
    number: Jit
    key: Jit
    step: Jit

    def lobe(self) -> Jit:
        return single(self.mi, self.number, self._seed(1, self.step))

    def direction(self) -> Jit:
        """Directions of two steps in a row are one point of four dimensions."""
        return pair(self.mi, self.number, self._seed(2, self.step >> 1), self.step & 1)

    def lamp(self) -> tuple[Jit, Jit]:
        mi, seed = self.mi, self._seed(3, self.step)
        return pair(mi, self.number, seed, mi.UInt32(0)), single(mi, self.number, seed ^ 0x55)

    def _seed(self, use: int, step: Jit) -> Jit:
        return hashed(self.mi, self.key + hashed(self.mi, 4 * step + use))


def trace(
    task: Task,
    first: Jit,
    *,
    bounces: int,
    samples: int,
    seed: int,
    sums: Jit,
    deposit: Deposit,
) -> tuple[Jit, Jit]:
    """Indirect light of the camera's sources, and all light of the scene's lamps, of every lane.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane, out of `first_hits`.
    bounces : int
        Indirect bounces to follow.
    samples : int
        Paths per lane; powers of two are stratified best.
    seed : int
        Of the sequences; other seeds give independent estimates.
    sums : pytree
        What `deposit` adds to, per lane.
    deposit : callable
        Takes up one contribution of modulated light.

    Returns
    -------
    pytree, Float
        The sums over all paths (not their mean), and the sum of the unmodulated radiance.
    """
    import drjit as dr

    mi, lanes = task.mi, dr.width(first.t)
    lane = dr.arange(mi.UInt32, lanes)
    # Opaque: another number must not mean another kernel.
    limit, paths, root = (dr.opaque(mi.UInt32, x) for x in (bounces, samples, seed & 0xFFFFFFFF))
    key = hashed(mi, lane ^ hashed(mi, root))
    start = _Path(first, mi.Float(1), first.t * task.stage.unit_m, mi.Float(1), mi.UInt32(0))

    def body(active: Jit, number: Jit, step: Jit, path: _Path, total: Jit) -> tuple[Jit, ...]:
        who, draw = (lane, number), _Draw(mi, number, key, step)
        path, alive, total = _bounce(task, who, active, path, draw, limit, total, deposit)
        alive &= path.bounce < limit + int(task.lamps)  # lamps shine on the last surface as well
        alive &= step < 2 * limit + MAX_PASSED  # rays that pass holes do not bounce
        number = dr.select(alive, number, number + 1)
        step = dr.select(alive, step + 1, 0)
        return active & (number < paths), number, step, dr.select(alive, path, start), total

    state = (first.is_valid(), mi.UInt32(0), mi.UInt32(0), start, (sums, dr.zeros(mi.Float, lanes)))
    final = dr.while_loop(state, lambda active, *_: active, body)
    return final[-1]


def _bounce(
    task: Task,
    who: tuple[Jit, Jit],
    active: Jit,
    path: _Path,
    draw: _Draw,
    limit: Jit,
    total: tuple[Jit, Jit],
    deposit: Deposit,
) -> tuple[_Path, Jit, tuple[Jit, Jit]]:
    """One step: lamps at this surface, a new direction, the next surface and the sources there."""
    import drjit as dr

    mi, stage, (sums, ambient), si = task.mi, task.stage, total, path.si
    if task.lamps:
        light = lamps_at(mi, stage, si, *draw.lamp(), active)
        length_m = path.length_m + path.ior * light.far_m
        sums = deposit(sums, *who, path.bounce, path.throughput * light.modulated, length_m)
        ambient = ambient + path.throughput * light.ambient
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, draw.lobe(), draw.direction(), active)
    throughput = path.throughput * weight[0]
    ior = path.ior * sample.eta
    active = active & (throughput > 0)
    nearby = stage.scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), active)
    hit = active & nearby.is_valid()
    if task.lamps:
        light = lamps_hit(mi, stage, si, nearby, sample, active)
        length_m = path.length_m + ior * light.far_m
        sums = deposit(sums, *who, path.bounce, throughput * light.modulated, length_m)
        ambient = ambient + throughput * light.ambient
    passed = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    new = _Path(
        nearby,
        throughput,
        path.length_m + dr.select(hit, ior * nearby.t * stage.unit_m, 0.0),
        ior,
        path.bounce + dr.select(passed, mi.UInt32(0), mi.UInt32(1)),
    )
    for flash in task.flashes:
        value, far_m = flash_light(mi, stage, flash, nearby, hit & (new.bounce <= limit))
        if flash.modulated:
            length_m = new.length_m + ior * far_m
            sums = deposit(sums, *who, new.bounce, throughput * value, length_m)
        else:
            ambient = ambient + throughput * value
    return new, hit, (sums, ambient)
