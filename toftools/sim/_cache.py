"""Indirect light of surfaces: a cache of places, solved for all bounces at once.

Every place i of the cache sends rays into its hemisphere. What they hit has direct light, which is
computed there, and indirect light, which is that of the nearest places of the cache. With the mean
direct light ``e_i`` over the hemisphere and the look-ups as a sparse matrix S,

    L = albedo (e + S L),

the rendering equation (seed "Transient instant radiosity", 2019, eq. 1) at the frequencies of the
modulation, S carrying the phase of the way. All bounces are a linear system (GMRES); iterated
n - 1 times it holds n of them. Rays of places that are near complete each other, so that their
errors average out when the light is gathered; rows add up to what they meet, so energy is kept to
the noise of the rays. Nearest places are told by position and normal; the error of a look-up falls
with the spacing of the cache, which is why it holds many places with few rays. What the few rays
leave to wish for, many bring at little cost once the light is known (`_lookup.sharpened`).
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toftools._native import threads
from toftools.sim._fan import along_curve, box_of, sides_of, turned_fan
from toftools.sim._hemisphere import hemisphere
from toftools.sim._hits import Hits, joined
from toftools.sim._light_map import LightMap, light_map
from toftools.sim._phasors import C128
from toftools.sim._second import up_of
from toftools.sim._task import Jit, Task
from toftools.sim._virtual import Channels, albedo_of
from toftools.types import F64
from toftools.units import path_to_phase

log = logging.getLogger(__name__)

RAYS = 32
"""Rays of each place."""
NEAREST = 2
STILL = 1e-6
"""Relative residual at which all bounces are done."""
MOST = 50
"""Steps of the solver before it starts anew, and how often it may."""


@dataclass(frozen=True, eq=False)
class Cache:
    """Places with their indirect light.

    Parameters
    ----------
    tree : scipy.spatial.cKDTree
        Places and scaled normals.
    scale : float
        Length that a unit of difference of normals counts for, scene units.
    later : ndarray, (C, K), complex128
        Radiance by indirect light as it leaves a place of albedo 1.
    albedo : ndarray, (K,)
        Albedo of the places.
    guess : LightMap or None
        The light roughly, for the device; None where all is dark.
    """

    tree: Any
    scale: float
    later: C128
    albedo: F64
    guess: LightMap | None

    @property
    def light(self) -> C128:
        """Radiance by indirect light as it leaves the places."""
        return np.asarray(self.albedo * self.later)


def solved(
    task: Task, sets: list[Jit], spacing: float, channels: Channels, bounces: int | None, seed: int
) -> Cache:
    """Solve for the indirect light of places.

    Parameters
    ----------
    task : Task
        Scene and sources.
    sets : list of SurfaceInteraction3f
        Diffuse places, one or more.
    spacing : float
        Typical distance between places, scene units.
    channels : Channels
        What is summed up.
    bounces : int or None
        Bounces that the light may have made when it leaves a place; None for all.
    seed : int
        Of the rays.

    Returns
    -------
    Cache
        Places in the order of `sets`.
    """
    import drjit as dr

    tree, scale = _tree(sets, 2 * spacing)
    albedo = np.concatenate([albedo_of(at) for at in sets])
    dark = np.zeros((len(channels.freqs_hz), len(albedo)), np.complex128)
    empty = Cache(tree, scale, dark, albedo, None)
    if bounces == 0:
        return empty
    mi, start, light, hits = task.mi, 0, [], []
    rank = ranks(sets)
    for at in sets:
        width = dr.width(at.t)
        fan = turned_fan(mi, RAYS, rank[start : start + width], seed)
        arrived = hemisphere(task, at, fan, channels)
        arrived.hits.lane[:] += start
        start += width
        light.append(arrived.one_bounce + arrived.rest)
        hits.append(replace(arrived.hits, at=[]))  # surfaces are large, and not needed here
    once = np.concatenate(light, axis=1)
    every = joined(hits)
    near = nearest(empty, every)
    matrices = lookups(empty, every, near, start, channels)
    later = np.stack([
        _converged(m, albedo, x) if bounces is None else _bounced(m, albedo, x, bounces)
        for m, x in zip(matrices, once, strict=True)
    ])  # fmt: skip
    if not every.weight.size:
        return Cache(tree, scale, later, albedo, None)
    looked_at = (_shares(empty, near[0]), near[1])
    guess = light_map(mi, every, looked_at, albedo * later, spacing)
    return Cache(tree, scale, later, albedo, guess)


def _converged(matrix: Any, albedo: F64, once: C128) -> C128:  # noqa: ANN401 - sparse
    """Light of all bounces of one channel, by GMRES: the series is slow where it is bright."""
    from scipy.sparse.linalg import LinearOperator, gmres

    def left(light: C128) -> C128:
        return np.asarray(light - matrix @ (albedo * light))

    system = LinearOperator(matrix.shape, matvec=left, dtype=once.dtype)
    light, failed = gmres(system, once, x0=once, rtol=STILL, restart=MOST, maxiter=MOST)
    if failed:
        log.warning("light of many bounces is not exact: try a darker scene")
    return np.asarray(light)


def _bounced(matrix: Any, albedo: F64, once: C128, bounces: int) -> C128:  # noqa: ANN401
    """Light of some bounces of one channel."""
    light = once
    for _ in range(bounces - 1):
        light = once + matrix @ (albedo * light)
    return light


def ranks(sets: list[Jit]) -> Any:  # noqa: ANN401 - ints
    """Places in a row along which neighbours on one side of a surface are near.

    Parameters
    ----------
    sets : list of SurfaceInteraction3f
        Places.

    Returns
    -------
    ndarray of int, (K,)
        Number of every place in the row.
    """
    p, n = (
        np.concatenate([np.asarray(part.numpy()).reshape(3, -1) for part in parts], axis=1)
        for parts in ([at.p for at in sets], [up_of(at) for at in sets])
    )
    low, high = box_of(p)
    curve = along_curve((p - low[:, None]) / max((high - low).max(), np.finfo(np.float32).tiny))
    order = np.lexsort((curve, sides_of(n)))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank


def _tree(sets: list[Jit], scale: float) -> tuple[Any, float]:
    from scipy.spatial import cKDTree

    rows = [
        np.concatenate([np.asarray(at.p.numpy()), scale * np.asarray(up_of(at).numpy())])
        for at in sets
    ]
    return cKDTree(np.concatenate(rows, axis=1).T), scale


def nearest(cache: Cache, hits: Hits) -> tuple[F64, Any]:
    """Places of the cache that are nearest to hits.

    Parameters
    ----------
    cache : Cache
        Places.
    hits : Hits
        What rays met.

    Returns
    -------
    tuple of ndarray, (K, n)
        Distances, normals included, in scene units; and numbers of the places.
    """
    count = range(1, min(NEAREST, cache.tree.n) + 1)
    query = np.concatenate([hits.p, cache.scale * hits.n]).T
    far, place = cache.tree.query(query, k=count, workers=threads())
    return far, place


def lookups(
    cache: Cache, hits: Hits, near: tuple[F64, Any], lanes: int, channels: Channels
) -> Iterator[Any]:
    """Where hits look for their light, as one sparse matrix per channel, made when asked for.

    Parameters
    ----------
    cache : Cache
        Places.
    hits : Hits
        What rays met.
    near : tuple of ndarray
        Their `nearest` places.
    lanes : int
        Number W of points that the rays came from.
    channels : Channels
        Frequencies.

    Yields
    ------
    scipy.sparse.csr_array, (W, K)
        Weights with the phase of the way.
    """
    from scipy.sparse import csr_array

    place, share = near[1], hits.weight[:, None] * _shares(cache, near[0])
    order = np.argsort(hits.lane, kind="stable")
    begin = np.searchsorted(hits.lane[order], np.arange(lanes + 1)) * place.shape[1]
    column, share, length_m = place[order].ravel(), share[order], hits.length_m[order]
    for freq_hz in channels.freqs_hz:
        phase = np.exp(1j * path_to_phase(length_m, float(freq_hz)))[:, None]
        values = (share * phase).ravel()
        yield csr_array((values, column, begin), shape=(lanes, cache.tree.n))


def _shares(cache: Cache, far: F64) -> F64:
    """Weights of the nearest places, by inverse squares."""
    share = 1 / (far**2 + (1e-3 * cache.scale) ** 2)
    return np.asarray(share / share.sum(axis=1)[:, None])


def radiance(cache: Cache, light: C128, near: tuple[F64, Any]) -> C128:
    """Light of hits out of that of their nearest places.

    Parameters
    ----------
    cache : Cache
        Places.
    light : ndarray, (C, K), complex128
        Light of the places.
    near : tuple of ndarray
        `nearest` places of the hits.

    Returns
    -------
    ndarray, (C, n), complex128
        Light of the hits.
    """
    share = _shares(cache, near[0])
    return np.stack([(share * row[near[1]]).sum(axis=1) for row in light])
