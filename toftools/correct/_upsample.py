"""Irradiance on every pixel from a sparse, adaptively refined grid of pixels.

Reference: `_tiles` has the idea. A cell is refined where its corners lie on different surfaces, or
where the light half-way differs from what its corners predict by more than four tolerances: by
then its quarters, whose second-order error is a fourth of that, would exceed one. Inputs: surface,
patches at three scales. Fails where light changes within a cell and not at its corners (contact
shadows, which this transport has none of).
"""

import numpy as np
from numba import njit, prange

from toftools._turns import FAST
from toftools.correct import kernel_input
from toftools.correct._patches import LIGHT, merged
from toftools.correct._scene import Optics, Surface, lit
from toftools.correct._tiles import MOST, light_on, listed
from toftools.types import C64, F32, Bool
from toftools.units import TWO_PI, path_to_phase

Cell = tuple[int, int, int, int]
# First and last row, first and last column, the last ones shared with the next cell.

TILE = 16
"""Width of a tile in units of the finest block."""
PIXELS = 80_000
"""Frames of more pixels than this have finest blocks of more than one pixel."""
LEAST_CELL = 4
"""Cells up to this width in the same unit are not refined because surfaces meet in them."""
PATCH_SHARE = 1.0
"""Share of the tolerance that the bound of one patch may use up: bounds are some ten times the
errors, which add up at random."""
SAME_NORMAL, OFF_PLANE = np.float32(0.9), np.float32(0.25)
"""Corners count for a pixel if normals agree to 26 degrees and the slope between them to 14."""
LEAST_WEIGHT = np.float32(0.2)
"""A pixel whose corners on its plane have less weight than this gets its own gathering."""


