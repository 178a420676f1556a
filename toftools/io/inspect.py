"""What is in a recording: size, units, frequencies, convention, noise and wraps, as plain data.

Noise that nobody reports is estimated from second differences between neighbours in a row,
``d_x = v_(x-1) - 2 v_x + v_(x+1)``, which cancel constant and sloped surfaces and have six times
the variance of one pixel; the median absolute value shrugs off edges. It is too small where the
camera has already smoothed its image, and too large on fine texture.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.io.convention import Proposal, propose, steps_text
from toftools.phasor import phase_sigma_rad, phasors_of
from toftools.registry import READERS, parameters_of
from toftools.types import F32, Capture
from toftools.units import ambiguity_m, joint_ambiguity_m, phase_to_range

PERCENTILES = (1, 50, 99)
_NORMAL = 1.4826  # standard deviation of a normal variable per median absolute value


def summary(capture: Capture, reference_m: F32 | None = None) -> dict[str, Any]:
    """Everything worth knowing about a capture, as JSON values.

    Parameters
    ----------
    capture : Capture
        Recording.
    reference_m : ndarray, (H, W), or None
        Range from elsewhere to judge the convention by, m; by default the capture's own truth
        or the camera's own distance.

    Returns
    -------
    dict
        Nested plain values; None where something is not known.
    """
    camera, modulation = capture.sensor.camera, capture.sensor.modulation
    known_range, what = _own_reference(capture)
    found: dict[str, Any] = {
        "sensor": capture.sensor.name,
        "width": camera.width,
        "height": camera.height,
        "focal_px": [float(camera.K[0, 0]), float(camera.K[1, 1])],
        "distorted": bool(camera.dist.any()),
        **({} if camera.model == "pinhole" else {"camera_model": camera.model}),
        "holds": holds(capture),
        "freqs_hz": modulation.freqs_hz.tolist(),
        "ambiguity_m": ambiguity_m(modulation.freqs_hz).tolist(),
        "joint_ambiguity_m": _joint(modulation.freqs_hz),
        "steps_deg": [steps_text(steps) for steps in modulation.steps_rad],
        "tap_unit": None if capture.taps is None else capture.taps.unit,
        "valid_share": _valid_share(capture),
        "amplitude_percentiles": _amplitude_percentiles(capture),
        "range_m_percentiles": _percentiles(known_range),
        "noise": _noise(capture),
        "wraps": _wraps(known_range, modulation.freqs_hz),
        "provenance": dict(capture.provenance),
        "proposal": None,
    }
    if reference_m is not None:
        best: Proposal | None = propose(capture, reference_m)
        what = "the reference file"
    else:
        best = _self_proposal(capture, known_range)
    if best is not None:
        found["proposal"] = {**_proposal(best, what), "apply": _apply(best, capture)}
    return found


def _self_proposal(capture: Capture, known_range: F32 | None) -> Proposal | None:
    """The proposal against the capture's own distances, if they are enough to make one."""
    if known_range is None or (capture.taps is None and capture.phasors is None):
        return None
    try:
        return propose(capture, known_range)
    except ValueError:  # too few common pixels: nobody asked, so nothing is wrong
        return None


def reference_range(capture: Capture, name: str = "the reference") -> F32:
    """Range of a capture that serves as reference for another.

    Parameters
    ----------
    capture : Capture
        Capture with truth or a depth map.
    name : str
        What to call it in the message.

    Returns
    -------
    ndarray, (H, W)
        Radial range, m.

    Raises
    ------
    ValueError
        If it has neither.
    """
    range_m, _ = _own_reference(capture)
    if range_m is None:
        msg = f"{name} holds no distances; wanted truth or a depth map"
        raise ValueError(msg)
    return range_m


def _own_reference(capture: Capture) -> tuple[F32 | None, str]:
    if capture.truth is not None and np.isfinite(capture.truth.range_m).any():
        return capture.truth.range_m, "the truth in the file"
    if capture.depth is not None and np.isfinite(capture.depth.range_m).any():
        return capture.depth.range_m, "the distance in the file"
    return None, ""


def holds(capture: Capture) -> list[str]:
    """Names of the parts of a capture.

    Parameters
    ----------
    capture : Capture
        Recording.

    Returns
    -------
    list of str
        Such as ``["taps", "phasors", "truth", "reported:tofnet"]``.
    """
    parts = [name for name in ("taps", "phasors", "depth", "truth") if getattr(capture, name)]
    return parts + [f"reported:{name}" for name in capture.reported]


def _joint(freqs_hz: NDArray[np.float64]) -> float | None:
    try:
        return joint_ambiguity_m(freqs_hz)
    except ValueError:
        return None


def _valid_share(capture: Capture) -> dict[str, float]:
    shares = {}
    for name in ("taps", "phasors"):
        if getattr(capture, name) is not None:
            shares[name] = float(getattr(capture, name).valid.mean())
    if capture.depth is not None:
        shares["depth"] = float(np.isfinite(capture.depth.range_m).mean())
    if capture.truth is not None:
        shares["truth"] = float(np.isfinite(capture.truth.range_m).mean())
    return shares


