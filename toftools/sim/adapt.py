"""Other renderers' transients and phasors as captures with taps: light in, sensor model, capture.

Light comes as a `Transient` (ours, or any through `toftools.io.layouts`) or as phasors at the
frequencies that the sensor's correlation asks for; from there the road is that of our own
engines: `capture_taps`, noise and all. `mitransient_histogram` and `mitransient_phasors` put the
conventions of mitransient 1.3.1 (read in its source and measured) into parameters: paths start at
the near plane, phasors turn with -j and count from ``start_opl``, all lamps are modulated. It fails
for light that such a renderer has mixed up already: ambient lamps must be rendered apart and given
as ``ambient_e``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toftools.io.layouts import from_array, from_phasors, near_path_m, with_near_clip
from toftools.phasor import demodulate
from toftools.sim.noise import Ambient, capture_taps, light_freqs_hz
from toftools.transient import Transient, cut_share, first_return_m, phasors
from toftools.types import F32, Camera, Capture, Sensor, Truth
from toftools.units import C_M_S

_SAME = 1e-6
"""Relative difference up to which two frequencies are the same: float32 and a little more."""


def transient_capture(
    transient: Transient,
    sensor: Sensor,
    *,
    ambient_e: Ambient = 0.0,
    seed: int | None = 0,
    truth_range_m: ArrayLike | None = None,
    apart: float = 0.2,
    cut: float = 1e-3,
) -> Capture:
    """The capture that a sensor takes of a transient.

    Parameters
    ----------
    transient : Transient
        Light along path length, of the size of the sensor.
    sensor : Sensor
        Camera.
    ambient_e : float or ndarray, (H, W)
        Unmodulated charge per tap, electrons.
    seed : int or None
        Seed of the noise; None gives the expectation.
    truth_range_m : array_like, (H, W), or None
        True range, m; None takes the first return where it stands apart, if the emitter sits at
        the camera.
    apart : float
        Share of a pixel's light that makes its first return its range; above 1 for no truth.
    cut : float
        Largest share of the light that may lie outside the axis.

    Returns
    -------
    Capture
        Taps, phasors, and truth where there is any.

    Raises
    ------
    ValueError
        If the sizes differ, too much light is cut off, or the bins are too wide for a frequency.
    """
    _check_size("the transient", transient.shape, sensor)
    share = cut_share(transient)
    if share > cut:
        msg = (
            f"the axis of the transient leaves out about {100 * share:.3g} % of the light; give "
            "it more bins, or accept that with cut=1"
        )
        raise ValueError(msg)
    at_camera = not sensor.emitters and not any(sensor.emitter_offset_m)
    if truth_range_m is None and apart <= 1 and at_camera:
        truth_range_m = first_return_m(transient, least_share=apart)
    freqs = light_freqs_hz(sensor)
    unit = sensor.noise.signal_e if transient.unit == "relative" else 1.0
    table = dict(zip(freqs.tolist(), unit * phasors(transient, freqs), strict=True))
    what = {"engine": "transient", "bins": transient.n_bins, "bin_m": transient.bin_m,
            "cut_share": share, **transient.info}  # fmt: skip
    return _capture(table, sensor, ambient_e, seed, truth_range_m, what)


def phasor_capture(
    values: NDArray[np.complexfloating],
    freqs_hz: ArrayLike,
    sensor: Sensor,
    *,
    ambient_e: Ambient = 0.0,
    seed: int | None = 0,
    truth_range_m: ArrayLike | None = None,
) -> Capture:
    """The capture that a sensor takes of light known at some frequencies only.

    Parameters
    ----------
    values : ndarray, (F, H, W), complex
        Phasors of all modulated light, relative: 1 is a white wall at 1 m.
    freqs_hz : array_like, (F,)
        Their frequencies, Hz: 0 and every harmonic of the sensor's correlation must be there.
    sensor, ambient_e, seed, truth_range_m
        As for `transient_capture`; no truth if none is given.

    Returns
    -------
    Capture
        Taps, phasors, and truth if given.

    Raises
    ------
    ValueError
        If the sizes differ, or a frequency is missing.
    """
    known = np.atleast_1d(np.asarray(freqs_hz, dtype=np.float64))
    if values.ndim != 3 or values.shape[0] != known.size:
        msg = f"{known.size} frequencies need phasors of shape (F, H, W), got {values.shape}"
        raise ValueError(msg)
    _check_size("the phasors", values.shape[1:], sensor)
    if not np.isfinite(values).all():
        msg = "phasors must be finite, got nan or infinite ones; render those pixels again"
        raise ValueError(msg)
    table = {}
    for freq in light_freqs_hz(sensor).tolist():
        nearest = int(np.argmin(np.abs(known - freq)))
        if abs(known[nearest] - freq) > _SAME * freq:
            msg = (
                f"the sensor needs light at {freq / 1e6:g} MHz, got "
                f"{', '.join(f'{f / 1e6:g}' for f in known)} MHz; render that frequency too "
                "(0 is the steady image)"
            )
            raise ValueError(msg)
        table[freq] = sensor.noise.signal_e * values[nearest]
    what = {"engine": "phasors", "freqs_hz": known.tolist()}
    return _capture(table, sensor, ambient_e, seed, truth_range_m, what)


def _check_size(what: str, shape: tuple[int, ...], sensor: Sensor) -> None:
    if shape != sensor.camera.shape:
        msg = f"{what} must be of the sensor's size {sensor.camera.shape}, got {shape}"
        raise ValueError(msg)


def _capture(
    table: Mapping[float, NDArray[np.complexfloating]],
    sensor: Sensor,
    ambient_e: Ambient,
    seed: int | None,
    truth_range_m: ArrayLike | None,
    what: Mapping[str, Any],
) -> Capture:
    def light(freq_hz: float) -> NDArray[np.complex128]:
        return np.asarray(table[freq_hz], dtype=np.complex128)

    taps = capture_taps(light, ambient_e, sensor, seed=seed)
    truth = None if truth_range_m is None else Truth(np.asarray(truth_range_m, dtype=np.float32))
    return Capture(
        sensor=sensor,
        taps=taps,
        phasors=demodulate(taps, sensor),
        truth=truth if truth is not None and np.isfinite(truth.range_m).any() else None,
        provenance={**what, "ambient_e": float(np.mean(ambient_e)), "seed": seed},
    )


def mitransient_histogram(
    tensor: F32,
    *,
    bin_width_opl: float,
    start_opl: float,
    near_clip: float,
    camera: Camera,
    intensity: float,
    unit_m: float = 1.0,
    channel: int = 0,
) -> Transient:
    """A transient out of what mitransient's ``transient_hdr_film`` develops.

    Parameters
    ----------
    tensor : ndarray, (H, W, T, C)
        Radiance per bin (not divided by its width), counted from the near plane.
    bin_width_opl, start_opl : float
        Parameters of the film, scene units.
    near_clip : float
        Parameter of the camera, scene units; 0 if the integrator unwarps.
    camera : Camera
        The same camera.
    intensity : float
        Radiant intensity of the point light at the camera, scene units.
    unit_m : float
        Length of a scene unit, m.
    channel : int
        Which channel.

    Returns
    -------
    Transient
        Relative light along the whole path from the camera centre.

    Raises
    ------
    ValueError
        If a parameter or the tensor makes no sense.
    """
    made = from_array(
        tensor,
        axes="hwtc",
        bin_m=bin_width_opl * unit_m,
        start_m=start_opl * unit_m,
        channel=channel,
        scale=_relative(intensity, unit_m),
    )
    return with_near_clip(made, camera, near_clip * unit_m)


def mitransient_phasors(
    tensor: F32,
    steady: F32,
    *,
    freqs_per_unit: ArrayLike,
    start_opl: float,
    near_clip: float,
    camera: Camera,
    intensity: float,
    unit_m: float = 1.0,
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Phasors and frequencies for `phasor_capture` out of mitransient's ``phasor_hdr_film``.

    Parameters
    ----------
    tensor : ndarray, (H, W, F, 2)
        Phasors ``sum L exp(-2 pi j f (path - start_opl))``.
    steady : ndarray, (H, W, C)
        The steady image of the same render, the light at frequency zero.
    freqs_per_unit : array_like, (F,)
        ``film.frequencies``, turns per scene unit.
    start_opl, near_clip, camera, intensity, unit_m
        As for `mitransient_histogram`.

    Returns
    -------
    tuple of ndarray, (F + 1, H, W) and (F + 1,)
        Relative phasors in our convention, frequency zero first, and frequencies, Hz.

    Raises
    ------
    ValueError
        If a parameter or the tensor makes no sense.
    """
    freqs = C_M_S / unit_m * np.atleast_1d(np.asarray(freqs_per_unit, dtype=np.float64))
    start_m = start_opl * unit_m + near_path_m(camera, near_clip * unit_m, tensor.shape[:2])
    scale = _relative(intensity, unit_m)
    turned = from_phasors(tensor, freqs, axes="hwfp", sign=-1, start_m=start_m, scale=scale)
    mean = scale * np.asarray(steady, dtype=np.float64)[None, :, :, 0]
    return np.concatenate([mean.astype(np.complex128), turned]), np.concatenate([[0.0], freqs])


def _relative(intensity: float, unit_m: float) -> float:
    """Relative light per radiance: a white wall at 1 m has radiance intensity / pi there."""
    if not (np.isfinite(intensity) and intensity > 0 and np.isfinite(unit_m) and unit_m > 0):
        msg = f"intensity and unit_m must be positive, got {intensity} and {unit_m}"
        raise ValueError(msg)
    return float(np.pi / (intensity * unit_m**2))
