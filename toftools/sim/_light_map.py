"""Mean indirect light of the cells of a grid: a first guess of what a hit would look up.

Rays take the guess at every hit, on the device; a few hits, looked up in the cache itself, correct
it by the difference. So the light is that of the cache, with little of the noise of few hits.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toftools.sim._fan import box_of, sides_of
from toftools.sim._flash import opaque
from toftools.sim._hits import Hits
from toftools.sim._phasors import C128
from toftools.sim._task import Jit
from toftools.types import F64

MOST_CELLS = 1 << 23
"""Cells of the grid, all sides of surfaces counted; cells are larger where that does not do."""
SIDES = 6
"""Surfaces in a cell are kept apart by the axis that their normal is nearest to, and its sign."""


@dataclass(frozen=True, eq=False)
class LightMap:
    """Light by cell.

    Parameters
    ----------
    low : ndarray, (3,)
        Corner of the grid, scene units.
    size : float
        Length of a cell, scene units.
    shape : tuple of int
        Cells along x, y and z.
    number : UInt32
        Row of every cell and side in `light`; the last row, which is dark, where nothing is known.
    mean : csr_array, (N - 1, K)
        Which places of the cache the hits of a cell looked at.
    light : ndarray, (C, N), complex128
        Radiance by indirect light.
    """

    low: F64
    size: float
    shape: tuple[int, int, int]
    number: Jit
    mean: Any
    light: C128


def light_map(
    mi: Any,  # noqa: ANN401 - the module mitsuba
    hits: Hits,
    near: tuple[F64, Any],
    light: C128,
    size: float,
) -> LightMap:
    """Light of the cells that hits are in.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    hits : Hits
        Diffuse places, one or more.
    near : tuple of ndarray, (n, k)
        Weights and numbers of the places of the cache that they look at.
    light : ndarray, (C, K), complex128
        Radiance of the cache.
    size : float
        Length of a cell, scene units.

    Returns
    -------
    LightMap
        Means over the hits in each cell.
    """
    from scipy.sparse import csr_array

    low, high = box_of(hits.p)
    size = float(np.max([size, 1e-6 * (high - low).max(), np.finfo(np.float32).tiny]))
    while np.prod((high - low) // size + 1) * SIDES > MOST_CELLS:
        size *= 1.1
    x, y, z = ((high - low) // size).astype(int) + 1
    inside = ((hits.p >= low[:, None]) & (hits.p <= high[:, None])).all(axis=0)
    at = ((hits.p[:, inside] - low[:, None]) / size).astype(int)
    at = np.minimum(at, [[x - 1], [y - 1], [z - 1]])
    cell = ((at[2] * y + at[1]) * x + at[0]) * SIDES + sides_of(hits.n[:, inside])
    count = np.bincount(cell, minlength=x * y * z * SIDES)
    known = np.flatnonzero(count)
    number = np.full(count.size, known.size, np.uint32)
    number[known] = np.arange(known.size)
    share, place = near[0][inside], near[1][inside]
    row = np.repeat(number[cell], place.shape[1])
    weight = (share / count[cell][:, None]).ravel()
    mean = csr_array((weight, (row, place.ravel())), (known.size, light.shape[1]))
    return lit_by(LightMap(low, size, (x, y, z), mi.UInt32(number), mean, light), light)


def lit_by(known: LightMap, light: C128) -> LightMap:
    """The same cells in other light of the cache.

    Parameters
    ----------
    known : LightMap
        Cells.
    light : ndarray, (C, K), complex128
        Radiance of the cache.

    Returns
    -------
    LightMap
        With that light.
    """
    mean = (known.mean @ light.T).T
    return replace(known, light=np.concatenate([mean, np.zeros((len(mean), 1))], axis=1))


def row_of(mi: Any, known: LightMap, p: Jit, n: Jit, active: Jit) -> Jit:  # noqa: ANN401
    """Rows of places in `LightMap.light`.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    known : LightMap
        Grid.
    p, n : Point3f, Normal3f
        Places and normals.
    active : Bool
        Which of them count; others get the row that is dark.

    Returns
    -------
    UInt32
        Rows.
    """
    import drjit as dr

    x, y, z = known.shape
    low = mi.Point3f(*opaque(mi, known.low))
    at = mi.Point3i(dr.floor((p - low) / dr.opaque(mi.Float, known.size)))
    sides = [dr.opaque(mi.Int32, v) for v in (x, y, z)]
    inside = active & (dr.min(at) >= -1)
    for part, count in zip((at.x, at.y, at.z), sides, strict=True):
        inside &= part <= count
    at = mi.Point3i(
        *(dr.clip(a, 0, count - 1) for a, count in zip((at.x, at.y, at.z), sides, strict=True))
    )
    big: Jit = dr.abs(n)
    along = dr.select(big.x >= dr.maximum(big.y, big.z), 0, dr.select(big.y >= big.z, 1, 2))
    value = dr.select(along == 0, n.x, dr.select(along == 1, n.y, n.z))
    side = 2 * along + dr.select(value > 0, 1, 0)
    cell = mi.UInt32(((at.z * sides[1] + at.y) * sides[0] + at.x) * SIDES + side)
    dark = dr.opaque(mi.UInt32, known.light.shape[1] - 1)
    return dr.select(inside, dr.gather(mi.UInt32, known.number, cell, inside), dark)


def tables_of(mi: Any, known: LightMap) -> list[tuple[Jit, Jit]]:  # noqa: ANN401
    """Light of the rows on the device, real and imaginary, by channel.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    known : LightMap
        Light.

    Returns
    -------
    list of tuple of Float
        Tables.
    """
    return [
        tuple(mi.Float(np.ascontiguousarray(part, np.float32)) for part in (row.real, row.imag))
        for row in known.light
    ]
