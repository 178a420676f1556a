"""Rays into the hemispheres of diffuse points: what they meet, and the light that comes from there.

A ray drawn by the cosine brings the radiance of what it hits. Where virtual lights sample the same
surface with density D (per area), both are weighted by the balance heuristic: a ray of R with

    w = x / (D + x),    x = R cos cos' / (pi r^2)

(r the distance), a virtual light with ``1 - w``. So near pairs, where the inverse square makes
virtual lights bright spots, are left to rays, and nothing is clamped: energy is kept (E. Veach,
1997, section 9.2.2; for virtual lights T. Kollig and A. Keller, "Illumination in the presence of
weak singularities", 2004, recalled, which splits by a bound instead). What the rays hit is diffuse:
its direct light is computed there, its indirect light is left to `_cache`, for a few of the hits
that stand for all. Surfaces that are not diffuse are followed (`_followed`).

Lanes are points, and all look in the same direction at a time, so that their rays run side by side;
the few hits that are kept are traced again.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._fan import Fan, away_of
from toftools.sim._followed import followed
from toftools.sim._hits import Hits, joined, no_hits
from toftools.sim._light_map import LightMap, row_of
from toftools.sim._phasors import C128
from toftools.sim._second import face_of, scatters_alike, up_of
from toftools.sim._sweep import Against, swept
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._virtual import Channels
from toftools.types import F64

MOST_RAYS = 1 << 21
"""Rays at a time."""


@dataclass(frozen=True, eq=False)
class Arrived:
    """What rays brought to points, as the mean radiance over the hemisphere.

    Parameters
    ----------
    one_bounce, rest : ndarray, (C, W), complex128
        Direct light of first hits, holes passed, and of what was met by way of others.
    hits : Hits
        Places whose indirect light is still missing, point by point.
    guessed : ndarray, (C, W), complex128
        Indirect light of hits, roughly.
    ones : ndarray, (W,)
        What radiance 1 of all diffuse surfaces would give.
    """

    one_bounce: C128
    rest: C128
    hits: Hits
    guessed: C128
    ones: F64


def hemisphere(
    task: Task,
    points: Jit,
    fan: Fan,
    channels: Channels,
    against: Against | None = None,
    keep: int | None = None,
    guess: LightMap | None = None,
) -> Arrived:
    """Send rays from diffuse points.

    Parameters
    ----------
    task : Task
        Scene and sources.
    points : SurfaceInteraction3f, (W,)
        Diffuse points; others get nothing.
    fan : Fan
        Rays of every point.
    channels : Channels
        What is summed up.
    against : Against or None
        Virtual lights to be weighted against; None leaves all to the rays.
    keep : int or None
        Diffuse hits of a point that are kept, about, by chance those with more weight; None for
        all. With 0, surfaces that are not diffuse are not followed either.
    guess : LightMap or None
        Indirect light of diffuse hits, roughly, which hits that are kept say they have counted.

    Returns
    -------
    Arrived
        Light, and what is missing.
    """
    import drjit as dr

    mi, width = task.mi, dr.width(points.t)
    step, parts = max(1, MOST_RAYS // fan.rays), []
    for start in range(0, width, step):
        lanes = dr.arange(mi.UInt32, min(step, width - start)) + dr.opaque(mi.UInt32, start)
        first = swept(task, points, lanes, fan, channels, against, guess)
        lane, ray, weight = _thinned(first.shares, fan.offset, keep)
        light, hits = _met(task, points, (lane + start, ray, weight), fan, channels, guess)
        one, rest = light[:, :, start : start + first.ones.size]
        parts.append(Arrived(first.one_bounce + one, rest, hits, first.guessed, first.ones))
    if not parts:
        blank = np.zeros((len(channels.freqs_hz), 0), np.complex128)
        return Arrived(blank, blank, no_hits(), blank, np.zeros(0))
    return Arrived(
        np.concatenate([part.one_bounce for part in parts], axis=1),
        np.concatenate([part.rest for part in parts], axis=1),
        joined([part.hits for part in parts]),
        np.concatenate([part.guessed for part in parts], axis=1),
        np.concatenate([part.ones for part in parts]),
    )


def _thinned(shares: Any, offset: float, keep: int | None) -> tuple[Any, Any, F64]:  # noqa: ANN401
    """Points and rays of the hits that are kept, and their weight; at equal steps of the sum."""
    other = shares < 0
    if keep == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    share = np.where(other, 0.0, shares).astype(np.float64)
    if keep is None:
        chance = (share > 0).astype(np.float64)
    else:
        step = share.sum(axis=1, keepdims=True) / keep
        chance = np.minimum(1.0, np.divide(share, step, out=np.zeros_like(share), where=step > 0))
    ticks = np.floor(chance.cumsum(axis=1) + offset)
    kept = np.diff(ticks, axis=1, prepend=0.0) > 0
    weight = np.divide(share, chance, out=np.ones_like(share), where=chance > 0)
    lane, ray = np.nonzero(kept | other)
    return lane, ray, np.where(other, 1.0, weight)[lane, ray]


def _met(
    task: Task,
    points: Jit,
    picked: tuple[Any, Any, F64],
    fan: Fan,
    channels: Channels,
    guess: LightMap | None,
) -> tuple[C128, Hits]:
    """What picked rays meet by way of surfaces that are not diffuse, (2, C, W), and hits."""
    import drjit as dr

    mi, (lane, ray, weight) = task.mi, picked
    width, kinds = dr.width(points.t), len(channels.freqs_hz)
    found = np.zeros((2, kinds, width), np.complex128)
    if not lane.size:
        return found, no_hits()
    lanes, number = (mi.UInt32(x.astype(np.uint32)) for x in (lane, ray))
    si = dr.gather(mi.SurfaceInteraction3f, points, lanes)
    nearby = next_hit(task, si, away_of(mi, up_of(si), fan.square(number, lanes)), mi.Bool(True))
    straight, valid = scatters_alike(mi, nearby), nearby.is_valid()
    far_m = nearby.t * task.stage.unit_m
    share = mi.Float((weight / fan.rays).astype(np.float32))
    dr.eval(nearby, straight, valid, far_m, share)
    hits = [_hits(mi, dr.compress(straight), lanes, nearby, (share, far_m), guess, straight=True)]
    other: Jit = dr.compress(valid & ~straight)
    if dr.width(other):
        some = dr.gather(mi.UInt32, lanes, other)
        start = [dr.gather(kind, x, other) for kind, x in (
            (mi.SurfaceInteraction3f, nearby), (mi.Float, share), (mi.Float, far_m))]  # fmt: skip
        draw = (dr.gather(mi.UInt32, number, other), fan.key(some))
        *light, end, share, far_m = followed(task, (*start, mi.Float(1)), draw, channels)
        dr.eval(light, end, share, far_m)
        ended: Jit = dr.compress(share > 0)
        hits.append(_hits(mi, ended, some, end, (share, far_m), None, straight=False))
        mine = np.asarray(some.numpy(), np.int64)
        for row, (real, imaginary) in zip(
            found.reshape(-1, width), (pair for part in light for pair in part), strict=True
        ):
            row += np.bincount(mine, real.numpy(), width)
            row += 1j * np.bincount(mine, imaginary.numpy(), width)
    return found, joined(hits)


def _hits(
    mi: Any,  # noqa: ANN401
    kept: Jit,
    lanes: Jit,
    at: Jit,
    shares: tuple[Jit, Jit],
    guess: LightMap | None,
    *,
    straight: bool,
) -> Hits:
    """Kept lanes in numpy; `shares` are their weights and ways."""
    import drjit as dr

    share, length_m = shares
    if not dr.width(kept):
        return no_hits()
    at = dr.gather(mi.SurfaceInteraction3f, at, kept)
    normal = up_of(at)
    dr.eval(at, normal)
    guessed = np.full(dr.width(kept), -1)
    if guess is not None:
        rows = row_of(mi, guess, at.p, face_of(at), mi.Bool(True))  # as `_sweep` has taken it
        guessed = np.asarray(rows.numpy(), np.int64)

    def taken(kind: Any, values: Jit) -> Any:  # noqa: ANN401
        return dr.gather(kind, values, kept).numpy()

    return Hits(
        lane=np.asarray(taken(mi.UInt32, lanes), np.int64),
        p=np.asarray(at.p.numpy(), np.float64).reshape(3, -1),
        n=np.asarray(normal.numpy(), np.float64).reshape(3, -1),
        weight=np.asarray(taken(mi.Float, share), np.float64),
        length_m=np.asarray(taken(mi.Float, length_m), np.float64),
        guessed=guessed,
        straight=np.full(guessed.size, straight),
        at=[at],
    )
