"""Rays into the hemispheres of diffuse points: what they meet, and the light that comes from there.

A ray drawn by the cosine brings the radiance of what it hits. Where virtual lights sample the same
surface with density D (per area), both are weighted by the balance heuristic: a ray of R with

    w = x / (D + x),    x = R cos cos' / (pi r^2)

(r the distance), a virtual light with ``1 - w``. So near pairs, where the inverse square makes
virtual lights bright spots, are left to rays, and nothing is clamped: energy is kept (E. Veach,
1997, section 9.2.2; for virtual lights T. Kollig and A. Keller, "Illumination in the presence of
weak singularities", 2004, recalled, which splits by a bound instead). What the rays hit is diffuse:
its direct light is computed there, its indirect light is left to `_cache`. Surfaces that are not
diffuse are followed, by their own scattering, until a diffuse one is met.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._flash import flash_light
from toftools.sim._hits import Hits, joined, no_hits
from toftools.sim._phasors import C128, cycles_per_m, turn
from toftools.sim._second import scatters_alike, up_of
from toftools.sim._sobol import hashed, pair, single
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._viewpoints import Viewpoint, density
from toftools.sim._views import MAX_LANES
from toftools.sim._virtual import Channels
from toftools.types import F64

LONGEST = 32
"""Surfaces in a row that are not diffuse."""
SURE = 0.3
"""Weight from which a hit is kept for sure; others stay by chance."""


@dataclass(frozen=True, eq=False)
class Arrived:
    """What rays brought to points, as the mean radiance over the hemisphere.

    Parameters
    ----------
    one_bounce, rest : ndarray, (C, W), complex128
        Direct light of first hits, and of what was met by way of others.
    hits : Hits
        Places whose indirect light is still missing.
    ones : ndarray, (W,)
        What radiance 1 of all diffuse surfaces would give.
    """

    one_bounce: C128
    rest: C128
    hits: Hits
    ones: F64


@dataclass(frozen=True, eq=False)
class Against:
    """Virtual lights that sample the same light.

    Parameters
    ----------
    views : tuple of Viewpoint
        From where they were put on surfaces.
    total : int
        Directions drawn.
    """

    views: tuple[Viewpoint, ...]
    total: int


def hemisphere(
    task: Task,
    points: Jit,
    keys: Jit,
    rays: int,
    channels: Channels,
    against: Against | None = None,
    sure: float = SURE,
) -> Arrived:
    """Send rays from diffuse points.

    Parameters
    ----------
    task : Task
        Scene and sources.
    points : SurfaceInteraction3f, (W,)
        Diffuse points; others get nothing.
    keys : UInt32, (W,)
        Root of every point's random numbers; the same root gives the same directions.
    rays : int
        Rays of each point, a power of two for full stratification.
    channels : Channels
        What is summed up.
    against : Against or None
        Virtual lights to be weighted against; None leaves all to the rays.
    sure : float
        Weight from which a hit is kept for sure; others stay by chance, with more weight.

    Returns
    -------
    Arrived
        Light, and what is missing.
    """
    import drjit as dr

    mi, width = task.mi, dr.width(points.t)
    step = max(1, MAX_LANES // rays)
    parts = []
    for start in range(0, width, step):
        index = dr.arange(mi.UInt32, min(step, width - start)) + start
        some = dr.gather(mi.SurfaceInteraction3f, points, index)
        part = _part(task, some, dr.gather(mi.UInt32, keys, index), rays, channels, against, sure)
        part.hits.lane[:] += start
        parts.append(part)
    if not parts:
        blank = np.zeros((len(channels.freqs_hz), 0), np.complex128)
        return Arrived(blank, blank, no_hits(), np.zeros(0))
    return Arrived(
        np.concatenate([part.one_bounce for part in parts], axis=1),
        np.concatenate([part.rest for part in parts], axis=1),
        joined([part.hits for part in parts]),
        np.concatenate([part.ones for part in parts]),
    )


def _part(
    task: Task,
    points: Jit,
    keys: Jit,
    rays: int,
    channels: Channels,
    against: Against | None,
    sure: float,
) -> Arrived:
    """Rays of as many points as fit at a time; lanes are point-major."""
    import drjit as dr

    mi, stage, width = task.mi, task.stage, dr.width(points.t)
    lane, each = dr.arange(mi.UInt32, width * rays), dr.opaque(mi.UInt32, rays)
    index, number = lane // each, lane % each
    si = dr.gather(mi.SurfaceInteraction3f, points, index)
    key = dr.gather(mi.UInt32, keys, index)
    up, active = up_of(si), scatters_alike(mi, si)
    square = pair(mi, number, hashed(mi, key + 2), mi.UInt32(0))
    away = mi.Frame3f(up).to_world(mi.warp.square_to_cosine_hemisphere(square))
    nearby = next_hit(task, si, away, active)
    diffuse = active & scatters_alike(mi, nearby)
    facing = up_of(nearby)
    far_m = dr.select(nearby.is_valid(), nearby.t * stage.unit_m, 1.0)
    share = dr.select(diffuse, mi.Float(1), 0.0)
    if against is not None:
        x = dr.opaque(mi.Float, rays) * dr.dot(up, away) * -dr.dot(facing, away)
        x *= dr.inv_pi / dr.square(far_m)
        dense = density(task, against.views, against.total, nearby.p, facing, diffuse)
        share = dr.select(diffuse, x / (dense + x), 0.0)
    hit = active & nearby.is_valid()
    weight = dr.select(diffuse, share, mi.Float(1))
    one = _lit(task, nearby, hit, weight, dr.select(hit, far_m, 0.0), channels)
    stay = dr.minimum(weight / dr.opaque(mi.Float, max(sure, 1e-6)), 1.0)
    hit &= single(mi, number, hashed(mi, key + 7)) < stay
    weight = dr.select(hit, weight / stay, 0.0)
    straight = hit & diffuse
    begin = (nearby, hit & ~straight, weight, far_m, mi.Float(1))
    rest, end, weight, length_m = _followed(task, begin, (number, key), channels)
    dr.eval(one, rest, share, weight, length_m, end, straight)
    hits = _hits(mi, dr.compress(weight > 0), (index, end, weight / rays, length_m, straight))
    total = [np.stack([_mean(part, rays) for part in light]) for light in (one, rest)]
    ones = np.asarray(dr.block_sum(share, rays).numpy(), np.float64) / rays
    return Arrived(total[0], total[1], hits, ones)


def _mean(part: tuple[Jit, ...], rays: int) -> C128:
    """Mean over the rays of every point of one complex channel."""
    import drjit as dr

    real, imaginary = (np.asarray(dr.block_sum(x, rays).numpy(), np.float64) for x in part)
    return np.asarray((real + 1j * imaginary) / rays)


def _hits(mi: Any, kept: Jit, what: tuple[Jit, ...]) -> Hits:  # noqa: ANN401
    """Kept lanes in numpy."""
    import drjit as dr

    if not dr.width(kept):
        return no_hits()
    index, end, weight, length_m, straight = what
    at = dr.gather(mi.SurfaceInteraction3f, end, kept)
    normal = up_of(at)
    dr.eval(at, normal)

    def taken(kind: Any, values: Jit) -> Any:  # noqa: ANN401
        return dr.gather(kind, values, kept).numpy()

    return Hits(
        lane=np.asarray(taken(mi.UInt32, index), np.int64),
        p=np.asarray(at.p.numpy(), np.float64).reshape(3, -1),
        n=np.asarray(normal.numpy(), np.float64).reshape(3, -1),
        weight=np.asarray(taken(mi.Float, weight), np.float64),
        length_m=np.asarray(taken(mi.Float, length_m), np.float64),
        straight=np.asarray(taken(mi.Bool, straight), bool),
        at=[at],
    )


def _lit(
    task: Task, si: Jit, active: Jit, weight: Jit, path_m: Jit, channels: Channels, ior: Jit = 1.0
) -> list[tuple[Jit, Jit]]:
    """Direct light of surfaces, turned by the way to the viewer, by channel."""
    mi = task.mi
    sums = [(mi.Float(0), mi.Float(0)) for _ in channels.modulated]
    cycles = cycles_per_m(channels.freqs_hz)
    for flash in task.flashes:
        value, far_m = flash_light(mi, task.stage, flash, si, active & (weight > 0), ior=ior)
        light = value * weight
        for i, (cycle, modulated) in enumerate(zip(cycles, channels.modulated, strict=True)):
            if modulated == flash.modulated:
                turns = (*turn(mi, cycle, path_m + far_m), mi.Float(0))
                sums[i] = (sums[i][0] + light * turns[0], sums[i][1] + light * turns[1])
    return sums


def _followed(
    task: Task, begin: tuple[Jit, ...], draw: tuple[Jit, Jit], channels: Channels
) -> tuple[Jit, Jit, Jit, Jit]:
    """Rays scattered on to the first diffuse surface, and the light on the way.

    Returned are that light, the last surface, the weight of the ray there (0 if there is none) and
    the way to it; lanes that do not start keep what they have.
    """
    import drjit as dr

    mi, (number, key) = task.mi, draw

    def body(active: Jit, step: Jit, at: Jit, state: Jit, rest: Jit) -> tuple[Jit, ...]:
        weight, length_m, ior = state
        seed = hashed(mi, key + hashed(mi, 4 * step + 0x1001))
        lobe, square = single(mi, number, seed), pair(mi, number, seed, mi.UInt32(1))
        sample, value = at.bsdf().sample(mi.BSDFContext(), at, lobe, square, active)
        ior = dr.select(active, ior * sample.eta, ior)
        nearby = next_hit(task, at, at.to_world(sample.wo), active & (value[0] > 0))
        hit = active & (value[0] > 0) & nearby.is_valid()
        weight = dr.select(active, dr.select(hit, weight * value[0], 0.0), weight)
        far_m = nearby.t * task.stage.unit_m
        length_m = length_m + dr.select(hit, ior * far_m, 0.0)
        light = _lit(task, nearby, hit, weight, length_m, channels, ior)
        rest = [(a + c, b + d) for (a, b), (c, d) in zip(rest, light, strict=True)]
        ended = hit & scatters_alike(mi, nearby)
        at = dr.select(hit, nearby, at)
        return hit & ~ended & (step < LONGEST), step + 1, at, (weight, length_m, ior), rest

    at, active, weight, length_m, ior = begin
    lanes = dr.width(at.t)
    zeros = [(dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)) for _ in channels.modulated]
    state = (weight, length_m, ior + dr.zeros(mi.Float, lanes))
    start = (active, dr.zeros(mi.UInt32, lanes), at, state, zeros)
    _, step, end, (weight, length_m, _), rest = dr.while_loop(
        start, lambda active, *_: active, body
    )
    # Who was given up after the most surfaces brings nothing more.
    return rest, end, dr.select(step > LONGEST, 0.0, weight), length_m
