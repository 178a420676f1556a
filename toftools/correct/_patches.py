"""Pixels of square image blocks merged into patches that share a plane: emitters at three scales.

A patch at its pixels' centroid (weighted by the light they give) is right to first order; what is
left is of second order in its size over the distance. Blocks that hold an edge would break that,
so within a block only pixels of one plane are merged, into at most `CLUSTERS` patches.
References: the centroid rule is that of hierarchical radiosity (textbook); merging by planes is
ours. Inputs: surface, phasors. Fails where a receiver is nearer than a block's size: take a
smaller scale there, as `_tiles` does.
"""

import numpy as np
from numba import njit, prange

from toftools._transfer import sincos
from toftools._turns import FAST
from toftools.correct import kernel_input
from toftools.correct._scene import Optics, Surface
from toftools.types import C64, F32, Bool
from toftools.units import TWO_PI, path_to_phase

CLUSTERS = 4
SAME_NORMAL = np.float32(0.95)
"""Cosine between normals of one plane, 18 degrees."""
SAME_PLANE = np.float32(0.05)
"""Distance from the plane in units of range times the angle of a block: below it is one plane."""
AREA, PLACE, NORMAL, SPREAD, LIGHT = 0, 1, 4, 7, 8
"""Columns of a patch: area, place (3), normal (3), mean squared radius, radiosity (2 F)."""


def merged(view: Optics, seen: Surface, values: C64, block_px: int) -> F32:
    """Patches of one scale.

    Parameters
    ----------
    view : Optics
        Of the camera.
    seen : Surface
        Surface of the frame; only flat pixels emit.
    values : ndarray, (F, H, W), complex64
        Measured phasors.
    block_px : int
        Size of a block; 1 keeps every pixel.

    Returns
    -------
    ndarray, (rows, columns, C, 8 + 2 F), float32
        Patches of each block, the used ones first; area 0 for the others. Phasors are those at
        the patch.
    """
    n_freqs, height, width = values.shape
    rows, cols = -(-height // block_px), -(-width // block_px)
    table = np.empty((rows, cols, min(CLUSTERS, block_px**2), LIGHT + 2 * n_freqs), np.float32)
    _merge(
        kernel_input(seen.position),
        kernel_input(seen.normal),
        kernel_input(seen.area_m2),
        kernel_input(seen.flat),
        view.solid_angle_sr,
        kernel_input(values).view(np.float32).reshape(n_freqs, height, width, 2),
        np.asarray(path_to_phase(1.0, view.freqs_hz) / TWO_PI, np.float32),
        block_px,
        table,
    )
    return table


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _cluster(first: F32, used: int, at: F32, limit: np.float32) -> int:
    """Which patch a pixel joins: the first on its plane, else a new one, else the closest."""
    near, best = 0, np.float32(-1e9)
    for c in range(used):
        f = first[c]
        cos = at[3] * f[3] + at[4] * f[4] + at[5] * f[5]
        off = abs(f[3] * (at[0] - f[0]) + f[4] * (at[1] - f[1]) + f[5] * (at[2] - f[2]))
        if cos > SAME_NORMAL and off < limit:
            return c
        if cos - off / limit > best:
            near, best = c, cos - off / limit
    return used if used < first.shape[0] else near


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _add(s: F32, at: F32, a: np.float32, r: np.float32, light: F32, turns: F32) -> None:
    """Add a pixel's area, moments (weighted by area times amplitude) and turned phasors."""
    w = a * np.sqrt(light[0, 0] ** 2 + light[0, 1] ** 2) + np.float32(1e-12)
    s[0] += a
    s[1] += w
    for i in range(3):
        s[2 + i] += w * at[i]
        s[5 + i] += a * at[3 + i]
    s[8] += w * (at[0] * at[0] + at[1] * at[1] + at[2] * at[2])
    for f in range(turns.size):
        sn, cs = sincos(-r * turns[f])
        s[9 + 2 * f] += a * (light[f, 0] * cs - light[f, 1] * sn)
        s[10 + 2 * f] += a * (light[f, 0] * sn + light[f, 1] * cs)


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _finish(s: F32, patch: F32) -> None:
    """Sums to a patch."""
    patch[:] = 0
    if s[0] <= 0:
        return
    patch[AREA] = s[0]
    size = np.sqrt(s[5] * s[5] + s[6] * s[6] + s[7] * s[7])
    left = s[8] / s[1]
    for i in range(3):
        patch[PLACE + i] = s[2 + i] / s[1]
        patch[NORMAL + i] = s[5 + i] / size
        left -= patch[PLACE + i] * patch[PLACE + i]
    patch[SPREAD] = max(left, s[0] / 6)  # mean squared radius of a square, at least
    for i in range(patch.size - LIGHT):
        patch[LIGHT + i] = s[9 + i] / s[0]


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _merge(
    position: F32, normal: F32, area: F32, flat: Bool, solid: F32, values: F32,
    turns: F32, block: int, table: F32,
) -> None:  # fmt: skip
    """Fill the table, block row by block row."""
    height, width = area.shape
    for i in prange(table.shape[0]):
        n = table.shape[2]
        first, sums = np.empty((n, 6), np.float32), np.empty((n, table.shape[3] + 1), np.float32)
        at = np.empty(6, np.float32)
        for j in range(table.shape[1]):
            used = 0
            sums[:] = 0
            for v in range(i * block, min(i * block + block, height)):
                for u in range(j * block, min(j * block + block, width)):
                    if not flat[v, u]:
                        continue
                    for k in range(3):
                        at[k], at[3 + k] = position[k, v, u], normal[k, v, u]
                    r = np.sqrt(at[0] * at[0] + at[1] * at[1] + at[2] * at[2])
                    c = _cluster(first, used, at, SAME_PLANE * block * r * np.sqrt(solid[v, u]))
                    if c == used:
                        first[c] = at
                        used += 1
                    _add(sums[c], at, area[v, u], r, values[:, v, u], turns)
            for c in range(n):
                _finish(sums[c], table[i, j, c])
