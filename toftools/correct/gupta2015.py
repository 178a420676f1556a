"""Phasor imaging (micro ToF): frequencies so high that indirect light vanishes, unwrapped by beats.

Diffuse indirect light arrives spread over time, so its phasor is a low-pass function of frequency:
above a bandwidth that depends on the scene, all that is left is direct light, ``z_f = a exp(j k_f
d)``. One such frequency repeats every few centimetres. The product of two, ``z_1 conj(z_2)``, is
the phasor of their difference frequency: as free of multipath as its factors, where a *measured*
low frequency is not. Reference: Gupta et al., ACM TOG 2015 (below; abstract read, the rest
recalled: the paper also unwraps by close high frequencies, and calls its own low-frequency
counterpart macro ToF). Input: two or more frequencies of at least `least_hz`; lower ones are
ignored. ``amplitude`` is that of the direct light (the paper's separation, its modulated half).

The differences of all pairs are climbed as a ladder: the lowest gives the range within its own
turn, every next one refines it by rounding to its nearest turn, the highest frequency ends it.
Ours: with all wraps known, all frequencies are averaged with the weights of the Cramer-Rao bound.

When it fails; figures of the closed-form scenes (tests/test_gupta2015.py bounds them):

- The bandwidth is the scene's. Error of the mean phase, in mm, wraps known:

  | MHz                           | 20  | 50  | 100 | 200 | 300 | 500 | 700 | 1000 | 1500 |
  |-------------------------------|-----|-----|-----|-----|-----|-----|-----|------|------|
  | cavity, radius 2 m, albedo .8 | 925 | 36  | 32  | 4.6 | 5.1 | 0.8 | 0.5 | 0.26 | 0.20 |
  | cavity, radius 1 m, albedo .8 |1065 | 318 | 18  | 16  | 10  | 2.1 | 0.8 | 0.40 | 0.40 |
  | corner 90 deg at 1 m, median  | 62  | 53  | 35  | 9.2 | 5.8 | 2.1 | 1.2 | 0.78 | 0.29 |
  | corner, 95th percentile       | 65  | 58  | 44  | 27  | 18  | 11  | 6.8 | 5.2  | 3.8  |

- Next to a concave edge the detour of light shrinks with the distance, so that no frequency is
  high enough: the phase error stays at up to 0.24 rad, and only its length falls as 1 / f.
- Mirrors, and a few discrete returns in general, never vanish: a second return of share r moves
  every phase by up to r rad, a difference by twice that, and a step of ratio g makes it 2 g r:
  0.1 leaves all wraps right and 0.8 mm of error on average, 0.2 breaks 27 % of them, 0.4 71 %.
- Noise: a step of ratio g between rungs multiplies the phase noise of the lower rung by g, and
  wraps break when that reaches half a turn. A pair alone has g = f_1 / (f_1 - f_2): 1000 + 1010
  MHz at a signal to noise ratio of 50 loses 27 % of the wraps; with 1100 MHz added (steps of 9
  and 10) none in 10 000 down to a ratio of 20.
- The range repeats every ``c / (2 df)``, df the smallest difference, which can be short of the
  joint ambiguity of all frequencies (1000, 1030, 1070 MHz: 5 m instead of 15 m).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.correct import INVALID, OK, refuse_emitter_offset, warm_up
from toftools.correct._returns import GUARD_M
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import ambiguity_m, range_to_phase

BLOCK = 1 << 15
"""Pixels at a time; each takes some 100 bytes per frequency while it is worked on."""
LEAST_DIFFERENCE = 1e-6
"""Frequencies closer than this, relative to the highest, are the same."""


@dataclass(frozen=True, eq=False)
class Ladder:
    """The synthetic frequencies in ascending order.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        High frequencies, Hz.
    use : ndarray, (F,)
        Where they are among the sensor's frequencies.
    pairs : tuple of (int, int)
        Of each rung, the higher and the lower frequency it is the difference of.
    rungs_hz : tuple of float
        Difference frequencies, Hz.
    """

    freqs_hz: F64
    use: NDArray[np.intp]
    pairs: tuple[tuple[int, int], ...]
    rungs_hz: tuple[float, ...]


def gupta2015(sensor: Sensor, *, least_hz: float = 500e6) -> Callable[[Phasors], DepthMap]:
    """Range from frequencies above the bandwidth of indirect light.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more different ones of at least `least_hz`.
    least_hz : float
        Frequencies below this are ignored, Hz: the bandwidth of indirect light in the scene.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``, ranges within one turn of the smallest difference frequency;
        its last 5 cm count as just below zero, hence as 0.
        `sigma_m` is the Cramer-Rao bound at the measured amplitudes, right where the wraps are.
        `confidence` is the distance to the nearest wrong wrap of any rung in standard deviations
        (of unit relative noise where sigma is unknown). ``info["residual"]`` (H, W): chi-squared
        of F - 1 degrees of freedom, or the amplitude-weighted mean squared phase residual, rad^2.

    Raises
    ------
    ValueError
        If there are fewer than two such frequencies, or the emitter is not at the camera.

    References
    ----------
    M. Gupta, S. K. Nayar, M. B. Hullin, J. Martin, "Phasor Imaging: A Generalization of
    Correlation-Based Time-of-Flight Imaging", ACM Transactions on Graphics 34 (2015) 156;
    technical report CUCS-019-14, Columbia University, 2014.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> camera = sensor("phasor_imaging:width=1,height=1")  # 1000, 1010, 1100 MHz
    >>> phase = range_to_phase(9.0, camera.modulation.freqs_hz)  # 60 turns and more
    >>> round(float(gupta2015(camera)(Phasors(np.exp(1j * phase)[:, None, None])).range_m[0, 0]), 4)
    9.0
    """
    refuse_emitter_offset(sensor)
    ladder = _ladder(sensor.modulation.freqs_hz, least_hz)
    n_freqs = sensor.modulation.n_freqs

    def run(phasors: Phasors) -> DepthMap:
        if phasors.values.shape[0] != n_freqs:
            msg = f"phasors must have {n_freqs} frequencies, got {phasors.values.shape[0]}"
            raise ValueError(msg)
        return _estimate(phasors, ladder)

    warm_up(run, n_freqs)
    return run


def _ladder(freqs_hz: F64, least_hz: float) -> Ladder:
    use = np.flatnonzero(freqs_hz >= least_hz)
    high = freqs_hz[use]
    order = np.argsort(high)[::-1]
    pairs = [(int(i), int(j)) for n, i in enumerate(order) for j in order[n + 1 :]]
    pairs = [p for p in pairs if high[p[0]] - high[p[1]] > LEAST_DIFFERENCE * high[p[0]]]
    if not (np.isfinite(least_hz) and least_hz > 0) or not pairs:
        msg = (
            f"gupta2015 needs two different frequencies of {least_hz:g} Hz or more, got "
            f"{freqs_hz.tolist()} Hz; use 'crt', or least_hz where indirect light vanishes earlier"
        )
        raise ValueError(msg)
    pairs.sort(key=lambda p: float(high[p[0]] - high[p[1]]))
    return Ladder(high, use, tuple(pairs), tuple(float(high[i] - high[j]) for i, j in pairs))


def _estimate(phasors: Phasors, ladder: Ladder) -> DepthMap:
    shape = phasors.valid.shape
    z = phasors.values[ladder.use].reshape(ladder.use.size, -1)
    sigma = None
    if phasors.sigma is not None:
        sigma = phasors.sigma[ladder.use].reshape(z.shape)
    n_pixels = z.shape[1]
    found = np.empty((5, n_pixels), np.float32)
    for lo in range(0, n_pixels, BLOCK):
        part = slice(lo, min(lo + BLOCK, n_pixels))
        found[:, part] = _block(z[:, part], None if sigma is None else sigma[:, part], ladder)
    range_m, sigma_m, confidence, amplitude, residual = found.reshape(5, *shape)
    ok = phasors.valid & np.isfinite(range_m)
    nan = np.float32(np.nan)
    return DepthMap(
        range_m=np.where(ok, range_m, nan),
        sigma_m=None if sigma is None else np.where(ok, sigma_m, nan),
        confidence=np.where(ok, confidence, np.float32(0)),
        amplitude=np.where(ok, amplitude, np.float32(0)),
        info={"status": np.where(ok, np.uint8(OK), np.uint8(INVALID)), "residual": residual},
    )


def _block(
    z: NDArray[np.complex64], sigma: NDArray[np.float32] | None, ladder: Ladder
) -> tuple[F64, F64, F64, F64, F64]:
    """Range, its sigma, confidence, amplitude and residual of pixels (F, P)."""
    strength = np.abs(z).astype(np.float64)
    cycles = np.angle(z).astype(np.float64) / (2 * np.pi)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Relative noise, which is phase noise in rad; in units of the mean amplitude if unknown.
        noise = (strength.mean(axis=0) if sigma is None else sigma) / strength
        # Infinite weights help nobody: a signal to noise ratio of 1e5 is as good as it gets.
        weight = range_to_phase(1.0, ladder.freqs_hz[:, None]) ** 2 / np.maximum(noise, 1e-5) ** 2
        turned, margin = _climb(cycles, noise, ladder)
        off_m = _off(cycles, turned, ladder)
        total = weight.sum(axis=0)
        shift = (weight * off_m).sum(axis=0) / total
        residual = (weight * (off_m - shift) ** 2).sum(axis=0)
    if sigma is None:
        residual = residual / z.shape[0]
    period = float(ambiguity_m(ladder.rungs_hz[0]))
    range_m = np.maximum(np.mod(turned + shift + GUARD_M, period) - GUARD_M, 0.0)
    signal = (strength > 0).all(axis=0)
    with np.errstate(divide="ignore"):
        sigma_m = 1 / np.sqrt(total)
    amplitude = strength.mean(axis=0)
    return np.where(signal, range_m, np.nan), sigma_m, margin, amplitude, residual


def _climb(cycles: F64, noise: F64, ladder: Ladder) -> tuple[F64, F64]:
    """Range (P,) by the ladder, and its least margin to a wrong wrap in standard deviations."""
    top = int(np.argmax(ladder.freqs_hz))
    # A rung's turns and the variance of its phase; the last one is the highest frequency itself.
    rungs = [(f, cycles[i] - cycles[j], noise[i] ** 2 + noise[j] ** 2)
             for f, (i, j) in zip(ladder.rungs_hz, ladder.pairs, strict=True)]  # fmt: skip
    rungs.append((float(ladder.freqs_hz[top]), cycles[top], noise[top] ** 2))
    below_hz, turns, below_variance = rungs[0]
    turns = np.mod(turns, 1.0)
    margin = np.full(turns.shape, np.inf)
    for freq_hz, measured, variance in rungs[1:]:
        gain = freq_hz / below_hz
        expected = turns * gain
        turns = measured + np.rint(expected - measured)
        spread = np.sqrt(gain**2 * below_variance + variance) / (2 * np.pi)
        margin = np.minimum(margin, (0.5 - np.abs(expected - turns)) / np.maximum(spread, 1e-12))
        below_hz, below_variance = freq_hz, variance
    return turns * float(ambiguity_m(below_hz)), margin


def _off(cycles: F64, range_m: F64, ladder: Ladder) -> F64:
    """How far each frequency's range is from the given one (F, P), wraps by rounding, m."""
    turn_m = ambiguity_m(ladder.freqs_hz)[:, None]
    ahead = cycles - range_m / turn_m
    return np.asarray((ahead - np.rint(ahead)) * turn_m)
