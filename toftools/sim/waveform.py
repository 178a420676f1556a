"""Correlation functions as harmonics; a non-sinusoidal one makes wiggling appear by itself.

The correlation of two periodic waves has the product of their Fourier coefficients as harmonics;
taps sample it at K points, so harmonics m = +-1 modulo K alias onto the first and bend the phase
(R. Lange, "3D time-of-flight distance measurement with custom solid-state image sensors", thesis,
Siegen 2000, figure 2.13, shows it for a square wave and four taps). How much of the
light is modulated is not told here but by ``Noise.contrast``: square against square makes 0.81.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toftools.sim.tables import two_columns
from toftools.types import F64, Modulation, Sensor

C128 = NDArray[np.complex128]

WAVEFORMS = ("sine", "square", "trapezoid")
"""Waveforms by name; any other name is the file of a measured correlation."""
N_HARMONICS = 31
"""Harmonics kept by default: peaks of the wiggling of square waves come out within 0.01 degrees,
its course within 0.07 degrees (four taps, worst phase)."""
WORST_CONDITION = 100.0
"""Harmonics of a measured correlation may magnify its errors by at most this."""
LEAST_HARMONIC = 1e-4
"""Measured harmonics below this part of the first are noise: they move no phase by 0.01 degrees."""


def pulse_coefficients(n: int, *, duty: float = 0.5, rise: float = 0.0) -> F64:
    """Fourier coefficients of a train of trapezoid pulses, relative to its mean.

    Parameters
    ----------
    n : int
        Coefficients m = 1..n to give.
    duty : float
        Width of the pulse at half height, share of the period, 0..1.
    rise : float
        Duration of each edge, share of the period, up to the smaller of duty and 1 - duty; 0 is a
        square wave.

    Returns
    -------
    ndarray, (n,)
        ``sinc(m duty) sinc(m rise)`` with ``sinc(x) = sin(pi x) / (pi x)``: the pulse is a box as
        wide as `duty`, smoothed by a box as wide as `rise`, and centred on time 0.

    Raises
    ------
    ValueError
        If duty or rise is out of range.

    Examples
    --------
    >>> pulse_coefficients(4).round(3).tolist()
    [0.637, 0.0, -0.212, -0.0]
    """
    if not (0 < duty < 1 and 0 <= rise <= min(duty, 1 - duty)):
        msg = f"wanted 0 < duty < 1 and 0 <= rise <= min(duty, 1 - duty), got {duty} and {rise}"
        raise ValueError(msg)
    m = np.arange(1, n + 1)
    return np.asarray(np.sinc(m * duty) * np.sinc(m * rise))


def correlation_harmonics(light: ArrayLike, reference: ArrayLike) -> C128:
    """Harmonics of the correlation of two waves, relative to the first.

    Parameters
    ----------
    light, reference : array_like, (n,), real or complex
        Fourier coefficients m = 1..n of both waves, of ``exp(+j m omega t)``.

    Returns
    -------
    ndarray, (n,), complex
        Harmonics as `Modulation` wants them; the phase of the first is taken as the origin.

    Raises
    ------
    ValueError
        If the first harmonic vanishes.

    Examples
    --------
    >>> square = pulse_coefficients(5)
    >>> np.round(1 / correlation_harmonics(square, square)[::2].real).tolist()
    [1.0, 9.0, 25.0]
    """
    # Mean of light(t - phi / omega) reference(t - step / omega) over a period:
    # 2 Re sum_m conj(L_m) R_m exp(j m (phi - step))
    return _relative(np.conj(np.asarray(light)) * np.asarray(reference))


def _relative(harmonics: C128 | F64) -> C128:
    """Harmonics divided by the first, whose phase becomes the origin of phase."""
    if not abs(harmonics[0]) > 1e-12 * np.abs(harmonics).max():
        msg = f"the correlation has no first harmonic: got {np.abs(harmonics)[:4].tolist()}, ..."
        raise ValueError(msg)
    turn = np.exp(-1j * np.arange(1, harmonics.size + 1) * np.angle(harmonics[0]))
    relative = np.asarray(harmonics * turn / abs(harmonics[0]), dtype=np.complex128)
    relative[np.abs(relative) < 1e-15] = 0
    return relative


def measured_harmonics(table: F64, *, n_harmonics: int = N_HARMONICS) -> C128:
    """Harmonics of a measured correlation function, by least squares.

    Parameters
    ----------
    table : ndarray, (N, 2)
        Phase of the light against the reference, rad, and value of the tap, in any unit; phases in
        any order, over at least one turn. A scan of the reference instead of the light runs
        backwards: negate its phases.
    n_harmonics : int
        Harmonics to fit at most; fewer where the phases do not determine as many.

    Returns
    -------
    ndarray, (M,), complex
        Harmonics relative to the first, whose phase becomes the origin; those below
        `LEAST_HARMONIC` are 0.

    Raises
    ------
    ValueError
        If the phases do not determine the harmonics, or there is no first one.
    """
    angle, value = table.T
    most = min(n_harmonics, (angle.size - 1) // 2)
    turn = np.exp(1j * np.outer(angle, np.arange(1, most + 1)))
    waves = np.stack([turn.real, -turn.imag], axis=-1).reshape(angle.size, 2 * most)
    basis = np.concatenate([np.ones((angle.size, 1)), waves], axis=1)  # 1, cos, -sin, cos 2, ...
    gram = basis.T @ basis
    sizes = [2 * n + 1 for n in range(1, most + 1)]
    sound = [size for size in sizes if np.linalg.cond(gram[:size, :size]) < WORST_CONDITION**2]
    if not sound:
        msg = (
            f"{angle.size} phases from {angle.min():.3g} to {angle.max():.3g} rad do not determine "
            "a harmonic; spread them evenly over a whole turn"
        )
        raise ValueError(msg)
    fit = np.linalg.lstsq(basis[:, : max(sound)], value, rcond=None)[0][1:]
    harmonics = _relative(fit[::2] + 1j * fit[1::2])
    harmonics[np.abs(harmonics) < LEAST_HARMONIC] = 0
    return np.trim_zeros(harmonics, "b")


def with_waveform(
    sensor: Sensor,
    name: str,
    *,
    n_harmonics: int = N_HARMONICS,
    duty: float = 0.5,
    rise: float | None = None,
) -> Sensor:
    """The same sensor with another correlation function.

    Parameters
    ----------
    sensor : Sensor
        Any sensor.
    name : str
        ``sine``; ``square`` or ``trapezoid``, which is the light, against a square reference of
        half the period; or the file of a measured correlation, two columns of phase and value.
    n_harmonics : int
        Harmonics to keep.
    duty : float
        Width of the light pulse at half height, share of the period.
    rise : float or None
        Duration of each edge of the light pulse, share of the period; None is 0.1 for the
        trapezoid and 0 for the square wave.

    Returns
    -------
    Sensor
        Copy with ``modulation.harmonics`` set.

    Raises
    ------
    ValueError
        If the waveform is unknown or its file is no correlation.

    References
    ----------
    Peak wiggling of square waves: 4.07, 1.12 and 0.46 degrees for 4, 3 and 8 taps, computed from
    the aliasing.
    """
    if name == "sine":
        row = np.ones(1, dtype=np.complex128)
    elif name in WAVEFORMS:
        edge = 0.1 * (name == "trapezoid") if rise is None else rise
        light = pulse_coefficients(n_harmonics, duty=duty, rise=edge)
        row = correlation_harmonics(light, pulse_coefficients(n_harmonics))
    elif Path(name).suffix or "/" in name:
        table = two_columns(name, "phase in rad and correlation")
        row = measured_harmonics(table, n_harmonics=n_harmonics)
    else:
        msg = f"unknown waveform {name!r}; known: {', '.join(WAVEFORMS)}; or give a file"
        raise ValueError(msg)
    old = sensor.modulation
    harmonics = np.broadcast_to(row, (old.n_freqs, row.size))
    return replace(sensor, modulation=Modulation(old.freqs_hz, old.steps_rad, harmonics))
