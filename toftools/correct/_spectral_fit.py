"""Least-squares fit of few returns to phasors, from given ranges; what the spectral methods share.

The model is ``z_f = sum_l a_l exp(j k_f d_l)`` with real amplitudes that do not depend on
frequency, ``k_f = 4 pi f / c``. Amplitudes at given ranges are linear least squares. The ranges
are fitted by Levenberg-Marquardt on the residuals divided by their noise, with the amplitudes
solved for anew at every step (variable projection: four times fewer steps for close returns than
stepping in both). That is maximum likelihood; its inverse normal matrix is the Cramer-Rao bound,
and so `sigma_m`. Reference: Golub and Pereyra, "The differentiation of pseudo-inverses and
nonlinear least squares problems whose variables separate", SIAM J. Numer. Anal. 10 (1973).
Inputs: phasors, their noise, starting ranges. Fails, like any local fit, when it starts in the
valley of another minimum: further than about a quarter turn of the highest frequency off.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from toftools._turns import FAST
from toftools.correct._spectral_roots import Complexes
from toftools.types import F64

BLOCK = 128
"""Pixels per parallel task."""
SPREAD = 0.1
"""Starting ranges closer than this, in rad at the highest frequency, are moved apart by it: equal
ranges have equal derivatives, and the fit could never part them."""
CLOSE_ENOUGH = 3e-5
"""The fit ends when no range moves by more than this, in rad of the root-mean-square frequency."""
HALF_PI_HIGH, HALF_PI_LOW = 1.5707963109016418, 1.5893254773528196e-08  # pi/2 in two parts


class Fit(NamedTuple):
    """Returns of P pixels.

    Parameters
    ----------
    ranges_m, amplitudes, sigma_m : ndarray, (L, P)
        Returns in no order, and the Cramer-Rao bound of their ranges, m.
    chi2 : ndarray, (P,)
        Squared residual over noise, of 2 F - 2 L degrees of freedom.
    """

    ranges_m: F64
    amplitudes: F64
    sigma_m: F64
    chi2: F64


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit_returns(z: Complexes, noise: F64, k: F64, ranges_m: F64, steps: int) -> Fit:
    """Fit returns, starting from given ranges.

    Parameters
    ----------
    z : ndarray, (F, P), complex
        Phasors.
    noise : ndarray, (F, P)
        Standard deviation of their components, positive.
    k : ndarray, (F,)
        ``4 pi f / c``, rad/m.
    ranges_m : ndarray, (L, P)
        Ranges to start from, m; NaN starts from zero.
    steps : int
        Most steps of the fit; 0 keeps the ranges and fits amplitudes only.

    Returns
    -------
    Fit
        Returns in the order of `ranges_m`.
    """
    n_returns, n = ranges_m.shape
    d_out, a_out = np.empty((n_returns, n)), np.empty((n_returns, n))
    sigma, chi2 = np.empty((n_returns, n)), np.empty(n)
    scale, apart = np.sqrt((k * k).mean()), SPREAD / k.max()
    for block in prange((n + BLOCK - 1) // BLOCK):
        # Slot 0 holds the fit, 1 a trial, 2 the damped matrix and the step, 3 and 4 derivatives.
        data, x = np.empty((3, k.size)), np.empty((2, 2, n_returns))
        m, g = np.empty((3, 2 * n_returns, 2 * n_returns)), np.empty((5, 2 * n_returns))
        for p in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            for f in range(k.size):
                data[0, f], data[1, f] = z[f, p].real, z[f, p].imag
                data[2, f] = 1 / noise[f, p]
            for i in range(n_returns):
                x[0, 0, i] = 0.0
                x[0, 1, i] = ranges_m[i, p] if np.isfinite(ranges_m[i, p]) else 0.0
            if steps > 0:
                _move_apart(x, apart)
            linear_amplitudes(k, scale, data, x, m, g, 0)
            chi2[p] = _descend(k, scale, steps, data, x, m, g)
            for i in range(n_returns):
                a_out[i, p], d_out[i, p] = x[0, 0, i], x[0, 1, i]
                sigma[i, p] = _bound(i, scale, m, g)
    return Fit(d_out, a_out, sigma, chi2)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _move_apart(x: F64, least: float) -> None:
    """Move ranges that coincide apart, symmetrically."""
    for i in range(x.shape[2]):
        for j in range(i):
            if abs(x[0, 1, i] - x[0, 1, j]) < least:
                middle = (x[0, 1, i] + x[0, 1, j]) / 2
                x[0, 1, j], x[0, 1, i] = middle - least, middle + least


@njit(cache=True, inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def _cos_sin(x: float) -> tuple[float, float]:
    """Cosine and sine to 1e-13 for |x| below 1e5: Taylor's series within a quarter turn."""
    quarter = np.rint(x * (2 / np.pi))
    r = (x - quarter * HALF_PI_HIGH) - quarter * HALF_PI_LOW
    s = r * r
    sin = 1 - s / 156 * (1 - s / 210)
    sin = 1 - s / 42 * (1 - s / 72 * (1 - s / 110 * sin))
    sin = r * (1 - s / 6 * (1 - s / 20 * sin))
    cos = 1 - s / 132 * (1 - s / 182 * (1 - s / 240))
    cos = 1 - s / 30 * (1 - s / 56 * (1 - s / 90 * cos))
    cos = 1 - s / 2 * (1 - s / 12 * cos)
    part = int(quarter) & 3
    if part & 1:
        cos, sin = sin, cos
    return (-cos if part in (1, 2) else cos), (-sin if part >= 2 else sin)


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _normal(k: F64, scale: float, data: F64, x: F64, m: F64, g: F64, slot: int) -> float:
    """Chi-squared, with the lower normal matrix and the right side of (a, scale * d)."""
    n = x.shape[2]
    for i in range(2 * n):
        g[slot, i] = 0.0
        for j in range(i + 1):
            m[slot, i, j] = 0.0
    chi2 = 0.0
    for f in range(k.size):
        re, im, weight = data[0, f], data[1, f], data[2, f]
        for i in range(n):
            a = x[slot, 0, i]
            cos, sin = _cos_sin(k[f] * x[slot, 1, i])
            re -= a * cos
            im -= a * sin
            g[3, i], g[4, i] = weight * cos, weight * sin
            slope = a * k[f] / scale
            g[3, n + i], g[4, n + i] = -slope * g[4, i], slope * g[3, i]
        re *= weight
        im *= weight
        chi2 += re * re + im * im
        for i in range(2 * n):
            g[slot, i] += g[3, i] * re + g[4, i] * im
            for j in range(i + 1):
                m[slot, i, j] += g[3, i] * g[3, j] + g[4, i] * g[4, j]
    return chi2


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _factor(m: F64, n: int, damping: float, slot: int) -> bool:
    """Cholesky's factor of a damped matrix, into slot 2; False if it is singular."""
    for i in range(n):
        for j in range(i + 1):
            m[2, i, j] = m[slot, i, j]
        m[2, i, i] = m[slot, i, i] * (1 + damping) + 1e-300
    for j in range(n):
        whole = m[2, j, j]
        for r in range(j):
            m[2, j, j] -= m[2, j, r] * m[2, j, r]
        if not m[2, j, j] > 1e-13 * whole:
            return False
        m[2, j, j] = np.sqrt(m[2, j, j])
        for i in range(j + 1, n):
            for r in range(j):
                m[2, i, j] -= m[2, i, r] * m[2, j, r]
            m[2, i, j] /= m[2, j, j]
    return True


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _substitute(m: F64, g: F64, n: int) -> None:
    """Solve for the right side in slot 2, in place, with the factor there."""
    for i in range(n):
        for r in range(i):
            g[2, i] -= m[2, i, r] * g[2, r]
        g[2, i] /= m[2, i, i]
    for i in range(n - 1, -1, -1):
        for r in range(i + 1, n):
            g[2, i] -= m[2, r, i] * g[2, r]
        g[2, i] /= m[2, i, i]


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def linear_amplitudes(k: F64, scale: float, data: F64, x: F64, m: F64, g: F64, slot: int) -> None:
    """Real amplitudes of given ranges, by linear least squares.

    Parameters
    ----------
    k : ndarray, (F,)
        Wave numbers, rad/m.
    scale : float
        Unit of the wave numbers, rad/m.
    data : ndarray, (3, F)
        Real and imaginary parts of the phasors, and their weights.
    x : ndarray, (2, 2, L)
        Slots of amplitudes, which must be zero and are filled, and ranges.
    m, g : ndarray, (3, >= 2 L, >= 2 L) and (5, >= 2 L)
        Space to work in.
    slot : int
        Which slot to use.
    """
    n = x.shape[2]
    _normal(k, scale, data, x, m, g, slot)
    for i in range(n):
        g[2, i] = g[slot, i]
    if _factor(m, n, 1e-9, slot):  # equal ranges share their amplitude
        _substitute(m, g, n)
        for i in range(n):
            x[slot, 0, i] = g[2, i]


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _descend(k: F64, scale: float, steps: int, data: F64, x: F64, m: F64, g: F64) -> float:
    """Levenberg-Marquardt in place; the chi-squared reached."""
    n = x.shape[2]
    chi2 = _normal(k, scale, data, x, m, g, 0)
    damping = 1e-5
    for _ in range(steps):
        if not _factor(m, 2 * n, damping, 0):
            damping *= 100
            continue
        for i in range(2 * n):
            g[2, i] = g[0, i]
        _substitute(m, g, 2 * n)
        moved = 0.0
        for i in range(n):
            x[1, 0, i] = 0.0
            x[1, 1, i] = x[0, 1, i] + g[2, n + i] / scale
            moved = max(moved, abs(g[2, n + i]))
        linear_amplitudes(k, scale, data, x, m, g, 1)
        less = _normal(k, scale, data, x, m, g, 1)
        if less <= chi2:
            chi2 = less
            x[0], m[0], g[0] = x[1], m[1], g[1]
            damping *= 0.1
        else:
            damping *= 10
        if (moved < CLOSE_ENOUGH and damping < 1) or damping > 1e9:
            break
    return float(chi2)


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _bound(i: int, scale: float, m: F64, g: F64) -> float:
    """Cramer-Rao bound of one range: root of its entry in the inverse of the last matrix."""
    size = m.shape[1]
    if not _factor(m, size, 0.0, 0):
        return np.inf
    for j in range(size):
        g[2, j] = 0.0
    g[2, size // 2 + i] = 1.0
    _substitute(m, g, size)
    variance: float = g[2, size // 2 + i]
    return float(variance**0.5 / scale)
