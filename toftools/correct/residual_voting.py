"""Unwrapping by residual voting, the Kinect v2 chain of the open driver libfreenect2.

The lowest frequency gives a coarse range in each of its wraps; the middle one is unwrapped to it,
the highest to the middle one, and the wrap in which those two agree best wins. The three unwrapped
phases are averaged in turns, which weighs their ranges by f_i. A pixel is dropped if a phasor is
too weak, or if the unwrapped phases lie too far from those of any one range:
``sum phi_i^2 - (sum f_i phi_i)^2 / sum f_i^2 > limit^2``, with a limit between 35 and 20 degrees
that falls as the amplitude a grows, ``12.9 a^-0.533`` rad.

Reference: depth processors of OpenKinect/libfreenect2 (formulas and thresholds read there); the
same chain is the baseline of F. Järemo Lawin, P.-E. Forssén, H. Ovrén, ECCV 2016 (arXiv
1608.05209). Reconstructed: the driver has 80/16/120 MHz and two wraps of 16 MHz built in as
constants, this file takes any three frequencies and all wraps of the lowest, and gives the same
votes for 80/16/120. The driver's amplitude unit is its own; here it is tied to the noise
(`UNIT_SNR`). The driver's depth limits of 0.5 and 4.5 m and its bilateral and edge filters are
left out: they are not unwrapping. Input: exactly three frequencies. Fails at long range, where
the noise of the lowest frequency exceeds half a wrap of the middle one: such pixels are dropped
or, worse, wrong.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools._turns import FAST, LEAST, turns
from toftools.correct import INVALID, OK, REJECTED, kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._wraps import longest_m
from toftools.types import F32, DepthMap, Phasors, Sensor
from toftools.units import TWO_PI, ambiguity_m

UNIT_SNR = 0.9
"""A / sigma per amplitude unit of libfreenect2: mean of 0.82, 1.26 and 0.64, the linear terms of
the phase noise at 80, 16 and 120 MHz in the driver's KDE variant (read)."""
LIMIT_RAD, LIMIT_SLOPE = 12.8866, -0.5330578
"""Residual limit of the driver at amplitude one, and the power with which it falls (read)."""


