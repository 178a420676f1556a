"""Indirect light of what rays met: out of the cache, or by further rays where that is too coarse.

Where rays have taken a guess at the light (`_light_map`), the few hits that are looked up bring the
difference, as a control variate.

A place that is nearer to the point its ray came from than to any place of the cache may lie in a
gap that the cache knows nothing of; its light would leak in from outside. Such hits send rays of
their own, whose hits are looked up in turn.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from toftools.sim._cache import Cache, nearest, radiance, ranks
from toftools.sim._fan import own_fan, turned_fan
from toftools.sim._hemisphere import hemisphere
from toftools.sim._hits import Hits, surfaces_of
from toftools.sim._light_map import lit_by
from toftools.sim._phasors import C128
from toftools.sim._task import Jit, Task
from toftools.sim._tracer import lane_keys
from toftools.sim._virtual import Channels, albedo_of
from toftools.units import path_to_phase

COARSE = 1.0
"""Distance to the cache, in lengths of the ray, from which it is too coarse."""
DEEPEST, FURTHER = 3, 4
"""How often in a row rays may end in a gap, and rays of a hit that does."""
SHARP, SHARP_KEPT = 256, 16
"""Rays of a place of the cache that looks around once more, and how many look light up."""


def looked_up(
    task: Task,
    cache: Cache,
    hits: Hits,
    lanes: int,
    channels: Channels,
    seed: int,
    deepest: int = DEEPEST,
) -> C128:
    """Indirect light that hits bring to the points their rays came from.

    Parameters
    ----------
    task : Task
        Scene and sources.
    cache : Cache
        Indirect light of surfaces.
    hits : Hits
        What rays met.
    lanes : int
        Number W of points.
    channels : Channels
        What is summed up.
    seed : int
        Of further rays.
    deepest : int
        How often hits may send rays; 0 takes what the cache has.

    Returns
    -------
    ndarray, (C, W), complex128
        Mean radiance over the hemisphere.
    """
    near = nearest(cache, hits)
    ways = hits.length_m / task.stage.unit_m
    coarse = (near[0][:, 0] > COARSE * ways) & (deepest > 0)
    light = radiance(cache, cache.light, near)
    if coarse.any():
        light[:, coarse] = _further(task, cache, hits, coarse, channels, seed, deepest)
    if cache.guess is not None:
        light -= cache.guess.light[:, hits.guessed]
    return _arriving(hits, light, lanes, channels)


def sharpened(task: Task, sets: list[Jit], cache: Cache, channels: Channels, seed: int) -> Cache:
    """A cache whose places have looked around once more, with many rays.

    Parameters
    ----------
    task : Task
        Scene and sources.
    sets : list of SurfaceInteraction3f
        Its places.
    cache : Cache
        Light of one bounce less, or of all.
    channels : Channels
        What is summed up.
    seed : int
        Of the rays.

    Returns
    -------
    Cache
        Light with less noise, and with one more bounce if they are counted.
    """
    import drjit as dr

    rank, start, light = ranks(sets), 0, []
    for at in sets:
        width = dr.width(at.t)
        fan = turned_fan(task.mi, SHARP, rank[start : start + width], seed)
        arrived = hemisphere(task, at, fan, channels, None, SHARP_KEPT, cache.guess)
        found = looked_up(task, cache, arrived.hits, width, channels, seed, 0)
        light.append(arrived.one_bounce + arrived.rest + arrived.guessed + found)
        start += width
    later = np.concatenate(light, axis=1)
    guess = None if cache.guess is None else lit_by(cache.guess, cache.albedo * later)
    return replace(cache, later=later, guess=guess)


def _further(
    task: Task,
    cache: Cache,
    hits: Hits,
    coarse: Any,  # noqa: ANN401 - bools
    channels: Channels,
    seed: int,
    deepest: int,
) -> C128:
    """Light of some hits by rays of their own, (C, n)."""
    found, start = [], 0
    for at in surfaces_of(task, hits, np.flatnonzero(coarse)):
        number, albedo = _lanes(task, at, start), albedo_of(at)
        start += len(albedo)
        fan = own_fan(task.mi, FURTHER, lane_keys(task.mi, number, seed))
        arrived = hemisphere(task, at, fan, channels)
        width = len(albedo)
        later = looked_up(task, cache, arrived.hits, width, channels, seed + 1, deepest - 1)
        found.append(albedo * (arrived.one_bounce + arrived.rest + later))
    return np.concatenate(found, axis=1)


def _arriving(hits: Hits, light: C128, lanes: int, channels: Channels) -> C128:
    """Sums over the hits of each point, phases turned by the way."""
    sums, turns = np.empty((len(light), lanes), np.complex128), {}
    for row, values, freq_hz in zip(sums, light, channels.freqs_hz, strict=True):
        if freq_hz not in turns:
            phase = path_to_phase(hits.length_m, float(freq_hz))
            turns[freq_hz] = hits.weight * np.exp(1j * phase)
        turned = values * turns[freq_hz]
        row[:] = np.bincount(hits.lane, turned.real, lanes)
        row += 1j * np.bincount(hits.lane, turned.imag, lanes)
    return sums


def _lanes(task: Task, at: Jit, start: int) -> Jit:
    import drjit as dr

    return dr.arange(task.mi.UInt32, dr.width(at.t)) + dr.opaque(task.mi.UInt32, start)
