"""The answers to a virtual rig: what a faultless calibration would find."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from toftools.phasor import phase, phasors_of
from toftools.sim._rig_errors import Errors
from toftools.sim._rig_unit import amplitude_error_rad, unit_of
from toftools.sim._rig_wiggling import Wiggling, wiggling
from toftools.types import F64, Bool, Camera, Capture, Sensor
from toftools.units import TWO_PI


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
            Measured phase less wiggling, common phase and fixed pattern, rad.
        amplitude : ndarray, (F, ...)
            Measured amplitude without the gain of the pixel, unit of the taps.

        Returns
        -------
        ndarray, (F, ...)
            Phase, rad.
        """
        return amplitude_error_rad(
            self.amplitude_rad, self.reference_amplitude, phase_rad, amplitude
        )

    def common_on(self, walls: Iterable[Capture]) -> F64:
        """Common phase in the terms of a fit whose amplitude error is zero on average over walls.

        Parameters
        ----------
        walls : iterable of Capture
            Captures of the rig.

        Returns
        -------
        ndarray, (F,)
            Common phase with the mean of the planted amplitude error over their sound pixels, rad.
        """
        means = []
        for capture in walls:
            phasors = phasors_of(capture)
            measured = phase(phasors.values.astype(np.complex128))
            curve = self.wiggling
            waves = [
                np.interp(layer, curve.phase_rad, error, period=TWO_PI)
                for layer, error in zip(measured, curve.error_rad, strict=True)
            ]
            left = measured - np.stack(waves) - self.common_phase_rad[:, None, None]
            amplitude = np.abs(phasors.values).astype(np.float64)
            related = self.amplitude_error_rad(left - self.fixed_pattern_rad, amplitude)
            means.append(related[:, phasors.valid & ~self.bad].mean(axis=1))
        return np.asarray(self.common_phase_rad + np.mean(means, axis=0))

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