def residual_voting(
    sensor: Sensor,
    *,
    max_range_m: float = 0.0,
    least_amplitude: float = 3.0,
    least_sum: float = 10.0,
    strict_rad: float = 0.3490659,
    lax_rad: float = 0.6108653,
) -> Callable[[Phasors], DepthMap]:
    """Range by residual voting over three frequencies, doubtful pixels dropped.

    Parameters
    ----------
    sensor : Sensor
        Gives the three frequencies, in any order.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity. Ranges beyond are dropped.
    least_amplitude, least_sum : float
        Smallest amplitude of each frequency and smallest sum of all three, in units of
        libfreenect2 (0.9 standard deviations each). Not applied where sigma is unknown.
    strict_rad, lax_rad : float
        Residual allowed at high and at low amplitude, rad: 20 and 35 degrees. Where sigma is
        unknown, `lax_rad` holds.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``: dropped pixels are NaN with status REJECTED, `confidence`
        is one minus the squared residual over its limit, ``info["residual"]`` the residual in rad.

    Raises
    ------
    ValueError
        If the sensor has not three different frequencies, a threshold is negative, or the
        emitter is not at the camera.

    References
    ----------
    OpenKinect/libfreenect2, depth packet processor; F. Järemo Lawin et al., ECCV 2016.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("kinect2_nominal:width=1,height=1")
    >>> phase = range_to_phase(17.0, camera.modulation.freqs_hz)
    >>> run = residual_voting(camera)
    >>> round(float(run(Phasors(np.exp(1j * phase)[:, None, None])).range_m[0, 0]), 4)
    17.0
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    if freqs.size != 3 or np.unique(freqs).size != 3:
        msg = f"residual_voting needs three different frequencies, got {freqs.tolist()} Hz"
        raise ValueError(msg)
    if min(least_amplitude, least_sum, strict_rad, lax_rad) < 0:
        msg = "residual_voting takes no negative thresholds; give amplitudes and radians >= 0"
        raise ValueError(msg)
    order = np.argsort(freqs)
    ambiguity = ambiguity_m(freqs[order]).astype(np.float32)
    longest = longest_m(freqs, max_range_m)
    # A hair less than the limit: 18.75 m of 9.375 m wraps are two wraps, whatever the rounding.
    n_wraps = int(np.ceil(longest / ambiguity[0] - 1e-3))

    def run(phasors: Phasors) -> DepthMap:
        if phasors.values.shape[0] != freqs.size:
            msg = f"phasors must have {freqs.size} frequencies, got {phasors.values.shape[0]}"
            raise ValueError(msg)
        values = kernel_input(phasors.values[order])
        range_m, residual = np.empty((2, *phasors.valid.shape), np.float32)
        parts = values.view(np.float32).reshape(3, -1, 2)
        _vote(parts, ambiguity, n_wraps, range_m.reshape(-1), residual.reshape(-1))
        amplitude = np.abs(values)
        sigma = None if phasors.sigma is None else phasors.sigma[order]
        limit: F32 = np.full(1, lax_rad, np.float32)
        loud: NDArray[np.bool_] = np.ones(1, np.bool_)
        if sigma is not None:
            units = amplitude / np.maximum(sigma * np.float32(UNIT_SNR), np.float32(1e-30))
            limit = _limit(units, strict_rad, lax_rad)
            loud = (units.min(axis=0) >= least_amplitude) & (units.sum(axis=0) >= least_sum)
        valid = phasors.valid & (amplitude > 2 * LEAST).all(axis=0)
        kept = valid & loud & (residual <= limit) & (range_m >= 0) & (range_m <= longest)
        status = np.where(
            kept, np.uint8(OK), np.where(valid, np.uint8(REJECTED), np.uint8(INVALID))
        )
        trust = 1 - (residual / np.maximum(limit, np.float32(1e-9))) ** 2
        return DepthMap(
            range_m=np.where(kept, range_m, np.float32(np.nan)),
            sigma_m=_sigma_m(amplitude, sigma, ambiguity, kept),
            confidence=np.where(kept, trust, np.float32(0)),
            info={"status": status, "residual": residual},
        )

    warm_up(run, freqs.size)
    return run


def _limit(units: F32, strict_rad: float, lax_rad: float) -> F32:
    """Residual allowed at an amplitude (of the loudest frequency), rad."""
    loudest = np.maximum(units.max(axis=0), np.float32(1e-6))
    limit = np.float32(LIMIT_RAD) * loudest ** np.float32(LIMIT_SLOPE)
    return np.asarray(np.clip(limit, strict_rad, lax_rad))


def _sigma_m(
    amplitude: F32, sigma: F32 | None, ambiguity: F32, kept: NDArray[np.bool_]
) -> F32 | None:
    """First-order noise of the average in turns: ``sqrt(sum var turns) / sum 1 / U_i``."""
    if sigma is None:
        return None
    # An amplitude of nothing is not kept; the floor only keeps it from overflowing.
    with np.errstate(invalid="ignore"):  # nor is one of infinite noise
        turns = sigma / np.maximum(amplitude, np.float32(1e-6) * sigma + np.float32(1e-30))
    turns /= np.float32(TWO_PI)
    sigma_m = np.sqrt((turns**2).sum(axis=0)) / (1 / ambiguity).sum()
    return np.where(kept, sigma_m, np.float32(np.nan))


@njit(parallel=True, cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _vote(values: F32, U: F32, n_wraps: int, range_m: F32, residual: F32) -> None:
    """Unwrapped average and distance from the line of common ranges, rad, per pixel."""
    low_to_mid, mid_to_high = U[0] / U[1], U[1] / U[2]
    per_range = np.float32(1) / U  # turns per metre, proportional to frequency
    inverse = np.float32(1) / per_range.sum()
    scale = np.float32(TWO_PI) / np.sqrt((per_range * per_range).sum())
    for p in prange(range_m.size):
        low = turns(values[0, p, 0], values[0, p, 1])
        mid = turns(values[1, p, 0], values[1, p, 1])
        high = turns(values[2, p, 0], values[2, p, 1])
        best = np.float32(2)  # no vote exceeds half a turn
        a, b, c = low, mid, high
        for k in range(n_wraps):
            new_a = low + np.float32(k)
            new_b = mid + np.rint(new_a * low_to_mid - mid)
            off = new_b * mid_to_high - high
            new_c = high + np.rint(off)
            vote = abs(np.rint(off) - off)
            a = new_a if vote < best else a
            b = new_b if vote < best else b
            c = new_c if vote < best else c
            best = min(best, vote)
        range_m[p] = (a + b + c) * inverse
        # |phi x f|^2 / |f|^2 is the squared distance of phi from the line along f (Lagrange).
        x = b * per_range[2] - c * per_range[1]
        y = c * per_range[0] - a * per_range[2]
        z = a * per_range[1] - b * per_range[0]
        residual[p] = scale * np.sqrt(x * x + y * y + z * z)
