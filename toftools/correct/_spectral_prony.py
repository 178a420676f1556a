"""Prony's method on equispaced frequencies: annihilating polynomials and the ranges of their roots.

On frequencies ``f_n = f_0 + n df`` L returns are a sum of L exponentials in n,
``z_n = sum_l c_l u_l^n`` with ``u_l = exp(j 4 pi df d_l / c)`` and ``c_l = a_l exp(j 4 pi f_0 d_l
/ c)``. The polynomial whose roots are the u_l annihilates every run of L + 1 neighbours,
``sum_k h_k z_(n+k) = 0``: h is the null vector of the matrix of these runs, in the sense of total
least squares its smallest singular vector. Reference: textbook (Stoica and Moses, "Spectral
Analysis of Signals", chapter 4). Inputs: phasors of ascending equispaced frequencies. Fails where
returns are closer than noise lets the roots part.

Roots give ranges modulo ``c / (2 df)``. Where f_0 is no multiple of df the joint ambiguity is
longer, and the phase of c_l at a middle frequency says which of its parts d_l lies in, since
amplitudes are positive (ours).
"""

import numpy as np
from numba import njit, prange

from toftools.correct._spectral_roots import Complexes, roots, smallest
from toftools.types import F64
from toftools.units import TWO_PI, ambiguity_m, joint_ambiguity_m, phase_to_range, range_to_phase

BLOCK = 128
"""Pixels per parallel task."""
MOST_PARTS = 8
"""Parts of the joint ambiguity that amplitude phases are asked to tell apart."""


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def root_angles(z: Complexes, order: int, backward: bool) -> F64:
    """Angles of the roots of the annihilating polynomial.

    Parameters
    ----------
    z : ndarray, (N, P), complex
        Samples of the exponentials.
    order : int
        Number L of exponentials.
    backward : bool
        Whether runs count reversed and conjugate too: for roots on the unit circle they obey the
        same equation.

    Returns
    -------
    ndarray, (L, P)
        Angles, rad.
    """
    n, n_pixels = z.shape
    angles = np.empty((order, n_pixels))
    for block in prange((n_pixels + BLOCK - 1) // BLOCK):
        size = order + 1
        gram, vectors = np.empty((2, size, size), np.complex128)
        null, found = np.empty(size, np.complex128), np.empty(size, np.complex128)
        for p in range(block * BLOCK, min(n_pixels, block * BLOCK + BLOCK)):
            gram[:] = 0
            for i in range(n - order):
                for r in range(size):
                    for s in range(size):
                        gram[r, s] += np.conj(z[i + r, p]) * z[i + s, p]
                        if backward:
                            gram[r, s] += z[i + order - r, p] * np.conj(z[i + order - s, p])
            smallest(gram, vectors, null)
            roots(null, order, found)
            for i in range(order):
                angles[i, p] = np.arctan2(found[i].imag, found[i].real)
    return angles


def parts(freqs_hz: F64) -> tuple[int, float]:
    """How many times the ambiguity of the frequency step fits in the joint one.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Ascending equispaced frequencies, Hz.

    Returns
    -------
    count : int
        1 where only the step's own ambiguity can be had: more than `MOST_PARTS` would ask too
        much of the phase of an amplitude.
    period_m : float
        Range after which answers repeat, m.

    Examples
    --------
    >>> count, period_m = parts(np.array([50e6, 70e6, 90e6]))
    >>> count, round(period_m, 2)
    (2, 14.99)
    """
    step_m = float(ambiguity_m(freqs_hz[1] - freqs_hz[0]))
    try:
        joint_m = joint_ambiguity_m(freqs_hz)
    except ValueError:  # they never meet
        return 1, step_m
    count = round(joint_m / step_m)
    return (count, joint_m) if 1 < count <= MOST_PARTS else (1, step_m)


def ranges_of(angles: F64, z: Complexes, freqs_hz: F64, count: int) -> F64:
    """Ranges of roots, unwrapped over the joint ambiguity.

    Parameters
    ----------
    angles : ndarray, (L, P)
        Angles of the roots, rad.
    z : ndarray, (F, P), complex
        Phasors.
    freqs_hz : ndarray, (F,)
        Ascending equispaced frequencies, Hz.
    count : int
        `parts` of them.

    Returns
    -------
    ndarray, (L, P)
        Ranges, m.
    """
    step_hz = freqs_hz[1] - freqs_hz[0]
    ranges_m = phase_to_range(np.mod(angles, TWO_PI), step_hz)
    if count == 1:
        return ranges_m
    middle = freqs_hz.size // 2
    n = np.arange(freqs_hz.size) - middle
    turns = np.exp(1j * n[:, None, None] * angles)  # (F, L, P): the phase at the middle is c_l's
    gram = np.einsum("flp,fmp->plm", turns.conj(), turns)
    gram += 1e-9 * np.eye(len(angles))  # equal roots share their amplitude
    right = np.einsum("flp,fp->pl", turns.conj(), z)
    phase = np.angle(np.linalg.solve(gram, right[..., None])[..., 0]).T  # (L, P)
    options = ranges_m + ambiguity_m(step_hz) * np.arange(count)[:, None, None]
    agree = np.cos(phase - range_to_phase(options, freqs_hz[middle]))
    best = agree.argmax(axis=0)[None]
    return np.asarray(np.take_along_axis(options, best, axis=0)[0])
