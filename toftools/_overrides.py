"""What a user may change about a preset sensor by ``key=val``."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from toftools._params import checked_params
from toftools.camera import pinhole, resized
from toftools.phasor import SCHEMES
from toftools.types import F64, Emitter, Modulation, Sensor, Timing

NOISE_KEYS: Mapping[str, Any] = MappingProxyType(
    {"read_e": 20.0, "full_well_e": float("inf"), "dn_per_e": 1.0, "contrast": (0.8,),
     "signal_e": 20_000.0, "dark_e": 50.0, "adc_bits": 12}
)  # fmt: skip
DEFECT_KEYS: Mapping[str, Any] = MappingProxyType(
    {"prnu": 0.01, "dsnu_e": 5.0, "fppn_rad": (0.05,), "ab_gain": 0.01, "temperature_c": 25.0,
     "reference_c": 25.0, "drift_rad_per_k": (1e-3,), "drift_gain_per_k": -3e-3, "scatter": 0.02,
     "scatter_px": 30.0, "unit": 0}
)  # fmt: skip
TIMING_KEYS: Mapping[str, Any] = MappingProxyType(
    {"tap_interval_s": 1e-3, "exposure_s": 1e-3, "beat_hz": 30.0, "taps_per_exposure": 1}
)
CAMERA_KEYS: Mapping[str, Any] = MappingProxyType({"width": 256, "height": 256, "hfov_deg": 70.0})
WAVE_KEYS: Mapping[str, Any] = MappingProxyType({"waveform": "sine", "duty": 0.5, "rise": 0.1})
LIGHT_KEYS: Mapping[str, Any] = MappingProxyType(
    {"emitter": (0.0, 0.0, 0.0), "beam_deg": 70.0, "beam": "beam.csv"}
)
KEYS: Mapping[str, Any] = MappingProxyType(
    {"freqs": (20e6,), "steps": None, **WAVE_KEYS, **CAMERA_KEYS, **LIGHT_KEYS, **NOISE_KEYS,
     "companding": "kinect2", **DEFECT_KEYS, **TIMING_KEYS}
)  # fmt: skip
"""Every key of a sensor with a typical value, whose type says what is wanted."""

FLAT_SHARE = 0.8
"""Part of the half angle of a spot over which it is flat."""
ROLL_OFF_POINTS = 33


def overridden(sensor: Sensor, params: Mapping[str, Any]) -> Sensor:
    """A sensor with some of its figures changed.

    Parameters
    ----------
    sensor : Sensor
        A preset.
    params : mapping
        Values by the names in `KEYS`.

    Returns
    -------
    Sensor
        Changed copy.

    Raises
    ------
    ValueError
        If a key is unknown or a value is not what it should be.
    """
    unknown = [key for key in params if key not in KEYS]
    if unknown:
        msg = f"unknown sensor key {unknown[0]!r}; known: {', '.join(KEYS)}"
        raise ValueError(msg)
    params = checked_params(f"sensor {sensor.name}", KEYS, params)
    if "freqs" in params:
        sensor = _freqs(sensor, params["freqs"])
    if "steps" in params:
        sensor = _steps(sensor, params["steps"])
    sensor = _timed(sensor, _given(params, TIMING_KEYS), chosen="steps" in params)
    sensor = _waved(sensor, _given(params, WAVE_KEYS))
    sensor = _sized(sensor, _given(params, CAMERA_KEYS))
    sensor = _lit(sensor, _given(params, LIGHT_KEYS))
    _check_meant(sensor, params)
    noise = _given(params, NOISE_KEYS)
    if "companding" in params:
        noise["codes_dn"] = _codes(params["companding"])
    defects = _given(params, DEFECT_KEYS)
    return replace(
        sensor,
        noise=replace(sensor.noise, **noise),
        defects=replace(sensor.defects, **defects),
    )


def _check_meant(sensor: Sensor, params: Mapping[str, Any]) -> None:
    """Refuse what would change nothing because its other half is missing."""
    if params.get("ab_gain") and sensor.timing.taps_per_exposure == 1:
        msg = "ab_gain is of node B of a two-tap pixel; give taps_per_exposure=2 as well"
        raise ValueError(msg)


def _given(params: Mapping[str, Any], keys: Mapping[str, Any]) -> dict[str, Any]:
    return {key: params[key] for key in keys if key in params}


def _freqs(sensor: Sensor, value: Any) -> Sensor:  # noqa: ANN401 - parsed from text
    old = sensor.modulation
    freqs = np.atleast_1d(np.asarray(value, dtype=np.float64))
    same = freqs.size == old.n_freqs
    steps = old.steps_rad if same else old.steps_rad[0] - old.steps_rad[0, 0]
    return replace(sensor, modulation=Modulation(freqs, steps))


def _steps(sensor: Sensor, value: Any) -> Sensor:  # noqa: ANN401 - parsed from text
    if isinstance(value, str):
        if value not in SCHEMES:
            msg = f"unknown tap scheme {value!r}; known: {', '.join(SCHEMES)}"
            raise ValueError(msg)
        steps = SCHEMES[value]
    else:
        checked_params("sensor", {"steps": (0.0,)}, {"steps": value})
        steps = np.atleast_1d(np.asarray(value, dtype=np.float64))
    old = sensor.modulation
    return replace(sensor, modulation=Modulation(old.freqs_hz, steps, old.harmonics))


def _timed(sensor: Sensor, times: dict[str, Any], *, chosen: bool) -> Sensor:
    """Timing of the taps; heterodyne taps cover one beat by default, and step as they fall.

    Two shots of a two-tap pixel cover half a beat: half a turn apart, both would see the same.
    """
    if not times:
        return sensor
    old, nodes = sensor.modulation, times.get("taps_per_exposure", 1)
    shots = max(old.n_taps // max(nodes, 1), 1)
    if beat_hz := times.get("beat_hz"):
        parts = 4 if (shots, nodes) == (2, 2) else shots
        times.setdefault("tap_interval_s", 1 / (parts * abs(beat_hz)))
        times.setdefault("exposure_s", times["tap_interval_s"])
    timing = replace(sensor.timing, **times)
    if not (timing.beat_hz and not chosen):
        return replace(sensor, timing=timing)
    steps = _heterodyne_steps(timing, shots)
    return replace(sensor, timing=timing, modulation=Modulation(old.freqs_hz, steps))


def _heterodyne_steps(timing: Timing, shots: int) -> F64:
    beat = 2 * np.pi * timing.beat_hz * timing.tap_interval_s * np.arange(shots)
    return np.ravel(beat[:, None] + np.pi * np.arange(timing.taps_per_exposure))


def _waved(sensor: Sensor, wave: dict[str, Any]) -> Sensor:
    if not wave:
        return sensor
    from toftools.sim.waveform import with_waveform

    name = wave.pop("waveform", "sine")
    if wave and name not in ("square", "trapezoid"):
        msg = f"{' and '.join(wave)} shape a square or trapezoid waveform, got waveform={name}"
        raise ValueError(msg)
    return with_waveform(sensor, name, **wave)


def _sized(sensor: Sensor, size: Mapping[str, Any]) -> Sensor:
    camera = sensor.camera
    width, height = size.get("width", camera.width), size.get("height", camera.height)
    if "hfov_deg" in size:
        return replace(sensor, camera=pinhole(width, height, hfov_deg=float(size["hfov_deg"])))
    if (width, height) == (camera.width, camera.height):
        return sensor
    return replace(sensor, camera=resized(camera, width, height))


def _lit(sensor: Sensor, light: Mapping[str, Any]) -> Sensor:
    """The emitter elsewhere, or with a beam."""
    if not light:
        return sensor
    if "beam" in light and "beam_deg" in light:
        msg = "got both beam and beam_deg, wanted one: a measured profile or an angle"
        raise ValueError(msg)
    offset_m: Any = tuple(np.ravel(light.get("emitter", sensor.emitter_offset_m)))
    if "beam" in light:
        from toftools.sim.tables import two_columns

        beam = two_columns(light["beam"], "angle in degrees and intensity")
    elif "beam_deg" in light:
        beam = spot(float(light["beam_deg"]))
    else:
        return replace(sensor, emitter_offset_m=offset_m)
    return replace(sensor, emitters=(Emitter(offset_m, beam),))


def spot(beam_deg: float) -> F64:
    """Profile of a flat-topped spot: flat, then falling like a cosine to 0 at its edge.

    Parameters
    ----------
    beam_deg : float
        Full angle of the spot, degrees, at most 360.

    Returns
    -------
    ndarray, (N, 2)
        Angle from the axis, degrees, and intensity: 1 over the inner `FLAT_SHARE` of the half
        angle, half a cosine wave beyond.

    Raises
    ------
    ValueError
        If the angle is out of range.

    Examples
    --------
    >>> spot(70.0)[[0, 1, -1]].round(6).tolist()
    [[0.0, 1.0], [28.0, 1.0], [35.0, 0.0]]
    """
    if not 0 < beam_deg <= 360:
        msg = f"beam_deg must lie between 0 and 360 degrees, got {beam_deg}"
        raise ValueError(msg)
    down = np.linspace(0, 1, ROLL_OFF_POINTS)
    angle = beam_deg / 2 * (FLAT_SHARE + (1 - FLAT_SHARE) * down)
    table = np.stack([angle, (1 + np.cos(np.pi * down)) / 2], axis=1)
    return np.concatenate([[[0.0, 1.0]], table])


def _codes(name: str) -> tuple[float, ...]:
    from toftools.sim.companding import codes_of_file, kinect2_codes

    return kinect2_codes() if name == "kinect2" else codes_of_file(name)
