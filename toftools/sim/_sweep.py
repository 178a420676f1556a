"""Rays of many points side by side: the light of first hits, and how much each ray counts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._fan import Fan, away_of
from toftools.sim._followed import direct_along
from toftools.sim._light_map import LightMap, row_of, tables_of
from toftools.sim._phasors import C128, cycles_per_m, turn
from toftools.sim._second import face_of, scatters_alike, up_of
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._viewpoints import Viewpoint, density
from toftools.sim._virtual import Channels
from toftools.types import F64


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


@dataclass(frozen=True, eq=False)
class Swept:
    """What first hits tell.

    Parameters
    ----------
    one_bounce, guessed : ndarray, (C, W), complex128
        Their direct light, and their indirect light roughly.
    ones : ndarray, (W,)
        What radiance 1 of all diffuse surfaces would give.
    shares : ndarray, (W, R), float32
        Weight of each ray, -1 where it met a surface that is not diffuse.
    """

    one_bounce: C128
    guessed: C128
    ones: F64
    shares: Any


def swept(
    task: Task,
    points: Jit,
    lanes: Jit,
    fan: Fan,
    channels: Channels,
    against: Against | None,
    guess: LightMap | None,
) -> Swept:
    """Send the rays of some points.

    Parameters
    ----------
    task : Task
        Scene and sources.
    points : SurfaceInteraction3f
        Diffuse points; others get nothing.
    lanes : UInt32, (W,)
        Which of them.
    fan : Fan
        Rays of every point.
    channels : Channels
        What is summed up.
    against : Against or None
        Virtual lights to be weighted against.
    guess : LightMap or None
        Indirect light of diffuse hits, roughly.

    Returns
    -------
    Swept
        Means over the rays, and weights.
    """
    import drjit as dr

    mi, width, kinds = task.mi, dr.width(lanes), len(channels.freqs_hz)
    si = dr.gather(mi.SurfaceInteraction3f, points, lanes)
    up, active = up_of(si), scatters_alike(mi, si)
    local, count = dr.arange(mi.UInt32, width), dr.opaque(mi.UInt32, fan.rays)
    shares = dr.zeros(mi.Float, width * fan.rays)
    more_of = _guessing(task, channels, guess)
    dr.eval(si, up, active, local, shares)

    def body(number: Jit, sums: Jit, more: Jit, ones: Jit) -> tuple[Jit, ...]:
        away = away_of(mi, up, fan.square(number, lanes))
        nearby = next_hit(task, si, away, active)
        hit = active & nearby.is_valid()
        diffuse = hit & scatters_alike(mi, nearby)
        far_m, facing = dr.select(hit, nearby.t * task.stage.unit_m, 1.0), face_of(nearby)
        share = dr.select(diffuse, mi.Float(1), 0.0)
        if against is not None:
            x = mi.Float(count) * dr.dot(up, away) * -dr.dot(facing, away)
            x *= dr.inv_pi / dr.square(far_m)
            dense = density(task, against.views, against.total, nearby.p, facing, diffuse)
            share = dr.select(diffuse & (x > 0), x / (dense + x), 0.0)  # along the surface: 0 / 0
        weight = dr.select(diffuse, share, mi.Float(1))
        light = direct_along(task, nearby, hit, weight, dr.select(hit, far_m, 0.0), channels)
        marked = dr.select(hit & ~diffuse, mi.Float(-1), share)
        dr.scatter(shares, marked, local * count + number)
        sums = [(a + c, b + d) for (a, b), (c, d) in zip(sums, light, strict=True)]
        return number + 1, sums, more_of(more, nearby.p, facing, share, far_m), ones + share

    zero = dr.zeros(mi.Float, width)
    blank = [(zero, zero) for _ in range(kinds)]
    state = (mi.UInt32(0), blank, blank, zero)
    _, sums, more, ones = dr.while_loop(state, lambda number, *_: number < count, body)
    dr.eval(sums, more, ones, shares)
    each = shares.numpy().reshape(width, -1)
    light, guessed = (_complex(part) / fan.rays for part in (sums, more))
    return Swept(light, guessed, np.asarray(ones.numpy(), np.float64) / fan.rays, each)


def _guessing(task: Task, channels: Channels, guess: LightMap | None) -> Callable[..., Jit]:
    """Function that adds the light of hits, roughly, to sums."""
    import drjit as dr

    if guess is None:
        return lambda sums, *_: sums
    mi, tables, cycles = task.mi, tables_of(task.mi, guess), cycles_per_m(channels.freqs_hz)
    dr.eval(tables)

    def more_of(sums: Jit, p: Jit, n: Jit, share: Jit, far_m: Jit) -> Jit:
        row, new = row_of(mi, guess, p, n, share > 0), []
        for (x, y), table, cycle in zip(sums, tables, cycles, strict=True):
            a, b = (share * dr.gather(mi.Float, part, row) for part in table)
            c, d, *_ = (*turn(mi, cycle, far_m), mi.Float(0))
            new.append((x + a * c - b * d, y + a * d + b * c))
        return new

    return more_of


def _complex(rows: Jit) -> C128:
    pairs = np.array([[np.asarray(x.numpy(), np.float64) for x in row] for row in rows])
    return np.asarray(pairs[:, 0] + 1j * pairs[:, 1])
