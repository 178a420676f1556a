"""Cramer-Rao bounds of range: one frequency, several frequencies, several returns.

What no unbiased estimator can beat: here to be compared with, no method calls them. The `sigma_m`
of `crt` equals `crlb_multi_range_m` (test_unwrapping.py::test_crt_says_the_bound_of_every_pixel).
The sparse methods give no sigma; `crlb_returns_m` says how well two returns can be told apart.
"""

import numpy as np
from numpy.typing import ArrayLike

from toftools.phasor import demodulation_weights
from toftools.types import F64
from toftools.units import phase_to_range, range_to_phase


def crlb_range_m(
    freq_hz: ArrayLike,
    amplitude_e: ArrayLike,
    offset_e: ArrayLike,
    *,
    read_e: float = 0.0,
    n_taps: int = 4,
) -> F64:
    """Cramer-Rao bound of the range from one frequency, ``c/(4 pi f) sqrt(2 (B+s_r^2)/N)/A``.

    Parameters
    ----------
    freq_hz : array_like
        Modulation frequency, Hz.
    amplitude_e, offset_e : array_like
        A and B of each tap, electrons.
    read_e : float
        Read noise, electrons.
    n_taps : int
        Number N of equispaced taps, at least 3.

    Returns
    -------
    ndarray
        Standard deviation of the range, m.

    References
    ----------
    R. Lange, P. Seitz, "Solid-state time-of-flight range camera", IEEE JQE 37 (2001) 390-397,
    for N = 4 without read noise. The bound takes the shot noise as white with variance B; the
    exact one is `fisher_phase_exact`.

    Examples
    --------
    >>> round(1e3 * float(crlb_range_m(60e6, 1600, 2000)), 2)
    7.86
    """
    if n_taps < 3:
        msg = f"n_taps must be at least 3, got {n_taps}"
        raise ValueError(msg)
    variance = 2 * (np.asarray(offset_e, dtype=np.float64) + read_e**2) / n_taps
    return phase_to_range(np.sqrt(variance) / np.asarray(amplitude_e), freq_hz)


def fisher_phase_exact(amplitude_e: ArrayLike, offset_e: ArrayLike, *, n_taps: int = 4) -> F64:
    """Exact Poisson Fisher information of the phase, averaged over phase.

    ``J = N B (1 - sqrt(1 - m^2))`` with ``m = A / B``; tends to ``N B m^2 / 2`` for small m,
    the information behind `crlb_range_m`. The atan2 estimator stays at the small-m value, so at
    m = 0.8 it is some 12 % above this bound.

    Parameters
    ----------
    amplitude_e, offset_e : array_like
        A and B, electrons, A <= B.
    n_taps : int
        Number of equispaced taps.

    Returns
    -------
    ndarray
        Fisher information, rad^-2.

    Examples
    --------
    >>> round(float(fisher_phase_exact(1600, 2000)), 6)
    3200.0
    """
    offset = np.asarray(offset_e, dtype=np.float64)
    contrast = np.asarray(amplitude_e, dtype=np.float64) / offset
    return np.asarray(n_taps * offset * (1 - np.sqrt(1 - contrast**2)))


def crlb_taps_range_m(
    freq_hz: ArrayLike,
    amplitude_e: float,
    offset_e: float,
    phase_rad: ArrayLike,
    steps_rad: ArrayLike,
    *,
    read_e: float = 0.0,
) -> F64:
    """Cramer-Rao bound of the range from taps of any steps, offset and amplitude unknown.

    Each tap carries information ``1 / (I_k + read_e^2)`` about its mean (exact for shot noise
    alone); the bound is that of the phase in the inverse of the 3 x 3 information about
    ``(B, A cos phi, A sin phi)``.

    Parameters
    ----------
    freq_hz : array_like
        Modulation frequency, Hz.
    amplitude_e, offset_e : float
        A and B of each tap, electrons, A < B.
    phase_rad : array_like, (...)
        Phase of the return, rad.
    steps_rad : array_like, (K,)
        Tap steps, rad.
    read_e : float
        Read noise, electrons.

    Returns
    -------
    ndarray, (...)
        Standard deviation of the range, m.

    Examples
    --------
    Three taps determine three unknowns, so that least squares reaches the bound.

    >>> steps = np.arange(3) * 2 * np.pi / 3
    >>> bound = crlb_taps_range_m(60e6, 1600, 2000, np.pi / 6, steps)  # cos 3 phi = 0
    >>> bool(np.isclose(bound, crlb_range_m(60e6, 1600, 2000, n_taps=3)))
    True
    """
    angle = np.asarray(phase_rad, dtype=np.float64)
    steps = np.asarray(steps_rad, dtype=np.float64)
    basis = np.stack([np.ones_like(steps), np.cos(steps), np.sin(steps)])  # (3, K)
    taps = offset_e + amplitude_e * np.cos(angle[..., None] - steps)
    information = np.einsum("ak,bk,...k->...ab", basis, basis, 1 / (taps + read_e**2))
    across = np.stack([np.zeros_like(angle), -np.sin(angle), np.cos(angle)], axis=-1)
    variance = np.einsum("...a,...ab,...b->...", across, np.linalg.inv(information), across)
    return phase_to_range(np.sqrt(variance) / amplitude_e, freq_hz)


