"""Paths shared among neighbouring pixels: what one pixel found at a second surface serves them all.

Every pixel of a group draws a second surface point and finds the light that arrives there, of all
further bounces. Each pixel then connects its own first surface to the second points of the whole
group, weighted by the balance heuristic over the pixels that could have drawn them, visibility
included: unbiased whatever the group. Thirty-two paths for the price of a few, where neighbours
look alike; at depth edges the weights see that they do not. Second points that do not scatter
alike in all directions, and those reached by way of a mirror or glass, stay with their own pixel.

References
----------
P. Bekaert, M. Sbert, J. Halton, "Accelerating Path Tracing by Re-Using Paths", Eurographics
Workshop on Rendering, 2002 (the estimator; equation numbers there were not at hand).
"""

import numpy as np

from toftools.sim._flash import flash_light
from toftools.sim._phasors import (
    Light,
    added,
    cycles_per_m,
    depositor,
    empty_sums,
    light_of,
    turn,
)
from toftools.sim._second import Found, Mine, Points, facing, geometry, scatters_alike, up_of
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._tracer import Draw, Path, lane_keys, walk
from toftools.sim._views import MAX_LANES, own_light
from toftools.types import F64

GROUP = 32
"""Pixels that share their paths; at most 32, one bit of visibility each."""
WALKS = 4
"""Paths that go on from every second point, since connecting it costs more than they do."""


