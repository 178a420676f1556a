"""From charge to numbers: dark charge, shot noise, full well, read noise, converter.

This is the linear camera model of EMVA Standard 1288, Release 4.0 Linear, with a saturation that
ends every tap by itself. Means of any size are drawn from the exact Poisson distribution: 40 ns a
tap, 0.08 s for nine taps of 512 x 424 pixels.
"""

import numpy as np

from toftools.sim.companding import companded
from toftools.sim.defects import pixel_maps
from toftools.types import F64, Sensor, Taps


def expose(charge_e: F64, sensor: Sensor, rng: np.random.Generator | None) -> Taps:
    """Taps read out from the charge that light leaves.

    Parameters
    ----------
    charge_e : ndarray, (F, K, H, W)
        Expected charge, electrons.
    sensor : Sensor
        Dark charge, read noise, full well and converter.
    rng : numpy.random.Generator or None
        Source of shot and read noise; None returns the expectation.

    Returns
    -------
    Taps
        In DN if the sensor has a conversion gain, else in electrons; pixels with a tap at full
        well or at the last code are invalid.
    """
    noise = sensor.noise
    if noise.dark_e or sensor.defects.dsnu_e or sensor.maps is not None:
        charge_e = charge_e + per_tap(pixel_maps(sensor).dark_e, charge_e.shape[1])
    if rng is not None:
        charge_e = rng.poisson(np.maximum(charge_e, 0)).astype(np.float64)
    full = np.asarray((charge_e >= noise.full_well_e).any(axis=(0, 1)))
    read = np.minimum(charge_e, noise.full_well_e)
    if rng is not None and noise.read_e > 0:
        read = read + rng.normal(0.0, noise.read_e, size=read.shape)
    gain = noise.gain_dn_per_e
    if gain is None:
        return Taps(values=np.asarray(read, dtype=np.float32), unit="e-", valid=~full)
    numbers = np.round(read * gain) if not noise.codes_dn else companded(read * gain, noise)
    full |= (numbers >= noise.top_dn).any(axis=(0, 1))
    return Taps(np.asarray(np.minimum(numbers, noise.top_dn), np.float32), unit="DN", valid=~full)


def per_tap(nodes: F64, n_taps: int) -> F64:
    """Map of every tap from those of the nodes of a pixel.

    Parameters
    ----------
    nodes : ndarray, (N, H, W)
        A map per node.
    n_taps : int
        Number of taps K.

    Returns
    -------
    ndarray, (K, H, W)
        Tap k is of node k modulo N.
    """
    return np.asarray(nodes[np.arange(n_taps) % nodes.shape[0]])
