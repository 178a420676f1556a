"""Indirect light at diffuse points, of any number of bounces: one independent estimate per seed.

Virtual lights and rays share the first bounce (`_hemisphere`); the indirect light that they carry
comes out of a cache (`_cache`) whose places are the virtual lights, and some of what the points'
own rays hit nearby, since there it is looked up most. Light with more than one bounce is scaled so
that radiance 1 everywhere would give what the points really see of diffuse surfaces: most of what
virtual lights get wrong is a factor common to all light.
"""

from dataclasses import dataclass, replace

import numpy as np

from toftools.sim._cache import Cache, solved
from toftools.sim._crowded import CROWDED
from toftools.sim._fan import away_of, own_fan, shared_fan
from toftools.sim._gather import gather
from toftools.sim._hemisphere import hemisphere
from toftools.sim._hits import surfaces_of
from toftools.sim._lookup import DEEPEST, looked_up, sharpened
from toftools.sim._phasors import C128
from toftools.sim._second import scatters_alike, up_of
from toftools.sim._sobol import hashed, pair
from toftools.sim._sweep import Against
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._tracer import lane_keys
from toftools.sim._viewpoints import Viewpoint
from toftools.sim._virtual import Channels, Virtual, virtual_lights
from toftools.types import F64

PER_RAY = 16
"""Virtual lights per ray of a point."""
FEWEST, MOST_RAYS = 32, 1024
KEEP = 64
"""Hits of a point, about, that are looked up in the cache."""
NEARBY = 2.0
"""Places of the cache among nearby hits, per virtual light."""
MOST_HITS = 1 << 21
"""Rays of points at a time, times channels where those are many."""
FEW_CHANNELS = 8
SCOUTS = 2048
"""Points that tell where the cache should be finer."""
SHORT, ACROSS = 0.05, 4
"""A place of the cache whose rays are so short, in distances between virtual lights, lies in a gap:
so many places are put on what is across."""


@dataclass(frozen=True, eq=False)
class Field:
    """Light of a scene, ready to be looked at from any point.

    Parameters
    ----------
    views : tuple of Viewpoint
        From where virtual lights were put on surfaces.
    channels : Channels
        What is summed up.
    lights : Virtual
        Virtual lights.
    cache : Cache or None
        Indirect light of surfaces, that of the virtual lights first; None for one bounce alone.
    rays : int
        Rays of a point that go with so many virtual lights.
    follow : int
        How often hits that the cache is too coarse for may send rays.
    keep : int
        Hits of a point, about, that are looked up in the cache.
    seed : int
        Of the rays.
    """

    views: tuple[Viewpoint, ...]
    channels: Channels
    lights: Virtual
    cache: Cache | None
    rays: int
    follow: int
    keep: int
    seed: int


