"""Pixel patterns and temperature drift of one camera.

A camera's patterns follow from its serial number alone, so that all its captures share them while
shot noise differs. Magnitudes and shapes of phase offsets follow the factory tables of a Kinect
v2, which show 0.08, 0.02 and 0.11 rad at 80, 16 and 120 MHz: in proportion to frequency, as delays
in the clock tree make them, smooth along rows and columns with a small white part.
"""

import numpy as np

from toftools.types import F64, PixelMaps, Sensor

WHITE_VARIANCE = 0.06
"""Share of the variance of phase offsets that neighbours do not share (Kinect v2: steps between
neighbours of 0.019 rad in the median against 0.08 rad over the image)."""
N_WAVES = 4
"""Cosine waves per axis that make up the smooth part."""


def pixel_maps(sensor: Sensor) -> PixelMaps:
    """Pixel patterns of a camera: those it carries, or drawn from its serial number.

    Parameters
    ----------
    sensor : Sensor
        Camera with `defects` and perhaps `maps`.

    Returns
    -------
    PixelMaps
        Patterns with the standard deviations of `defects`.
    """
    if sensor.maps is not None:
        return sensor.maps
    defects, shape = sensor.defects, sensor.camera.shape
    nodes = (sensor.timing.taps_per_exposure, *shape)
    gain_rng, dark_rng, phase_rng = (np.random.default_rng((defects.unit, n)) for n in range(3))
    gain, dark, delay = np.ones(nodes), np.full(nodes, sensor.noise.dark_e), np.zeros(shape)
    if defects.prnu:
        gain = np.maximum(1 + defects.prnu * gain_rng.standard_normal(nodes), 0)
    if defects.dsnu_e:
        dark = np.maximum(dark + defects.dsnu_e * dark_rng.standard_normal(nodes), 0)
    spread = per_freq_phase_rad(defects.fppn_rad, sensor)
    if spread.any():
        delay = _delay_pattern(shape, phase_rng)
    return PixelMaps(gain, dark, spread[:, None, None] * delay)


def per_freq_phase_rad(value: float | tuple[float, ...], sensor: Sensor) -> F64:
    """Phase per frequency of a delay: one number is that of the highest frequency.

    Parameters
    ----------
    value : float or tuple of float
        Phase, rad, as in `Defects`.
    sensor : Sensor
        Gives the frequencies.

    Returns
    -------
    ndarray, (F,)
        Phase, rad.
    """
    freqs = sensor.modulation.freqs_hz
    if isinstance(value, tuple):
        return np.asarray(value)
    return np.asarray(value * freqs / freqs.max())


def _delay_pattern(shape: tuple[int, int], rng: np.random.Generator) -> F64:
    """Smooth row and column curves plus white noise, mean 0 and standard deviation 1."""
    smooth = np.zeros(shape)
    for axis, n in enumerate(shape):
        at = (np.arange(n) + 0.5) / n
        waves = np.cos(np.pi * np.arange(1, N_WAVES + 1)[:, None] * at)  # (waves, n)
        curve = (rng.standard_normal(N_WAVES) / np.arange(1, N_WAVES + 1)) @ waves
        smooth += curve[:, None] if axis == 0 else curve[None, :]
    white = rng.standard_normal(shape)
    return _standard(
        np.sqrt(1 - WHITE_VARIANCE) * _standard(smooth) + np.sqrt(WHITE_VARIANCE) * _standard(white)
    )


def _standard(image: F64) -> F64:
    """Mean 0 and standard deviation 1; a lone pixel keeps mean 0."""
    centred = image - image.mean()
    return np.asarray(centred / max(float(centred.std()), np.finfo(np.float64).tiny))


def pixel_phase_rad(sensor: Sensor, maps: PixelMaps) -> F64:
    """Phase that pixels and temperature add to the light.

    Parameters
    ----------
    sensor : Sensor
        Camera.
    maps : PixelMaps
        Its patterns.

    Returns
    -------
    ndarray, (F, H, W)
        Phase, rad, of the first harmonic; harmonic m is delayed by m times as much.
    """
    defects = sensor.defects
    warmth = defects.temperature_c - defects.reference_c
    drift = per_freq_phase_rad(defects.drift_rad_per_k, sensor) * warmth
    return np.asarray(maps.phase_rad + drift[:, None, None])
