"""Paths shared among neighbouring pixels: what one pixel found at a second surface serves them all.

Every pixel of a group draws a second surface point and finds the light that arrives there, of all
further bounces. Each pixel then connects its own first surface to the second points of the whole
group, weighted by the balance heuristic over the pixels that could have drawn them, visibility
included: unbiased whatever the group. Sixteen paths for the price of about two, where neighbours
look alike; at depth edges the weights see that they do not. Second points that do not scatter
alike in all directions, and those reached by way of a mirror or glass, stay with their own pixel.

References
----------
P. Bekaert, M. Sbert, J. Halton, "Accelerating Path Tracing by Re-Using Paths", Eurographics
Workshop on Rendering, 2002 (the estimator; equation numbers there were not at hand).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._flash import flash_light
from toftools.sim._phasors import (
    Light,
    added,
    cycles_per_m,
    depositor,
    empty_sums,
    indirect_light,
    light_of,
    turn,
)
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._tracer import Draw, Path, lane_keys, walk
from toftools.types import F64

GROUP = 16
"""Pixels that share their paths; at most 32, one bit of visibility each."""
WALKS = 4
"""Paths that go on from every second point, since connecting it costs more than they do."""
MAX_LANES = 1 << 20


@dataclass
class _Found:
    """Second surface points of one lane each (sample-major), and the light that arrives there.

    Parameters
    ----------
    p, n, sh_n : Point3f, Normal3f, Normal3f
        Place, geometric and shading normal, turned towards the pixel that drew it.
    valid, shared : Bool
        Whether there is a point, and whether others may use it.
    weight, length_m : Float
        Of the pixel's own use: material over density, and optical length from the first surface.
    sums : pytree
        Light leaving towards the pixel, by frequency and bounce.
    ambient : Float
        The same without modulation.
    seen, density : UInt32, Float
        Which pixels of the group see it, and the sum of their densities per area.
    """

    p: Jit
    n: Jit
    sh_n: Jit
    valid: Jit
    shared: Jit
    weight: Jit
    length_m: Jit
    sums: Jit
    ambient: Jit
    seen: Jit
    density: Jit


def shared_light(
    task: Task, first: Jit, freqs_hz: F64, *, bounces: int, samples: int, seed: int
) -> Light:
    """One independent estimate of all light but `direct_light`, with paths shared in groups.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane; groups of `GROUP` neighbours should be near one another.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.
    bounces, samples, seed : int
        As `trace` takes them.

    Returns
    -------
    Light
        Mean per lane, as of `indirect_light`; neighbours' errors are alike.
    """
    import drjit as dr

    mi, pixels = task.mi, dr.width(first.t)
    total = (empty_sums(task, pixels, freqs_hz), dr.zeros(mi.Float, pixels))
    slab = max(1, MAX_LANES // pixels)
    for start in range(0, samples if bounces else 0, slab):
        count = min(slab, samples - start)
        found = _find(task, first, freqs_hz, (start, count, bounces, seed))
        dr.eval(found)
        found.seen, found.density = _see(task, first, found)
        dr.eval(found)
        total = _connect(task, first, found, count, freqs_hz, total)
        dr.eval(total)
    light = light_of(*total, samples)
    if not task.lamps:
        return light
    # Lamps that shine on the first surface itself are sampled there, with nobody's help.
    own = indirect_light(task, first, freqs_hz, bounces=0, samples=samples, seed=seed)
    return Light(own.direct, light.one_bounce, light.rest, light.ambient + own.ambient)


def worth_sharing(task: Task, first: Jit, seed: int) -> bool:
    """Whether most second points can serve neighbours; else sharing costs more than it brings.

    Parameters
    ----------
    task : Task
        Scene.
    first : SurfaceInteraction3f
        First surfaces of a sample of pixels.
    seed : int
        Of the directions tried.

    Returns
    -------
    bool
        True if at least half of them can.
    """
    found = _find(task, first, np.zeros(0), (0, 1, 1, seed))
    valid = int(np.count_nonzero(found.valid.numpy()))
    return 2 * int(np.count_nonzero(found.shared.numpy())) >= valid


def _find(task: Task, first: Jit, freqs_hz: F64, what: tuple[int, int, int, int]) -> _Found:
    """Draw second surface points, and follow their paths to the end."""
    import drjit as dr

    mi, (start, count, bounces, seed) = task.mi, what
    pixels = dr.width(first.t)
    lane = dr.arange(mi.UInt32, pixels * count)
    pixel = lane % dr.opaque(mi.UInt32, pixels)
    number = lane // dr.opaque(mi.UInt32, pixels) + dr.opaque(mi.UInt32, start)
    si = dr.gather(mi.SurfaceInteraction3f, first, pixel)
    draw = Draw(mi, number, lane_keys(mi, pixel, seed), mi.UInt32(0))
    active, context = si.is_valid(), mi.BSDFContext()
    sample, weight = si.bsdf().sample(context, si, draw.lobe(), draw.direction(), active)
    active &= weight[0] > 0
    second = next_hit(task, si, si.to_world(sample.wo), active)
    valid = active & second.is_valid()
    passed = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    bounce = dr.select(passed, mi.UInt32(0), mi.UInt32(1))
    deposit, limit = depositor(task, freqs_hz), dr.opaque(mi.UInt32, bounces)
    sums, ambient = empty_sums(task, pixels * count, freqs_hz), dr.zeros(mi.Float, pixels * count)
    for flash in task.flashes:
        lit = valid & (bounce <= limit)
        value, far_m = flash_light(mi, task.stage, flash, second, lit, ior=sample.eta)
        if flash.modulated:
            sums = deposit(sums, lane, number, bounce, WALKS * value, far_m)
        else:
            ambient = ambient + WALKS * value
    path = Path(second, dr.select(valid, 1.0, 0.0), mi.Float(0), sample.eta, bounce)
    later = Draw(mi, number * WALKS, draw.key, mi.UInt32(1))
    sums, ambient = walk(task, lane, path, later, (bounces, WALKS), (sums, ambient), deposit)
    towards = si.p - second.p
    shared = valid & _diffuse(mi, si) & _diffuse(mi, second)
    return _Found(
        p=second.p,
        n=_facing(second.n, towards),
        sh_n=_facing(second.sh_frame.n, towards),
        valid=valid,
        shared=shared,
        weight=weight[0] / WALKS,
        length_m=sample.eta * second.t * task.stage.unit_m,
        sums=sums,
        ambient=ambient,
        seen=mi.UInt32(0),
        density=mi.Float(0),
    )


def _diffuse(mi: Any, si: Jit) -> Jit:  # noqa: ANN401 - the module mitsuba
    """Whether surfaces scatter alike in all directions of the side that is looked at."""
    import drjit as dr

    bsdf, valid = si.bsdf(), si.is_valid()
    kinds = mi.BSDFFlags
    for kind in (kinds.Glossy, kinds.Delta, kinds.DiffuseTransmission):
        valid &= ~mi.has_flag(bsdf.flags(), kind)
    # Flags tell nothing of bent normals and black backs: try one direction.
    trial = mi.Vector3f(0.48, 0.36, dr.copysign(mi.Float(0.8), si.wi.z))
    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, trial, valid)
    albedo = bsdf.eval_diffuse_reflectance(si, valid)[0]
    off = dr.maximum(dr.abs(dr.pi * density - 0.8), dr.abs(dr.pi * value[0] - 0.8 * albedo))
    return valid & (off < 1e-5)


def _facing(normal: Jit, towards: Jit) -> Jit:
    import drjit as dr

    return dr.select(dr.dot(normal, towards) < 0, -normal, normal)


def _up(si: Jit) -> Jit:
    """Shading normal on the side that is looked at."""
    return _facing(si.sh_frame.n, si.to_world(si.wi))


def _geometry(si: Jit, p: Jit, n: Jit, sh_n: Jit) -> tuple[Jit, Jit, Jit]:
    """From first surfaces to a second point: direction, cosine there over distance squared, way.

    The cosine is zero on the back of the second point, whose light is another.
    """
    import drjit as dr

    away = p - si.p
    far = dr.norm(away)
    to = away / far
    cosine = -dr.dot(n, to)
    front = (cosine > 0) & (dr.dot(sh_n, to) < 0) & (far > 0)
    return to, dr.select(front, cosine / dr.square(far), 0.0), far


def _see(task: Task, first: Jit, found: _Found) -> tuple[Jit, Jit]:
    """Which pixels of a point's group see it, and the sum of their densities per area there."""
    import drjit as dr

    mi, pixels = task.mi, dr.width(first.t)
    size = dr.opaque(mi.UInt32, pixels)
    pixel = dr.arange(mi.UInt32, dr.width(found.weight)) % size
    base, diffuse = pixel - pixel % GROUP, _diffuse(mi, first)
    dr.eval(diffuse)

    def body(k: Jit, seen: Jit, density: Jit) -> tuple[Jit, Jit, Jit]:
        other = base + k
        active = found.shared & (other < size)
        si = dr.gather(mi.SurfaceInteraction3f, first, other, active)
        active &= dr.gather(mi.Bool, diffuse, other, active)
        to, factor, _ = _geometry(si, found.p, found.n, found.sh_n)
        pdf = dr.maximum(dr.dot(_up(si), to), 0.0) * dr.inv_pi
        active &= (pdf * factor > 0) | (other == pixel)
        blocked = task.stage.scene.ray_test(si.spawn_ray_to(found.p), active & (other != pixel))
        active &= ~blocked
        density = density + dr.select(active, pdf * factor, 0.0)
        return k + 1, seen | dr.select(active, mi.UInt32(1) << k, 0), density

    lanes = dr.width(found.weight)
    state = (mi.UInt32(0), dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Float, lanes))
    _, seen, density = dr.while_loop(state, lambda k, *_: k < GROUP, body)
    return seen, density


