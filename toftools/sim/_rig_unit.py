"""The camera that results from planting errors into a nominal one."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from toftools.camera import rays
from toftools.sim._rig_errors import Errors
from toftools.sim._rig_wiggling import ripple
from toftools.sim.defects import per_freq_phase_rad, pixel_maps
from toftools.sim.noise import contrasts
from toftools.sim.target import pixel_rays
from toftools.sim.waveform import with_waveform
from toftools.types import F64, Bool, Camera, Defects, Modulation, Sensor

OFFSETS, BAD = 101, 102
"""Streams of random numbers of a unit, beside those of `toftools.sim.defects`."""
RAYS_PER_SIDE = 6
"""Rays along either side of a pixel that looks at a board."""
LEVEL = 0.5
"""Charge on the axis that the rig aims at, as share of what a white surface at 1 m gives."""
FILL = 0.25
"""The same as share of the full well, where that is less."""


@dataclass(frozen=True, eq=False)
class Unit:
    """One camera with its errors.

    Parameters
    ----------
    nominal : Sensor
        What its maker says, and what its captures carry.
    sensor : Sensor
        What it is: true optics, waveform and pixel maps; the phase map is the fixed pattern.
    common_rad : ndarray, (F,)
        Phase of delay and offsets, rad.
    sensor_rad_per_k, light_rad_per_k : ndarray, (F,)
        Drift, rad/K.
    amplitude_rad : ndarray, (3, F)
        Coefficients a, b, c of the amplitude-related error, rad.
    reference : ndarray, (F,)
        Amplitude at which that is zero, unit of the taps.
    bad : ndarray, (H, W), bool
        Dead and hot pixels.
    errors : Errors
        Where it all comes from.
    """

    nominal: Sensor
    sensor: Sensor
    common_rad: F64
    sensor_rad_per_k: F64
    light_rad_per_k: F64
    amplitude_rad: F64
    reference: F64
    bad: Bool
    errors: Errors

    @cached_property
    def directions(self) -> F64:
        """Ray of every pixel, (H, W, 3)."""
        return rays(self.sensor.camera)

    @cached_property
    def fine_directions(self) -> F64:
        """Many rays of every pixel, (S, H, W, 3)."""
        return pixel_rays(self.sensor.camera, RAYS_PER_SIDE)

    @cached_property
    def ripple(self) -> F64:
        """Measured amplitude over that of a sine, evenly over a turn of the phase, (F, P)."""
        return ripple(self.sensor)

    def drift_rad(self, sensor_c: float, light_c: float) -> F64:
        """Phase (F,) that temperatures add, rad."""
        return np.asarray(
            self.sensor_rad_per_k * (sensor_c - self.errors.reference_sensor_c)
            + self.light_rad_per_k * (light_c - self.errors.reference_light_c)
        )

    def amplitude_error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Phase that the amplitude adds, rad.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Phase of the light with drift and this error, rad.
        amplitude : ndarray, (F, ...)
            Measured amplitude, unit of the taps.

        Returns
        -------
        ndarray, (F, ...)
            Phase, rad.
        """
        return amplitude_error_rad(self.amplitude_rad, self.reference, phase_rad, amplitude)


def amplitude_error_rad(coefficients: F64, reference: F64, phase_rad: F64, amplitude: F64) -> F64:
    """``a x + b x^2 + c x cos(phase)`` with x octaves of amplitude over its reference, rad."""
    more = (1,) * (np.ndim(amplitude) - 1)
    a, b, c = coefficients.reshape(3, -1, *more)
    base = reference.reshape(-1, *more)
    x = np.log2(np.maximum(amplitude / base, np.finfo(np.float32).eps))
    return np.asarray(a * x + b * x**2 + c * x * np.cos(phase_rad))


