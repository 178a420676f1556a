"""Phase and range errors of captures whose true range is known, and their summaries."""

from collections.abc import Iterable

import numpy as np

from toftools.conditions import expected_range_m, name_of
from toftools.phasor import phase_sigma_rad, phasors_of
from toftools.types import F64, Capture, Phasors
from toftools.units import TWO_PI, phase_to_range, range_to_phase


def wrap_half(angle_rad: F64) -> F64:
    """Angle in [-pi, pi).

    Parameters
    ----------
    angle_rad : ndarray
        Angle, rad.

    Returns
    -------
    ndarray
        The same direction.
    """
    return np.asarray((angle_rad + np.pi) % TWO_PI - np.pi)


def phase_error_rad(capture: Capture) -> F64:
    """Measured minus expected phase.

    Parameters
    ----------
    capture : Capture
        Capture with conditions that say the distance.

    Returns
    -------
    ndarray, (F, H, W)
        Error within half a turn of 0, rad; NaN where a pixel is invalid, dark or without truth.
    """
    phasors, freqs = phasors_of(capture), capture.sensor.modulation.freqs_hz
    expected = range_to_phase(expected_range_m(capture), freqs[:, None, None])
    error = wrap_half(np.angle(phasors.values).astype(np.float64) - expected)
    return np.asarray(np.where(usable(phasors), error, np.nan))


def usable(phasors: Phasors) -> F64:
    """Pixels that carry a phase: valid and not dark at any frequency.

    Parameters
    ----------
    phasors : Phasors
        Measurement.

    Returns
    -------
    ndarray, (H, W), bool
        True where a phase is measured.
    """
    return np.asarray(phasors.valid & (np.abs(phasors.values) > 0).all(axis=0))


def range_error_m(capture: Capture) -> F64:
    """The phase error as range, per frequency.

    Parameters
    ----------
    capture : Capture
        Capture with conditions.

    Returns
    -------
    ndarray, (F, H, W)
        Measured minus expected range, m.
    """
    freqs = capture.sensor.modulation.freqs_hz[:, None, None]
    return np.asarray(phase_to_range(phase_error_rad(capture), freqs))


def range_noise_m(capture: Capture) -> F64 | None:
    """Standard deviation of the range of every frequency by the noise of its phasors.

    Parameters
    ----------
    capture : Capture
        Any capture.

    Returns
    -------
    ndarray, (F, H, W), or None
        Standard deviation, m; None if the phasors carry no sigma.
    """
    sigma = phase_sigma_rad(phasors_of(capture))
    if sigma is None:
        return None
    freqs = capture.sensor.modulation.freqs_hz[:, None, None]
    return np.asarray(phase_to_range(sigma.astype(np.float64), freqs))


def rms_mm(errors_m: Iterable[F64]) -> float:
    """Root mean square of all finite errors, mm.

    Parameters
    ----------
    errors_m : iterable of ndarray
        Errors, m.

    Returns
    -------
    float
        NaN if there is none.
    """
    total, count = 0.0, 0
    for errors in errors_m:
        finite = errors[np.isfinite(errors)]
        total, count = total + float((finite**2).sum()), count + finite.size
    return 1e3 * float(np.sqrt(total / count)) if count else float("nan")


def same_sensor(captures: Iterable[Capture]) -> None:
    """Refuse captures of different resolutions or frequencies.

    Parameters
    ----------
    captures : iterable of Capture
        Captures that belong together.

    Raises
    ------
    ValueError
        If one differs from the first, by name.
    """
    first: Capture | None = None
    for capture in captures:
        if first is None:
            first = capture
            continue
        shape, wanted = capture.sensor.camera.shape, first.sensor.camera.shape
        if shape != wanted:
            msg = (
                f"{name_of(capture)} has {shape[1]} x {shape[0]} px and {name_of(first)} "
                f"{wanted[1]} x {wanted[0]}; calibrate one resolution at a time"
            )
            raise ValueError(msg)
        freqs, expected = capture.sensor.modulation.freqs_hz, first.sensor.modulation.freqs_hz
        if freqs.shape != expected.shape or not np.allclose(freqs, expected, rtol=1e-9):
            msg = (
                f"{name_of(capture)} was taken at {_mhz(freqs)} MHz and {name_of(first)} at "
                f"{_mhz(expected)}; calibrate one set of frequencies at a time"
            )
            raise ValueError(msg)


def _mhz(freqs_hz: F64) -> str:
    return " + ".join(f"{freq / 1e6:g}" for freq in freqs_hz)
