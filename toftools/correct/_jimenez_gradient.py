"""How a sum over all pairs of patches changes with the ranges of the patches: the exact gradient.

References: plain differentiation of the transfer of `_transfer`, in its terms. Inputs: patches,
what is sent and how much each receiver pulls. Fails at kinks, where a patch turns away from
another: there it is the slope of one side.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools._transfer import FAST, Patches, sincos
from toftools.types import C64, F32, F64
from toftools.units import TWO_PI

C128 = NDArray[np.complex128]


def through_transfer(now: Patches, ray: F32, d: F64, k: F64, pull: C128, sent: C64) -> F64:
    """Gradient of ``Re sum_u pull(u) G(u)``, G what `toftools._transfer.gather` gives.

    Parameters
    ----------
    now : Patches
        N patches that light each other.
    ray : ndarray, (3, N)
        Directions in which they move.
    d : ndarray, (N,)
        Their ranges, m; areas grow with the square.
    k : ndarray, (F,)
        Wave numbers of the modulation, rad per metre of path.
    pull : ndarray, (F, N)
        Weight of each irradiance.
    sent : ndarray, (F, N)
        Radiosity, whose phase falls by k per metre of the sender's range.

    Returns
    -------
    ndarray, (N,)
        Derivative by every range, 1/m.
    """
    scale = np.maximum(np.abs(pull).max(axis=1, keepdims=True), 1e-300)  # float32 has no room
    out = np.zeros((k.size, d.size))
    parts = [(pull / scale).real, (pull / scale).imag, sent.real, sent.imag]
    _gradient(
        *(np.ascontiguousarray(a, np.float32) for a in (now.position, now.normal, now.area_m2)),
        *(np.ascontiguousarray(a, np.float32) for a in (ray, d, k / TWO_PI, *parts)),
        out,
    )
    return np.asarray(np.sum(out * scale, axis=0))


@njit(parallel=True, cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _gradient(
    at: F32, normal: F32, area: F32, ray: F32, d: F32, turns_per_m: F32,
    qx: F32, qy: F32, bx: F32, by: F32, out: F64,
) -> None:  # fmt: skip
    """Fill out (F, N): node i as receiver of every j, and as sender to it.

    With D = p_j - p_i, r = |D|: W_ij = C_i C_j A_j / (r^2 (pi r^2 + A_j)), C_i = n_i . D,
    C_j = -n_j . D; t_ij = q_i b_j exp(jkr). The sum is Re(t_ij) W_ij; d_i moves p_i along its ray.
    """
    pi, one, two, zero = np.float32(np.pi), np.float32(1), np.float32(2), np.float32(0)
    for i in prange(at.shape[1]):
        px, py, pz = at[0, i], at[1, i], at[2, i]
        nx, ny, nz = normal[0, i], normal[1, i], normal[2, i]
        rx, ry, rz = ray[0, i], ray[1, i], ray[2, i]
        slope_i = -(nx * rx + ny * ry + nz * rz)  # of C_i
        ai, grow = area[i], two / d[i]  # of A_i, relative
        for f in range(turns_per_m.size):
            per_m = turns_per_m[f]
            k = per_m * (two * pi)
            qxi, qyi, bxi, byi = qx[f, i], qy[f, i], bx[f, i], by[f, i]
            total = zero
            for j in range(area.size):
                dx, dy, dz = at[0, j] - px, at[1, j] - py, at[2, j] - pz
                r2 = dx * dx + dy * dy + dz * dz + np.float32(1e-12)
                r = np.sqrt(r2)
                ci = nx * dx + ny * dy + nz * dz
                cj = -(normal[0, j] * dx + normal[1, j] * dy + normal[2, j] * dz)
                sees = one if (ci > 0) and (cj > 0) else zero
                slope_j = normal[0, j] * rx + normal[1, j] * ry + normal[2, j] * rz
                both = sees * ci * cj
                slope = sees * (slope_i * cj + ci * slope_j)  # of the product
                r2_slope = -two * (dx * rx + dy * ry + dz * rz)
                aj = area[j]
                ei, ej = one / (pi * r2 + ai), one / (pi * r2 + aj)
                inv = one / r2
                # i receives: W_ij and its logarithmic derivative by r^2.
                share = aj * ej * inv
                w = both * share
                dw = slope * share - w * r2_slope * (inv + pi * ej)
                # i sends: W_ji, whose area grows too.
                share = ai * ei * inv
                v = both * share
                dv = slope * share + v * (pi * r2 * ei * grow - r2_slope * (inv + pi * ei))
                s, c = sincos(r * per_m)
                dr = r2_slope * r * inv * np.float32(0.5)
                x, y = qxi * bx[f, j] - qyi * by[f, j], qxi * by[f, j] + qyi * bx[f, j]
                total += (x * c - y * s) * dw - k * (x * s + y * c) * w * dr
                x, y = qx[f, j] * bxi - qy[f, j] * byi, qx[f, j] * byi + qy[f, j] * bxi
                # What it sends is turned by -k too: Re(-jkt) = k Im(t).
                total += (x * c - y * s) * dv + k * (x * s + y * c) * v * (one - dr)
            out[f, i] = total
