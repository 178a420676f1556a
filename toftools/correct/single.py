"""One frequency, no unwrapping: range = c phase / (4 pi f) in [0, c / 2f); the baseline.

Reference: R. Lange and P. Seitz, "Solid-state time-of-flight range camera", IEEE J. Quantum
Electronics 37 (2001) 390-397. Input: phasors of any number of frequencies, of which one is used.
Fails when the range exceeds the ambiguity c / 2f (it comes back too short by whole multiples) and
wherever multipath bends the phase.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import INVALID, OK, refuse_emitter_offset
from toftools.phasor import wrapped_range_m
from toftools.types import DepthMap, Phasors, Sensor
from toftools.units import ambiguity_m, phase_to_range


def single(sensor: Sensor, *, freq_index: int = 0) -> Callable[[Phasors], DepthMap]:
    """Range from the phase of one frequency.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies.
    freq_index : int
        Which frequency to use, from 0.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``: range in [0, c / 2f), its standard deviation where the
        phasors carry one, confidence = signal to noise ratio (amplitude if sigma is unknown).

    Raises
    ------
    ValueError
        If the sensor has no such frequency, or its emitter is not at the camera.

    References
    ----------
    R. Lange, P. Seitz, "Solid-state time-of-flight range camera", IEEE JQE 37 (2001) 390-397.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> run = single(sensor("deeptof:width=1,height=1"))
    >>> round(float(run(Phasors(np.full((1, 1, 1), 1j))).range_m[0, 0]), 3)  # quarter of 7.495 m
    1.874
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    if not 0 <= freq_index < freqs.size:
        msg = (
            f"freq_index must be 0..{freqs.size - 1} for {freqs.size} frequencies, got {freq_index}"
        )
        raise ValueError(msg)
    freq_hz = float(freqs[freq_index])
    # The largest float32 below the ambiguity: rounding must not leave the half-open interval.
    longest = np.nextafter(np.float32(ambiguity_m(freq_hz)), np.float32(0))

    def run(phasors: Phasors) -> DepthMap:
        if phasors.values.shape[0] != freqs.size:
            msg = f"phasors must have {freqs.size} frequencies, got {phasors.values.shape[0]}"
            raise ValueError(msg)
        value = phasors.values[freq_index]
        amplitude = np.abs(value)
        valid = phasors.valid & (amplitude > 0)
        range_m = wrapped_range_m(value[None], [freq_hz])[0].astype(np.float32)
        sigma_m, confidence = None, amplitude
        if phasors.sigma is not None:
            noise = np.maximum(phasors.sigma[freq_index], np.finfo(np.float32).tiny)
            with np.errstate(divide="ignore", over="ignore"):  # no noise: infinite confidence
                confidence = amplitude / noise
                sigma_m = phase_to_range(1 / confidence, freq_hz)
        return DepthMap(
            range_m=np.where(valid, np.minimum(range_m, longest), np.float32(np.nan)),
            sigma_m=None if sigma_m is None else np.where(valid, sigma_m, np.nan),
            confidence=np.where(valid, confidence, np.float32(0)),
            amplitude=amplitude,
            info={"status": np.where(valid, np.uint8(OK), np.uint8(INVALID))},
        )

    return run
