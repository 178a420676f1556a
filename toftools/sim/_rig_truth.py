"""The answers to a virtual rig: what a faultless calibration would find.

Wiggling is computed from the aliasing of harmonics at the tap steps, not fitted: taps at
``step_k`` and demodulation weights ``w_k`` turn light of phase phi into
``z(phi) = sum_m (h_m e^{j m phi} sum_k w_k e^{-j m step_k} + conj(h_m) e^{-j m phi} sum_k w_k
e^{+j m step_k}) / 2``, whose phase is the measured one.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from toftools.phasor import demodulation_weights
from toftools.sim._rig_errors import Errors
from toftools.sim._rig_unit import amplitude_error_rad, unit_of
from toftools.sim.shapes import C128
from toftools.types import F64, Bool, Camera, Sensor
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


@dataclass(frozen=True, eq=False)
class RigTruth:
    """What was planted, in the terms of a calibration.

    Parameters
    ----------
    camera : Camera
        True optics.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    wiggling : Wiggling
        Cyclic error.
    common_phase_rad : ndarray, (F,)
        Delay, offsets and the mean of the wiggling, rad.
    fixed_pattern_rad : ndarray, (F, H, W)
        Phase offsets of the pixels, mean 0, rad.
    sensor_rad_per_k, light_rad_per_k : ndarray, (F,)
        Drift, rad/K, zero at the reference temperatures.
    reference_sensor_c, reference_light_c : float
        Those temperatures, degrees Celsius.
    amplitude_rad : ndarray, (3, F)
        Coefficients of the amplitude-related error.
    reference_amplitude : ndarray, (F,)
        Amplitude at which it is zero, unit of the taps.
    gain, dark_e : ndarray, (N, H, W)
        Relative gain and dark charge, electrons, of every node.
    bad : ndarray, (H, W), bool
        Dead and hot pixels.
    errors : Errors
        What was asked for.
    """

    camera: Camera
    freqs_hz: F64
    wiggling: Wiggling
    common_phase_rad: F64
    fixed_pattern_rad: F64
    sensor_rad_per_k: F64
    light_rad_per_k: F64
    reference_sensor_c: float
    reference_light_c: float
    amplitude_rad: F64
    reference_amplitude: F64
    gain: F64
    dark_e: F64
    bad: Bool
    errors: Errors

    def amplitude_error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Amplitude-related phase error.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Phase of the light, rad.
        amplitude : ndarray, (F, ...)
            Amplitude without the ripple of wiggling and without the gain of the pixel, unit of the
            taps.

        Returns
        -------
        ndarray, (F, ...)
            Phase, rad.
        """
        return amplitude_error_rad(
            self.amplitude_rad, self.reference_amplitude, phase_rad, amplitude
        )

    def arrays(self) -> dict[str, Any]:
        """All of it by name, as ``truth.npz`` holds it."""
        whole: Mapping[str, Any] = {**vars(self), **vars(self.wiggling)}
        found = {
            name: value for name, value in whole.items() if isinstance(value, np.ndarray | float)
        }
        renamed = {
            f"wiggling_{name}" if name in vars(self.wiggling) else name: value
            for name, value in found.items()
        }
        return {**renamed, "K": self.camera.K, "dist": self.camera.dist}

    def planted(self) -> dict[str, Any]:
        """What was asked for, as plain JSON values."""
        return asdict(self.errors)


def truth_of(errors: Errors, sensor: Sensor) -> RigTruth:
    """The answers to a rig of these errors.

    Parameters
    ----------
    errors : Errors
        What is planted.
    sensor : Sensor
        The nominal camera.

    Returns
    -------
    RigTruth
        Every coefficient and map.

    Raises
    ------
    ValueError
        As `toftools.sim.rig.rig`.
    """
    unit = unit_of(errors, sensor)
    maps, curve = unit.sensor.maps, wiggling(unit.sensor)
    assert maps is not None
    mean = maps.phase_rad.mean(axis=(1, 2))
    return RigTruth(
        camera=unit.sensor.camera,
        freqs_hz=unit.sensor.modulation.freqs_hz,
        wiggling=curve,
        common_phase_rad=unit.common_rad + mean + curve.mean_rad,
        fixed_pattern_rad=maps.phase_rad - mean[:, None, None],
        sensor_rad_per_k=unit.sensor_rad_per_k,
        light_rad_per_k=unit.light_rad_per_k,
        reference_sensor_c=errors.reference_sensor_c,
        reference_light_c=errors.reference_light_c,
        amplitude_rad=unit.amplitude_rad,
        reference_amplitude=unit.reference,
        gain=maps.gain,
        dark_e=maps.dark_e,
        bad=unit.bad,
        errors=errors,
    )


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
    return Wiggling(phase, error - mean[:, None], 2 * c[:, 1:].real, -2 * c[:, 1:].imag, mean)


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
