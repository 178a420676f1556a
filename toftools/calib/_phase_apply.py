"""What phase stages share: rotation of phasors, and their line of residuals."""

from collections.abc import Sequence

import numpy as np

from toftools.calib.residuals import rms_mm
from toftools.calib.stage import Residual
from toftools.types import F64, Phasors
from toftools.units import phase_to_range


def rotated(phasors: Phasors, error_rad: F64) -> Phasors:
    """Phasors with a phase taken off; sigma stays.

    Parameters
    ----------
    phasors : Phasors
        (F, H, W).
    error_rad : ndarray, broadcasts to (F, H, W)
        Phase to take off, rad; pixels where it is NaN become invalid.

    Returns
    -------
    Phasors
        ``z exp(-j error)``.
    """
    known = np.isfinite(error_rad)
    values = phasors.values * np.exp(-1j * np.where(known, error_rad, 0.0)).astype(np.complex64)
    valid = phasors.valid & np.broadcast_to(known, values.shape).all(axis=0)
    return Phasors(values, sigma=phasors.sigma, valid=valid)


def check_freqs(slot: str, n_freqs: int, phasors: Phasors) -> None:
    """Refuse phasors of another number of frequencies."""
    got = phasors.values.shape[0]
    if got != n_freqs:
        msg = f"{slot} was calibrated for {n_freqs} frequencies, got phasors of {got}"
        raise ValueError(msg)


def to_mm(error_rad: F64, freqs_hz: F64) -> F64:
    """Phase errors (K, F, ...) as range, mm."""
    freqs = freqs_hz.reshape(-1, *(1,) * (error_rad.ndim - 2))
    return np.asarray(1e3 * phase_to_range(error_rad, freqs))


def rad_per_mm(freqs_hz: F64) -> F64:
    """Phase of one millimetre of range, rad, (F,)."""
    return np.asarray(1 / to_mm(np.ones((1, freqs_hz.size)), freqs_hz)[0])


def residual_in_mm(
    freqs_hz: F64,
    before: F64,
    after: F64,
    held_out: F64 | None,
    sigma: F64 | None,
    notes: Sequence[str],
) -> Residual:
    """The line of residuals of a phase stage.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    before, after : ndarray, (K, F, ...)
        Errors without and with the stage, rad.
    held_out, sigma : ndarray, (K, F, ...), or None
        Held-out errors, and noise, rad; None where there are none, or the noise is not known.
    notes : sequence of str
        Sentences.

    Returns
    -------
    Residual
        In mm, all frequencies together.
    """
    low, same, out, noise = (
        float("nan") if x is None else rms_mm([1e-3 * to_mm(x, freqs_hz)])
        for x in (before, after, held_out, sigma)
    )
    n = int(np.isfinite(after).sum())
    return Residual("mm", low, same, out, noise, n, tuple(notes))


def mhz(freqs_hz: F64) -> str:
    """Frequencies in words."""
    return " and ".join(f"{freq / 1e6:g}" for freq in freqs_hz) + " MHz"
