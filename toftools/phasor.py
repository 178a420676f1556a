"""Taps to phasors and back, noise propagation and Cramer-Rao bounds.

A tap is ``I_k = B + A cos(phi - step_k)``; demodulation is the least-squares fit of
``(B, A cos phi, A sin phi)`` to the taps, which for equispaced steps is the discrete Fourier
transform. With harmonics in the correlation the fit is biased (wiggling): that is the sensor's
physics, left to calibration.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toftools.types import F32, F64, Capture, DepthMap, Noise, Phasors, Sensor, Taps
from toftools.units import ambiguity_m, phase_to_range, range_to_phase, wrap_phase

SCHEMES: Mapping[str, F64] = MappingProxyType(
    {
        "three_step": np.arange(3, dtype=np.float64) * (2 * np.pi / 3),
        "four_step": np.arange(4, dtype=np.float64) * (np.pi / 2),
        "eight_step": np.arange(8, dtype=np.float64) * (np.pi / 4),
        "four_step_0_180_90_270": np.array([0.0, np.pi, np.pi / 2, 3 * np.pi / 2]),
    }
)
"""Tap schemes by name: reference phase of each tap, rad, in the order of the taps."""


def demodulation_weights(steps_rad: ArrayLike) -> NDArray[np.complex128]:
    """Weights w with ``A exp(j phi) = sum_k w_k I_k`` for arbitrary tap steps.

    Parameters
    ----------
    steps_rad : array_like, (..., K)
        Tap steps, rad.

    Returns
    -------
    ndarray, (..., K), complex
        Weights; they sum to zero, so constant light cancels.

    Raises
    ------
    ValueError
        If the steps do not determine offset, cosine and sine.

    Examples
    --------
    >>> turns = demodulation_weights(SCHEMES["four_step"]) * 2
    >>> bool(np.allclose(turns, [1, 1j, -1, -1j]))
    True
    """
    steps = np.asarray(steps_rad, dtype=np.float64)
    basis = np.stack([np.ones_like(steps), np.cos(steps), np.sin(steps)], axis=-1)  # (..., K, 3)
    if np.linalg.cond(basis).max() > 1e6:
        msg = f"tap steps {steps.tolist()} rad do not separate offset, cosine and sine; spread them"
        raise ValueError(msg)
    inverse = np.linalg.pinv(basis)  # (..., 3, K)
    weights: NDArray[np.complex128] = inverse[..., 1, :] + 1j * inverse[..., 2, :]
    weights[np.abs(weights) < 1e-15] = 0
    return weights


def demodulate(taps: Taps, sensor: Sensor) -> Phasors:
    """Phasors of a set of taps, with their standard deviation where the noise is known.

    Parameters
    ----------
    taps : Taps
        Samples (F, K, H, W).
    sensor : Sensor
        Gives the tap steps and the noise model.

    Returns
    -------
    Phasors
        (F, H, W); `sigma` follows from shot and read noise and is None for taps in DN without
        a conversion gain.

    Raises
    ------
    ValueError
        If the taps do not match the sensor.
    """
    steps = sensor.modulation.steps_rad
    if taps.values.shape[:2] != steps.shape:
        msg = f"taps must be {steps.shape} + (H, W), got {taps.values.shape}"
        raise ValueError(msg)
    weights = demodulation_weights(steps)  # (F, K)
    values = np.einsum("fk,fkhw->fhw", weights.astype(np.complex64), taps.values)
    return Phasors(
        values=values,
        sigma=phasor_sigma(taps, weights, sensor.noise),
        valid=taps.valid & np.isfinite(taps.values).all(axis=(0, 1)),
    )


def phasor_sigma(taps: Taps, weights: NDArray[np.complex128], noise: Noise) -> F32 | None:
    """Standard deviation of each phasor component from the tap noise model.

    The variance of tap k is ``I_k + read_e^2`` electrons squared (shot and read noise); it is
    averaged over the real and the imaginary part, which for equispaced taps gives
    ``2 (B + read_e^2) / K``.

    Parameters
    ----------
    taps : Taps
        Samples.
    weights : ndarray, (F, K)
        Demodulation weights.
    noise : Noise
        Electronics.

    Returns
    -------
    ndarray, (F, H, W), float32, or None
        Standard deviation in the unit of the taps; None if the unit is DN and the conversion
        gain is unknown.
    """
    if taps.unit == "DN" and noise.dn_per_e is None:
        return None
    gain = 1.0 if taps.unit == "e-" else float(noise.dn_per_e or 1.0)  # unit per electron
    power = (np.abs(weights) ** 2 / 2).astype(np.float32)  # (F, K)
    signal_e = np.maximum(taps.values, 0) * np.float32(1 / gain)
    variance_e = np.einsum("fk,fkhw->fhw", power, signal_e)
    variance_e += (power.sum(axis=1) * np.float32(noise.read_e**2))[:, None, None]
    return np.asarray(gain * np.sqrt(variance_e), dtype=np.float32)


def phasors_of_depth(depth: DepthMap, freq_hz: float) -> Phasors:
    """One-frequency phasors of a depth-only camera, so that it enters like any other.

    Parameters
    ----------
    depth : DepthMap
        Range with or without amplitude (1 is taken where there is none).
    freq_hz : float
        Frequency whose ambiguity range holds the ranges, Hz.

    Returns
    -------
    Phasors
        (1, H, W); pixels without a range are invalid.
    """
    known = np.isfinite(depth.range_m)
    amplitude = np.ones(known.shape) if depth.amplitude is None else depth.amplitude
    angle = range_to_phase(np.where(known, depth.range_m, 0.0), freq_hz)
    values = np.where(known, amplitude, 0) * np.exp(1j * angle)
    return Phasors(np.asarray(values[None], dtype=np.complex64), valid=known)


def phasors_of(capture: Capture) -> Phasors:
    """Phasors of a capture, whatever it holds: its own, its taps' or its depth's.

    Parameters
    ----------
    capture : Capture
        Any capture.

    Returns
    -------
    Phasors
        (F, H, W).

    Raises
    ------
    ValueError
        If the capture holds only a depth whose ranges its sensor's frequency cannot tell apart.
    """
    if capture.phasors is not None:
        return capture.phasors
    if capture.taps is not None:
        return demodulate(capture.taps, capture.sensor)
    assert capture.depth is not None
    freq_hz = float(capture.sensor.modulation.freqs_hz[0])
    known = np.isfinite(capture.depth.range_m)
    if not known.any():
        msg = "got a capture with amplitude only; wanted taps, phasors or a range to correct"
        raise ValueError(msg)
    farthest, limit = float(capture.depth.range_m[known].max()), float(ambiguity_m(freq_hz))
    if farthest >= limit:
        msg = (
            f"got a depth-only capture out to {farthest:.2f} m whose sensor wraps at "
            f"{limit:.2f} m; convert it with a lower frequency"
        )
        raise ValueError(msg)
    return phasors_of_depth(capture.depth, freq_hz)


def modulate(phasors: NDArray[np.complexfloating], offset: ArrayLike, steps_rad: ArrayLike) -> F64:
    """Taps of given phasors, the inverse of demodulation: ``I_k = B + Re(z exp(-j step_k))``.

    Parameters
    ----------
    phasors : ndarray, (F, H, W), complex
        Phasors.
    offset : array_like, broadcasts to (F, H, W)
        Constant light B.
    steps_rad : array_like, (F, K)
        Tap steps, rad.

    Returns
    -------
    ndarray, (F, K, H, W)
        Taps, float64.
    """
    turn = np.exp(-1j * np.asarray(steps_rad))[:, :, None, None]  # (F, K, 1, 1)
    constant = np.broadcast_to(np.asarray(offset, dtype=np.float64), phasors.shape)
    return np.asarray(constant[:, None] + (phasors[:, None] * turn).real)


def phase(values: NDArray[np.complexfloating]) -> F64:
    """Phase of phasors in [0, 2 pi).

    Parameters
    ----------
    values : ndarray
        Phasors.

    Returns
    -------
    ndarray
        Phase, rad.
    """
    return wrap_phase(np.angle(values))


def wrapped_range_m(values: NDArray[np.complexfloating], freqs_hz: ArrayLike) -> F64:
    """Range of each phasor without any wrap, in [0, c / 2f).

    Parameters
    ----------
    values : ndarray, (F, ...)
        Phasors.
    freqs_hz : array_like, (F,)
        Modulation frequencies, Hz.

    Returns
    -------
    ndarray, (F, ...)
        Radial range, m.
    """
    freqs = np.reshape(freqs_hz, (-1,) + (1,) * (values.ndim - 1))
    return phase_to_range(phase(values), freqs)


def phase_sigma_rad(phasors: Phasors) -> F32 | None:
    """First-order standard deviation of the phase, ``sigma / |z|``.

    Parameters
    ----------
    phasors : Phasors
        Phasors with or without `sigma`.

    Returns
    -------
    ndarray, (F, H, W), or None
        Standard deviation, rad; None if the phasors carry none.
    """
    if phasors.sigma is None:
        return None
    amplitude = np.maximum(np.abs(phasors.values), np.finfo(np.float32).tiny)
    return np.asarray(phasors.sigma / amplitude, dtype=np.float32)


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
