"""Small Hermitian eigenproblems and polynomial roots, pixel by pixel, for the spectral methods.

Reference: cyclic Jacobi rotations of a Hermitian matrix and the simultaneous iteration of Durand
and Kerner are textbook (Golub and Van Loan, "Matrix Computations", chapter 8; Henrici, "Applied
and Computational Complex Analysis", volume 1). For two to six rows both beat LAPACK called once
per pixel. Inputs: matrices of up to `MOST + 1` rows. Fails where the smallest eigenvalue is
multiple, since its vector is then arbitrary, and where roots are multiple, which come back with
half the digits.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

MOST = 6
"""Most returns, that is, largest degree of a polynomial."""
SWEEPS = 20
"""Sweeps of rotations; five suffice for six rows, and the loop ends when nothing is left."""
ROUNDS = 60
"""Rounds of the simultaneous iteration of all roots."""

Complexes = NDArray[np.complex128]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def smallest(matrix: Complexes, vectors: Complexes, vector: Complexes) -> float:
    """Smallest eigenvalue of a Hermitian matrix, and its eigenvector.

    Parameters
    ----------
    matrix : ndarray, (N, N), complex
        Matrix; overwritten.
    vectors : ndarray, (N, N), complex
        Space to work in.
    vector : ndarray, (N,), complex
        Filled with the eigenvector of unit length.

    Returns
    -------
    float
        Smallest eigenvalue.
    """
    n = matrix.shape[0]
    for i in range(n):
        for k in range(n):
            vectors[i, k] = 1.0 if i == k else 0.0
    for _ in range(SWEEPS):
        if _off_diagonal(matrix) <= 1e-34:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                _rotate(matrix, vectors, p, q)
    least = 0
    for i in range(1, n):
        if matrix[i, i].real < matrix[least, least].real:
            least = i
    for i in range(n):
        vector[i] = vectors[i, least]
    return float(matrix[least, least].real)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _off_diagonal(matrix: Complexes) -> float:
    """Squares above the diagonal, relative to those on it."""
    off, size = 0.0, 1e-300
    for p in range(matrix.shape[0]):
        size += _squared(matrix[p, p])
        for q in range(p + 1, matrix.shape[0]):
            off += _squared(matrix[p, q])
    return off / size


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _rotate(a: Complexes, v: Complexes, p: int, q: int) -> None:
    """One Jacobi rotation, which makes a[p, q] zero."""
    size = np.sqrt(_squared(a[p, q]))
    if size < 1e-150:
        return
    turn = a[p, q] * (1 / size)
    ratio = (a[q, q].real - a[p, p].real) / (2 * size)
    t = (1.0 if ratio >= 0 else -1.0) / (abs(ratio) + np.sqrt(1 + ratio * ratio))
    c = 1 / np.sqrt(1 + t * t)
    s = t * c
    there, back = s * turn, s * np.conj(turn)
    pp, qq = a[p, p].real - t * size, a[q, q].real + t * size
    for i in range(a.shape[0]):
        x, y = v[i, p], v[i, q]
        v[i, p], v[i, q] = c * x - back * y, there * x + c * y
        x, y = a[i, p], a[i, q]
        a[i, p], a[i, q] = c * x - back * y, there * x + c * y
        a[p, i], a[q, i] = np.conj(a[i, p]), np.conj(a[i, q])
    a[p, p], a[q, q] = pp, qq
    a[p, q] = a[q, p] = 0.0


@njit(cache=True, inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def _squared(z: complex) -> float:
    """Squared modulus, without the care of abs() for overflow."""
    return z.real * z.real + z.imag * z.imag


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def roots(poly: Complexes, degree: int, out: Complexes) -> None:
    """Roots of ``sum_k poly[k] z^k``, k = 0..degree.

    Parameters
    ----------
    poly : ndarray, (>= degree + 1,), complex
        Coefficients, ascending. A leading one that is nothing beside the others is taken as
        1e-12 of them: its root lies very far away instead of nowhere.
    degree : int
        Degree, 1..`MOST`.
    out : ndarray, (>= degree,), complex
        Filled with the roots, in no order.
    """
    largest = 0.0
    for k in range(degree + 1):
        largest = max(largest, abs(poly[k]))
    lead = poly[degree]
    if abs(lead) <= 1e-12 * largest:
        lead = complex(max(1e-12 * largest, 1e-300))
    if degree == 1:
        out[0] = -poly[0] / lead
    elif degree == 2:
        half = poly[1] / lead / 2
        bend = np.sqrt(half * half - poly[0] / lead)
        # The sign that does not cancel; the other root follows from the product of both.
        far = -half - bend if (np.conj(half) * bend).real >= 0 else -half + bend
        out[0] = far
        out[1] = poly[0] / lead / far if abs(far) > 1e-300 else far
    else:
        _all_roots(poly, lead, degree, out)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _all_roots(poly: Complexes, lead: complex, degree: int, out: Complexes) -> None:
    """Iteration of Durand and Kerner, from points near the unit circle."""
    for i in range(degree):
        out[i] = 0.95 * np.exp(1j * (2 * np.pi * i / degree + 0.4))
    for _ in range(ROUNDS):
        moved = 0.0
        for i in range(degree):
            value, spread = 1.0 + 0.0j, 1.0 + 0.0j
            for k in range(degree - 1, -1, -1):
                value = value * out[i] + poly[k] / lead
            for k in range(degree):
                if k != i:
                    spread *= out[i] - out[k]
            step = value / spread if abs(spread) > 1e-300 else 1e-3 + 0.0j
            out[i] -= step
            moved = max(moved, abs(step) / (1 + abs(out[i])))
        if moved < 1e-14:
            break
