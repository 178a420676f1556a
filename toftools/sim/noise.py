"""From light to taps: everything between the scene and the raw numbers, in the order of nature.

Light passes the lens (scatter), is correlated with the reference (harmonics, contrast, phase
offsets) and collected by the pixel (its gain); `readout` makes numbers of the charge. Engines give
light and call `capture_taps`, or `capture_moving` where something moves between taps; nothing here
knows what a scene is.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toftools.sim.defects import pixel_maps, pixel_phase_rad
from toftools.sim.readout import expose as expose
from toftools.sim.readout import per_tap
from toftools.sim.scatter import scattered
from toftools.types import C64, F64, Bool, Sensor, Taps

Light = Callable[[float], NDArray[np.complex128]]
"""Modulated light of a scene: frequency in Hz -> (H, W) complex charge per tap, electrons; at 0 Hz
its mean. Light per unit source strength times ``Noise.signal_e``."""
Ambient = float | F64
"""Unmodulated charge per tap, electrons: a number or (H, W)."""
Frame = tuple[Light, Ambient]
FrameAt = Callable[[float], Frame]
"""Time in s after the first tap -> light and ambient light at that time."""


def light_freqs_hz(sensor: Sensor) -> F64:
    """All frequencies at which `capture_taps` asks for light: 0 and every harmonic in use.

    Parameters
    ----------
    sensor : Sensor
        Frequencies and harmonics.

    Returns
    -------
    ndarray, (N,)
        Rising frequencies, Hz, 0 first; light is asked for at exactly these numbers.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> light_freqs_hz(sensor("opt8241")).tolist()
    [0.0, 40000000.0, 70000000.0]
    """
    used = [m * freq for freq, row in _harmonics(sensor) for m, _ in row]
    return np.unique([0.0, *used])


def tap_times_s(sensor: Sensor) -> F64:
    """Time of each tap after the first: frequencies one after another, nodes A and B at once.

    Parameters
    ----------
    sensor : Sensor
        Its `timing` and numbers of frequencies and taps.

    Returns
    -------
    ndarray, (F, K)
        Times, s.
    """
    mod, timing = sensor.modulation, sensor.timing
    shots = mod.n_taps // timing.taps_per_exposure
    exposure = np.arange(mod.n_freqs * shots).reshape(mod.n_freqs, shots)
    return np.repeat(exposure * timing.tap_interval_s, timing.taps_per_exposure, axis=1)


def contrasts(sensor: Sensor) -> F64:
    """Demodulation contrast per frequency, heterodyne averaging included.

    Parameters
    ----------
    sensor : Sensor
        Camera.

    Returns
    -------
    ndarray, (F,)
        Contrast of the first harmonic.
    """
    timing = sensor.timing
    gate = np.sinc(timing.beat_hz * timing.exposure_s)
    return np.asarray(
        gate * np.broadcast_to(sensor.noise.contrast, sensor.modulation.freqs_hz.shape)
    )


def capture_taps(light: Light, ambient_e: Ambient, sensor: Sensor, *, seed: int | None) -> Taps:
    """Taps of a scene that stands still.

    Parameters
    ----------
    light : callable
        ``light(freq_hz)`` gives the phasor of the modulated light per pixel, (H, W), electrons per
        tap at modulation depth one; at 0 Hz it is the mean charge.
    ambient_e : float or ndarray, (H, W)
        Unmodulated charge per tap, electrons.
    sensor : Sensor
        Camera.
    seed : int or None
        Seed of the noise; None gives the expectation (converter included).

    Returns
    -------
    Taps
        In DN if the sensor has a conversion gain, else in electrons; pixels with a saturated tap
        are invalid.

    Raises
    ------
    ValueError
        If the contrast is more than the waveform can have.
    """
    return expose(clean_taps(light, ambient_e, sensor), sensor, _rng(seed))


def capture_moving(frame_at: FrameAt, sensor: Sensor, *, seed: int | None) -> Taps:
    """Taps of a scene that changes between them.

    Parameters
    ----------
    frame_at : callable
        ``frame_at(time_s)`` gives light and ambient light, as `capture_taps` takes them, at one of
        the times of `tap_times_s`; called once per distinct time.
    sensor : Sensor
        Camera.
    seed : int or None
        As for `capture_taps`.

    Returns
    -------
    Taps
        As of `capture_taps`.

    Raises
    ------
    ValueError
        As `capture_taps`.
    """
    times = tap_times_s(sensor)
    charge = np.zeros((*times.shape, *sensor.camera.shape))
    for time in np.unique(times):
        light, ambient_e = frame_at(float(time))
        _collect(charge, times == time, light, ambient_e, sensor)
    return expose(charge, sensor, _rng(seed))


def true_phasors(light: Light, sensor: Sensor) -> C64:
    """Phasors that ideal taps of some light would have: no harmonics, defects or noise.

    Parameters
    ----------
    light : callable
        As for `capture_taps`, such as the direct light alone.
    sensor : Sensor
        Frequencies, contrast and gain.

    Returns
    -------
    ndarray, (F, H, W), complex64
        Phasors in the unit of the taps, as `Truth` holds them.
    """
    unit = sensor.noise.gain_dn_per_e or 1.0
    freqs = sensor.modulation.freqs_hz
    layers = [
        unit * contrast * light(float(freq))
        for freq, contrast in zip(freqs, contrasts(sensor), strict=True)
    ]
    return np.asarray(layers, dtype=np.complex64)


def clean_taps(light: Light, ambient_e: Ambient, sensor: Sensor) -> F64:
    """Expected charge that light leaves in every tap, dark charge not included.

    Parameters
    ----------
    light, ambient_e, sensor
        As for `capture_taps`.

    Returns
    -------
    ndarray, (F, K, H, W)
        Charge, electrons.

    Raises
    ------
    ValueError
        As `capture_taps`.
    """
    steps = sensor.modulation.steps_rad
    charge = np.zeros((*steps.shape, *sensor.camera.shape))
    _collect(charge, np.ones(steps.shape, bool), light, ambient_e, sensor)
    return charge


def _rng(seed: int | None) -> np.random.Generator | None:
    return None if seed is None else np.random.default_rng(seed)


def _harmonics(sensor: Sensor) -> list[tuple[float, list[tuple[int, complex]]]]:
    """Per frequency in Hz: order and weight, contrast included, of each harmonic in use."""
    mod, timing = sensor.modulation, sensor.timing
    assert mod.harmonics is not None
    orders = np.arange(1, mod.harmonics.shape[1] + 1)
    # Heterodyne: over an exposure harmonic m turns by 2 pi m beat_hz exposure_s against its step
    # ("natural sampling": R. Lange, thesis, Siegen 2000, figure 2.10).
    gate = np.sinc(orders * timing.beat_hz * timing.exposure_s)
    contrast = np.broadcast_to(sensor.noise.contrast, mod.freqs_hz.shape)
    rows = []
    for freq, depth, weights in zip(mod.freqs_hz, contrast, mod.harmonics, strict=True):
        _check_positive(depth * weights)
        gated = depth * weights * gate
        rows.append(
            (float(freq), [(int(m), complex(w)) for m, w in zip(orders, gated, strict=True) if w])
        )
    return rows


def _check_positive(weights: NDArray[np.complex128]) -> None:
    """Correlation of two waves that are nowhere negative is nowhere negative."""
    n = 64 * weights.size
    wave = n * np.fft.irfft(np.r_[1.0, weights / 2], n)  # 1 + sum_m Re(w_m exp(j m phi))
    if wave.min() < -1e-6:
        most = abs(weights[0]) / (1 - float(wave.min()))
        msg = (
            f"a contrast of {abs(weights[0]):.3g} makes taps of this waveform negative, "
            f"wanted at most {most:.3g}"
        )
        raise ValueError(msg)


def _collect(charge: F64, picked: Bool, light: Light, ambient_e: Ambient, sensor: Sensor) -> None:
    """Add to the picked taps (F, K) the charge that light leaves in them, electrons."""
    mod, defects, maps = sensor.modulation, sensor.defects, pixel_maps(sensor)
    offset = scattered(defects.light_gain * light(0.0).real + ambient_e, defects)
    delay = pixel_phase_rad(sensor, maps)
    for i, (freq, row) in enumerate(_harmonics(sensor)):
        taps = np.flatnonzero(picked[i])
        if taps.size == 0:
            continue
        charge[i, taps] += offset.real
        for m, weight in row:
            wave = defects.light_gain * weight * scattered(light(m * freq), defects)
            if delay[i].any():
                wave = wave * np.exp(1j * m * delay[i])
            for k in taps:
                turn = m * mod.steps_rad[i, k]
                charge[i, k] += np.cos(turn) * wave.real + np.sin(turn) * wave.imag
    if defects.prnu or defects.ab_gain or sensor.maps is not None:
        node_b = np.arange(mod.n_taps) % sensor.timing.taps_per_exposure == 1
        gain = np.where(node_b, 1 + defects.ab_gain, 1.0)[:, None, None]
        response = gain * per_tap(maps.gain, mod.n_taps)
        for i, k in np.argwhere(picked):
            charge[i, k] *= response[k]
