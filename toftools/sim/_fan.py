"""Directions of rays from diffuse points: of each its own, completing a neighbour's, or shared."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._sobol import hashed, pair
from toftools.sim._task import Jit

BITS = 12
"""Of a coordinate on the curve that orders directions."""
RARE = 0.01
"""Share of places, on either side, that may lie far out."""


@dataclass(frozen=True, eq=False)
class Fan:
    """Where the rays of points go.

    Parameters
    ----------
    rays : int
        Rays of each point, a power of two for full stratification.
    square : callable
        From numbers of rays and of points to points of the unit square.
    key : callable
        From numbers of points to roots of other random numbers.
    offset : float
        Chance, in [0, 1), by which hits are picked.
    """

    rays: int
    square: Callable[[Jit, Jit], Jit]
    key: Callable[[Jit], Jit]
    offset: float


def own_fan(mi: Any, rays: int, keys: Jit) -> Fan:  # noqa: ANN401 - the module mitsuba
    """Every point has its own low-discrepancy sequence.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    rays : int
        Their number.
    keys : UInt32, (W,)
        Root of every point's random numbers.

    Returns
    -------
    Fan
        Directions.
    """
    import drjit as dr

    def key(lane: Jit) -> Jit:
        return dr.gather(mi.UInt32, keys, lane)

    def square(number: Jit, lane: Jit) -> Jit:
        return pair(mi, number, hashed(mi, key(lane) + 2), mi.UInt32(0))

    return Fan(rays, square, key, 0.5)


def turned_fan(mi: Any, rays: int, rank: Any, seed: int) -> Fan:  # noqa: ANN401 - mitsuba, ints
    """Points that are near in rank have directions that complete each other.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    rays : int
        Their number.
    rank : ndarray of int, (W,)
        Place of every point in a row in which neighbours are near; that part of one long sequence
        is its own.
    seed : int
        Of the sequence.

    Returns
    -------
    Fan
        Directions.
    """
    import drjit as dr

    root = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
    first = mi.UInt32((rank * rays).astype(np.uint32))
    dr.eval(first)

    def key(lane: Jit) -> Jit:
        return hashed(mi, root + lane)

    def square(number: Jit, lane: Jit) -> Jit:
        index = dr.gather(mi.UInt32, first, lane) + number
        return pair(mi, index, hashed(mi, root + 2), mi.UInt32(0))

    return Fan(rays, square, key, 0.5)


def shared_fan(mi: Any, rays: int, seed: int) -> Fan:  # noqa: ANN401 - the module mitsuba
    """All points have the same directions, so that neighbours err alike; near ones come in a row.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    rays : int
        Their number.
    seed : int
        Of the sequence.

    Returns
    -------
    Fan
        Directions.
    """
    import drjit as dr

    root = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
    found = pair(mi, dr.arange(mi.UInt32, rays), hashed(mi, root + 2), mi.UInt32(0))
    rows = np.asarray(found.numpy(), np.float32).reshape(2, -1)
    table = mi.Point2f(rows[:, np.argsort(along_curve(rows), kind="stable")])
    dr.eval(table, root)
    rng = np.random.default_rng(seed)

    def square(number: Jit, _: Jit) -> Jit:
        return dr.gather(mi.Point2f, table, number)

    return Fan(rays, square, lambda _: root, rng.random())


def away_of(mi: Any, up: Jit, square: Jit) -> Jit:  # noqa: ANN401 - the module mitsuba
    """Directions by the cosine.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    up : Normal3f
        Normals.
    square : Point2f
        Points of the unit square.

    Returns
    -------
    Vector3f
        Unit vectors.
    """
    return mi.Frame3f(up).to_world(mi.warp.square_to_cosine_hemisphere(square))


def along_curve(rows: Any) -> Any:  # noqa: ANN401 - float32 to ints
    """Places on a curve of Morton's, which keeps near points near.

    Parameters
    ----------
    rows : ndarray, (D, N)
        Coordinates from 0 to 1; D is 2 or 3.

    Returns
    -------
    ndarray of int, (N,)
        Numbers that order the points.
    """
    bits = np.clip(rows * (1 << BITS), 0, (1 << BITS) - 1).astype(np.int64)
    found = np.zeros(bits.shape[1], np.int64)
    for level in range(BITS):
        for axis, row in enumerate(bits):
            found |= ((row >> level) & 1) << (len(bits) * level + axis)
    return found


def box_of(p: Any) -> tuple[Any, Any]:  # noqa: ANN401 - floats
    """Box around places, but for the few that lie so far out that it would be coarse.

    Parameters
    ----------
    p : ndarray, (3, N)
        Places, one or more.

    Returns
    -------
    tuple of ndarray, (3,)
        Lowest and highest corner.
    """
    low, high = np.quantile(p, (RARE, 1 - RARE), axis=1)
    span = high - low
    span = np.maximum(span, span.max() / 2)
    return np.maximum(p.min(axis=1), low - span), np.minimum(p.max(axis=1), high + span)


def sides_of(n: Any) -> Any:  # noqa: ANN401 - floats to ints
    """Which axis normals are nearest to, and its sign, as a number from 0 to 5.

    Parameters
    ----------
    n : ndarray, (3, N)
        Normals.

    Returns
    -------
    ndarray of int, (N,)
        Twice the axis, and 1 more along it.
    """
    axis = np.abs(n).argmax(axis=0)
    return 2 * axis + (np.take_along_axis(n, axis[None], 0)[0] > 0)