def demodulation_efficiency(
    amplitude_e: float,
    offset_e: float,
    phase_rad: ArrayLike,
    steps_rad: ArrayLike,
    *,
    read_e: float = 0.0,
) -> F64:
    """Efficiency of least-squares demodulation: variance at the bound over its own variance.

    Least squares weighs all taps alike, although weak ones have less shot noise. By shot noise
    alone, with m = A / B, it reaches 1 for three taps, ``1 - m^2 / 2 sin^2(2 phi)`` for four
    equispaced ones, and ``(m^2 / 2) / (1 - sqrt(1 - m^2))`` for many.

    Parameters
    ----------
    amplitude_e, offset_e, phase_rad, steps_rad, read_e
        As for `crlb_taps_range_m`.

    Returns
    -------
    ndarray, (...)
        Efficiency, 0..1; the range deviates by the bound over its root.

    References
    ----------
    Derived here: for four taps the inverse information is in closed form, and the variance of the
    phase is ``(B / 2 - A^2 sin^2(2 phi) / (4 B)) / A^2``; for many, see `fisher_phase_exact`.

    Examples
    --------
    >>> four = np.arange(4) * np.pi / 2
    >>> demodulation_efficiency(1600, 2000, [0.0, np.pi / 4], four).round(3).tolist()
    [1.0, 0.68]
    """
    angle = np.asarray(phase_rad, dtype=np.float64)[..., None]
    steps = np.asarray(steps_rad, dtype=np.float64)
    variance_e2 = offset_e + amplitude_e * np.cos(angle - steps) + read_e**2  # (..., K)
    across = (demodulation_weights(steps) * np.exp(-1j * angle)).imag / amplitude_e
    own = np.sum(across**2 * variance_e2, axis=-1)
    bound = crlb_taps_range_m(1.0, amplitude_e, offset_e, phase_rad, steps, read_e=read_e)
    return np.asarray((bound / phase_to_range(1.0, 1.0)) ** 2 / own)


def crlb_multi_range_m(freqs_hz: ArrayLike, phasor_snr: ArrayLike) -> F64:
    """Cramer-Rao bound of the range from several frequencies, wraps known.

    ``sigma = c/(4 pi) [sum_i f_i^2 (A_i / sigma_i)^2]^(-1/2)``, sigma_i the standard deviation of
    each phasor component; for N taps ``sigma_i^2 = 2 (B_i + s_r^2) / N``.

    Parameters
    ----------
    freqs_hz : array_like, (F,)
        Modulation frequencies, Hz.
    phasor_snr : array_like, (F, ...)
        ``A_i / sigma_i`` per frequency.

    Returns
    -------
    ndarray, (...)
        Standard deviation of the range, m.

    Examples
    --------
    >>> one = crlb_multi_range_m([60e6], [50.0])
    >>> bool(np.isclose(one, phase_to_range(1 / 50, 60e6)))
    True
    """
    snr = np.asarray(phasor_snr, dtype=np.float64)
    freqs = np.reshape(np.asarray(freqs_hz, dtype=np.float64), (-1,) + (1,) * (snr.ndim - 1))
    information = np.sum((freqs * snr) ** 2, axis=0)
    return phase_to_range(1 / np.sqrt(information), 1.0)


def crlb_returns_m(
    freqs_hz: ArrayLike, ranges_m: ArrayLike, amplitudes: ArrayLike, sigma: ArrayLike
) -> F64:
    """Cramer-Rao bound of the ranges of L returns from F complex phasors.

    The model is ``z_i = sum_l a_l exp(j 4 pi f_i d_l / c)`` with amplitudes that do not depend
    on frequency; the Fisher matrix is ``sum_i Re(D_i^H D_i) / sigma_i^2`` with D_i the row of
    derivatives by (a_l, d_l).

    Parameters
    ----------
    freqs_hz : array_like, (F,)
        Modulation frequencies, Hz.
    ranges_m, amplitudes : array_like, (L,)
        The returns.
    sigma : array_like, () or (F,)
        Standard deviation of each phasor component.

    Returns
    -------
    ndarray, (L,)
        Standard deviation of each range, m; infinite where the data do not determine it.

    Raises
    ------
    ValueError
        If ``2 F < 2 L``: fewer data than unknowns.

    Examples
    --------
    >>> lone = crlb_returns_m([40e6, 70e6], [2.0], [100.0], 1.0)
    >>> bool(np.isclose(lone[0], crlb_multi_range_m([40e6, 70e6], [100.0, 100.0])))
    True
    """
    freqs = np.atleast_1d(np.asarray(freqs_hz, dtype=np.float64))
    ranges = np.atleast_1d(np.asarray(ranges_m, dtype=np.float64))
    if freqs.size < ranges.size:
        msg = f"{ranges.size} returns need as many frequencies, got {freqs.size}"
        raise ValueError(msg)
    turn = np.exp(1j * range_to_phase(ranges[None, :], freqs[:, None]))  # (F, L)
    slope = 1j * range_to_phase(1.0, freqs)[:, None] * np.asarray(amplitudes) * turn
    rows = np.concatenate([turn, slope], axis=1)  # (F, 2L)
    weight = 1 / np.broadcast_to(np.asarray(sigma, dtype=np.float64), freqs.shape) ** 2
    information = np.einsum("fa,f,fb->ab", rows.conj(), weight, rows).real
    # Scale to a unit diagonal first: amplitudes and ranges have different units.
    scale = 1 / np.sqrt(np.diag(information))
    scaled = information * np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e12:
        return np.full(ranges.size, np.inf)
    variance = np.diag(np.linalg.inv(scaled)) * scale**2
    return np.asarray(np.sqrt(variance[ranges.size :]))
