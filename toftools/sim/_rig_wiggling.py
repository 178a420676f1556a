"""Wiggling of a sensor from the aliasing of its harmonics at the tap steps, computed, not fitted.

Taps at ``step_k`` and demodulation weights ``w_k`` turn light of phase phi into
``z(phi) = sum_m (h_m e^{j m phi} sum_k w_k e^{-j m step_k} + conj(h_m) e^{-j m phi} sum_k w_k
e^{+j m step_k}) / 2``: its phase is the measured one, its modulus the ripple of the amplitude.
"""

from dataclasses import dataclass

import numpy as np

from toftools.phasor import demodulation_weights
from toftools.sim.shapes import C128
from toftools.types import F64, Sensor
from toftools.units import TWO_PI

ORDERS = 16
"""Harmonics of the wiggling that are told."""
SAMPLES = 4096
"""Phases at which its curve is told."""
NEWTON = 6
"""Steps from true to measured phase; each squares what is left of 0.02 rad."""


@dataclass(frozen=True, eq=False)
class Wiggling:
    """Wiggling as function of the measured phase, zero mean over a turn.

    Parameters
    ----------
    phase_rad : ndarray, (P,)
        Measured phase, evenly over a turn, rad.
    error_rad : ndarray, (F, P)
        Measured minus true phase, rad.
    cos_rad, sin_rad : ndarray, (F, ORDERS)
        ``error = sum_n cos_rad[n - 1] cos(n phase) + sin_rad[n - 1] sin(n phase)``.
    mean_rad : ndarray, (F,)
        Mean that was taken off, rad: part of the common phase.
    """

    phase_rad: F64
    error_rad: F64
    cos_rad: F64
    sin_rad: F64
    mean_rad: F64


def wiggling(sensor: Sensor) -> Wiggling:
    """Cyclic error of a sensor from its harmonics and tap steps.

    Parameters
    ----------
    sensor : Sensor
        Camera with `modulation.harmonics`; pixel patterns play no part.

    Returns
    -------
    Wiggling
        Curve and Fourier coefficients.
    """
    phase = np.arange(SAMPLES) * (TWO_PI / SAMPLES)
    true = np.broadcast_to(phase, (sensor.modulation.n_freqs, SAMPLES))
    error, density = _error(sensor, true)
    order = np.arange(ORDERS + 1)[:, None]
    # Over measured phase; the density turns the integral into one over true phase.
    waves = [
        (np.exp(-1j * order * (phase + e)) @ (e * d)) / SAMPLES
        for e, d in zip(error, density, strict=True)
    ]
    c = np.stack(waves)  # (F, ORDERS + 1)
    mean = c[:, 0].real
    for _ in range(NEWTON):  # the true phases whose measured ones lie evenly
        true = true + (phase - true - error) / density
        error, density = _error(sensor, true)
    return Wiggling(
        np.asarray(phase, np.float64),
        error - mean[:, None],
        2 * c[:, 1:].real,
        -2 * c[:, 1:].imag,
        mean,
    )


def ripple(sensor: Sensor) -> F64:
    """Measured amplitude over that of the first harmonic.

    Parameters
    ----------
    sensor : Sensor
        Camera with `modulation.harmonics`.

    Returns
    -------
    ndarray, (F, SAMPLES)
        Ratio over a turn of the phase before wiggling.
    """
    phase = np.arange(SAMPLES) * (TWO_PI / SAMPLES)
    z, _ = _response(sensor, np.broadcast_to(phase, (sensor.modulation.n_freqs, SAMPLES)))
    return np.abs(z) / np.sinc(sensor.timing.beat_hz * sensor.timing.exposure_s)


def _error(sensor: Sensor, phase_rad: F64) -> tuple[F64, F64]:
    """Measured minus true phase at true phases (F, P), and slope of the measured phase."""
    z, slope = _response(sensor, phase_rad)
    return np.angle(z * np.exp(-1j * phase_rad)), np.imag(slope / z)


def _response(sensor: Sensor, phase_rad: F64) -> tuple[C128, C128]:
    """Demodulated phasor of light of unit amplitude at phases (F, P), and its slope."""
    mod, timing = sensor.modulation, sensor.timing
    assert mod.harmonics is not None
    weights = demodulation_weights(mod.steps_rad)  # (F, K)
    z, slope = np.zeros((2, *phase_rad.shape), np.complex128)
    for i in range(mod.harmonics.shape[1]):
        m = i + 1
        h = mod.harmonics[:, i] * np.sinc(m * timing.beat_hz * timing.exposure_s)
        if not h.any():
            continue
        turn = np.exp(1j * m * mod.steps_rad)  # (F, K)
        up = h * (weights / turn).sum(axis=1) / 2
        down = np.conj(h) * (weights * turn).sum(axis=1) / 2
        wave = np.exp(1j * m * phase_rad)
        rising, falling = up[:, None] * wave, down[:, None] / wave
        z += rising + falling
        slope += 1j * m * (rising - falling)
    return z, slope
