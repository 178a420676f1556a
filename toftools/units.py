"""Phase, range and path length: the only file that knows c or 4 pi.

Conventions (docs/conventions.md): range is radial and one-way, path length is the whole way
light travels, phase grows with range and lies in [0, 2 pi).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

C_M_S = 299_792_458.0
"""Speed of light in vacuum, m/s (exact by definition of the metre)."""

TWO_PI = 2.0 * np.pi

MOST_TURNS = 10_000
"""Turns of the highest frequency within which phases must meet to have a joint ambiguity."""
SMALL_TURNS = 256
"""Exact repetitions up to here come first. Beyond, neighbouring ranges differ by less than 1.4
degrees, and a near repetition before (40.01 and 69.97 MHz: 4 to 7) is what the camera means."""
EXACT = 1e-9
"""Relative error of frequencies whose ratio still counts as exact."""
CLOSER = 0.1
"""A near repetition is this much closer than anything before: 0.08 for the Kinect v2."""


def range_to_phase(range_m: ArrayLike, freq_hz: ArrayLike) -> NDArray[np.float64]:
    """Unwrapped phase of a return at a radial range, ``4 pi f range / c``.

    Parameters
    ----------
    range_m : array_like
        Radial range, m.
    freq_hz : array_like
        Modulation frequency, Hz; broadcasts against `range_m`.

    Returns
    -------
    ndarray
        Phase in rad, not wrapped.

    Examples
    --------
    >>> round(float(range_to_phase(ambiguity_m(20e6), 20e6) / (2 * np.pi)), 12)
    1.0
    """
    return np.asarray(4.0 * np.pi * np.asarray(freq_hz) * np.asarray(range_m) / C_M_S)


def phase_to_range(phase_rad: ArrayLike, freq_hz: ArrayLike) -> NDArray[np.float64]:
    """Radial range of a phase, ``c phase / (4 pi f)``: the inverse of `range_to_phase`.

    Parameters
    ----------
    phase_rad : array_like
        Phase, rad; unwrapped phases give unwrapped ranges.
    freq_hz : array_like
        Modulation frequency, Hz.

    Returns
    -------
    ndarray
        Radial range, m.

    Examples
    --------
    >>> round(float(phase_to_range(np.pi, 60e6)), 6)
    1.249135
    """
    return np.asarray(C_M_S * np.asarray(phase_rad) / (4.0 * np.pi * np.asarray(freq_hz)))


def path_to_phase(path_m: ArrayLike, freq_hz: ArrayLike) -> NDArray[np.float64]:
    """Phase after a whole optical path, ``2 pi f path / c`` (a direct return has path 2 range).

    Parameters
    ----------
    path_m : array_like
        Optical path length from emitter to camera, m.
    freq_hz : array_like
        Modulation frequency, Hz.

    Returns
    -------
    ndarray
        Phase in rad, not wrapped.

    Examples
    --------
    >>> bool(path_to_phase(4.0, 20e6) == range_to_phase(2.0, 20e6))
    True
    """
    return range_to_phase(np.asarray(path_m) / 2.0, freq_hz)


def time_to_path(time_s: ArrayLike) -> NDArray[np.float64]:
    """Optical path that light covers in a time, ``c time``.

    Parameters
    ----------
    time_s : array_like
        Time of flight from emitter to camera, s.

    Returns
    -------
    ndarray
        Optical path length, m.

    Examples
    --------
    >>> round(float(time_to_path(1e-9)), 6)
    0.299792
    """
    return np.asarray(C_M_S * np.asarray(time_s, dtype=np.float64))


def ambiguity_m(freq_hz: ArrayLike) -> NDArray[np.float64]:
    """Range at which the phase of one frequency has made a full turn, ``c / (2 f)``.

    Parameters
    ----------
    freq_hz : array_like
        Modulation frequency, Hz.

    Returns
    -------
    ndarray
        Unambiguous range, m.

    Examples
    --------
    >>> round(float(ambiguity_m(60e6)), 3)
    2.498
    """
    return np.asarray(C_M_S / (2.0 * np.asarray(freq_hz, dtype=np.float64)))


def joint_ambiguity_m(freqs_hz: ArrayLike, *, tol_cycles: float = 0.02) -> float:
    """Range at which the phases of all frequencies come back together.

    For commensurate frequencies, whose ratios are whole numbers up to `SMALL_TURNS`, this is
    ``c / (2 gcd)``. Real cameras run slightly off their nominal frequencies; for the rest, phases
    that come back to within `tol_cycles`, and ten times closer than at any shorter range, count
    as a repetition: noise that could tell the two apart would not mix up any shorter ranges.
    Different frequencies make different numbers of turns until then, or their beat is not over.

    Parameters
    ----------
    freqs_hz : array_like, (F,)
        Modulation frequencies, Hz.
    tol_cycles : float
        Phase difference still taken as a repetition, in turns; 0 asks for an exact one (to 1e-9
        of the frequencies), with whole numbers of any size up to 10 000.

    Returns
    -------
    float
        Joint unambiguous range, m.

    Raises
    ------
    ValueError
        If the phases do not come together within 10 000 turns of the highest frequency.

    Examples
    --------
    >>> round(joint_ambiguity_m([40e6, 70e6]), 3)
    14.99
    >>> round(joint_ambiguity_m([100e6, 101e6]), 1)
    149.9
    >>> round(joint_ambiguity_m([80.1675385e6, 16.05444453e6, 120.44403642e6]), 2)
    18.67
    """
    freqs = np.unique(np.asarray(freqs_hz, dtype=np.float64))
    turns = np.arange(1, MOST_TURNS + 1)
    cycles = turns[:, None] * freqs / freqs[-1]  # (N, F) turns of each frequency
    whole = np.round(cycles)
    # Sorted: distinct neighbours are distinct throughout, and the lowest has the fewest turns.
    complete = (np.diff(whole, axis=1, prepend=0) >= 1).all(axis=1)
    off = np.abs(cycles - whole).max(axis=1)
    exact = complete & (off <= EXACT * turns)
    closest_before = np.minimum.accumulate(np.r_[0.5, off[:-1]])
    nearly = complete & (off < tol_cycles) & (off < CLOSER * closest_before)
    small = exact & (turns <= SMALL_TURNS)
    together = small if small.any() else exact | nearly
    if not together.any():
        msg = (
            f"got frequencies {freqs.tolist()} Hz whose phases never meet within {tol_cycles} "
            "turns; wanted commensurate frequencies; pass a maximum range instead"
        )
        raise ValueError(msg)
    return float(ambiguity_m(freqs[-1]) * turns[int(np.argmax(together))])


def wrap_phase(phase_rad: ArrayLike) -> NDArray[np.float64]:
    """Phase brought into [0, 2 pi).

    Parameters
    ----------
    phase_rad : array_like
        Any phase, rad.

    Returns
    -------
    ndarray
        The same angle in [0, 2 pi).

    Examples
    --------
    >>> round(float(wrap_phase(-0.5)), 4)
    5.7832
    """
    wrapped = np.mod(np.asarray(phase_rad, dtype=np.float64), TWO_PI)
    # np.mod of a tiny negative number rounds up to 2 pi itself, which is not in the interval.
    return np.asarray(np.where(wrapped >= TWO_PI, 0.0, wrapped))


def check_freqs(freqs_hz: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Frequencies as a float64 vector, refused if they are not plausible modulation in Hz.

    Parameters
    ----------
    freqs_hz : sequence of float, (F,)
        Modulation frequencies, Hz.

    Returns
    -------
    ndarray, (F,)
        The same frequencies, float64.

    Raises
    ------
    ValueError
        If empty, not finite, or outside 1 kHz .. 100 GHz (a value in MHz, typically).
    """
    freqs = np.atleast_1d(np.asarray(freqs_hz, dtype=np.float64))
    if freqs.ndim != 1 or freqs.size == 0:
        msg = f"freqs_hz must be a vector with at least one frequency, got shape {freqs.shape}"
        raise ValueError(msg)
    if not (np.isfinite(freqs).all() and (freqs >= 1e3).all() and (freqs <= 1e11).all()):
        msg = f"freqs_hz must lie in 1e3..1e11 Hz, got {freqs.tolist()}; give Hz, not MHz"
        raise ValueError(msg)
    return freqs
