"""Indirect light on every pixel, gathered where it must be, from patches as coarse as may be.

The image is cut into tiles. For each tile the emitters are listed once, starting from the coarsest
patches: one is opened into its blocks of the next scale where its error could matter. To second
order that error is at most about ``E_v s^2 (3 / d^2 + k^2 / 2)``: E_v the irradiance the patch can
give, s^2 its mean squared radius, d its least distance from the tile, k = 2 pi f / c. The phasor
of irradiance is then gathered on a sparse grid of pixels, refined where the second difference on
a surface exceeds the tolerance or where surfaces meet, and interpolated bilinearly, per pixel
between the corners that lie on its plane. References: second-order control of cached radiance,
J. Marco, "Transient light transport" (thesis, 2018), chapter 2, carried to surfaces and phasors;
lists of opened patches are those of hierarchical radiosity (textbook). Inputs: surface, patches at
three scales. Fails where an emitter is nearer than its own size at the finest scale.
"""

import numpy as np
from numba import njit

from toftools._transfer import sincos
from toftools._turns import FAST
from toftools.correct._patches import AREA, LIGHT, NORMAL, PLACE, SPREAD
from toftools.types import F32

FAR = np.float32(3.0)
"""Second derivatives of ``cos cos / r^2`` relative to it, times r^2 / 2: about this much."""
COPLANAR, LEVEL = np.float32(0.95), np.float32(0.05)
"""Patches are on one plane if normals agree to 18 degrees and the slope between them to 3."""
MOST = 12_288
"""Patches listed per tile; beyond, nothing more is opened."""


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def _could_give(
    p: F32, i: int, j: int, c: int, t: F32, a: int, k: np.float32
) -> tuple[np.float32, np.float32]:
    """Most irradiance that patch p[i, j, c] can give the tile's patch t[a], and its error."""
    dx = p[i, j, c, PLACE] - t[a, PLACE]
    dy = p[i, j, c, PLACE + 1] - t[a, PLACE + 1]
    dz = p[i, j, c, PLACE + 2] - t[a, PLACE + 2]
    nx, ny, nz = p[i, j, c, NORMAL], p[i, j, c, NORMAL + 1], p[i, j, c, NORMAL + 2]
    area, spread = p[i, j, c, AREA], p[i, j, c, SPREAD]
    mx, my, mz = t[a, NORMAL], t[a, NORMAL + 1], t[a, NORMAL + 2]
    reach, apart = 2 * np.sqrt(t[a, SPREAD]), np.sqrt(dx * dx + dy * dy + dz * dz)
    up, down = mx * dx + my * dy + mz * dz, -(nx * dx + ny * dy + nz * dz)
    if mx * nx + my * ny + mz * nz > COPLANAR and abs(up) < LEVEL * (apart + reach):
        return np.float32(0), np.float32(0)  # one plane: no light worth a refinement
    d = max(apart - reach, np.float32(0.25) * np.sqrt(area))
    room = reach + 2 * np.sqrt(spread)
    cosines = min((up + room) / d, np.float32(1)) * min((down + room) / d, np.float32(1))
    if up + room <= 0 or down + room <= 0:
        return np.float32(-1), np.float32(0)
    power = p[i, j, c, LIGHT] ** 2 + p[i, j, c, LIGHT + 1] ** 2
    give = np.sqrt(power) * area * cosines / (np.float32(np.pi) * d * d + area)
    return give, give * spread * (FAR / (d * d) + np.float32(0.5) * k * k)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def _judge(p: F32, i: int, j: int, tile: F32, k: np.float32, limit: np.float32) -> int:
    """What to do with the patches of a block: 0 leave out, 1 list, 2 open."""
    verdict = 0
    for c in range(p.shape[2]):
        if p[i, j, c, AREA] <= 0:
            break
        for a in range(tile.shape[0]):
            if tile[a, AREA] <= 0:
                break
            give, error = _could_give(p, i, j, c, tile, a, k)
            if error > limit:
                return 2
            if give >= 0:
                verdict = 1
    return verdict


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _append(p: F32, i: int, j: int, chosen: F32, n: int) -> int:
    """List the used patches of a block."""
    for c in range(p.shape[2]):
        if p[i, j, c, AREA] > 0 and n < chosen.shape[1]:
            for x in range(p.shape[3]):
                chosen[x, n] = p[i, j, c, x]
            n += 1
    return n


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def listed(
    coarse: F32, middle: F32, fine: F32, tile: F32, k: np.float32, limit: np.float32, chosen: F32
) -> int:
    """Emitters of one tile, as coarse as the limits allow.

    Parameters
    ----------
    coarse, middle, fine : ndarray, (rows, columns, C, 8 + 2 F)
        Patches at three scales, each 4 times finer than the one before.
    tile : ndarray, (C, 8 + 2 F)
        Patches of the tile: where the receivers are.
    k : float
        Wave number of the highest frequency, rad/m.
    limit : float
        Error of irradiance that one patch may leave there.
    chosen : ndarray, (8 + 2 F, N)
        Filled.

    Returns
    -------
    int
        How many.
    """
    n = 0
    for i in range(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            verdict = _judge(coarse, i, j, tile, k, limit)
            if verdict == 1 or (verdict == 2 and n > chosen.shape[1] // 2):
                n = _append(coarse, i, j, chosen, n)
            elif verdict == 2:
                n = _opened(middle, fine, 4 * i, 4 * j, tile, k, limit, chosen, n)
    return n


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _opened(
    middle: F32, fine: F32, i0: int, j0: int, tile: F32, k: np.float32,
    limit: np.float32, chosen: F32, n: int,
) -> int:  # fmt: skip
    """List a coarse block by its blocks of the middle scale, those that must be by their pixels."""
    for i in range(i0, min(i0 + 4, middle.shape[0])):
        for j in range(j0, min(j0 + 4, middle.shape[1])):
            verdict = _judge(middle, i, j, tile, k, limit)
            if verdict == 1 or (verdict == 2 and n > chosen.shape[1] * 3 // 4):
                n = _append(middle, i, j, chosen, n)
            elif verdict == 2:
                for a in range(4 * i, min(4 * i + 4, fine.shape[0])):
                    for b in range(4 * j, min(4 * j + 4, fine.shape[1])):
                        if _judge(fine, a, b, tile, k, limit) > 0:
                            n = _append(fine, a, b, chosen, n)
    return n


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _sum(
    px: np.float32, py: np.float32, pz: np.float32, nx: np.float32, ny: np.float32,
    nz: np.float32, e: F32, n: int, f: int, turns: np.float32,
) -> tuple[np.float32, np.float32]:  # fmt: skip
    """Irradiance phasor at one place from n listed patches; as in `toftools._transfer`."""
    x, y = np.float32(0), np.float32(0)
    for j in range(n):
        dx, dy, dz = e[1, j] - px, e[2, j] - py, e[3, j] - pz
        a = e[0, j]
        r2 = dx * dx + dy * dy + dz * dz + np.float32(1e-12)
        cos_u = max(nx * dx + ny * dy + nz * dz, np.float32(0))
        cos_v = max(-(e[4, j] * dx + e[5, j] * dy + e[6, j] * dz), np.float32(0))
        weight = cos_u * cos_v * a / (r2 * (np.float32(np.pi) * r2 + a))
        s, c = sincos(np.sqrt(r2) * turns)
        re, im = e[8 + 2 * f, j], e[9 + 2 * f, j]
        x += weight * (re * c - im * s)
        y += weight * (re * s + im * c)
    return x, y


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def light_on(
    position: F32, normal: F32, v: int, u: int, chosen: F32, n: int, turns: F32,
    out: F32, i: int, j: int,
) -> None:  # fmt: skip
    """Irradiance phasors at one pixel from the listed patches.

    Parameters
    ----------
    position, normal : ndarray, (3, H, W)
        Surface.
    v, u : int
        Row and column.
    chosen : ndarray, (8 + 2 F, N)
        Listed patches, of which n count.
    n : int
        How many.
    turns : ndarray, (F,)
        Turns per metre.
    out : ndarray, (rows, columns, F, 2)
        Filled at (i, j).
    i, j : int
        Where to.
    """
    for f in range(turns.size):
        re, im = _sum(
            position[0, v, u], position[1, v, u], position[2, v, u],
            normal[0, v, u], normal[1, v, u], normal[2, v, u], chosen, n, f, turns[f],
        )  # fmt: skip
        out[i, j, f, 0], out[i, j, f, 1] = re, im
