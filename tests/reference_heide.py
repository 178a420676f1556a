"""Slow, readable twin of `heide2013`: the same objective by L-BFGS-B, the same model by scipy."""

import numpy as np
from scipy.optimize import least_squares, minimize


def objective(x, matrix, data, weight, huber, cyclic):
    """Value and gradient of what the transient minimises."""
    step = np.roll(x, -1) - x
    if not cyclic:
        step[-1] = 0
    rest = matrix @ x - data
    far = np.abs(step) > huber
    value = np.where(far, np.abs(step) - huber / 2, step**2 / (2 * huber)).sum()
    slope = weight * np.where(far, np.sign(step), step / huber)
    return rest @ rest / 2 + weight * value, matrix.T @ rest + np.roll(slope, 1) - slope


def transient(matrix, data, weight, huber, *, cyclic):
    """Non-negative minimiser for one pixel, and its objective."""
    found = minimize(
        objective,
        np.zeros(matrix.shape[1]),
        (matrix, data, weight, huber, cyclic),
        jac=True,
        bounds=[(0, None)] * matrix.shape[1],
        options={"maxiter": 20_000, "maxfun": 40_000, "ftol": 1e-14, "gtol": 1e-9},
    )
    return found.x, found.fun


def model(p, k, n, *, decay):
    """Phasors of n sharp returns ``(a, d)``, and of a decay ``(b, ln L)`` behind the first."""
    z = sum(p[2 * i] * np.exp(1j * k * p[2 * i + 1]) for i in range(n))
    if decay:
        z = z + p[2 * n] * np.exp(1j * k * p[1]) / (1 - 1j * k * np.exp(p[2 * n + 1]))
    return z


def fit(z, k, start, n, *, decay):
    """Least squares from a start: parameters and sum of squares."""

    def rest(p):
        r = model(p, k, n, decay=decay) - z
        return np.concatenate([r.real, r.imag])

    found = least_squares(rest, start, method="lm", x_scale="jac", xtol=1e-14, ftol=1e-14)
    return found.x, 2 * found.cost
