"""Periodic functions of phase with zero mean over a turn: Fourier harmonics and B-splines.

A design matrix serves the fit, a curve and its slope serve the stage; both describe the same
function.
"""

import numpy as np
from numpy.typing import NDArray

from toftools.types import F64
from toftools.units import TWO_PI


def fourier(phase_rad: F64, harmonics: int) -> F64:
    """Columns cos psi, sin psi, cos 2 psi, sin 2 psi, ...

    Parameters
    ----------
    phase_rad : ndarray, (N,)
        Phase, rad.
    harmonics : int
        Largest order.

    Returns
    -------
    ndarray, (N, 2 harmonics)
        Columns; the first 2 m are those of m harmonics.

    Examples
    --------
    >>> fourier(np.array([np.pi / 2]), 2).round(12).tolist()
    [[0.0, 1.0, -1.0, 0.0]]
    """
    columns = np.empty((phase_rad.size, 2 * harmonics))
    first = np.exp(1j * phase_rad)
    wave = np.ones_like(first)
    for order in range(harmonics):
        wave = wave * first
        columns[:, 2 * order], columns[:, 2 * order + 1] = wave.real, wave.imag
    return columns


def fourier_curve(cos_rad: F64, sin_rad: F64, phase_rad: F64, *, slope: bool = False) -> F64:
    """Sum of harmonics per frequency, or its derivative.

    Parameters
    ----------
    cos_rad, sin_rad : ndarray, (F, M)
        Coefficients of orders 1..M, rad.
    phase_rad : ndarray, (F, ...)
        Phase, rad.
    slope : bool
        Derivative instead of value.

    Returns
    -------
    ndarray, (F, ...)
        Value, rad, or slope, rad/rad.
    """
    phase = np.asarray(phase_rad, dtype=np.float64)
    first = np.exp(1j * phase)
    # Horner's rule on Re sum_m (cos_m - j sin_m) exp(j m psi)
    coefficients = cos_rad - 1j * sin_rad
    if slope:
        coefficients = coefficients * 1j * np.arange(1, cos_rad.shape[1] + 1)
    wide = (slice(None), *[None] * (phase.ndim - 1))
    total = np.zeros_like(first)
    for order in range(cos_rad.shape[1] - 1, -1, -1):
        total = (total + coefficients[:, order][wide]) * first
    return np.asarray(total.real)


def spline(phase_rad: F64, knots: int, degree: int) -> F64:
    """Columns of a periodic uniform B-spline, each less its mean over the turn.

    Parameters
    ----------
    phase_rad : ndarray, (N,)
        Phase, rad.
    knots : int
        Number of knots on the turn, the first at phase 0; more than `degree`.
    degree : {1, 3}
        Piecewise linear or cubic.

    Returns
    -------
    ndarray, (N, knots)
        Columns; column k belongs to the knot at ``2 pi k / knots``. They add up to 0, so the
        coefficients count only up to a constant.
    """
    left, weights = _local(phase_rad, knots, degree, slope=False)
    columns = np.full((phase_rad.size, knots), -1.0 / knots)
    rows = np.arange(phase_rad.size)
    for step, weight in enumerate(weights):
        columns[rows, (left + step) % knots] += weight
    return columns


def spline_curve(knot_rad: F64, phase_rad: F64, degree: int, *, slope: bool = False) -> F64:
    """A periodic uniform B-spline per frequency, or its derivative.

    Parameters
    ----------
    knot_rad : ndarray, (F, K)
        Coefficients per knot, rad; their mean is the mean of the curve.
    phase_rad : ndarray, (F, ...)
        Phase, rad.
    degree : {1, 3}
        Piecewise linear or cubic.
    slope : bool
        Derivative instead of value.

    Returns
    -------
    ndarray, (F, ...)
        Value, rad, or slope, rad/rad.
    """
    phase = np.asarray(phase_rad, dtype=np.float64)
    knots = knot_rad.shape[1]
    left, weights = _local(phase, knots, degree, slope=slope)
    row = np.arange(knot_rad.shape[0]).reshape(-1, *[1] * (phase.ndim - 1))
    terms = (w * knot_rad[row, (left + step) % knots] for step, w in enumerate(weights))
    return np.asarray(sum(terms))


def _local(
    phase: F64, knots: int, degree: int, *, slope: bool
) -> tuple[NDArray[np.intp], tuple[F64, ...]]:
    """First knot that a phase feels, and the weights of this knot and those after it."""
    place = phase * (knots / TWO_PI)
    cell = np.floor(place)
    t = place - cell
    left = np.nan_to_num(cell).astype(np.intp) - (degree - 1) // 2  # NaN stays in the weights
    if degree == 1:
        rate = np.full_like(t, knots / TWO_PI)
        return left, (-rate, rate) if slope else (1 - t, t)
    if slope:
        scale = knots / (2 * TWO_PI)
        ends = (-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2)
        return left, tuple(scale * part for part in ends)
    parts = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    return left, tuple(part / 6 for part in parts)