def irradiance(view: Optics, seen: Surface, values: C64, tol_m: float) -> C64:
    """Irradiance phasors on all pixels.

    Parameters
    ----------
    view, seen
        Camera and surface.
    values : ndarray, (F, H, W)
        Measured phasors.
    tol_m : float
        Error of range to stay below, m.

    Returns
    -------
    ndarray, (F, H, W), complex64
        Zero where no surface is known.
    """
    n_freqs, height, width = values.shape
    unit = max(1, int(np.ceil(np.sqrt(height * width / PIXELS))))
    scales = [merged(view, seen, values, unit * block) for block in (TILE, 4, 1)]
    wave = np.asarray(path_to_phase(1.0, view.freqs_hz), np.float32)
    # d range = d phase / 2k, and d phase = dE / L where the direct light dominates.
    allowed = 2 * np.float32(tol_m) * wave[:, None, None] * lit(view, seen)
    out = np.zeros((n_freqs, height, width, 2), np.float32)
    _light(
        *(kernel_input(a) for a in (seen.position, seen.normal, seen.known, allowed, *scales)),
        wave / np.float32(TWO_PI), unit * TILE, out,
    )  # fmt: skip
    return out.view(np.complex64)[..., 0]


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _limit(known: Bool, allowed: F32, box: Cell) -> np.float32:
    """Error of irradiance that one patch may leave: a share of what the mean pixel may have."""
    total, n = np.float32(0), 0
    for v in range(box[0], box[1] + 1):
        for u in range(box[2], box[3] + 1):
            if known[v, u]:
                total += allowed[0, v, u]
                n += 1
    return np.float32(PATCH_SHARE) * total / np.float32(max(n, 1))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def _alike(position: F32, normal: F32, v: int, u: int, b: int, a: int) -> bool:
    """Whether two pixels lie on one plane, roughly."""
    dx = position[0, b, a] - position[0, v, u]
    dy = position[1, b, a] - position[1, v, u]
    dz = position[2, b, a] - position[2, v, u]
    nx, ny, nz = normal[0, v, u], normal[1, v, u], normal[2, v, u]
    cos = nx * normal[0, b, a] + ny * normal[1, b, a] + nz * normal[2, b, a]
    off = nx * dx + ny * dy + nz * dz
    near = OFF_PLANE * OFF_PLANE * (dx * dx + dy * dy + dz * dz)
    return bool(cos > SAME_NORMAL and off * off <= near)


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _blend(
    position: F32, normal: F32, known: Bool, out: F32, v: int, u: int,
    cell: Cell, box: Cell, into: F32,
) -> np.float32:  # fmt: skip
    """Light at a pixel from the corners of its cell on its plane; their bilinear weight."""
    top, bottom, left, right = cell
    y = np.float32(v - top) / np.float32(max(bottom - top, 1))
    x = np.float32(u - left) / np.float32(max(right - left, 1))
    total = np.float32(0)
    into[:] = 0
    for i in range(4):
        b, a = bottom if i >= 2 else top, right if i % 2 else left
        w = (y if i >= 2 else 1 - y) * (x if i % 2 else 1 - x)
        if w > 0 and known[b, a] and _alike(position, normal, v, u, b, a):
            total += w
            for f in range(into.shape[0]):
                into[f, 0] += w * out[b - box[0], a - box[2], f, 0]
                into[f, 1] += w * out[b - box[0], a - box[2], f, 1]
    if total > 0:
        into /= total
    return total


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _refine(
    position: F32, normal: F32, known: Bool, allowed: F32, done: Bool, chosen: F32, n: int,
    turns: F32, cell: Cell, box: Cell, out: F32,
) -> int:  # fmt: skip
    """Gather half-way between a cell's corners; 1 if surfaces meet in it, 2 if light is bent."""
    top, bottom, left, right = cell
    rows, cols = (top, (top + bottom) // 2, bottom), (left, (left + right) // 2, right)
    guess = np.zeros((turns.size, 2), np.float32)
    again = 0
    for i in range(3):
        for j in range(3):
            v, u = rows[i], cols[j]
            if not known[v, u] or done[v - box[0], u - box[2]]:
                continue
            y, x = v - box[0], u - box[2]
            weight = np.float32(0)
            if i == 1 or j == 1:
                weight = _blend(position, normal, known, out, v, u, cell, box, guess)
            light_on(position, normal, v, u, chosen, n, turns, out, y, x)
            done[v - box[0], u - box[2]] = True
            if i == 1 or j == 1:
                again = max(again, 1 if weight < np.float32(0.99) else 0)
                for f in range(turns.size):
                    re, im = out[y, x, f, 0] - guess[f, 0], out[y, x, f, 1] - guess[f, 1]
                    if weight > LEAST_WEIGHT and re * re + im * im > 16 * allowed[f, v, u] ** 2:
                        again = 2
    return again


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _fill(
    position: F32, normal: F32, known: Bool, done: Bool, chosen: F32, n: int, turns: F32,
    cell: Cell, box: Cell, out: F32,
) -> None:  # fmt: skip
    """Interpolate the pixels of a cell; gather those without a corner on their plane."""
    guess = np.zeros((turns.size, 2), np.float32)
    for v in range(cell[0], cell[1] + 1):
        for u in range(cell[2], cell[3] + 1):
            if not known[v, u] or done[v - box[0], u - box[2]]:
                continue
            y, x = v - box[0], u - box[2]
            if _blend(position, normal, known, out, v, u, cell, box, guess) < LEAST_WEIGHT:
                light_on(position, normal, v, u, chosen, n, turns, out, y, x)
            else:
                for f in range(turns.size):
                    out[y, x, f, 0], out[y, x, f, 1] = guess[f, 0], guess[f, 1]


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _tile(
    position: F32, normal: F32, known: Bool, allowed: F32, done: Bool, chosen: F32, n: int,
    turns: F32, box: Cell, least: int, out: F32,
) -> None:  # fmt: skip
    """Light on one tile: a stack of cells, refined until they need no more."""
    stack = np.empty((64, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = box
    count = 1
    while count > 0:
        count -= 1
        top, bottom, left, right = stack[count]
        cell = (top, bottom, left, right)
        again = _refine(
            position, normal, known, allowed, done, chosen, n, turns, cell, box, out
        )  # fmt: skip
        size = max(bottom - top, right - left)
        split = (again == 2 and size > 2) or (again == 1 and size > least)
        mid_v, mid_u = (top + bottom) // 2, (left + right) // 2
        for i in range(2):
            for j in range(2):
                first_v, last_v = (mid_v, bottom) if i else (top, mid_v)
                first_u, last_u = (mid_u, right) if j else (left, mid_u)
                if split:
                    stack[count, 0], stack[count, 1] = first_v, last_v
                    stack[count, 2], stack[count, 3] = first_u, last_u
                    count += 1
                else:
                    quarter = (first_v, last_v, first_u, last_u)
                    _fill(position, normal, known, done, chosen, n, turns, quarter, box, out)


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _light(
    position: F32, normal: F32, known: Bool, allowed: F32, coarse: F32, middle: F32, fine: F32,
    turns: F32, size: int, arrived: F32,
) -> None:  # fmt: skip
    """Fill arrived (F, H, W, 2), tile by tile."""
    height, width = known.shape
    k = np.float32(TWO_PI) * turns.max()
    for i in prange(coarse.shape[0]):
        chosen = np.empty((LIGHT + 2 * turns.size, MOST), np.float32)
        out = np.empty((size + 1, size + 1, turns.size, 2), np.float32)
        done = np.empty((size + 1, size + 1), np.bool_)
        for j in range(coarse.shape[1]):
            top, left = i * size, j * size
            box = (top, min(top + size, height - 1), left, min(left + size, width - 1))
            limit = _limit(known, allowed, box)
            n = listed(coarse, middle, fine, coarse[i, j], k, limit, chosen)
            out[:] = 0
            done[:] = False
            if n > 0:
                _tile(
                    position, normal, known, allowed, done, chosen, n, turns, box,
                    max(size * LEAST_CELL // TILE, 1), out,
                )  # fmt: skip
            for v in range(top, min(top + size, height)):
                for u in range(left, min(left + size, width)):
                    for f in range(turns.size):
                        arrived[f, v, u, 0] = out[v - top, u - left, f, 0]
                        arrived[f, v, u, 1] = out[v - top, u - left, f, 1]
