"""Noise of taps carried over to their phasors.

Shot noise is read off the taps themselves, so it holds for any pixel gain, ambient light or dark
charge; patterns that stay the same from shot to shot are no noise and are not in it. It fails for
taps from which a constant was subtracted (differences of two nodes), whose charge is unknown.
"""

import numpy as np
from numpy.typing import NDArray

from toftools.types import C64, F32, Noise, Taps


def phasor_sigma(
    taps: Taps, values: C64, weights: NDArray[np.complex128], noise: Noise
) -> F32 | None:
    """Standard deviation of each phasor across its direction, from the tap noise model.

    The variance of tap k is ``v_k = I_k + read_e^2 + q_k`` electrons squared: shot noise of all
    charge in the tap (light, ambient, dark), read noise, and quantisation of taps in DN. Across a
    phasor of phase phi that makes ``sum_k Im(w_k exp(-j phi))^2 v_k``, which is what moves the
    phase, and thereby the range. For four or more equispaced taps and a sine it is the same in
    every direction, ``2 (B + read_e^2 + q) / K``, and so the standard deviation of the real and of
    the imaginary part; of three it is ``2 (B - A / 2 cos 3 phi + read_e^2 + q) / 3``.

    Parameters
    ----------
    taps : Taps
        Samples.
    values : ndarray, (F, H, W)
        Their phasors.
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
    if taps.unit == "DN" and noise.gain_dn_per_e is None:
        return None
    gain = 1.0 if taps.unit == "e-" else float(noise.gain_dn_per_e or 1.0)  # unit per electron
    power = (np.abs(weights) ** 2 / 2).astype(np.float32)  # (F, K)
    tap_e2 = taps.values * np.float32(1 / gain) + np.float32(noise.read_e**2)
    if taps.unit == "DN":
        tap_e2 += np.float32(1 / gain**2) * rounding_dn2(taps.values, noise)
    tap_e2 = np.maximum(tap_e2, 0)  # of the sum: read noise about zero must average out
    variance_e = np.einsum("fk,fkhw->fhw", power, tap_e2)
    if not _same_in_every_direction(weights):
        # Im(w u)^2 = (|w|^2 - Re(w^2 u^2)) / 2, with u = exp(-j phi)
        square = (weights**2 / 2).astype(np.complex64)
        tilt = np.einsum("fk,fkhw->fhw", square, tap_e2)
        length2 = np.maximum(np.abs(values) ** 2, np.finfo(np.float32).tiny)
        with np.errstate(invalid="ignore"):  # infinite taps: the pixel is invalid anyway
            variance_e -= (tilt * np.conj(values) ** 2).real / length2
        variance_e = np.maximum(variance_e, 0)  # rounding
    return np.asarray(gain * np.sqrt(variance_e), dtype=np.float32)


def rounding_dn2(values: F32, noise: Noise) -> F32 | np.float32:
    """Variance of rounding to numbers of the converter: uniform noise over the cell of each.

    A cell as wide as w has w^2 / 12 (EMVA Standard 1288, Release 4.0 Linear, for w = 1 DN), good
    where other noise is wider than half a cell.

    Parameters
    ----------
    values : ndarray
        Taps, DN.
    noise : Noise
        Its `codes_dn`.

    Returns
    -------
    ndarray or float, float32
        Variance, DN squared; one number for a linear converter.
    """
    if not noise.codes_dn:
        return np.float32(1 / 12)
    codes = np.asarray(noise.codes_dn)
    middles = (codes[1:] + codes[:-1]) / 2
    cells = np.diff(np.r_[-middles[0], middles, codes[-1]])  # that of 0 reaches below it
    at = np.searchsorted(middles, np.abs(values))
    return np.asarray(cells[at] ** 2 / 12, dtype=np.float32)


def _same_in_every_direction(weights: NDArray[np.complex128]) -> bool:
    """Whether taps of any ``B + A cos(phi - step)`` scatter their phasor alike in all directions.

    They do if ``sum_k w_k^2 I_k = 0`` for constant, cosine and sine, which span the same as a
    constant and both parts of the weights.
    """
    basis = np.stack([np.ones_like(weights), weights.real, weights.imag])  # (3, F, K)
    return bool(np.abs(np.einsum("fk,nfk->nf", weights**2, basis)).max() < 1e-9)
