"""Taps to phasors and back.

A tap is ``I_k = B + A cos(phi - step_k)``; demodulation is the least-squares fit of
``(B, A cos phi, A sin phi)`` to the taps, which for equispaced steps is the discrete Fourier
transform. With harmonics in the correlation the fit is biased (wiggling): that is the sensor's
physics, left to calibration.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toftools.tap_noise import phasor_sigma
from toftools.types import F32, F64, Capture, DepthMap, Phasors, Sensor, Taps
from toftools.units import ambiguity_m, phase_to_range, range_to_phase, wrap_phase

SCHEMES: Mapping[str, F64] = MappingProxyType(
    {
        "three_step": np.arange(3, dtype=np.float64) * (2 * np.pi / 3),
        "four_step": np.arange(4, dtype=np.float64) * (np.pi / 2),
        "eight_step": np.arange(8, dtype=np.float64) * (np.pi / 4),
        "four_step_0_180_90_270": np.array([0.0, np.pi, np.pi / 2, 3 * np.pi / 2]),
        # Nodes A and B of a two-tap pixel in turn; over ab_four_step both see every step.
        "ab_three_step": np.array([0, 3, 2, 5, 4, 1]) * (np.pi / 3),
        "ab_four_step": np.array([0, 2, 1, 3, 2, 0, 3, 1]) * (np.pi / 2),
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
        (F, H, W); `sigma` follows from the noise of the taps (`tap_noise.phasor_sigma`) and is
        None for taps in DN without a conversion gain.

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
        sigma=phasor_sigma(taps, values, weights, sensor.noise),
        valid=taps.valid & np.isfinite(taps.values).all(axis=(0, 1)),
    )


def phasors_of_depth(depth: DepthMap, freq_hz: float) -> Phasors:
    """One-frequency phasors of a depth-only camera, so that it enters like any other.

    Parameters
    ----------
    depth : DepthMap
        Range with or without amplitude (1 is taken where there is none, or no positive number).
    freq_hz : float
        Frequency whose ambiguity range holds the ranges, Hz.

    Returns
    -------
    Phasors
        (1, H, W); pixels without a range are invalid.
    """
    known = np.isfinite(depth.range_m)
    amplitude = np.ones(known.shape, np.float32) if depth.amplitude is None else depth.amplitude
    told = np.isfinite(amplitude) & (amplitude > 0)
    angle = range_to_phase(np.where(known, depth.range_m, 0.0), freq_hz)
    values = np.where(known, np.where(told, amplitude, 1), 0) * np.exp(1j * angle)
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
    """First-order standard deviation of the phase, ``sigma / |z|``, sigma being that across z.

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
