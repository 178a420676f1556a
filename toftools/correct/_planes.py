"""Places and normals of an organised range image, from the best plane through each pixel.

A plane is affine in ``1 / z`` over the normalised image coordinates (x / z, y / z), whatever the
camera. So every pixel takes, of all small windows that contain it, the one whose affine fit of
``1 / z`` is best, and reads place and normal off that plane: exact on planes up to their very
edge, smoothed elsewhere, and never a mean over an occlusion or a crease. References: the choice
of the window is that of M. Kuwahara et al., "Processing of RI-angiocardiographic images" (1976),
with planes instead of means (ours). Inputs: rays and ranges. Fails where objects are smaller than
a window.
"""

import numpy as np
from numba import njit, prange

from toftools.types import F32, Bool

LEAST_COS = 0.1
"""Surfaces seen at a more grazing angle count as seen at this one (84 degrees)."""
FLATNESS = 0.5
"""A pixel whose window deviates from a plane by more than this share of its size is an edge."""


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _sums(rays: F32, range_m: F32, v: int, u: int, reach: int, s: F32) -> None:
    """Moments of x, y and the relative 1/z in the window around a pixel."""
    height, width = range_m.shape
    cz = rays[2, v, u]
    x0, y0, z0 = rays[0, v, u] / cz, rays[1, v, u] / cz, range_m[v, u] * cz
    s[:] = 0
    for b in range(max(v - reach, 0), min(v + reach + 1, height)):
        for a in range(max(u - reach, 0), min(u + reach + 1, width)):
            z = range_m[b, a] * rays[2, b, a]
            if z > 0:
                x = rays[0, b, a] / rays[2, b, a] - x0
                y = rays[1, b, a] / rays[2, b, a] - y0
                q = z0 / z - 1
                s[0] += 1
                s[1] += x
                s[2] += y
                s[3] += q
                s[4] += x * x
                s[5] += x * y
                s[6] += y * y
                s[7] += x * q
                s[8] += y * q
                s[9] += q * q


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit(rays: F32, range_m: F32, noise_m: F32, reach: int, planes: F32) -> None:
    """Affine fit of 1/z around every pixel.

    Parameters
    ----------
    rays : ndarray, (3, H, W)
        Unit viewing directions.
    range_m, noise_m : ndarray, (H, W)
        Range and its standard deviation, m.
    reach : int
        Windows are 2 reach + 1 pixels wide.
    planes : ndarray, (5, H, W)
        Filled: 1/z in the middle, its two slopes, its rms residual relative to it (infinite
        where there is no plane), and the residual that noise may leave.
    """
    height, width = range_m.shape
    for v in prange(height):
        s = np.empty(10, np.float64)
        for u in range(width):
            planes[3, v, u] = np.inf
            z = range_m[v, u] * rays[2, v, u]
            if not z > 0:
                continue
            _sums(rays, range_m, v, u, reach, s)
            n, x, y, q = s[0], s[1], s[2], s[3]
            cxx, cxy, cyy = s[4] - x * x / n, s[5] - x * y / n, s[6] - y * y / n
            cxq, cyq, cqq = s[7] - x * q / n, s[8] - y * q / n, s[9] - q * q / n
            det = cxx * cyy - cxy * cxy
            if n < 3 or det <= 1e-6 * cxx * cyy:
                continue
            gx, gy = (cyy * cxq - cxy * cyq) / det, (cxx * cyq - cxy * cxq) / det
            planes[0, v, u] = (1 + (q - gx * x - gy * y) / n) / z
            planes[1, v, u] = gx / z
            planes[2, v, u] = gy / z
            planes[3, v, u] = np.sqrt(max(cqq - gx * cxq - gy * cyq, 0.0) / n)
            planes[4, v, u] = 2 * noise_m[v, u] / range_m[v, u] + 1e-5


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _best(planes: F32, v: int, u: int, reach: int) -> tuple[int, int]:
    """Window with the least residual; within the noise, the nearest one. (-1, -1) if none."""
    height, width = planes.shape[1:]
    best, bv, bu = np.float32(np.inf), -1, -1
    for b in range(max(v - reach, 0), min(v + reach + 1, height)):
        for a in range(max(u - reach, 0), min(u + reach + 1, width)):
            far = (b - v) * (b - v) + (a - u) * (a - u)
            score = max(planes[3, b, a], planes[4, b, a]) * (1 + np.float32(1e-3) * far)
            if score < best:
                best, bv, bu = score, b, a
    return bv, bu


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def choose(
    rays: F32, solid: F32, range_m: F32, noise_m: F32, reach: int, planes: F32,
    vectors: F32, scalars: F32, masks: Bool,
) -> None:  # fmt: skip
    """Best of the windows that hold a pixel, and its plane there.

    Parameters
    ----------
    rays, range_m, noise_m, reach, planes
        As for `fit`.
    solid : ndarray, (H, W)
        Solid angle of each pixel, sr.
    vectors : ndarray, (2, 3, H, W)
        Filled: place and normal.
    scalars : ndarray, (2, H, W)
        Filled: cosine and area.
    masks : ndarray, (2, H, W), bool
        Filled: known and flat.
    """
    height, width = range_m.shape
    for v in prange(height):
        for u in range(width):
            rx, ry, rz = rays[0, v, u], rays[1, v, u], rays[2, v, u]
            known = range_m[v, u] > 0
            r = range_m[v, u] if known else np.float32(0)
            nx, ny, nz, cos, flat = -rx, -ry, -rz, np.float32(1), False
            bv, bu = _best(planes, v, u, reach)
            if known and bv >= 0 and rz > 0:
                gx, gy = planes[1, bv, bu], planes[2, bv, bu]
                z = rays[2, bv, bu]
                x, y = rx / rz - rays[0, bv, bu] / z, ry / rz - rays[1, bv, bu] / z
                q = planes[0, bv, bu] + gx * x + gy * y
                # q = n . (x, y, 1) / d, so the normal is along its coefficients.
                g0 = q - gx * rx / rz - gy * ry / rz
                size = np.sqrt(gx * gx + gy * gy + g0 * g0)
                bent = 2 * planes[4, bv, bu] + np.sqrt(solid[v, u]) * (2 * reach + 1) * FLATNESS
                if q > 0 and abs(q * r * rz - 1) < bent:
                    nx, ny, nz = -gx / size, -gy / size, -g0 / size
                    cos = -(nx * rx + ny * ry + nz * rz)
                    r = 1 / (q * rz)
                    flat = planes[3, bv, bu] < bent
            cos = max(cos, np.float32(LEAST_COS))
            masks[0, v, u], masks[1, v, u] = known, flat
            scalars[0, v, u], scalars[1, v, u] = cos, r * r * solid[v, u] / cos
            vectors[0, 0, v, u], vectors[0, 1, v, u], vectors[0, 2, v, u] = r * rx, r * ry, r * rz
            vectors[1, 0, v, u], vectors[1, 1, v, u], vectors[1, 2, v, u] = nx, ny, nz
