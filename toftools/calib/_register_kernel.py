"""Nearest surface behind every pixel of another camera; slow twin in tests/test_register.py."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from toftools.types import F32, F64

COLOURED, NO_RANGE, OUTSIDE, HIDDEN = 0, 1, 2, 3
LEAST_WEIGHT = 1e-6
"""A point whose surface has less of the four pixels around it is not seen."""


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def cover(u: F64, v: F64, w: F64, nearest: F64) -> None:
    """Draw quadrangles, the nearest in front.

    Parameters
    ----------
    u, v : ndarray, (N, 4)
        Corners in the image, in order around, px; NaN leaves a quadrangle out.
    w : ndarray, (N, 4)
        Inverse distance of the corners, 1/m.
    nearest : ndarray, (H, W)
        Largest inverse distance so far; 0 where nothing is. Changed in place.
    """
    height, width = nearest.shape
    for n in range(u.shape[0]):
        for b in range(1, 3):  # triangles 0 1 2 and 0 2 3
            u0, v0, u1, v1 = u[n, 0], v[n, 0], u[n, b], v[n, b]
            u2, v2 = u[n, b + 1], v[n, b + 1]
            area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
            if not abs(area) > 1e-12:
                continue
            w0, w1, w2 = w[n, 0], w[n, b], w[n, b + 1]
            rows = max(min(v0, v1, v2), 0.0), min(max(v0, v1, v2), height - 1.0)
            columns = max(min(u0, u1, u2), 0.0), min(max(u0, u1, u2), width - 1.0)
            if rows[0] > rows[1] or columns[0] > columns[1]:
                continue  # beside the image, however far
            for y in range(int(np.ceil(rows[0])), int(rows[1]) + 1):
                for x in range(int(np.ceil(columns[0])), int(columns[1]) + 1):
                    a1 = ((x - u0) * (v2 - v0) - (u2 - u0) * (y - v0)) / area
                    a2 = ((u1 - u0) * (y - v0) - (x - u0) * (v1 - v0)) / area
                    if a1 >= 0 and a2 >= 0 and a1 + a2 <= 1:
                        here = w0 + a1 * (w1 - w0) + a2 * (w2 - w0)
                        if here > nearest[y, x]:
                            nearest[y, x] = here


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _mix(
    at: tuple[float, float, float], lax: float, nearest: F64, image: F32, colour: F32
) -> tuple[float, bool]:
    """Sum of the colours of one surface around a point; weight, and whether another hides it."""
    height, width, channels = image.shape
    u, v, w = at
    x0, y0 = int(np.floor(u)), int(np.floor(v))
    weight, hidden = 0.0, False
    for k in range(4):
        x, y = x0 + k % 2, y0 + k // 2
        share = (1 - abs(u - x)) * (1 - abs(v - y))
        x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
        here = nearest[y, x]
        gap = 1 / w - 1 / here if here > 0 else 0.0
        hidden |= gap > lax and share > 0
        if abs(gap) <= lax:
            weight += share
            for c in range(channels):
                colour[c] += np.float32(share) * image[y, x, c]
    return weight, hidden


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def pick(
    place: tuple[F64, F64, F64],
    lax: F64,
    nearest: F64,
    image: F32,
    colours: F32,
    status: NDArray[np.uint8],
) -> None:
    """Colour of points, from those of the four pixels around them that show the same surface.

    Parameters
    ----------
    place : tuple of 3 ndarray, (N,)
        Column and row in the image, px, and inverse distance, 1/m; NaN where unknown.
    lax : ndarray, (N,)
        Difference of distance up to which two points may belong to one surface, m.
    nearest : ndarray, (H, W)
        Inverse distance of what the image shows, 1/m; 0 where unknown.
    image : ndarray, (H, W, C)
        Colours.
    colours : ndarray, (N, C)
        Zeros, filled with the colours of points that are seen, else with NaN.
    status : ndarray, (N,), uint8
        Filled with what became of every point.
    """
    height, width = nearest.shape
    for n in range(lax.size):
        u, v, w = place[0][n], place[1][n], place[2][n]
        weight = 0.0
        if not w > 0:
            status[n] = OUTSIDE if w == 0 else NO_RANGE
        elif not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            status[n] = OUTSIDE
        else:
            weight, hidden = _mix((u, v, w), lax[n], nearest, image, colours[n])
            status[n] = COLOURED if weight > LEAST_WEIGHT else (HIDDEN if hidden else OUTSIDE)
        scale = np.float32(1 / weight if weight > LEAST_WEIGHT else np.nan)
        for c in range(colours.shape[1]):
            colours[n, c] *= scale
