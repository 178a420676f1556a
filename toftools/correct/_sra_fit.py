"""The returns that SRA found, fitted to the phasors: without its bias, and with a sigma.

The linear program shrinks amplitudes and moves returns until the residual is all that it may be:
at the default of 5 % by 0.5 to 6 cm, where noise moves them by millimetres. It is good at saying
how many returns there are and about where. From there least squares goes on, weighted by the
noise where that is known: ``min sum_f |z_f - sum_l a_l exp(j k_f d_l)|^2 / sigma_f^2`` over the L
returns that are strong enough, by Gauss-Newton. Only as many of them are kept, the strongest, as
the noise asks for: the program splits returns when that makes the sum smaller. Where sigma is
unknown, epsilon is taken for three times the noise. All this is ours, not the paper's.

Reference: textbook least squares; the covariance is the inverse of the normal matrix, the
Cramer-Rao bound of `crlb_returns_m`, times the reduced chi-squared where noise cannot explain the
residual. Inputs: returns of either SRA. Fails where the number of returns is wrong. Where there
are more returns than frequencies, or the fit runs off or knows the first range less well than
the program, the answer of the program stays, and sigma is how far the allowed residual can push
a return, ``epsilon sum |z_f| / (a_1 sum k_f)``, joined by the noise: an order of magnitude.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct import kernel_input
from toftools.correct._returns import GUARD_M, answer
from toftools.correct._sra_small import C128, cholesky, sort_strong, substitute, unwrapped
from toftools.types import F32, F64, Bool, DepthMap, Phasors
from toftools.units import range_to_phase

BLOCK = 64
"""Pixels that share the arrays of a fit."""
STEPS = 12
SMALL_RAD = 1e-5
"""A step this short is the last: convergence is fast enough that the next one is none."""
LONGEST_RAD = 0.5
"""Longest step of a return, as phase of the highest frequency."""
FARTHEST_RAD = 1.5
"""How far it may go in all; what is farther is another solution."""
LEAST_NOISE = 1e-5
"""Relative to the amplitude, so that noise-free input keeps finite weights."""
UNKNOWN_NOISE = 3.0
"""Where sigma is unknown the allowed residual is taken for this many times the noise."""
SURPRISE = 6.0
"""Standard deviations of chi-squared that noise does not reach."""


class Bounds(NamedTuple):
    """What a fit must keep to.

    Parameters
    ----------
    epsilon : float
        Residual that the program allows, as a share of the summed amplitudes.
    period_m : float
        Joint ambiguity, m; 0 where the range is limited.
    limit_m : float
        Range limit, m; infinite if none.
    """

    epsilon: float
    period_m: float
    limit_m: float


def fitted(
    phasors: Phasors, usable: Bool, freqs_hz: F64, bounds: Bounds, ranges_m: F32, amplitudes: F32
) -> DepthMap:
    """Fit the returns of a frame and answer with the first ones.

    Parameters
    ----------
    phasors : Phasors
        Measurement.
    usable : ndarray, (H, W), bool
        Pixels for which an answer was tried.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    bounds : Bounds
        What to keep to.
    ranges_m, amplitudes : ndarray, (L, P), float32
        Returns that are strong enough, nearest first; NaN and 0 for none. Overwritten.

    Returns
    -------
    DepthMap
        The answer.
    """
    n_freqs, shape = freqs_hz.size, usable.shape
    known = phasors.sigma is not None
    sigma = np.zeros((n_freqs, 1), np.float32) if phasors.sigma is None else phasors.sigma
    sigma_m = fit_returns(
        kernel_input(phasors.values).reshape(n_freqs, -1),
        kernel_input(sigma).reshape(n_freqs, -1),
        known,
        np.asarray(range_to_phase(1.0, freqs_hz)),
        bounds,
        ranges_m,
        amplitudes,
    )
    return answer(
        ranges_m.reshape(-1, *shape).astype(np.float64),
        amplitudes.reshape(-1, *shape).astype(np.float64),
        usable,
        sigma_m=sigma_m.reshape(shape) if known else None,
    )


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit_returns(
    values: NDArray[np.complex64], sigma: F32, known: bool, rad_per_m: F64, bounds: Bounds,
    ranges_m: F32, amplitudes: F32,
) -> F32:  # fmt: skip
    """Fit the returns of every pixel, in place.

    Parameters
    ----------
    values : ndarray, (F, P)
        Phasors.
    sigma : ndarray, (F, P) or (F, 1)
        Standard deviation of the real and of the imaginary part.
    known : bool
        Whether it is known.
    rad_per_m : ndarray, (F,)
        Phase per range, rad/m.
    bounds : Bounds
        What to keep to.
    ranges_m, amplitudes : ndarray, (L, P)
        Returns, NaN and 0 for none, the nearest first; overwritten where the fit holds.

    Returns
    -------
    ndarray, (P,)
        Standard deviation of the first range, m; NaN where there is none.
    """
    n_freqs, n = values.shape
    most = ranges_m.shape[0]
    sigma_m = np.full(n, np.nan, np.float32)
    for block in prange((n + BLOCK - 1) // BLOCK):
        matrix, right = np.empty((2 * most, 2 * most)), np.empty(2 * most)
        rows = np.empty((2, 2 * most))
        d, a = np.empty(most), np.empty(most)
        z, weight = np.empty(n_freqs, np.complex128), np.empty(n_freqs)
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            count = 0
            while count < most and amplitudes[count, p] > 0:
                count += 1
            if count == 0:
                continue
            weigh_pixel(values, sigma, known, p, bounds.epsilon, z, weight)
            sigma_m[p] = _push(z, weight, rad_per_m, amplitudes[0, p], bounds.epsilon)
            for few in range(1, min(count, n_freqs) + 1):
                _strongest(ranges_m[:, p], amplitudes[:, p], d[:few], a[:few])
                if not fit_pixel(z, weight, rad_per_m, d[:few], a[:few], matrix, right, rows):
                    continue
                own_m, excess = settle(
                    z, weight, rad_per_m, bounds, d[:few], a[:few], matrix, right, rows
                )
                if few < count and (excess > 1 or few == n_freqs):
                    continue  # too few, or as many unknowns as numbers: nothing was tested
                own_m *= np.sqrt(excess) if known else 1.0
                if few == 1 or own_m < sigma_m[p]:
                    sigma_m[p] = own_m
                    ranges_m[:, p], amplitudes[:, p] = np.nan, 0.0
                    for k in range(few):
                        ranges_m[k, p], amplitudes[k, p] = max(d[k], 0.0), a[k]
                break
    return sigma_m


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def weigh_pixel(
    values: NDArray[np.complex64], sigma: F32, known: bool, p: int, epsilon: float,
    z: C128, weight: F64,
) -> None:  # fmt: skip
    """Phasors of a pixel and what they weigh."""
    mean = 0.0
    for f in range(z.size):
        z[f] = values[f, p]
        mean += abs(z[f]) / z.size
    for f in range(z.size):
        known = known and 0 <= sigma[f, p if known else 0] < np.inf
    for f in range(z.size):
        noise = np.float64(sigma[f, p]) if known else epsilon * mean / UNKNOWN_NOISE
        weight[f] = 1 / max(noise, LEAST_NOISE * mean) ** 2


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _strongest(ranges_m: F32, amplitudes: F32, d: F64, a: F64) -> None:
    """Fill d and a with the strongest returns."""
    a[:] = -1.0
    for j in range(ranges_m.size):
        at, size = np.float64(ranges_m[j]), np.float64(amplitudes[j])
        for k in range(a.size):
            if size > a[k]:
                d[k], at, a[k], size = at, d[k], size, a[k]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _push(z: C128, weight: F64, rad_per_m: F64, amplitude: float, epsilon: float) -> float:
    """How far the allowed residual and the noise can push a return, m."""
    total, information = 0.0, 0.0
    for f in range(z.size):
        total += abs(z[f])
        information += weight[f] * (rad_per_m[f] * amplitude) ** 2
    return float(
        np.hypot(epsilon * total / (amplitude * rad_per_m.sum()), 1 / np.sqrt(information))
    )


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def fit_pixel(
    z: C128, weight: F64, rad_per_m: F64, d: F64, a: F64, matrix: F64, right: F64, rows: F64
) -> bool:
    """Gauss-Newton from d, which it changes with a; whether it held."""
    n, top = d.size, rad_per_m.max()
    begun = d.copy()
    for _ in range(STEPS):
        _normal(z, weight, rad_per_m, d, a, matrix, right, rows)
        if not cholesky(matrix, 2 * n):
            return False
        substitute(matrix, right, 2 * n)
        largest = 0.0
        for k in range(n):
            move = right[n + k] / (top * a[k])
            move = min(max(move, -LONGEST_RAD / top), LONGEST_RAD / top)
            d[k] += move
            a[k] = max(a[k] + right[k], 0.2 * a[k])
            largest = max(largest, abs(move))
        if largest * top < SMALL_RAD:
            break
    return bool(np.abs(d - begun).max() * top < FARTHEST_RAD)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def settle(
    z: C128, weight: F64, rad_per_m: F64, bounds: Bounds, d: F64, a: F64,
    matrix: F64, right: F64, rows: F64,
) -> tuple[float, float]:  # fmt: skip
    """Bring the fitted ranges into the limits and into order.

    Returns sigma of the first, m, and reduced chi-squared where noise cannot explain it, else 1.
    """
    n, top = d.size, rad_per_m.max()
    for k in range(n):
        d[k] = unwrapped(d[k], bounds.period_m)
    sort_strong(d, a, n, 0.0)
    chi2 = _normal(z, weight, rad_per_m, d, a, matrix, right, rows)
    if not (-GUARD_M <= d[0] <= bounds.limit_m and cholesky(matrix, 2 * n)):
        return np.inf, np.inf
    right[:] = 0.0
    right[n] = 1.0
    substitute(matrix, right, 2 * n)
    sigma_m, freedom = np.sqrt(right[n]) / (top * a[0]), 2.0 * (z.size - n)
    surprise = chi2 > freedom + SURPRISE * np.sqrt(2.0 * freedom)
    return sigma_m, chi2 / freedom if freedom > 0 and surprise else 1.0


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _normal(
    z: C128, weight: F64, rad_per_m: F64, d: F64, a: F64, matrix: F64, right: F64, rows: F64
) -> float:
    """Normal equations for steps in a[k] and in ``a[k] k_max d[k]``; chi-squared as it is."""
    n, top, chi2 = d.size, rad_per_m.max(), 0.0
    matrix[:] = 0.0
    right[:] = 0.0
    for f in range(z.size):
        rest, slope = z[f], rad_per_m[f] / top
        for k in range(n):
            cos, sin = np.cos(rad_per_m[f] * d[k]), np.sin(rad_per_m[f] * d[k])
            rest -= a[k] * complex(cos, sin)
            rows[0, k], rows[1, k] = cos, sin
            rows[0, n + k], rows[1, n + k] = -slope * sin, slope * cos
        chi2 += weight[f] * (rest.real**2 + rest.imag**2)
        for i in range(2 * n):
            right[i] += weight[f] * (rows[0, i] * rest.real + rows[1, i] * rest.imag)
            for j in range(i + 1):
                matrix[i, j] += weight[f] * (rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j])
    return chi2