def shared_light(
    task: Task,
    first: Jit,
    freqs_hz: F64,
    *,
    inside: int = 1,
    bounces: int,
    samples: int,
    seed: int,
) -> Light:
    """One independent estimate of all light but `direct_light`, with paths shared in groups.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surfaces, `inside` of every pixel in a row; groups of `GROUP` neighbouring pixels
        should be near one another.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.
    inside : int
        Points per pixel, which its paths take in turn.
    bounces, samples, seed : int
        As `trace` takes them, samples per pixel.

    Returns
    -------
    Light
        Mean per pixel, as of `own_light`; neighbours' errors are alike.
    """
    import drjit as dr

    mi, points = task.mi, Points(task.mi, first, inside, seed)
    pixels = points.pixels
    total = (empty_sums(task, pixels, freqs_hz), dr.zeros(mi.Float, pixels))
    slab = max(1, MAX_LANES // pixels)
    for start in range(0, samples if bounces else 0, slab):
        count = min(slab, samples - start)
        found = _find(task, points, freqs_hz, (start, count, bounces))
        dr.eval(found)
        found.seen, found.density = _see(task, points, found, start)
        dr.eval(found)
        total = _connect(task, points, found, (start, count), freqs_hz, total)
        dr.eval(total)
    light = light_of(*total, samples)
    if not task.lamps:
        return light
    # Lamps that shine on the first surface itself are sampled there, with nobody's help.
    own = own_light(task, first, freqs_hz, inside=inside, bounces=0, samples=samples, seed=seed)
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
    found = _find(task, Points(task.mi, first, 1, seed), np.zeros(0), (0, 1, 1))
    valid = int(np.count_nonzero(found.valid.numpy()))
    return 2 * int(np.count_nonzero(found.shared.numpy())) >= valid


def _find(task: Task, points: Points, freqs_hz: F64, what: tuple[int, int, int]) -> Found:
    """Draw second surface points, and follow their paths to the end."""
    import drjit as dr

    mi, pixels, (start, count, bounces) = task.mi, points.pixels, what
    lane = dr.arange(mi.UInt32, pixels * count)
    pixel = lane % dr.opaque(mi.UInt32, pixels)
    number = lane // dr.opaque(mi.UInt32, pixels) + dr.opaque(mi.UInt32, start)
    si = dr.gather(mi.SurfaceInteraction3f, points.first, points.slot(pixel, number))
    draw = Draw(mi, number, lane_keys(mi, pixel, points.seed), mi.UInt32(0))
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
    shared = valid & scatters_alike(mi, si) & scatters_alike(mi, second)
    return Found(
        p=second.p,
        n=facing(second.n, towards),
        sh_n=facing(second.sh_frame.n, towards),
        valid=valid,
        shared=shared,
        weight=weight[0] / WALKS,
        length_m=sample.eta * second.t * task.stage.unit_m,
        sums=sums,
        ambient=ambient,
        seen=mi.UInt32(0),
        density=mi.Float(0),
    )


def _see(task: Task, points: Points, found: Found, start: int) -> tuple[Jit, Jit]:
    """Which pixels of a point's group see it, and the sum of their densities per area there."""
    import drjit as dr

    mi, size = task.mi, dr.opaque(task.mi.UInt32, points.pixels)
    lane = dr.arange(mi.UInt32, dr.width(found.weight))
    pixel, number = lane % size, lane // size + dr.opaque(mi.UInt32, start)
    base, diffuse = pixel - pixel % GROUP, scatters_alike(mi, points.first)
    dr.eval(diffuse)

    def body(k: Jit, seen: Jit, density: Jit) -> tuple[Jit, Jit, Jit]:
        other = base + k
        active = found.shared & (other < size)
        slot = points.slot(other, number)
        si = dr.gather(mi.SurfaceInteraction3f, points.first, slot, active)
        active &= dr.gather(mi.Bool, diffuse, slot, active)
        to, factor, _ = geometry(si, found.p, found.n, found.sh_n)
        pdf = dr.maximum(dr.dot(up_of(si), to), 0.0) * dr.inv_pi
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
    task: Task,
    points: Points,
    found: Found,
    numbers: tuple[int, int],
    freqs_hz: F64,
    total: tuple[Jit, Jit],
) -> tuple[Jit, Jit]:
    """Light that every pixel gets from the second points of its group."""
    import drjit as dr

    mi, first, (start, count) = task.mi, points.first, numbers
    size, most = (dr.opaque(mi.UInt32, x) for x in (points.pixels, count * GROUP))
    begin, pixel = dr.opaque(mi.UInt32, start), dr.arange(mi.UInt32, points.pixels)
    base, cycles = pixel - pixel % GROUP, cycles_per_m(freqs_hz)
    mine = Mine(
        p=first.p,
        up=up_of(first),
        albedo=first.bsdf().eval_diffuse_reflectance(first, first.is_valid())[0],
        far_m=dr.select(first.is_valid(), first.t * task.stage.unit_m, 0.0),
        valid=first.is_valid(),
    )
    dr.eval(mine)

    def body(k: Jit, sums: Jit, ambient: Jit) -> tuple[Jit, Jit, Jit]:
        other, number = base + k % GROUP, k // GROUP
        here = dr.gather(Mine, mine, points.slot(pixel, begin + number))
        active = here.valid & (other < size)
        there = dr.gather(Found, found, other + number * size, active)
        own = active & there.valid & ~there.shared & (other == pixel)
        seen = active & there.shared & ((there.seen >> (pixel - base)) & 1 != 0)
        to, factor, far = geometry(here, there.p, there.n, there.sh_n)
        value = here.albedo * dr.maximum(dr.dot(here.up, to), 0.0) * dr.inv_pi
        value = value * factor / (WALKS * there.density)
        light = dr.select(seen & (there.density > 0), value, 0.0)
        light = dr.select(own, there.weight, light)
        far_m = dr.select(own, there.length_m, far * task.stage.unit_m)
        turns = [turn(mi, cycle, here.far_m + far_m) for cycle in cycles]
        sums = [
            added(part, light, [_product(a, b) for a, b in zip(turns, lit, strict=True)])
            for part, lit in zip(sums, there.sums, strict=True)
        ]
        return k + 1, sums, ambient + light * there.ambient

    state = (dr.zeros(mi.UInt32, points.pixels), *total)
    _, sums, ambient = dr.while_loop(state, lambda k, *_: k < most, body)
    return sums, ambient


def _product(a: tuple[Jit, ...], b: tuple[Jit, ...]) -> tuple[Jit, ...]:
    """Product of two complex numbers in parts, or of two real ones."""
    if len(a) == 1:
        return (a[0] * b[0],)
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]