def share_met(task: Task, points: Jit, rays: int, seed: int) -> F64:
    """Share of each point's hemisphere, by the cosine, that diffuse surfaces fill.

    Parameters
    ----------
    task : Task
        Scene.
    points : SurfaceInteraction3f, (W,)
        Points.
    rays : int
        Rays of each that only ask whether they meet any.
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
    key = hashed(mi, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF))  # one for all: neighbours err alike
    dr.eval(up, active)
    limit = dr.opaque(mi.UInt32, rays)

    def body(number: Jit, met: Jit) -> tuple[Jit, Jit]:
        square = pair(mi, number, key, mi.UInt32(0))
        away = away_of(mi, up, square)
        nearby = next_hit(task, points, away, active)
        return number + 1, met + dr.select(active & scatters_alike(mi, nearby), 1.0, 0.0)

    state = (mi.UInt32(0), dr.zeros(mi.Float, width))
    _, met = dr.while_loop(state, lambda number, *_: number < limit, body)
    return np.asarray(met.numpy(), np.float64) / rays


def light_field(
    task: Task,
    views: tuple[Viewpoint, ...],
    channels: Channels,
    points: Jit,
    total: int,
    bounces: int | None,
    seed: int,
) -> Field:
    """Light a scene and solve for its bounces.

    Parameters
    ----------
    task : Task
        Scene and sources.
    views : tuple of Viewpoint
        From where virtual lights are put on surfaces.
    channels : Channels
        What is summed up.
    points : SurfaceInteraction3f
        Some of the diffuse points that will be looked at: near them the cache is finer.
    total : int
        Directions in which virtual lights are looked for.
    bounces : int or None
        Indirect bounces; None for all.
    seed : int
        Other seeds give independent estimates.

    Returns
    -------
    Field
        Light everywhere.
    """
    rays = int(np.clip(1 << max(total // PER_RAY - 1, 0).bit_length(), FEWEST, MOST_RAYS))
    lights = virtual_lights(task, views, total, channels, seed)
    left = None if bounces is None else bounces - 1
    if left == 0:
        return Field(views, channels, lights, None, rays, 0, 0, seed)
    near = _nearby(task, views, points, total, NEARBY * len(lights.albedo), seed)
    spacing_m = np.sqrt(np.median(lights.area_m2)) if len(lights.area_m2) else task.stage.unit_m
    spacing = float(spacing_m) / task.stage.unit_m
    sets = [*lights.at, *near, *_across(task, near, SHORT * spacing_m, seed)]
    if not sets:
        return Field(views, channels, lights, None, rays, 0, KEEP, seed)
    before = None if left is None else left - 1
    cache = solved(task, sets, spacing, channels, before, seed + 0x77)
    cache = sharpened(task, sets, cache, channels, seed + 0x99)
    follow = 0 if left is not None else DEEPEST
    return Field(views, channels, lights, cache, rays, follow, KEEP, seed)


def arriving(task: Task, field: Field, points: Jit, met: F64 | None = None) -> tuple[C128, C128]:
    """Mean radiance over the hemisphere of points, by number of indirect bounces.

    Parameters
    ----------
    task : Task
        Scene and sources.
    field : Field
        Light of the scene.
    points : SurfaceInteraction3f, (W,)
        Diffuse points; others get nothing.
    met : ndarray, (W,), or None
        Out of `share_met`; with None, light of more bounces is not scaled.

    Returns
    -------
    tuple of ndarray, (C, W), complex128
        Light with one bounce, and with more; phases end at the points.
    """
    import drjit as dr

    many = max(1, len(field.channels.freqs_hz) // FEW_CHANNELS)
    step, parts = max(256, MOST_HITS // field.rays // many), []
    for start in range(0, dr.width(points.t), step):
        index = dr.arange(task.mi.UInt32, min(step, dr.width(points.t) - start))
        index += dr.opaque(task.mi.UInt32, start)
        part = dr.gather(task.mi.SurfaceInteraction3f, points, index)
        dr.eval(part)  # else gathering from it evaluates every field by a kernel of its own
        some = None if met is None else met[start : start + step]
        parts.append(_arriving(task, field, part, some, field.seed + 0xB1 + start))
    kinds = np.zeros((len(field.channels.freqs_hz), 0), np.complex128)
    one, rest = zip(*parts, strict=True) if parts else ((kinds,), (kinds,))
    return np.concatenate(one, axis=1), np.concatenate(rest, axis=1)


def _arriving(
    task: Task, field: Field, points: Jit, met: F64 | None, seed: int
) -> tuple[C128, C128]:
    """The same for as many points as fit; the seed is that of further rays."""
    import drjit as dr

    mi, width, channels, cache = task.mi, dr.width(points.t), field.channels, field.cache
    fan = shared_fan(mi, field.rays, field.seed + 0x51)
    against = Against(field.views, field.lights.total)
    guess = None if cache is None else cache.guess
    arrived = hemisphere(task, points, fan, channels, against, field.keep, guess)
    count = len(field.lights.albedo)
    later = np.zeros_like(field.lights.direct) if cache is None else cache.light[:, :count]
    one, rest, ones = gather(task, points, field.lights, later, channels, field.rays)
    if cache is None:
        return arrived.one_bounce + one, arrived.rest
    hits, ones, scale = arrived.hits, ones + arrived.ones, np.ones(width)
    if met is not None:
        np.divide(met, ones, out=scale, where=ones > 0)
    # Light by way of other surfaces is not among the ones.
    hits = replace(hits, weight=hits.weight * np.where(hits.straight, scale[hits.lane], 1.0))
    found = looked_up(task, cache, hits, width, channels, seed, field.follow)
    rest = arrived.rest + scale * (rest + arrived.guessed) + found
    return arrived.one_bounce + one, rest


def _nearby(
    task: Task,
    views: tuple[Viewpoint, ...],
    points: Jit,
    total: int,
    wanted: float,
    seed: int,
) -> list[Jit]:
    """Places that the points' own rays look up, by chance, those with more weight rather."""
    import drjit as dr

    mi, width = task.mi, dr.width(points.t)
    if not width or not wanted > 0:
        return []
    step = max(1, width // SCOUTS)
    index = dr.arange(mi.UInt32, -(-width // step)) * dr.opaque(mi.UInt32, step)
    scouts = dr.gather(mi.SurfaceInteraction3f, points, index)
    dr.eval(scouts)
    fan = own_fan(mi, FEWEST, lane_keys(mi, index, seed + 0x33))
    dark, none = task.without_flashes(), Channels(np.zeros(1), (True,))
    hits = hemisphere(dark, scouts, fan, none, Against(views, total)).hits
    if not hits.weight.size:
        return []
    rng = np.random.default_rng(seed)
    taken = rng.random(hits.weight.size) < wanted * hits.weight / hits.weight.sum()
    sets, start = [], 0
    for at in hits.at:
        number = np.flatnonzero(taken[start : start + dr.width(at.t)])
        start += dr.width(at.t)
        if number.size:
            sets.append(dr.gather(mi.SurfaceInteraction3f, at, mi.UInt32(number.astype(np.uint32))))
    dr.eval(sets)
    return sets


def _across(task: Task, sets: list[Jit], short_m: float, seed: int) -> list[Jit]:
    """Places across from those in gaps, where else the light from outside would be looked up."""
    import drjit as dr

    mi, found = task.mi, []
    for at in sets:
        width = dr.width(at.t)
        fan = own_fan(mi, FEWEST, lane_keys(mi, dr.arange(mi.UInt32, width), seed + 0x55))
        hits = hemisphere(
            task.without_flashes(), at, fan, Channels(np.zeros(1), (True,)), keep=None
        ).hits
        near = np.flatnonzero(hits.length_m < short_m)
        count = np.bincount(hits.lane[near], minlength=width)
        near = near[count[hits.lane[near]] > CROWDED * FEWEST]
        _, first, many = np.unique(hits.lane[near], return_index=True, return_counts=True)
        picked = [
            near[f + m * np.arange(ACROSS) // ACROSS] for f, m in zip(first, many, strict=True)
        ]
        if picked:
            found += surfaces_of(task, hits, np.sort(np.concatenate(picked)))
    return found
