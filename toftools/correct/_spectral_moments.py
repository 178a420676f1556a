"""Trigonometric moment problems, pixel by pixel: Pisarenko's and the maximum entropy estimate.

Moments ``c_n = sum_l a_l exp(j n phi_l)``, n = 1..m, are phasors at harmonic frequencies, phi_l the
phases of the returns at the first. ``T_jk = c_(j-k)`` is their Toeplitz matrix; c_0 is unknown, and
T + c_0 is positive semi-definite from c_0 = -lambda on, lambda the smallest eigenvalue of T with a
zero diagonal. Reference: textbook (Stoica and Moses, "Spectral Analysis of Signals", chapters 3
and 4). Inputs: phasors of harmonics, ascending. Fails where returns are closer than the noise lets
roots part; with fewer returns than m the null space is larger, and the roots that are not returns
lie anywhere.
"""

import numpy as np
from numba import njit, prange

from toftools.correct._propagate import STEP
from toftools.correct._spectral_fit import linear_amplitudes
from toftools.correct._spectral_roots import Complexes, roots, smallest
from toftools.types import F64

BLOCK = 128
"""Pixels per parallel task."""


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def toeplitz(c: Complexes, matrix: Complexes) -> None:
    """Toeplitz matrix of moments c_1..c_m, with a diagonal of zero: entry (j, k) is c_(j-k)."""
    for j in range(c.size + 1):
        matrix[j, j] = 0.0
        for k in range(j):
            matrix[j, k] = c[j - k - 1]
            matrix[k, j] = np.conj(c[j - k - 1])


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def pisarenko(z: Complexes) -> tuple[F64, F64, F64]:
    """Pisarenko's estimate, its returns in the order of what they explain.

    Parameters
    ----------
    z : ndarray, (M, P), complex
        Moments c_1..c_m.

    Returns
    -------
    angles, weights : ndarray, (M, P)
        Phases at the first harmonic, rad, and amplitudes by least squares.
    total : ndarray, (P,)
        c_0, the sum of the amplitudes without ambient light.
    """
    m, n = z.shape
    angles, weights, total = np.empty((m, n)), np.empty((m, n)), np.empty(n)
    harmonics = np.arange(1.0, m + 1)
    for block in prange((n + BLOCK - 1) // BLOCK):
        matrix, vectors = np.empty((2, m + 1, m + 1), np.complex128)
        null, found = np.empty(m + 1, np.complex128), np.empty(m, np.complex128)
        data, x = np.ones((3, m)), np.empty((2, 2, m))
        square, line = np.empty((3, 2 * m, 2 * m)), np.empty((5, 2 * m))
        for p in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            toeplitz(z[:, p], matrix)
            total[p] = -smallest(matrix, vectors, null)
            roots(null, m, found)
            for i in range(m):
                data[0, i], data[1, i] = z[i, p].real, z[i, p].imag
                x[0, 0, i] = 0.0
                # The null vector u has sum_k u_k exp(-j k phi) = 0 at every return.
                x[0, 1, i] = -np.arctan2(found[i].imag, found[i].real)
            for i in range(m):  # the next in line is the one that explains most of the rest
                best = i + _best(data, x[0, :, i:], x[0, :, :i], harmonics)
                x[0, 1, i], x[0, 1, best] = x[0, 1, best], x[0, 1, i]
                x[0, 0, : i + 1] = 0.0
                linear_amplitudes(harmonics, 1.0, data, x[:, :, : i + 1], square, line, 0)
            for i in range(m):
                angles[i, p], weights[i, p] = x[0, 1, i], x[0, 0, i]
    return angles, weights, total


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _best(data: F64, candidates: F64, taken: F64, k: F64) -> int:
    """Index of the candidate return that agrees best with what taken ones leave."""
    best, most = 0, -np.inf
    for c in range(candidates.shape[1]):
        score = 0.0
        for f in range(k.size):
            re, im = data[0, f], data[1, f]
            for i in range(taken.shape[1]):
                re -= taken[0, i] * np.cos(k[f] * taken[1, i])
                im -= taken[0, i] * np.sin(k[f] * taken[1, i])
            angle = k[f] * candidates[1, c]
            score += re * np.cos(angle) + im * np.sin(angle)
        if score > most:
            best, most = c, score
    return best


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def entropy_peaks(z: Complexes, above: F64) -> tuple[F64, F64, F64]:
    """Peaks of the maximum entropy density.

    Parameters
    ----------
    z : ndarray, (M, P), complex
        Moments c_1..c_m.
    above : ndarray, (P,)
        How far c_0 lies above the least possible.

    Returns
    -------
    angles, weights : ndarray, (M, P)
        Phase of the peak next to each pole, rad, and the residue there; residues sum to c_0.
    total : ndarray, (P,)
        c_0.
    """
    m, n = z.shape
    angles, weights, total = np.empty((m, n)), np.empty((m, n)), np.empty(n)
    for block in prange((n + BLOCK - 1) // BLOCK):
        matrix, vectors = np.empty((2, m + 1, m + 1), np.complex128)
        q, found = np.empty(m + 1, np.complex128), np.empty(m, np.complex128)
        for p in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            toeplitz(z[:, p], matrix)
            total[p] = above[p] - smallest(matrix, vectors, q)
            toeplitz(z[:, p], matrix)
            first_column(matrix, total[p], q)
            roots(q, m, found)
            for i in range(m):
                found[i] = 1 / found[i] if abs(found[i]) > 1e-300 else 0.0
            for i in range(m):
                angles[i, p] = _climb(q, np.arctan2(found[i].imag, found[i].real))
                weights[i, p] = _residue(q, found, i)
    return angles, weights, total


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def peak_sigma(z: Complexes, noise: F64, above: F64, angles: F64) -> F64:
    """Noise carried through to one peak, by forward differences as in `_propagate`.

    Parameters
    ----------
    z, noise : ndarray, (M, P)
        Moments and the standard deviation of their components.
    above : ndarray, (P,)
        As for `entropy_peaks`.
    angles : ndarray, (P,)
        The peak, rad.

    Returns
    -------
    ndarray, (P,)
        Standard deviation, rad; NaN where the density has no peak.
    """
    m, n = z.shape
    sigma = np.empty(n)
    for block in prange((n + BLOCK - 1) // BLOCK):
        matrix, vectors = np.empty((2, m + 1, m + 1), np.complex128)
        q, null = np.empty(m + 1, np.complex128), np.empty(m + 1, np.complex128)
        c = np.empty(m, np.complex128)
        for p in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            c[:] = z[:, p]
            toeplitz(c, matrix)
            total = above[p] - smallest(matrix, vectors, null)
            variance = 0.0
            for f in range(m):
                # To first order the eigenvalue moves by u^H dT u.
                lag = 0j
                for j in range(f + 1, m + 1):
                    lag += np.conj(null[j]) * null[j - f - 1]
                for part in (1.0 + 0j, 1j):
                    step = STEP * noise[f, p] * part
                    c[f] = z[f, p] + step
                    toeplitz(c, matrix)
                    first_column(matrix, total - 2 * (step * lag).real, q)
                    change = _climb(q, angles[p]) - angles[p]
                    variance += (change / STEP) ** 2
                c[f] = z[f, p]
            sigma[p] = np.sqrt(variance) if variance > 0 else np.nan  # no peak there
    return sigma


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def first_column(matrix: Complexes, c0: float, q: Complexes) -> None:
    """First column of the inverse of a Toeplitz matrix with c_0 on the diagonal, into q."""
    n = q.size
    for j in range(n):
        matrix[j, j] = c0
        q[j] = 0.0
    q[0] = 1.0
    for j in range(n):  # positive definite: no pivots needed
        for i in range(j + 1, n):
            factor = matrix[i, j] / matrix[j, j]
            for k in range(j, n):
                matrix[i, k] -= factor * matrix[j, k]
            q[i] -= factor * q[j]
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            q[j] -= matrix[j, k] * q[k]
        q[j] /= matrix[j, j]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _climb(q: Complexes, angle: float) -> float:
    """The peak of the density next to an angle, where ``|sum_k q_k exp(-j k phi)|^2`` is least."""
    for _ in range(6):
        turn, power = np.exp(-1j * angle), 1.0 + 0.0j
        value, slope, bend = 0j, 0j, 0j
        for k in range(q.size):
            value += q[k] * power
            slope -= 1j * k * q[k] * power
            bend -= k * k * q[k] * power
            power *= turn
        first = (np.conj(value) * slope).real
        second = abs(slope) ** 2 + (np.conj(value) * bend).real
        if second <= 0 or abs(first) > 0.3 * second:
            break
        angle -= first / second
    return angle


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _residue(q: Complexes, poles: Complexes, i: int) -> float:
    """Share of the density that belongs to one of its poles, which lie in the unit circle."""
    m = poles.size
    value, power = 0j, 1.0 + 0.0j
    for k in range(m + 1):
        value += np.conj(q[k]) * power
        power *= poles[i]
    spread = 1.0 + 0.0j
    for k in range(m):
        if k != i:
            spread *= poles[i] - poles[k]
    below = spread * value
    return (poles[i] ** (m - 1) / below).real if abs(below) > 1e-300 else 0.0
