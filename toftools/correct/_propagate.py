"""Noise of phasors carried through an estimator of range, to first order.

``sigma_d^2 = sum_i (dd/dx_i)^2 sigma_i^2`` over the two components of every phasor, the derivatives
by forward differences: the law for any estimator that is smooth over the noise, efficient or not,
which the Cramer-Rao bound is not. Reference: textbook propagation of uncertainty (JCGM 100:2008,
equation 10). Inputs: an estimator of whole images. Fails where the estimator jumps within the
noise: there the true spread is that of the jumps, and this sigma is too small.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toftools.types import F64

STEP = 0.05
"""Step of the differences in units of sigma: small against the noise, large against rounding."""


def propagated_sigma_m(
    estimate: Callable[[NDArray[np.complex128]], F64],
    values: NDArray[np.complexfloating],
    sigma: NDArray[np.floating],
    *,
    period_m: float = 0.0,
) -> F64:
    """Standard deviation of a range estimate, given that of the phasors.

    Parameters
    ----------
    estimate : callable
        Phasors (F, P) to ranges (P,), m; NaN for no answer. Called 2 F + 1 times.
    values : ndarray, (F, P), complex
        Phasors.
    sigma : ndarray, (F, P)
        Standard deviation of the real and of the imaginary part.
    period_m : float
        Range after which answers repeat, m; 0 if they do not.

    Returns
    -------
    ndarray, (P,)
        Standard deviation, m; NaN without an answer.

    Examples
    --------
    >>> from toftools.units import phase_to_range
    >>> one = propagated_sigma_m(
    ...     lambda z: phase_to_range(np.angle(z[0]), 20e6), np.array([[100j]]), np.ones((1, 1))
    ... )
    >>> bool(np.isclose(one[0], phase_to_range(1 / 100, 20e6), rtol=1e-3))
    True
    """
    z = np.asarray(values, dtype=np.complex128)
    here = estimate(z)
    step = STEP * np.asarray(sigma, dtype=np.float64)
    variance = np.zeros(here.shape)
    for f in range(z.shape[0]):
        for part in (1.0, 1.0j):
            moved = z.copy()
            moved[f] += part * step[f]
            change = estimate(moved) - here
            if period_m > 0:
                change = np.mod(change + period_m / 2, period_m) - period_m / 2
            # A neighbour without an answer says nothing: NaN comes through.
            variance += (change / STEP) ** 2
    return np.sqrt(variance)