def _connect(
    task: Task, first: Jit, found: _Found, count: int, freqs_hz: F64, total: tuple[Jit, Jit]
) -> tuple[Jit, Jit]:
    """Light that every pixel gets from the second points of its group."""
    import drjit as dr

    mi, pixels = task.mi, dr.width(first.t)
    size, most = dr.opaque(mi.UInt32, pixels), dr.opaque(mi.UInt32, count * GROUP)
    pixel = dr.arange(mi.UInt32, pixels)
    base, cycles = pixel - pixel % GROUP, cycles_per_m(freqs_hz)
    albedo, up = first.bsdf().eval_diffuse_reflectance(first, first.is_valid())[0], _up(first)
    start_m = dr.select(first.is_valid(), first.t * task.stage.unit_m, 0.0)
    dr.eval(albedo, up, start_m)

    def body(k: Jit, sums: Jit, ambient: Jit) -> tuple[Jit, Jit, Jit]:
        other = base + k % GROUP
        active = first.is_valid() & (other < size)
        there = dr.gather(_Found, found, other + (k // GROUP) * size, active)
        own = active & there.valid & ~there.shared & (other == pixel)
        seen = active & there.shared & ((there.seen >> (pixel - base)) & 1 != 0)
        to, factor, far = _geometry(first, there.p, there.n, there.sh_n)
        value = albedo * dr.maximum(dr.dot(up, to), 0.0) * dr.inv_pi
        value = value * factor / (WALKS * there.density)
        light = dr.select(seen & (there.density > 0), value, 0.0)
        light = dr.select(own, there.weight, light)
        far_m = dr.select(own, there.length_m, far * task.stage.unit_m)
        turns = [turn(mi, cycle, start_m + far_m) for cycle in cycles]
        sums = [
            added(part, light, [_product(a, b) for a, b in zip(turns, lit, strict=True)])
            for part, lit in zip(sums, there.sums, strict=True)
        ]
        return k + 1, sums, ambient + light * there.ambient

    state = (dr.zeros(mi.UInt32, pixels), *total)
    _, sums, ambient = dr.while_loop(state, lambda k, *_: k < most, body)
    return sums, ambient


def _product(a: tuple[Jit, ...], b: tuple[Jit, ...]) -> tuple[Jit, ...]:
    """Product of two complex numbers in parts, or of two real ones."""
    if len(a) == 1:
        return (a[0] * b[0],)
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]