def _percentiles(values: NDArray[Any] | None) -> list[float] | None:
    finite = np.empty(0) if values is None else values[np.isfinite(values)]
    return np.percentile(finite, PERCENTILES).astype(float).tolist() if finite.size else None


def _amplitude_percentiles(capture: Capture) -> dict[str, list[float] | None]:
    found: dict[str, list[float] | None] = {}
    if capture.taps is not None or capture.phasors is not None:
        phasors = phasors_of(capture)
        for freq_hz, plane in zip(capture.sensor.modulation.freqs_hz, phasors.values, strict=True):
            found[f"{freq_hz / 1e6:g} MHz"] = _percentiles(np.abs(plane[phasors.valid]))
    if capture.depth is not None and capture.depth.amplitude is not None:
        found["depth"] = _percentiles(capture.depth.amplitude)
    return found


def _noise(capture: Capture) -> dict[str, Any]:
    """Standard deviation of the range in metres: as reported, and as neighbours suggest."""
    freqs_hz = capture.sensor.modulation.freqs_hz
    if capture.taps is not None or capture.phasors is not None:
        phasors = phasors_of(capture)
        sigma = phase_sigma_rad(phasors)
        reported = None
        if sigma is not None and phasors.valid.any():
            reported = phase_to_range(np.median(sigma[:, phasors.valid], axis=1), freqs_hz).tolist()
        estimated = [
            _phase_noise_m(np.where(phasors.valid, plane, np.nan), float(freq_hz))
            for plane, freq_hz in zip(phasors.values, freqs_hz, strict=True)
        ]
        return {"of": "each frequency", "reported_m": reported, "estimated_m": estimated}
    depth = capture.depth
    assert depth is not None
    reported = None if depth.sigma_m is None else _percentiles(depth.sigma_m)
    return {
        "of": "the distance",
        "reported_m": None if reported is None else [reported[1]],
        "estimated_m": [neighbour_noise(depth.range_m)],
    }


def _phase_noise_m(plane: NDArray[Any], freq_hz: float) -> float | None:
    """Range noise of one frequency; steps between neighbours are taken modulo a turn."""
    step = np.angle(plane[:, 1:] * plane[:, :-1].conj())
    second = np.angle(np.exp(1j * np.diff(step, axis=1)))
    sigma = _from_second_differences(second)
    return None if sigma is None else float(phase_to_range(sigma, freq_hz))


def neighbour_noise(values: NDArray[Any]) -> float | None:
    """Noise of an image, from second differences along its rows.

    Parameters
    ----------
    values : ndarray, (H, W)
        Image; NaN is left out.

    Returns
    -------
    float or None
        Standard deviation of one pixel; None with fewer than 16 complete triples.
    """
    return _from_second_differences(np.diff(values.astype(np.float64), n=2, axis=1))


def _from_second_differences(second: NDArray[Any]) -> float | None:
    finite = np.abs(second[np.isfinite(second)])
    return float(_NORMAL * np.median(finite) / np.sqrt(6.0)) if finite.size >= 16 else None


def _wraps(range_m: F32 | None, freqs_hz: NDArray[np.float64]) -> dict[str, Any] | None:
    """Share of pixels beyond one turn, and the most turns, per frequency."""
    if range_m is None:
        return None
    turns = range_m[np.isfinite(range_m)] / ambiguity_m(freqs_hz)[:, None]  # (F, N)
    return {
        "share": (turns >= 1).mean(axis=1).tolist(),
        "most": np.floor(turns.max(axis=1)).astype(int).tolist(),
    }


def _proposal(best: Proposal, reference: str) -> dict[str, Any]:
    return {
        "reference": reference,
        "sign": best.sign,
        "steps_deg": None if best.steps_rad is None else [steps_text(s) for s in best.steps_rad],
        "coherence": best.coherence.tolist(),
        "offset_m": best.offset_m.tolist(),
        "offset_se_m": [_finite(error) for error in best.offset_se_m],
        "runner_up": best.runner_up,
        "margin": best.margin,
        "margin_se": _finite(best.margin_se),
        "decided": best.decided,
        "reason": best.reason,
    }


def _finite(value: float) -> float | None:
    """The number, or None for what JSON cannot hold."""
    return float(value) if np.isfinite(value) else None


def _apply(best: Proposal, capture: Capture) -> str | None:
    """What to give to --format so that the reader takes a decided proposal on."""
    name = str(capture.provenance.get("format"))
    convention = capture.provenance.get("convention")
    as_given = best.steps_rad is None or np.array_equal(
        best.steps_rad, capture.sensor.modulation.steps_rad
    )
    if not (best.decided and as_given) or name not in READERS or not isinstance(convention, dict):
        return None
    if not {"sign", "offset_m"} <= set(convention) & set(parameters_of(READERS[name].load())):
        return None
    sign = best.sign * int(convention["sign"])
    offset_m = float(best.offset_m[0]) + best.sign * float(convention["offset_m"])
    return f"{name}:sign={sign},offset_m={offset_m:.4f}"
