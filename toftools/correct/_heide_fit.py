"""Fit of a few returns to the phasors of a pixel, from the peaks of its transient.

The model is ``z_f = sum_l a_l e_l + b e_1 / (1 - j k L)``, ``e_l = exp(j k_f d_l)``: sharp returns,
and behind the nearest one an exponential decay of length L, the closed form of which in frequency
is that last term. Reference: the u-step of Heide et al. 2013, which fits a Gaussian and an
exponential at every peak. Inputs: phasors in float64, scaled to about 1. Fails where a peak of the
transient holds two returns; then they come back as one, with a decay.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct._heide_peaks import MOST, peaks
from toftools.types import F32, F64

EVIDENCE = 20.0
"""Fall of chi-squared that a decay must bring: noise does so in 5 of 100 000 pixels (2 d.o.f.)."""
STEPS = 30
LENGTHS_M = (0.1, 0.3, 1.0, 3.0)
"""Decay lengths to start from."""
SHORTEST_M, LONGEST_M = 0.03, 5.0
"""Decay lengths allowed: shorter ones are a sharp return, longer ones an offset."""
C128 = NDArray[np.complex128]


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})  # type: ignore[untyped-decorator]  # numba has no types
def _evaluate(
    z: C128, w: F64, k: F64, n: int, tail: bool, p: F64, normal: F64, slope: F64
) -> float:
    """Cost, and normal matrix and gradient of the model at `p`."""
    size = 2 * n + (2 if tail else 0)
    normal[:size, :size] = 0
    slope[:size] = 0
    rows = np.empty(size, np.complex128)
    cost = 0.0
    for f in range(k.size):
        rest = z[f]
        for s in range(n):
            phase = k[f] * p[2 * s + 1]
            turn = complex(np.cos(phase), np.sin(phase))
            rows[2 * s] = turn
            rows[2 * s + 1] = 1j * k[f] * p[2 * s] * turn
            rest -= p[2 * s] * turn
        if tail:
            length = np.exp(p[size - 1])
            decay = 1 / (1 - 1j * k[f] * length)
            light = p[size - 2] * rows[0] * decay
            rows[1] += 1j * k[f] * light
            rows[size - 2] = rows[0] * decay
            rows[size - 1] = 1j * k[f] * length * decay * light
            rest -= light
        cost += w[f] * (rest.real * rest.real + rest.imag * rest.imag)
        for i in range(size):
            slope[i] += w[f] * (rows[i].real * rest.real + rows[i].imag * rest.imag)
            for j in range(i + 1):
                product = rows[i].real * rows[j].real + rows[i].imag * rows[j].imag
                normal[i, j] += w[f] * product
    return cost


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _factorise(normal: F64, size: int, damping: float, factor: F64) -> bool:
    """Cholesky factor of ``normal + damping diag``; False if it is singular."""
    for i in range(size):
        for j in range(i + 1):
            rest = normal[i, j] * (1 + damping if i == j else 1.0)
            least = 1e-13 * rest
            for m in range(j):
                rest -= factor[i, m] * factor[j, m]
            if i > j:
                factor[i, j] = rest / factor[j, j]
            elif rest > least:
                factor[i, i] = np.sqrt(rest)
            else:
                return False
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _solve(normal: F64, size: int, damping: float, factor: F64, x: F64) -> bool:
    """Solve ``(normal + damping diag) x = x`` in place; False if that is singular."""
    if not _factorise(normal, size, damping, factor):
        return False
    for i in range(size):
        for m in range(i):
            x[i] -= factor[i, m] * x[m]
        x[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for m in range(i + 1, size):
            x[i] -= factor[m, i] * x[m]
        x[i] /= factor[i, i]
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit(z: C128, w: F64, k: F64, n: int, tail: bool, p: F64, normal: F64) -> float:
    """Levenberg-Marquardt from `p`, in place; leaves the normal matrix there and gives the cost."""
    size = 2 * n + (2 if tail else 0)
    slope, trial = np.empty(size), p.copy()
    step, factor, there = np.empty(size), np.empty((size, size)), np.empty(normal.shape)
    new_slope = np.empty(size)
    cost = _evaluate(z, w, k, n, tail, p, normal, slope)
    damping = 1e-3
    for _ in range(STEPS):
        step[:] = slope
        if not _solve(normal, size, damping, factor, step):
            damping = max(10 * damping, 1e-6)
            continue
        trial[:size] = p[:size] + step
        if tail:
            trial[size - 1] = min(max(trial[size - 1], np.log(SHORTEST_M)), np.log(LONGEST_M))
        new_cost = _evaluate(z, w, k, n, tail, trial, there, new_slope)
        if new_cost <= cost:
            moved = np.abs(trial[:size] - p[:size]).max()
            p[:size] = trial[:size]
            normal[:size, :size] = there[:size, :size]
            slope[:] = new_slope
            done = moved < 1e-7 or cost - new_cost < 1e-8 * cost
            cost, damping = new_cost, 0.1 * damping
            if done:
                break
        else:
            damping = 10 * damping
            if damping > 1e8:
                break
    return cost  # type: ignore[no-any-return]  # of an untyped kernel


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _drop(p: F64, n: int, share: float, apart_m: float) -> int:
    """Take out the weakest return if it does not count, or one that fell onto its neighbour."""
    weakest, strongest = 0, p[0]
    for s in range(1, n):
        weakest = s if p[2 * s] < p[2 * weakest] else weakest
        strongest = max(strongest, p[2 * s])
    out = weakest if p[2 * weakest] < share * strongest else -1
    for s in range(1, n):
        for m in range(s):
            if abs(p[2 * s + 1] - p[2 * m + 1]) < apart_m:
                out = s if p[2 * s] < p[2 * m] else m
    if out < 0:
        return n
    for s in range(out, n - 1):
        p[2 * s], p[2 * s + 1] = p[2 * s + 2], p[2 * s + 3]
    return n - 1


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _with_decay(
    z: C128, w: F64, k: F64, n: int, p: F64, normal: F64, cost: float, known: bool
) -> tuple[float, bool]:
    """Add a decay behind the first return where the data demand it."""
    size = 2 * n + 1  # all parameters but the length
    unit = 1.0 if known else cost / max(2 * k.size - size - 1, 1)
    slope, factor, tried = np.empty(p.size), np.empty((size, size)), p.copy()
    start, there = p.copy(), np.empty(normal.shape)
    best = 0.0
    for length in LENGTHS_M:
        # A score test: the fall of chi-squared that one linear step promises.
        tried[2 * n], tried[2 * n + 1] = 0.0, np.log(length)
        _evaluate(z, w, k, n, True, tried, there, slope)
        step = slope[:size].copy()
        if not _solve(there, size, 0.0, factor, step):
            continue
        gain = 0.0
        for i in range(size):
            gain += slope[i] * step[i]
        if gain > best and step[2 * n] > 0:
            best = gain
            start[:] = tried
            start[2 * n] = step[2 * n]
    if best <= 0.5 * EVIDENCE * unit:
        return cost, False
    least = fit(z, w, k, n, True, start, there)
    if not known:
        unit = least / max(2 * k.size - size - 1, 1)
    if cost - least <= EVIDENCE * unit or start[0] <= 0 or start[2 * n] <= 0:
        return cost, False
    p[:] = start
    normal[:, :] = there
    return least, True


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _order(p: F64, n: int, period_m: float, guard_m: float) -> None:
    """Bring the nearest return to the front."""
    nearest, least = 0, np.inf
    for s in range(n):
        at = p[2 * s + 1]
        if period_m > 0:
            at = (at + guard_m) % period_m - guard_m
            p[2 * s + 1] = at
        if at < least:
            nearest, least = s, at
    for i in range(2):
        p[i], p[2 * nearest + i] = p[2 * nearest + i], p[i]


@njit(cache=True, parallel=True)  # type: ignore[untyped-decorator]  # numba has no types
def returns(
    x: F32, z: C128, w: F64, k: F64, use: NDArray[np.bool_], known: bool, cell_m: float,
    cyclic: bool, period_m: float, guard_m: float, share: float, out: F64,
) -> None:  # fmt: skip
    """Returns of a block of pixels.

    Parameters
    ----------
    x : ndarray, (P, N)
        Transients.
    z, w : ndarray, (P, F)
        Phasors and weights 1 / sigma^2.
    k : ndarray, (F,)
        Phase per range, rad / m.
    use : ndarray, (P,), bool
        Pixels to fit.
    known : bool
        Whether the weights are those of the noise, or all 1.
    cell_m, cyclic, period_m, guard_m, share
        Grid cell, whether its ends meet, the range where all phases repeat (0: never), how far
        below zero is zero, and the least strength of a return.
    out : ndarray, (P, 3 MOST + 3)
        Ranges, amplitudes and standard deviations of the returns, nearest of them first; then
        cost, and strength (relative to the nearest return) and length of the decay. NaN, or
        amplitude 0, where there is none.
    """
    for i in prange(z.shape[0]):
        out[i] = np.nan
        out[i, MOST : 2 * MOST] = 0
        p = np.zeros(2 * MOST + 2)
        n = peaks(x[i], cell_m, cyclic, share, p) if use[i] else 0
        if n == 0:
            continue
        normal = np.empty((p.size, p.size))
        cost = fit(z[i], w[i], k, n, False, p, normal)
        fewer = _drop(p, n, share, 0.25 * cell_m)
        while 0 < fewer < n:
            n = fewer
            cost = fit(z[i], w[i], k, n, False, p, normal)
            fewer = _drop(p, n, share, 0.25 * cell_m)
        n = fewer
        if n == 0:
            continue
        _order(p, n, period_m, guard_m)
        cost = _evaluate(z[i], w[i], k, n, False, p, normal, np.empty(p.size))
        cost, tail = _with_decay(z[i], w[i], k, n, p, normal, cost, known)
        size = 2 * n + (2 if tail else 0)
        factor, unit = np.empty((size, size)), np.empty(size)
        for s in range(n):
            unit[:] = 0
            unit[2 * s + 1] = 1
            regular = _solve(normal, size, 0.0, factor, unit)
            out[i, s], out[i, MOST + s] = p[2 * s + 1], p[2 * s]
            out[i, 2 * MOST + s] = np.sqrt(unit[2 * s + 1]) if regular else np.inf
        out[i, 3 * MOST] = cost
        out[i, 3 * MOST + 1] = p[2 * n] / p[0] if tail else 0.0
        out[i, 3 * MOST + 2] = np.exp(p[2 * n + 1]) if tail else 0.0
