"""Light that diffuse patches send each other, as phasors: the all-pairs kernel.

The irradiance phasor at patch u from patches v of radiosity b is

    E(u) = sum_v b(v) cos_u cos_v A_v / (pi r^2 + A_v) exp(j 2 pi f r / c),    r = |u - v|,

per frequency f. Far apart this is the form factor ``cos cos A / (pi r^2)``; the A_v in the
denominator bounds it for neighbours, and makes it that of a disc of the same area facing the
receiver on its axis (exact there: textbook, e.g. Howell's catalogue of configuration factors,
disc to coaxial element). Reference: instant radiosity with path lengths kept; A. Keller, "Instant
radiosity", SIGGRAPH 1997, 49-56. Inputs: positions, normals, areas, float32. Fails where patches
are larger than their distance and not facing each other (creases: refine there), and where
something stands between (visibility is not looked at).

Time: 2 cores with AVX-512 do 2.7 thousand million pairs per second and frequency; sine and cosine
are polynomials after range reduction, since a call of libm keeps the loop from vectorising.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from toftools.types import C64, F32, F64
from toftools.units import TWO_PI, path_to_phase

# No NaN comes in, so the compiler may reorder sums and vectorise them.
FAST = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}
# sin and cos of 2 pi t, |t| <= 1/2, as t P(t^2) and Q(t^2); least maximum error, fitted for this
# file: 1e-7 and 8e-7 before rounding, checked in tests/test_transfer.py.
SIN = (6.283182621, -41.34142303, 81.59618378, -76.5801010, 41.20539474, -12.27126122)
COS = (0.9999992251, -19.73898315, 64.92872620, -85.27240753, 58.79407501, -21.07683563)


@dataclass(frozen=True, eq=False)
class Patches:
    """Small flat diffuse surfaces.

    Parameters
    ----------
    position : ndarray, (3, N)
        Centres, m, float32.
    normal : ndarray, (3, N)
        Unit normals, float32.
    area_m2 : ndarray, (N,)
        Areas, float32.
    """

    position: F32
    normal: F32
    area_m2: F32


def gather(receivers: Patches, emitters: Patches, radiosity: C64, freqs_hz: F64) -> C64:
    """Irradiance phasors at patches from the light of others, all pairs.

    Parameters
    ----------
    receivers, emitters : Patches
        Where light arrives, and where it comes from; they may be the same.
    radiosity : ndarray, (F, M), complex
        Radiosity phasor of each emitter as it leaves (its phase is that at the emitter).
    freqs_hz : ndarray, (F,)
        Frequencies, Hz; 0 gives the plain irradiance.

    Returns
    -------
    ndarray, (F, N), complex64
        Irradiance phasors, in the unit of the radiosity.

    Examples
    --------
    A square of 1 cm^2 faces a receiver 1 m away.

    >>> from toftools.units import C_M_S
    >>> one = np.array([[0.0], [0.0], [1.0]], np.float32)
    >>> here = Patches(0 * one, one, np.ones(1, np.float32))
    >>> there = Patches(one, -one, np.full(1, 1e-4, np.float32))
    >>> e = gather(here, there, np.ones((1, 1), np.complex64), np.array([C_M_S / 4]))[0, 0]
    >>> bool(np.isclose(e, 1j * 1e-4 / np.pi, rtol=1e-3))  # a quarter turn at c / 4 hertz
    True
    """
    light = np.ascontiguousarray(radiosity, np.complex64)
    turns_per_m = np.asarray(path_to_phase(1.0, freqs_hz) / TWO_PI, np.float32)
    out = np.empty((light.shape[0], receivers.position.shape[1]), np.complex64)
    _gather(
        *(_rows(a) for a in (receivers.position, receivers.normal)),
        *(_rows(a) for a in (emitters.position, emitters.normal, emitters.area_m2)),
        _rows(light.real),
        _rows(light.imag),
        turns_per_m,
        out.view(np.float32).reshape(*out.shape, 2),
    )
    return out


def _rows(array: F32) -> F32:
    """Contiguous, float32 and writable in type: one flavour for the compiler."""
    rows = np.ascontiguousarray(array, np.float32)
    return rows if rows.flags.writeable else rows.copy()


@njit(inline="always", fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def sincos(turns: np.float32) -> tuple[np.float32, np.float32]:
    """Sine and cosine of an angle in turns, float32, without a branch."""
    t = turns - np.rint(turns)
    y = t * t
    s = np.float32(SIN[5])
    c = np.float32(COS[5])
    s = s * y + np.float32(SIN[4])
    c = c * y + np.float32(COS[4])
    s = s * y + np.float32(SIN[3])
    c = c * y + np.float32(COS[3])
    s = s * y + np.float32(SIN[2])
    c = c * y + np.float32(COS[2])
    s = s * y + np.float32(SIN[1])
    c = c * y + np.float32(COS[1])
    s = s * y + np.float32(SIN[0])
    c = c * y + np.float32(COS[0])
    return s * t, c


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _gather(
    at: F32, facing: F32, from_: F32, normal: F32, area: F32, re: F32, im: F32,
    turns_per_m: F32, out: F32,
) -> None:  # fmt: skip
    """Fill out (F, N, 2); the inner loop stores nothing, or it would not be vectorised."""
    for i in prange(at.shape[1]):
        px, py, pz = at[0, i], at[1, i], at[2, i]
        nx, ny, nz = facing[0, i], facing[1, i], facing[2, i]
        for f in range(turns_per_m.size):
            k = turns_per_m[f]
            x, y = np.float32(0), np.float32(0)
            for j in range(area.size):
                dx, dy, dz = from_[0, j] - px, from_[1, j] - py, from_[2, j] - pz
                a = area[j]
                r2 = dx * dx + dy * dy + dz * dz + np.float32(1e-12)
                cos_u = max(nx * dx + ny * dy + nz * dz, np.float32(0))
                cos_v = -(normal[0, j] * dx + normal[1, j] * dy + normal[2, j] * dz)
                cos_v = max(cos_v, np.float32(0))
                # Both cosines lack a division by r: hence r^2 in the denominator.
                weight = cos_u * cos_v * a / (r2 * (np.float32(np.pi) * r2 + a))
                s, c = sincos(np.sqrt(r2) * k)
                x += weight * (re[f, j] * c - im[f, j] * s)
                y += weight * (re[f, j] * s + im[f, j] * c)
            out[f, i, 0] = x
            out[f, i, 1] = y
