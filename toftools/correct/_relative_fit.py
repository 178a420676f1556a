"""Kernel of dorrington2011: relative amplitude and relative range of two returns, many starts.

Taking the first return out of ``z_i = a exp(j k_i d) (1 + b exp(j k_i e))`` leaves two unknowns, b
and e. In logarithms, with ``L_i = log(1 + b exp(j k_i e))``,

    log |z_i| = log a + Re L_i,    arg z_i = k_i d + Im L_i  (mod 2 pi),

so a and d are linear and drop out by weighted least squares, weights ``|z_i|^2 / sigma_i^2`` (the
noise of a logarithm, to first order); with two frequencies that is the normalisation by one of
them. The wraps follow from one wrap of the highest frequency by rounding, as in _wraps.py. What is
left is solved by Gauss-Newton from the best of a table of starts. Reference: see dorrington2011.py;
logarithms, elimination and the starts are ours. Fails where a phasor is drowned in noise (its
logarithm is no longer linear in it), and between starts further apart than the valleys are wide.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.types import F64
from toftools.units import TWO_PI

STEP_RAD = 0.5
"""Spacing of the starts in relative range, as a phase of the highest frequency."""
STARTS_B = (0.1, 0.3, 0.6, 0.95)
"""Starts in relative amplitude, as shares of the largest."""
STEPS = 15
LEAST_B = 1e-3
LEAST_E = 0.1
"""Least relative range, as a phase of the highest frequency: closer returns are one."""
TIE = 2.0
"""Difference in chi-squared up to which solutions count as equally good."""
C128 = NDArray[np.complex128]
I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Starts:
    """Table of starts.

    Parameters
    ----------
    e, b : ndarray, (E,), (B,)
        Relative ranges, m, and relative amplitudes.
    logs : ndarray, (E, B, F), complex
        ``L_i`` of each start.
    """

    e: F64
    b: F64
    logs: C128


def table_of_starts(k: F64, max_extra_m: float, max_ratio: float) -> Starts:
    """Starts over all relative ranges and amplitudes.

    Parameters
    ----------
    k : ndarray, (F,)
        Phase per metre, rad/m.
    max_extra_m : float
        Largest relative range, m.
    max_ratio : float
        Largest relative amplitude.

    Returns
    -------
    Starts
        The table.

    Examples
    --------
    >>> table_of_starts(np.array([1.7, 2.9]), 3.0, 1.0).logs.shape
    (17, 4, 2)
    """
    count = max(int(np.ceil(max_extra_m * k.max() / STEP_RAD)), 2) - 1
    e = np.asarray((np.arange(count) + 1.0) * (max_extra_m / (count + 1.0)))
    b = np.asarray(STARTS_B) * max_ratio
    logs = np.log(1 + b[None, :, None] * np.exp(1j * e[:, None, None] * k))
    return Starts(e, b, logs)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _reduce(
    z_log: C128, logs: C128, k: F64, weight: F64, anchor: int, wrap: int, left: C128
) -> tuple[float, float, float]:
    """Residual after taking out a and d: sets `left`; returns its square, log a and d."""
    n = k.size
    here = z_log[anchor].imag - logs[anchor].imag + TWO_PI * wrap
    total = mean = slope = moment = 0.0
    for i in range(n):
        y = z_log[i] - logs[i]
        turns = np.rint((here / k[anchor] * k[i] - y.imag) / TWO_PI)
        left[i] = y + 1j * TWO_PI * turns
        total += weight[i]
        mean += weight[i] * left[i].real
        slope += weight[i] * k[i] * left[i].imag
        moment += weight[i] * k[i] * k[i]
    mean, slope = mean / total, slope / moment
    cost = 0.0
    for i in range(n):
        left[i] -= mean + 1j * k[i] * slope
        cost += weight[i] * (left[i].real ** 2 + left[i].imag ** 2)
    return cost, mean, slope


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _logs(b: float, e: float, k: F64, logs: C128) -> None:
    for i in range(k.size):
        logs[i] = np.log(1 + b * np.exp(1j * k[i] * e))


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _step(b: float, e: float, k: F64, weight: F64, left: C128, damping: float) -> F64:
    """Damped Gauss-Newton step of b and e, with a and d eliminated."""
    n = k.size
    slopes = np.empty((2, n), np.complex128)
    total, moment = np.sum(weight), np.sum(weight * k * k)
    for i in range(n):
        turn = np.exp(1j * k[i] * e)
        slopes[0, i] = turn / (1 + b * turn)
        slopes[1, i] = 1j * k[i] * b * slopes[0, i]
    for m in range(2):
        mean = np.sum(weight * slopes[m].real) / total
        slope = np.sum(weight * k * slopes[m].imag) / moment
        slopes[m] -= mean + 1j * k * slope
    bb = np.sum(weight * np.abs(slopes[0]) ** 2)
    ee = np.sum(weight * np.abs(slopes[1]) ** 2)
    be = np.sum(weight * (slopes[0] * np.conj(slopes[1])).real)
    to_b = np.sum(weight * (slopes[0] * np.conj(left)).real)
    to_e = np.sum(weight * (slopes[1] * np.conj(left)).real)
    bb, ee = bb * (1 + damping) + 1e-300, ee * (1 + damping) + 1e-300
    det = max(bb * ee - be * be, 1e-12 * bb * ee)
    return np.array([(ee * to_b - be * to_e) / det, (bb * to_e - be * to_b) / det])


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _solve(
    z_log: C128, k: F64, weight: F64, anchor: int, wrap: int, bounds: F64, start: F64, out: F64
) -> None:
    """Follow one start: ``out = (cost, d, e, a, b)``."""
    b, e = start[0], start[1]
    logs, left = np.empty(k.size, np.complex128), np.empty(k.size, np.complex128)
    trial, moved = np.empty_like(logs), np.empty_like(left)
    _logs(b, e, k, logs)
    cost, log_a, d = _reduce(z_log, logs, k, weight, anchor, wrap, left)
    damping = 1e-2
    for _ in range(STEPS):
        step = _step(b, e, k, weight, left, damping)
        new_b = min(max(b + step[0], bounds[0]), bounds[1])
        new_e = min(max(e + step[1], bounds[2]), bounds[3])
        _logs(new_b, new_e, k, trial)
        reached, new_a, new_d = _reduce(z_log, trial, k, weight, anchor, wrap, moved)
        if reached < cost:
            done = cost - reached < 1e-7 * (1e-2 + cost)
            b, e, cost, log_a, d = new_b, new_e, reached, new_a, new_d
            left[:] = moved
            damping *= 0.1
            if done:
                break
        elif damping > 1e4:
            break
        else:
            damping *= 10.0
    out[0], out[1], out[2], out[3], out[4] = cost, d, e, np.exp(log_a), b


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _scan(
    z_log: C128, k: F64, weight: F64, anchor: int, logs: C128, limits: F64, cost: F64, best: I64
) -> None:  # fmt: skip
    """Least cost (wraps, E) over the relative amplitudes of the table, and which has it."""
    left = np.empty(k.size, np.complex128)
    margin = STEP_RAD / k[anchor]  # the range of a start is not that of its solution
    for n in range(cost.shape[0]):
        for s in range(cost.shape[1]):
            cost[n, s] = np.inf
            for m in range(logs.shape[1]):
                c, _, d = _reduce(z_log, logs[s, m], k, weight, anchor, n, left)
                if c < cost[n, s] and limits[0] - margin <= d <= limits[1] + margin:
                    cost[n, s], best[n, s] = c, m


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _choose(solved: F64, count: int, limits: F64, out: F64) -> None:
    """Of the solutions within the limits that fit about equally well, that of the weakest second.

    ``out = (d, e, a, b)`` stays as it is where there is none.
    """
    least = np.inf
    for t in range(count):
        if limits[0] <= solved[t, 1] <= limits[1]:
            least = min(least, solved[t, 0])
    weakest = np.inf
    for t in range(count):
        second = solved[t, 3] * solved[t, 4]
        within = limits[0] <= solved[t, 1] <= limits[1]
        if within and solved[t, 0] <= least + TIE and second < weakest:
            weakest = second
            out[:] = solved[t, 1:]


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit(
    z: C128, sigma: F64, k: F64, wraps: int, solve: int, bounds: F64, limits: F64,
    e: F64, b: F64, logs: C128,
) -> F64:  # fmt: skip
    """Two returns of every pixel.

    Parameters
    ----------
    z : ndarray, (F, N), complex
        Phasors.
    sigma : ndarray, (F, N)
        Standard deviation of each phasor component.
    k : ndarray, (F,)
        Phase per metre, rad/m.
    wraps : int
        Wraps of the highest frequency to try, from 0.
    solve : int
        Starts followed to the end.
    bounds : ndarray, (4,)
        Least and largest b, least and largest e.
    limits : ndarray, (2,)
        Least and largest range of the first return, m.
    e, b, logs : ndarray
        `Starts`.

    Returns
    -------
    ndarray, (4, N)
        Range of the first return, m; relative range, m; amplitude; relative amplitude. NaN where
        no solution lies within the limits.
    """
    found = np.full((4, z.shape[1]), np.nan)
    anchor = int(np.argmax(k))
    for p in prange(z.shape[1]):
        size = np.abs(z[:, p])
        z_log = np.log(np.maximum(size, 1e-30)) + 1j * np.angle(z[:, p])
        weight = (size / sigma[:, p]) ** 2
        cost, best = np.empty((wraps, e.size)), np.zeros((wraps, e.size), np.int64)
        solved, count = np.empty((solve, 5)), 0
        _scan(z_log, k, weight, anchor, logs, limits, cost, best)
        while count < solve:
            at = int(np.argmin(cost))
            n, s = at // e.size, at % e.size
            if not cost[n, s] < np.inf:
                break
            start = np.array([b[best[n, s]], e[s]])
            _solve(z_log, k, weight, anchor, n, bounds, start, solved[count])
            cost[n, max(s - 1, 0) : s + 2] = np.inf
            count += 1
        _choose(solved, count, limits, found[:, p])
    return found
