"""From light to taps: correlation harmonics, ambient light, shot and read noise, saturation."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toftools.phasor import modulate
from toftools.types import F64, Sensor, Taps

Light = Callable[[float], NDArray[np.complex128]]
"""Transport of a scene: frequency in Hz -> (H, W) complex charge per tap, electrons at f = 0."""


def clean_taps(light: Light, ambient_e: float, sensor: Sensor) -> F64:
    """Expected charge of every tap.

    Parameters
    ----------
    light : callable
        ``light(freq_hz)`` gives the phasor of the modulated light per pixel, electrons, at
        modulation depth one; at 0 Hz it is the mean charge.
    ambient_e : float
        Unmodulated charge per tap, electrons: adds offset and shot noise, moves no phase.
    sensor : Sensor
        Frequencies, taps, harmonics and contrast.

    Returns
    -------
    ndarray, (F, K, H, W)
        Charge, electrons.
    """
    mod, contrast = sensor.modulation, sensor.noise.contrast
    assert mod.harmonics is not None
    offset = light(0.0).real + ambient_e  # (H, W)
    taps = np.empty((mod.n_freqs, mod.n_taps, *offset.shape))
    for i, freq in enumerate(mod.freqs_hz):
        taps[i] = offset
        for m, weight in enumerate(mod.harmonics[i], start=1):
            if weight != 0:
                phasor = (contrast * weight * light(m * float(freq)))[None]
                taps[i] += modulate(phasor, 0.0, m * mod.steps_rad[i : i + 1])[0]
    return taps


def expose(charge_e: F64, sensor: Sensor, rng: np.random.Generator | None) -> Taps:
    """Taps read out from expected charge.

    Parameters
    ----------
    charge_e : ndarray, (F, K, H, W)
        Expected charge, electrons.
    sensor : Sensor
        Read noise, full well and gain.
    rng : numpy.random.Generator or None
        Source of shot and read noise; None returns the expectation.

    Returns
    -------
    Taps
        In DN if the sensor has a conversion gain, else in electrons; pixels with a tap at full
        well are invalid.
    """
    noise = sensor.noise
    if rng is not None:
        charge_e = rng.poisson(np.maximum(charge_e, 0)).astype(np.float64)
    full = np.asarray((charge_e >= noise.full_well_e).any(axis=(0, 1)))
    read = np.minimum(charge_e, noise.full_well_e)
    if rng is not None and noise.read_e > 0:
        read = read + rng.normal(0.0, noise.read_e, size=read.shape)
    if noise.dn_per_e is None:
        return Taps(values=np.asarray(read, dtype=np.float32), unit="e-", valid=~full)
    return Taps(np.asarray(np.round(read * noise.dn_per_e), np.float32), unit="DN", valid=~full)
