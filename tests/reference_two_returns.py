"""Slow readable twins of the two-return inversions: matrices, polynomials and a general solver."""

import numpy as np
from scipy.optimize import least_squares


def ratio_twin(z_low, z_high):
    """Phases at the lower frequency and amplitudes, strongest first, by Pisarenko's method."""
    off = np.array(
        [
            [0, np.conj(z_low), np.conj(z_high)],
            [z_low, 0, np.conj(z_low)],
            [z_high, z_low, 0],
        ]
    )
    total = -np.linalg.eigvalsh(off)[0]  # a + b on the diagonal makes the matrix singular
    _, vectors = np.linalg.eigh(off + total * np.eye(3))
    roots = np.roots(np.conj(vectors[::-1, 0]))  # sum_k conj(v_k) u^k = 0 for every return u
    turns = roots / np.abs(roots)
    rows = np.stack([turns, turns**2])
    amplitudes = np.linalg.lstsq(
        np.concatenate([rows.real, rows.imag]),
        np.array([z_low.real, z_high.real, z_low.imag, z_high.imag]),
        rcond=None,
    )[0]
    order = np.argsort(-amplitudes)
    return np.mod(np.angle(turns[order]), 2 * np.pi), amplitudes[order]


def cauchy_twin(z):
    """Roots and complex amplitudes of four samples, strongest first, by Prony's method."""
    hankel = np.array([[z[0], z[1]], [z[1], z[2]]])
    constant, linear = np.linalg.solve(hankel, -z[2:4])
    roots = np.roots([1, linear, constant])
    amplitudes = np.linalg.lstsq(roots[None, :] ** np.arange(4)[:, None], z, rcond=None)[0]
    order = np.argsort(-np.abs(amplitudes))
    return roots[order], amplitudes[order]


def model(k, d, e, a, b):
    """Phasors of two returns."""
    return a * np.exp(1j * k * d) * (1 + b * np.exp(1j * k * e))


def two_twin(z, sigma, k, longest_m, extra_m, *, follow=5):
    """``(chi2, d, e, a, b)`` of the most likely two returns of one pixel.

    Every pair of a coarse grid, amplitudes by least squares, then a general solver in the phasors
    themselves from the best few.
    """
    step = 0.8 / k.max()
    starts = []
    for d in np.arange(0, longest_m, step):
        for e in np.arange(step, extra_m, step):
            rows = np.stack([np.exp(1j * k * d), np.exp(1j * k * (d + e))], axis=1) / sigma[:, None]
            amplitudes = np.linalg.lstsq(
                np.concatenate([rows.real, rows.imag]),
                np.concatenate([(z / sigma).real, (z / sigma).imag]),
                rcond=None,
            )[0]
            if amplitudes[0] > 0 and 0 < amplitudes[1] <= amplitudes[0]:
                cost = np.sum(np.abs(rows @ amplitudes - z / sigma) ** 2)
                starts.append((cost, d, e, amplitudes[0], amplitudes[1] / amplitudes[0]))

    def residual(x):
        off = (model(k, *x) - z) / sigma
        return np.concatenate([off.real, off.imag])

    below, above = [-np.inf, 0.1 / k.max(), 0, 1e-3], [np.inf, extra_m, np.inf, 1]
    found = []
    for start in sorted(starts)[:follow]:
        x = np.clip(start[1:], np.asarray(below) + 1e-6, np.asarray(above) - 1e-6)
        fit = least_squares(
            residual, x, bounds=(below, above), x_scale=[0.1, 0.1, max(x[2], 1e-9), 0.1]
        )
        found.append((2 * fit.cost, *fit.x))
    return min(found)
