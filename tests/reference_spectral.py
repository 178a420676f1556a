"""Slow readable twins of the spectral methods: dense linear algebra of one pixel at a time."""

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import least_squares


def annihilating_angles(z, order, *, both_ways):
    """Angles of the roots of the annihilating polynomial, from an SVD, ascending."""
    runs = [z[i : i + order + 1] for i in range(len(z) - order)]
    if both_ways:
        runs += [run[::-1].conj() for run in runs]
    null = np.linalg.svd(np.array(runs))[2][-1].conj()
    return np.sort(np.angle(np.roots(null[::-1])))


def moment_matrix(c, c0):
    """Hermitian Toeplitz matrix of c_0..c_m."""
    return toeplitz(np.r_[c0, c])


def pisarenko(c):
    """Total light, and returns (angles, weights) by ascending angle, from an eigenvector."""
    values, vectors = np.linalg.eigh(moment_matrix(c, 0.0))
    angles = np.sort(-np.angle(np.roots(vectors[::-1, 0])))
    turns = np.exp(1j * np.arange(1, len(c) + 1)[:, None] * angles)
    rows = np.concatenate([turns.real, turns.imag])
    weights = np.linalg.lstsq(rows, np.r_[c.real, c.imag], rcond=None)[0]
    return -values[0], angles, weights


def entropy_density(c, c0, angles):
    """Burg's density with moments c_0..c_m at given angles."""
    inverse = np.linalg.inv(moment_matrix(c, c0))[:, 0]
    turns = np.exp(-1j * np.arange(len(c) + 1) * np.asarray(angles)[..., None])
    return inverse[0].real / (2 * np.pi * np.abs(turns @ inverse) ** 2)


def pursuit(z, noise, k, grid, n_returns):
    """Cells of orthogonal matching pursuit, with real amplitudes."""
    columns = np.exp(1j * k[:, None] * grid) / noise[:, None]
    rows = np.concatenate([columns.real, columns.imag])
    data = np.r_[(z / noise).real, (z / noise).imag]
    rest, cells = data, []
    for _ in range(n_returns):
        cells.append(int(np.argmax(rows.T @ rest)))
        amounts = np.linalg.lstsq(rows[:, cells], data, rcond=None)[0]
        rest = data - rows[:, cells] @ amounts
    return cells


def fit(z, noise, k, ranges_m, amplitudes):
    """Maximum-likelihood returns (ranges, amplitudes), their sigma and chi-squared."""
    n = len(ranges_m)

    def residual(x):
        off = (z - np.exp(1j * k[:, None] * x[:n]) @ x[n:]) / noise
        return np.r_[off.real, off.imag]

    start = np.r_[ranges_m, amplitudes]
    found = least_squares(residual, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    return found.x[:n], found.x[n:], np.sqrt(np.diag(covariance))[:n], 2 * found.cost
