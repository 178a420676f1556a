"""Kernel of the two-return fit: all pairs of a coarse range grid, then Gauss-Newton steps.

For given ranges the amplitudes are linear, so the weighted squared residual of a pair follows from
its two correlations with lone returns, ``b(d) = sum_f w_f Re(z_f exp(-j k_f d))``, and from
``g(d1 - d2) = sum_f w_f cos(k_f (d1 - d2))``, which no pixel changes: the residual falls by
``(W b1^2 - 2 g b1 b2 + W b2^2) / (W^2 - g^2)``, W the sum of the weights (variable projection).
Reference: G. Golub, V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
problems whose variables separate", SIAM J. Numer. Anal. 10 (1973) 413-432; the pair search is ours.
Fails where the two returns are closer than a grid step and the steps start from the wrong side.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools._turns import FAST
from toftools.correct._wraps import LEAST_NOISE
from toftools.types import F32, F64, Bool

I64 = NDArray[np.int64]

STARTS = 2
"""Pairs of each kind (close, far, with the strongest lone return) from which the steps start."""
CLOSE = 5
"""Cells within which a partner is close: such pairs also mimic one return between two cells, and
would crowd out the far ones."""
STEPS = 12
SINGULAR = 1e-9
"""Pairs whose normal equations are this close to singular are one return."""


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def weigh(z: F64, sigma: F64, share: float, w: F64) -> float:
    """Weights of one pixel, ``1 / (sigma^2 + (share |z|)^2)``; their sum is 0 without signal."""
    power = 0.0
    for f in range(w.size):
        power += z[0, f] ** 2 + z[1, f] ** 2
    total = 0.0
    for f in range(w.size):
        w[f] = 0.0
        if power > 0:
            noise = sigma[f] ** 2 + share**2 * (z[0, f] ** 2 + z[1, f] ** 2)
            w[f] = 1.0 / max(noise, LEAST_NOISE * power)
        total += w[f]
    return total


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _gains(i: int, b: F32, g: F32, inverse: F32, total: np.float32, gain: F32) -> None:
    """By how much each partner of cell i lowers the residual; 0 if an amplitude is negative."""
    own = b[i]
    for j in range(i + 1, b.size):
        first = total * own - g[j - i] * b[j]
        other = total * b[j] - g[j - i] * own
        value = (own * first + b[j] * other) * inverse[j - i]
        gain[j] = value if min(first, other) > 0 else np.float32(0.0)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _pairs(b: F32, g: F32, total: np.float32, best: F32, second: I64) -> None:
    """Best close and best far partner of every cell, and by how much they lower the residual."""
    gain = np.zeros_like(b)
    least = np.float32(SINGULAR) * total * total
    inverse = np.float32(1.0) / np.maximum(total * total - g * g, least)
    best[:], second[:] = np.float32(0.0), 0
    for i in range(b.size - 1):
        _gains(i, b, g, inverse, total, gain)
        apart = min(i + 1 + CLOSE, b.size)
        second[0, i] = i + 1 + np.argmax(gain[i + 1 : apart])
        best[0, i] = gain[second[0, i]]
        if apart < b.size:
            second[1, i] = apart + np.argmax(gain[apart:])
            best[1, i] = gain[second[1, i]]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def residual(z: F64, k: F64, w: F64, x: F64) -> float:
    """Weighted squared residual of the returns ``x = (d1, d2, a1, a2)``."""
    cost = 0.0
    for f in range(k.size):
        re = z[0, f] - x[2] * np.cos(k[f] * x[0]) - x[3] * np.cos(k[f] * x[1])
        im = z[1, f] - x[2] * np.sin(k[f] * x[0]) - x[3] * np.sin(k[f] * x[1])
        cost += w[f] * (re * re + im * im)
    return cost


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def normal_equations(z: F64, k: F64, w: F64, x: F64, a: F64, b: F64) -> None:
    """Information matrix (4, 4) about ``(d1, d2, a1, a2)``, and right-hand side of the step."""
    a[:] = 0.0
    b[:] = 0.0
    row = np.empty((2, 4))
    for f in range(k.size):
        re, im = z[0, f], z[1, f]
        for n in range(2):
            cos, sin = np.cos(k[f] * x[n]), np.sin(k[f] * x[n])
            row[0, n], row[1, n] = -x[2 + n] * k[f] * sin, x[2 + n] * k[f] * cos
            row[0, 2 + n], row[1, 2 + n] = cos, sin
            re -= x[2 + n] * cos
            im -= x[2 + n] * sin
        for p in range(4):
            b[p] += w[f] * (row[0, p] * re + row[1, p] * im)
            for q in range(4):
                a[p, q] += w[f] * (row[0, p] * row[0, q] + row[1, p] * row[1, q])


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _factor(a: F64, scale: F64, damping: float, low: F64) -> bool:
    """Cholesky factor of ``S A S + damping``, S scaling A to a unit diagonal; False if singular."""
    for p in range(scale.size):
        for q in range(p + 1):
            s = 1.0 + damping if p == q else a[p, q] * scale[p] * scale[q]
            for r in range(q):
                s -= low[p, r] * low[q, r]
            if p == q and s < SINGULAR:
                return False
            low[p, q] = np.sqrt(s) if p == q else s / low[q, q]
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def solve(a: F64, b: F64, damping: float, x: F64) -> bool:
    """Solve ``(A + damping diag A) x = b``; False if that is close to singular."""
    n = b.size
    low, scale = np.zeros((n, n)), np.empty(n)
    for p in range(n):
        scale[p] = 1.0 / np.sqrt(max(a[p, p], 1e-300))
    if not _factor(a, scale, damping, low):
        return False
    for p in range(n):
        x[p] = (b[p] * scale[p] - np.sum(low[p, :p] * x[:p])) / low[p, p]
    for p in range(n - 1, -1, -1):
        x[p] = (x[p] - np.sum(low[p + 1 :, p] * x[p + 1 :])) / low[p, p]
    for p in range(n):
        x[p] *= scale[p]
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _polish(z: F64, k: F64, w: F64, rival: float, x: F64) -> float:
    """Levenberg-Marquardt steps from ``x``, in place; the residual reached."""
    a, b, step, trial = np.empty((4, 4)), np.empty(4), np.empty(4), np.empty(4)
    cost, damping = residual(z, k, w, x), 1e-3
    for n in range(STEPS):
        if n == STEPS // 3 and cost > 4.0 * rival:
            break  # another start is far ahead
        normal_equations(z, k, w, x, a, b)
        if not solve(a, b, damping, step):
            damping *= 10.0
            continue
        trial[:] = x + step
        reached = residual(z, k, w, trial) if min(trial[2], trial[3]) > 0 else np.inf
        if reached < cost:
            done = cost - reached < 1e-6 * (1e-6 + cost)
            x[:], cost, damping = trial, reached, damping * 0.1
            if done:
                break
        else:
            damping *= 10.0
    return float(cost)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _start(k: F64, z: F64, w: F64, total: float, d1: float, d2: float, x: F64) -> None:
    """Amplitudes of the pair (d1, d2) by least squares."""
    b1 = b2 = g = 0.0
    for f in range(k.size):
        b1 += w[f] * (z[0, f] * np.cos(k[f] * d1) + z[1, f] * np.sin(k[f] * d1))
        b2 += w[f] * (z[0, f] * np.cos(k[f] * d2) + z[1, f] * np.sin(k[f] * d2))
        g += w[f] * np.cos(k[f] * (d1 - d2))
    det = max(total * total - g * g, SINGULAR * total * total)
    x[0], x[1] = d1, d2
    x[2], x[3] = (total * b1 - g * b2) / det, (total * b2 - g * b1) / det


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _correlate(z: F64, w: F64, atoms: F32, b: F32, g: F32) -> None:
    """Correlation of a pixel with a return in every cell, and of such returns with each other."""
    for f in range(w.size):
        re, im = np.float32(w[f] * z[0, f]), np.float32(w[f] * z[1, f])
        b += re * atoms[0, f] + im * atoms[1, f]
        g += np.float32(w[f]) * atoms[0, f]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _greedy(
    z: F64, k: F64, w: F64, b: F32, atoms: F32, step_m: float, best: F32, second: I64, x: F64
) -> None:
    """Partners of the strongest lone return, which need not lie on the grid; its range in x[0].

    A strong return half a cell off leaves more than a weak one brings, so that no pair of cells
    shows the weak one.
    """
    i = int(np.argmax(b))
    left, right = b[max(i - 1, 0)], b[min(i + 1, b.size - 1)]
    bend = 2 * b[i] - left - right
    x[0] = max((i + (0.5 * (right - left) / bend if bend > 0 else 0.0)) * step_m, 0.0)
    own = 0.0
    for f in range(k.size):
        own += w[f] * (z[0, f] * np.cos(k[f] * x[0]) + z[1, f] * np.sin(k[f] * x[0]))
    for j in range(b.size):
        cross = 0.0
        for f in range(k.size):
            cos, sin = np.cos(k[f] * x[0]), np.sin(k[f] * x[0])
            cross += w[f] * (atoms[0, f, j] * cos + atoms[1, f, j] * sin)
        first, other = own - cross * b[j], b[j] - cross * own
        gain = (own * first + b[j] * other) / max(1.0 - cross * cross, SINGULAR)
        best[j], second[j] = (gain if min(first, other) > 0 else 0.0), j


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _fit_pixel(z: F64, k: F64, w: F64, total: float, atoms: F32, step_m: float, x: F64) -> float:
    """Best pair of returns of one pixel; the residual it leaves, infinite if there is none."""
    n_cells = atoms.shape[2]
    b, g = np.zeros(n_cells, np.float32), np.zeros(n_cells, np.float32)
    best, second = np.empty((3, n_cells), np.float32), np.empty((3, n_cells), np.int64)
    _correlate(z, w / total, atoms, b, g)  # weights of sum 1: single precision will do
    _pairs(b, g, np.float32(1.0), best, second)
    _greedy(z, k, w / total, b, atoms, step_m, best[2], second[2], x)
    lone_m = x[0]
    cost, trial = np.inf, np.empty(4)
    for start in range(3 * STARTS):
        kind = start % 3
        i = int(np.argmax(best[kind]))
        if best[kind, i] <= 0:
            continue
        near_m = lone_m if kind == 2 else i * step_m
        _start(k, z, w, total, near_m, second[kind, i] * step_m, trial)
        best[kind, max(i - 1, 0) : i + 2] = 0.0
        if min(trial[2], trial[3]) <= 0:
            continue
        reached = _polish(z, k, w, cost, trial)
        if reached < cost:
            cost = reached
            x[:] = trial
    return float(cost)


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit_two(
    z: F64, sigma: F64, wanted: Bool, k: F64, share: float, atoms: F32, step_m: float,
    returns: F64, cost: F64,
) -> None:  # fmt: skip
    """Most likely two returns of every wanted pixel.

    Parameters
    ----------
    z : ndarray, (2, F, P)
        Real and imaginary part of the phasors.
    sigma : ndarray, (F, P)
        Standard deviation of either part; 0 where unknown.
    wanted : ndarray, (P,), bool
        Pixels to fit.
    k : ndarray, (F,)
        Phase per range, rad/m.
    share : float
        Model error as a share of the amplitude.
    atoms : ndarray, (2, F, N)
        Cosine and sine of ``k_f d`` at every cell of the range grid, which starts at 0.
    step_m : float
        Grid step, m.
    returns : ndarray, (5, P)
        Out: ``d1, d2, a1, a2`` and the variance of d1, m^2; NaN where there is no fit.
    cost : ndarray, (P,)
        Out: weighted squared residual.
    """
    n_freqs = k.size
    for p in prange(z.shape[2]):
        returns[:, p] = np.nan
        cost[p] = np.inf
        if not wanted[p]:
            continue
        own, w, x = np.empty((2, n_freqs)), np.empty(n_freqs), np.empty(4)
        own[:] = z[:, :, p]
        total = weigh(own, sigma[:, p], share, w)
        cost[p] = _fit_pixel(own, k, w, total, atoms, step_m, x)
        if cost[p] < np.inf:
            a, b, unit, column = np.empty((4, 4)), np.empty(4), np.zeros(4), np.empty(4)
            normal_equations(own, k, w, x, a, b)
            returns[:4, p] = x
            near = 0 if x[0] <= x[1] else 1
            unit[near] = 1.0
            returns[4, p] = column[near] if solve(a, unit, 0.0, column) else np.inf