def unit_of(errors: Errors, sensor: Sensor) -> Unit:
    """The camera that results from planting errors into a nominal one.

    Parameters
    ----------
    errors : Errors
        What to plant.
    sensor : Sensor
        A preset without errors of its own.

    Returns
    -------
    Unit
        Nominal and true sensor, and all that depends on conditions.

    Raises
    ------
    ValueError
        If the sensor has errors already, or the distortion folds the image.
    """
    nominal = _nominal(sensor)
    mod = nominal.modulation
    camera = _true_camera(errors, nominal.camera)
    defects = Defects(prnu=errors.prnu, dsnu_e=errors.dsnu_e, fppn_rad=errors.fppn_rad,
                      unit=errors.unit)  # fmt: skip
    dark = replace(nominal.noise, dark_e=errors.dark_e)
    drawn = pixel_maps(replace(nominal, noise=dark, defects=defects))
    gain, dark_e = np.array(drawn.gain), np.array(drawn.dark_e)
    gain[1:] *= 1 + errors.ab_gain  # node B, where there is one
    bad = _break(errors, gain, dark_e, min(nominal.noise.full_well_e, 10 * nominal.noise.signal_e))
    true = with_waveform(replace(nominal, camera=camera), errors.waveform)
    rng = np.random.default_rng((errors.unit, OFFSETS))
    offset = errors.offset_rad * rng.standard_normal(mod.n_freqs)
    drifts = (errors.sensor_rad_per_k, errors.light_rad_per_k)
    terms = (errors.amplitude_rad, errors.amplitude_bend_rad, errors.amplitude_wave_rad)
    for value in (errors.fppn_rad, *drifts, *terms):
        if isinstance(value, tuple) and len(value) != mod.n_freqs:
            msg = f"wanted one phase, or one per frequency ({mod.n_freqs}), got {value}"
            raise ValueError(msg)
    return Unit(
        nominal=nominal,
        sensor=replace(true, maps=replace(drawn, gain=gain, dark_e=dark_e)),
        common_rad=2 * np.pi * mod.freqs_hz * errors.delay_s + offset,
        sensor_rad_per_k=per_freq_phase_rad(errors.sensor_rad_per_k, nominal),
        light_rad_per_k=per_freq_phase_rad(errors.light_rad_per_k, nominal),
        amplitude_rad=np.stack([per_freq_phase_rad(term, nominal) for term in terms]),
        reference=reference_amplitude(nominal, camera),
        bad=bad,
        errors=errors,
    )


def level_e(sensor: Sensor) -> float:
    """Charge per tap that the rig aims at on the optical axis, electrons."""
    return min(LEVEL * sensor.noise.signal_e, FILL * sensor.noise.full_well_e)


def reference_amplitude(sensor: Sensor, camera: Camera) -> F64:
    """Geometric mean amplitude of a facing wall that puts `level_e` on the axis, per frequency.

    So the amplitude-related error is zero on average over the pixels of walls, rail and delay
    sweep, and leaves common phase and wiggling nearly alone.

    Parameters
    ----------
    sensor : Sensor
        Electronics.
    camera : Camera
        True optics.

    Returns
    -------
    ndarray, (F,)
        Amplitude, unit of the taps.
    """
    forward = np.maximum(rays(camera)[..., 2], 0.05)
    falls = float(np.exp(3 * np.log(forward).mean()))  # cos of the surface, cos^2 of the way
    return falls * (sensor.noise.gain_dn_per_e or 1.0) * contrasts(sensor) * level_e(sensor)


def _nominal(sensor: Sensor) -> Sensor:
    """The sensor as its maker describes it; refuses one that has errors already."""
    mod, plain = sensor.modulation, vars(Defects())
    assert mod.harmonics is not None
    given = [name for name, value in vars(sensor.defects).items() if value != plain[name]]
    if mod.harmonics[:, 1:].any():
        given.append("waveform")
    if sensor.maps is not None:
        given.append("pixel maps")
    if given:
        msg = f"the sensor brings {', '.join(given)} along; a rig plants errors itself (--errors)"
        raise ValueError(msg)
    if sensor.emitters:
        msg = "a rig has closed forms for one isotropic light only; leave out beams and emitters"
        raise ValueError(msg)
    old = sensor.camera
    dist = np.zeros(4 if old.model == "fisheye" else 0)
    return replace(
        sensor, camera=replace(old, dist=dist), modulation=Modulation(mod.freqs_hz, mod.steps_rad)
    )


def _true_camera(errors: Errors, nominal: Camera) -> Camera:
    K = np.array(nominal.K)
    K[0, 0] *= 1 + errors.focal[0]
    K[1, 1] *= 1 + errors.focal[1]
    K[:2, 2] += np.array(errors.centre) * (nominal.width, nominal.height)
    dist = errors.dist or nominal.dist
    camera = replace(nominal, K=K, dist=np.asarray(dist))
    if not np.isfinite(rays(camera)).all():
        msg = f"dist={list(errors.dist)} folds the image at its edge; plant less distortion"
        raise ValueError(msg)
    return camera


def _break(errors: Errors, gain: F64, dark_e: F64, full_e: float) -> Bool:
    """Make some pixels dead and as many hot, in place; which."""
    rng = np.random.default_rng((errors.unit, BAD))
    draw = rng.random(gain.shape[1:])
    dead, hot = draw < errors.bad_share / 2, draw > 1 - errors.bad_share / 2
    gain[:, dead] = 0.0
    dark_e[:, hot] = 0.5 * full_e
    return np.asarray(dead | hot)
