"""One independent estimate of the indirect light at diffuse points, of any number of bounces.

Virtual lights and rays share the first bounce (`_hemisphere`); the indirect light that they carry
comes out of a cache (`_cache`) whose places are the virtual lights, and some of what the points'
own rays hit nearby, since there it is looked up most. Light with more than one bounce is scaled so
that radiance 1 everywhere would give what the points really see of diffuse surfaces: most of what
virtual lights get wrong is a factor common to all light.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._cache import applied, lookups, solved
from toftools.sim._gather import gather
from toftools.sim._hemisphere import Against, Hits, hemisphere
from toftools.sim._phasors import C128
from toftools.sim._second import scatters_alike, up_of
from toftools.sim._sobol import hashed, pair
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._tracer import lane_keys
from toftools.sim._viewpoints import Viewpoint
from toftools.sim._virtual import Channels, virtual_lights
from toftools.types import F64

PER_RAY = 32
"""Virtual lights per ray of a point."""
FEWEST, MOST_RAYS = 32, 1024
NEARBY = 0.5
"""Places of the cache among nearby hits, per virtual light."""
OPEN_RAYS = 512


@dataclass(frozen=True, eq=False)
class Estimate:
    """Mean radiance over the hemisphere of points.

    Parameters
    ----------
    one_bounce, rest : ndarray, (C, W), complex128
        By number of indirect bounces; phases end at the points.
    lights : int
        Virtual lights that were put on surfaces.
    """

    one_bounce: C128
    rest: C128
    lights: int


def share_met(task: Task, points: Jit, seed: int) -> F64:
    """Share of each point's hemisphere, by the cosine, that diffuse surfaces fill.

    Parameters
    ----------
    task : Task
        Scene.
    points : SurfaceInteraction3f, (W,)
        Points.
    seed : int
        Of the rays.

    Returns
    -------
    ndarray, (W,)
        From 0 to 1.
    """
    import drjit as dr

    mi, width = task.mi, dr.width(points.t)
    up, active = up_of(points), scatters_alike(mi, points)
    key = hashed(mi, lane_keys(mi, dr.arange(mi.UInt32, width), seed) + 2)
    dr.eval(up, active, key)
    limit = dr.opaque(mi.UInt32, OPEN_RAYS)

    def body(number: Jit, met: Jit) -> tuple[Jit, Jit]:
        square = pair(mi, number, key, mi.UInt32(0))
        away = mi.Frame3f(up).to_world(mi.warp.square_to_cosine_hemisphere(square))
        nearby = next_hit(task, points, away, active)
        return number + 1, met + dr.select(active & scatters_alike(mi, nearby), 1.0, 0.0)

    state = (mi.UInt32(0), dr.zeros(mi.Float, width))
    _, met = dr.while_loop(state, lambda number, *_: number < limit, body)
    return np.asarray(met.numpy(), np.float64) / OPEN_RAYS


def estimate(
    task: Task,
    views: tuple[Viewpoint, ...],
    points: Jit,
    met: F64,
    channels: Channels,
    total: int,
    bounces: int | None,
    seed: int,
) -> Estimate:
    """Estimate the indirect light at points.

    Parameters
    ----------
    task : Task
        Scene and sources.
    views : tuple of Viewpoint
        From where virtual lights are put on surfaces.
    points : SurfaceInteraction3f, (W,)
        Diffuse points.
    met : ndarray, (W,)
        Out of `share_met`.
    channels : Channels
        What is summed up.
    total : int
        Directions in which virtual lights are looked for.
    bounces : int or None
        Indirect bounces; None for all.
    seed : int
        Other seeds give independent estimates.

    Returns
    -------
    Estimate
        Light.
    """
    import drjit as dr

    mi, width = task.mi, dr.width(points.t)
    rays = int(np.clip(1 << (total // PER_RAY).bit_length(), FEWEST, MOST_RAYS))
    lights = virtual_lights(task, views, total, channels, seed)
    # One root for all points: neighbours err alike, so that interpolation sees smooth light.
    keys = lane_keys(mi, dr.zeros(mi.UInt32, width), seed + 0x51)
    arrived = hemisphere(task, points, keys, rays, channels, Against(views, total))
    sets = [*lights.at, *_nearby(mi, arrived.hits, NEARBY * len(lights.albedo), seed)]
    if not sets:
        return Estimate(arrived.one_bounce, arrived.rest, 0)
    usual_m2 = float(np.median(lights.area_m2)) if len(lights.area_m2) else task.stage.unit_m**2
    left = None if bounces is None else bounces - 1
    spacing = np.sqrt(usual_m2) / task.stage.unit_m
    cache = solved(task, sets, spacing, channels, left, seed + 0x77)
    later = cache.light[:, : len(lights.albedo)]
    one, rest, ones = gather(task, points, lights, later, channels, rays)
    straight = arrived.hits.straight
    ones = ones + np.bincount(
        arrived.hits.lane[straight], arrived.hits.weight[straight], minlength=width
    )
    found = applied(lookups(cache, _some(arrived.hits, straight), width, channels), cache.light)
    scale = np.divide(met, ones, out=np.ones(width), where=ones > 0)
    rest = arrived.rest + scale * (rest + found)
    if not straight.all():
        other = _some(arrived.hits, ~straight)
        rest = rest + applied(lookups(cache, other, width, channels), cache.light)
    return Estimate(arrived.one_bounce + one, rest, len(lights.albedo))


def _some(hits: Hits, which: Any) -> Hits:  # noqa: ANN401 - bools
    return Hits(
        lane=hits.lane[which],
        p=hits.p[:, which],
        n=hits.n[:, which],
        weight=hits.weight[which],
        length_m=hits.length_m[which],
        straight=hits.straight[which],
        at=[],
    )


def _nearby(mi: Any, hits: Hits, wanted: float, seed: int) -> list[Jit]:  # noqa: ANN401
    """Some of the hits, by chance, those with more weight rather."""
    import drjit as dr

    if not hits.weight.size or not wanted > 0:
        return []
    chance = np.random.default_rng(seed).random(hits.weight.size)
    taken = chance < wanted * hits.weight / hits.weight.sum()
    sets, start = [], 0
    for at in hits.at:
        number = np.flatnonzero(taken[start : start + dr.width(at.t)])
        start += dr.width(at.t)
        if number.size:
            sets.append(dr.gather(mi.SurfaceInteraction3f, at, mi.UInt32(number.astype(np.uint32))))
    dr.eval(sets)
    return sets
