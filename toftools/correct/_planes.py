"""Places and normals of an organised range image, from the best plane through each pixel.

A plane is affine in ``1 / z`` over the image (exactly without distortion). So every pixel takes,
of all small windows that contain it, the one whose affine fit of ``1 / z`` is best, and reads
place and normal off that plane: exact on planes up to their very edge, smoothed elsewhere, and
never a mean over an occlusion or a crease. References: the choice of the window is that of
M. Kuwahara et al., "Processing of RI-angiocardiographic images" (1976), with planes instead of
means (ours). Inputs: rays and ranges. Fails where objects are smaller than a window.
"""

import numpy as np
from numba import njit, prange

from toftools._turns import FAST
from toftools.types import F32, Bool

LEAST_COS = 0.1
"""Surfaces seen at a more grazing angle count as seen at this one (84 degrees)."""
FLATNESS = 0.5
"""A pixel whose window deviates from a plane by more than this share of its size is an edge."""
NEAREST_M = 0.01
"""Nothing is nearer: what noise or interference sends to zero has no surface."""
ROUNDING = 2e-6
"""Relative residual of 1/z that float32 leaves on a plane."""


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def fit(inverse_z: F32, noise: F32, reach: int, planes: F32) -> None:
    """Affine fit of 1/z in the window around every pixel.

    Parameters
    ----------
    inverse_z : ndarray, (H, W)
        1 / z, 1/m; NaN where unknown.
    noise : ndarray, (H, W)
        Relative standard deviation of it.
    reach : int
        Windows are 2 reach + 1 pixels wide; those that hold an unknown pixel or leave the image
        have no plane.
    planes : ndarray, (4, H, W)
        Filled: 1/z in the middle, its slopes per column and per row, and the rms residual
        relative to 1/z, at least what noise leaves; infinite where there is no plane.
    """
    height, width = inverse_z.shape
    n = np.float32((2 * reach + 1) ** 2)
    spread = np.float32(n * reach * (reach + 1) / 3)  # sum of squared steps
    for v in prange(height):
        planes[3, v] = np.inf
        if v < reach or v >= height - reach or width <= 2 * reach:
            continue
        sums = np.zeros((4, width), np.float32)
        for b in range(-reach, reach + 1):
            row = inverse_z[v + b]
            for a in range(-reach, reach + 1):
                for u in range(reach, width - reach):
                    q = row[u + a] - inverse_z[v, u]
                    sums[0, u] += q
                    sums[1, u] += np.float32(a) * q
                    sums[2, u] += np.float32(b) * q
                    sums[3, u] += q * q
        for u in range(reach, width - reach):
            q0 = inverse_z[v, u]
            mean, gu, gv = sums[0, u] / n, sums[1, u] / spread, sums[2, u] / spread
            left = sums[3, u] / n - mean * mean - (gu * gu + gv * gv) * spread / n
            left = np.sqrt(max(left, np.float32(0))) / q0
            planes[0, v, u] = q0 + mean
            planes[1, v, u] = gu
            planes[2, v, u] = gv
            floor = max(left, 2 * noise[v, u] + np.float32(ROUNDING))
            planes[3, v, u] = floor if floor < np.float32(1e3) else np.float32(np.inf)  # NaN too


@njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _best(planes: F32, v: int, reach: int, best: F32) -> None:
    """Window with the least residual for a row of pixels (the nearest of equals): best (4, W)."""
    height, width = planes.shape[1:]
    best[3] = np.inf
    for b in range(-min(reach, v), min(reach, height - 1 - v) + 1):
        for a in range(-reach, reach + 1):
            far = np.float32(1 + 1e-3 * (a * a + b * b))
            q, gu, gv, score = (
                planes[0, v + b],
                planes[1, v + b],
                planes[2, v + b],
                planes[3, v + b],
            )
            for u in range(max(-a, 0), min(width - a, width)):
                new = score[u + a] * far
                if new < best[3, u]:
                    best[0, u] = q[u + a] - np.float32(a) * gu[u + a] - np.float32(b) * gv[u + a]
                    best[1, u] = gu[u + a]
                    best[2, u] = gv[u + a]
                    best[3, u] = new


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def choose(
    rays: F32, steps: F32, solid: F32, range_m: F32, noise: F32, reach: int, planes: F32,
    vectors: F32, scalars: F32, masks: Bool,
) -> None:  # fmt: skip
    """Best of the windows that hold a pixel, and its plane there.

    Parameters
    ----------
    rays : ndarray, (3, H, W)
        Unit viewing directions.
    steps : ndarray, (4, H, W)
        Columns and rows per unit of x / z, columns and rows per unit of y / z.
    solid : ndarray, (H, W)
        Solid angle of each pixel, sr.
    range_m : ndarray, (H, W)
        Range, m.
    noise, reach, planes
        As for `fit`.
    vectors : ndarray, (2, 3, H, W)
        Filled: place and normal.
    scalars : ndarray, (2, H, W)
        Filled: cosine and area.
    masks : ndarray, (2, H, W), bool
        Filled: known and flat.
    """
    height, width = range_m.shape
    for v in prange(height):
        best = np.empty((4, width), np.float32)
        _best(planes, v, reach, best)
        for u in range(width):
            rx, ry, rz = rays[0, v, u], rays[1, v, u], rays[2, v, u]
            known = range_m[v, u] > np.float32(NEAREST_M)
            r = range_m[v, u] if known else np.float32(0)
            nx, ny, nz, cos, flat = -rx, -ry, -rz, np.float32(1), False
            q, gu, gv = best[0, u], best[1, u], best[2, u]
            bent = 4 * noise[v, u] + np.sqrt(solid[v, u]) * np.float32((2 * reach + 1) * FLATNESS)
            if known and best[3, u] < np.inf and q > 0 and abs(q * r * rz - 1) < bent:
                gx = gu * steps[0, v, u] + gv * steps[1, v, u]
                gy = gu * steps[2, v, u] + gv * steps[3, v, u]
                # q = n . (x, y, 1) / d, so the normal is along its coefficients.
                g0 = q - (gx * rx + gy * ry) / rz
                size = -1 / np.sqrt(gx * gx + gy * gy + g0 * g0)
                nx, ny, nz = gx * size, gy * size, g0 * size
                cos = -(nx * rx + ny * ry + nz * rz)
                r = 1 / (q * rz)
                flat = best[3, u] < bent
            cos = max(cos, np.float32(LEAST_COS))
            masks[0, v, u], masks[1, v, u] = known, flat
            scalars[0, v, u], scalars[1, v, u] = cos, r * r * solid[v, u] / cos
            vectors[0, 0, v, u], vectors[0, 1, v, u], vectors[0, 2, v, u] = r * rx, r * ry, r * rz
            vectors[1, 0, v, u], vectors[1, 1, v, u], vectors[1, 2, v, u] = nx, ny, nz
