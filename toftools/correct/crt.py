"""Multi-frequency unwrapping and range by noise-weighted maximum likelihood ("CRT").

Of all wrap counts that a range up to the limit can have, take those whose ranges agree best, and
average them: least ``sum_i w_i (d_i + n_i U_i - d)^2`` with ``w_i = (4 pi f_i / c)^2 A_i^2 /
sigma_i^2``. References: A. P. P. Jongenelen et al., "Analysis of errors in ToF range imaging with
dual-frequency modulation", IEEE Trans. Instrumentation and Measurement 60 (2011) 1861-1868, for
unwrapping by agreement of two frequencies; the weights are those of the Cramer-Rao bound. The
remainder-theorem name is kept for its currency: no integer arithmetic is done. Input: any number
of frequencies, with or without sigma. Fails when errors reach the spacing of neighbouring
candidates: noise at long range, and multipath, whose bias differs between frequencies and can
change the wrap count at any signal level.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import INVALID, OK, refuse_emitter_offset, warm_up
from toftools.correct._wraps import Candidates, plan, search
from toftools.types import F32, DepthMap, Phasors, Sensor

# What residual counts as none: a chi-squared of 1, or a squared phase error of (1 mrad)^2.
RESIDUAL_KNOWN_NOISE, RESIDUAL_UNKNOWN_NOISE = np.float32(1), np.float32(1e-6)


def crt(sensor: Sensor, *, max_range_m: float = 0.0) -> Callable[[Phasors], DepthMap]:
    """Most likely range given all frequencies.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, one or more.
    max_range_m : float
        Longest range that can occur, m; 0 stands for the joint ambiguity of all frequencies.
        Values beyond an exact repetition of all phases are cut to it; a near one (Kinect v2:
        18.67 m) cuts nothing. A limit well below makes wrong wraps rarer. Answers are
        confined to [0, max_range_m]. Up to the joint ambiguity that makes the axis a circle: a
        return at 1 cm whose noise says -2 cm comes back 2 cm short of the far end, since the
        data fit there perfectly; with a smaller limit it comes back as 0.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the Cramer-Rao bound at the measured
        amplitudes, right only where the wraps are. `confidence` is the margin of the winner
        over the runner-up divided by its own residual (one frequency: signal to noise ratio).
        ``info["residual"]`` (H, W): chi-squared of F - 1 degrees of freedom, or the
        amplitude-weighted mean squared phase residual in rad^2 where sigma is unknown.

    Raises
    ------
    ValueError
        If `max_range_m` is negative, or 0 with frequencies that never repeat together, or the
        emitter is not at the camera.

    References
    ----------
    A. P. P. Jongenelen, D. G. Bailey, A. D. Payne, A. A. Dorrington, D. A. Carnegie, "Analysis
    of errors in ToF range imaging with dual-frequency modulation", IEEE TIM 60 (2011) 1861-1868.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("opt8241:width=1,height=1")
    >>> phase = range_to_phase(9.0, camera.modulation.freqs_hz)  # 2.4 and 4.2 turns
    >>> round(float(crt(camera)(Phasors(np.exp(1j * phase)[:, None, None])).range_m[0, 0]), 4)
    9.0
    """
    refuse_emitter_offset(sensor)
    walk = plan(sensor, max_range_m, least_freqs=1, method="crt")

    def run(phasors: Phasors) -> DepthMap:
        found = search(phasors, walk, top=2)
        valid = phasors.valid & (found.information > 0)
        known = phasors.sigma is not None
        sigma_m = None
        if known:
            with np.errstate(divide="ignore"):
                sigma_m = np.where(valid, 1 / np.sqrt(found.information), np.float32(np.nan))
        return DepthMap(
            range_m=np.where(valid, found.range_m[0], np.float32(np.nan)),
            sigma_m=sigma_m,
            confidence=np.where(valid, _confidence(found, known=known), np.float32(0)),
            info={
                "status": np.where(valid, np.uint8(OK), np.uint8(INVALID)),
                "residual": found.cost[0],
            },
        )

    warm_up(run, sensor.modulation.n_freqs)
    return run


def _confidence(found: Candidates, *, known: bool) -> F32:
    """Margin over the runner-up relative to the residual.

    Measured by the area under error-versus-coverage curves: the margin alone ranks noise best and
    multipath badly, the residual alone the other way round; their ratio is within a few per cent
    of the better one. Two frequencies under heavy multipath are the exception: the margin wins.
    """
    if found.n_freqs == 1:
        return np.sqrt(found.information)
    floor = RESIDUAL_KNOWN_NOISE if known else RESIDUAL_UNKNOWN_NOISE
    with np.errstate(invalid="ignore"):
        return np.asarray((found.cost[1] - found.cost[0]) / (floor + found.cost[0]))
