"""Tensor-product B-splines over log amplitude and phase: uniform, periodic in phase.

Over log amplitude ``n`` functions are of degree ``min(3, n - 1)`` on the fitted span, and clamped
outside; over phase one function is a constant, and four or more are periodic cubics. All functions
together add up to 1 everywhere.
"""

import numpy as np
from numpy.typing import NDArray

from toftools.types import F64
from toftools.units import TWO_PI

Local = tuple[NDArray[np.intp], list[F64]]
"""First function that is not 0 at each point, and the weights of it and those after it."""


def uniform(place: F64, degree: int) -> list[F64]:
    """Weights of the ``degree + 1`` uniform B-splines that are not 0 in a cell.

    Parameters
    ----------
    place : ndarray
        Place within the cell, 0..1.
    degree : {0, 1, 2, 3}
        Degree.

    Returns
    -------
    list of ndarray
        Weights from the first to the last; they add up to 1.

    Examples
    --------
    >>> [round(float(w), 4) for w in uniform(np.array(0.0), 3)]
    [0.1667, 0.6667, 0.1667, 0.0]
    """
    t = np.asarray(place)
    if degree == 0:
        return [np.ones_like(t)]
    if degree == 1:
        return [1 - t, t]
    if degree == 2:
        return [(1 - t) ** 2 / 2, (1 + 2 * t - 2 * t**2) / 2, t**2 / 2]
    rest = 1 - t
    return [
        rest**3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (3 * rest**3 - 6 * rest**2 + 4) / 6,
        t**3 / 6,
    ]


def over_amplitude(amplitude: F64, span: F64, count: int) -> Local:
    """Functions of log amplitude on a span.

    Parameters
    ----------
    amplitude : ndarray
        Amplitude; what lies outside the span is taken as its end.
    span : ndarray, (2,)
        Lowest and highest amplitude.
    count : int
        Number of functions.

    Returns
    -------
    Local
        Indices and weights.
    """
    degree = min(3, count - 1)
    cells = count - degree
    low, high = np.log(span)
    inside = np.log(np.clip(np.nan_to_num(amplitude), span[0], span[1]))
    place = np.clip((inside - low) / (high - low), 0, 1) * cells
    cell = np.minimum(place.astype(np.intp), cells - 1)
    return cell, uniform(place - cell, degree)


def over_phase(phase_rad: F64, count: int) -> Local:
    """Periodic functions of phase.

    Parameters
    ----------
    phase_rad : ndarray
        Phase, rad.
    count : int
        1, or 4 and more.

    Returns
    -------
    Local
        Indices, to be taken modulo `count`, and weights.
    """
    if count == 1:
        return np.zeros(np.shape(phase_rad), np.intp), [np.ones(np.shape(phase_rad))]
    place = np.nan_to_num(phase_rad) * (count / TWO_PI)
    cell = np.floor(place)
    return cell.astype(np.intp) - 1, uniform(place - cell, 3)


def design(amplitude: F64, phase_rad: F64, span: F64, shape: tuple[int, int]) -> F64:
    """All functions at some points.

    Parameters
    ----------
    amplitude, phase_rad : ndarray, (N,)
        Points.
    span : ndarray, (2,)
        Lowest and highest amplitude.
    shape : tuple of int
        Numbers of functions over log amplitude and over phase.

    Returns
    -------
    ndarray, (N, prod(shape))
        Rows of numbers that add up to 1.
    """
    first, up = over_amplitude(amplitude, span, shape[0])
    start, around = over_phase(phase_rad, shape[1])
    rows, out = np.arange(first.size), np.zeros((first.size, shape[0] * shape[1]))
    for i, across in enumerate(up):
        for j, along in enumerate(around):
            out[rows, (first + i) * shape[1] + (start + j) % shape[1]] += across * along
    return out


def surface(knots: F64, amplitude: F64, phase_rad: F64, span: F64) -> F64:
    """Value of a surface, without the whole design matrix.

    Parameters
    ----------
    knots : ndarray, (A, P)
        Coefficients.
    amplitude, phase_rad : ndarray, (...)
        Points.
    span : ndarray, (2,)
        Lowest and highest amplitude.

    Returns
    -------
    ndarray, (...)
        Values.
    """
    if not knots.any():
        return np.zeros(np.broadcast(amplitude, phase_rad).shape)
    first, up = over_amplitude(amplitude, span, knots.shape[0])
    start, around = over_phase(phase_rad, knots.shape[1])
    total = np.zeros(np.broadcast(amplitude, phase_rad).shape)
    columns = [(start + j) % knots.shape[1] for j in range(len(around))]
    for i, across in enumerate(up):
        along = sum(w * knots[first + i, c] for w, c in zip(around, columns, strict=True))
        total += across * along
    return total


def roughness(shape: tuple[int, int]) -> F64:
    """Penalty that fills coefficients which no data determine: straight on, and level around.

    Parameters
    ----------
    shape : tuple of int
        Numbers of functions over log amplitude and over phase.

    Returns
    -------
    ndarray, (n, n)
        Squared second differences over log amplitude and first differences around the turn.
    """
    count, turn = shape
    bend = np.diff(np.eye(count), 2, axis=0) if count > 2 else np.zeros((1, count))
    step = np.eye(turn) - np.roll(np.eye(turn), 1, axis=1)
    return np.asarray(np.kron(bend.T @ bend, np.eye(turn)) + np.kron(np.eye(count), step.T @ step))
