"""Two returns from two or more frequencies, solved numerically for their relation to each other.

Model: ``z_i = a exp(j k_i d) (1 + b exp(j k_i e))``, a second return of relative amplitude b at
relative range e. Reference: A. A. Dorrington, J. P. Godbaz, M. J. Cree, A. D. Payne, L. V.
Streeter, "Separating true range measurements from multi-path and scattering interference in
commercial range cameras", Proc. SPIE 7864 (2011) 786404. The abstract and the beginning of the
text were at hand: additional raw images (frequencies), an optimisation, the individual returns of
each pixel. That the problem is normalised by one return, which leaves relative amplitude and phase
as unknowns, is recalled. Ours: the elimination in logarithms and the table of starts
(_relative_fit.py); wraps and returns are found together, over the joint ambiguity; the choice among
solutions; the test for one return (_one_or_two.py); the sigma, from the Fisher information at the
solution.

Two frequencies give four real data for four unknowns: some three to six different pairs of returns
explain them exactly. Of solutions that fit equally well (within 2 in chi-squared) the one with the
weakest second return is taken, the best of the rules tried: least relative amplitude, least total
amplitude, least e, nearest d. `max_range_m`, `max_extra_m` and `max_ratio` say what is possible;
the tighter, the fewer solutions. A third frequency tells them apart.

Inputs: two or more frequencies, at the contrasts that the sensor states; second return up to
`max_ratio` times as strong as the first and up to `max_extra_m` behind.
Measured (noise 1 % of the first return, separations 0.3 to 2 m, ratios 0.05 to 0.8, 4000 pixels;
share more than 0.1 m off, and that of `crt`): 20/50/70 MHz over 0.5 to 8 m 0.0 % (50 %), 80/16/120
MHz 0.0 % (14 %), 40/70 MHz limited to 3.5 m 0.1 % (57 %), 40/70 MHz over 0.5 to 8 m 21 % (57 %),
each of these an exact solution too. Errors are at the two-return bound from 0.6 m up (20/50/70 MHz:
19, 7 and 3 mm at 0.6, 1 and 2 m). 30 to 60 microseconds of processor time a pixel with two returns
(2 to 5 s a frame of 320 x 240), 1 with one; with `starts=1` half of it.
Fails where returns are close: at 0.3 m the bound is 75 mm, the median error 39 to 64 mm, and
normalised errors spread by 1.7 to 1.9. Fails to notice weak second returns (ratio 0.05 found in 0,
28, 53 and 49 % at 0.3, 0.6, 1 and 2 m; the others keep their bias of 5 to 17 mm) and, with two
frequencies over the joint ambiguity, to choose right in a fifth of the pixels. Fails where the
amplitudes are not alike: a lone return 10 % weaker at the highest frequency counts as two and is
8 cm off.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toftools.correct import kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._one_or_two import check_first_share, lone_return_test, returns_of
from toftools.correct._relative_fit import (
    LEAST_B,
    LEAST_E,
    STARTS_B,
    STEP_RAD,
    fit,
    table_of_starts,
)
from toftools.correct._returns import GUARD_M
from toftools.correct._wraps import longest_m
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import range_to_phase

MOST_STARTS = 100_000
"""More starts than this per pixel are refused: a frame would take minutes."""


def dorrington2011(
    sensor: Sensor,
    *,
    max_range_m: float = 0.0,
    max_extra_m: float = 2.5,
    max_ratio: float = 1.0,
    starts: int = 4,
    first_share: float = 0.05,
    false_alarm: float = 0.001,
    assumed_noise: float = 0.01,
) -> Callable[[Phasors], DepthMap]:
    """First of one or two returns by numerical inversion from several starts.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more, and the contrast of each.
    max_range_m : float
        Longest range of the first return, m; 0 stands for the joint ambiguity.
    max_extra_m : float
        Largest distance of the second return behind the first, m.
    max_ratio : float
        Largest amplitude of the second return relative to the first.
    starts : int
        Starts that are followed to the end, the best of a table.
    first_share : float
        Returns weaker than this share of the stronger are ignored.
    false_alarm : float
        Share of lone returns taken for two; one return is the answer where the chi-squared of
        its 2 F - 2 degrees of freedom is less improbable than that.
    assumed_noise : float
        Sigma as a share of the rms amplitude, in that test and in the weights, where sigma is not
        known.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the Cramer-Rao bound at the solution, right only
        where that is the right one of several. ``info``: `status`, `returns`, `ranges_m`,
        `amplitudes` (2, H, W), nearest first, and `chi2_one`, what one return leaves.

    Raises
    ------
    ValueError
        If there are fewer than two frequencies, a parameter is out of range, or the emitter is
        not at the camera.

    References
    ----------
    A. A. Dorrington, J. P. Godbaz, M. J. Cree, A. D. Payne, L. V. Streeter, "Separating true range
    measurements from multi-path and scattering interference in commercial range cameras", Proc.
    SPIE 7864 (2011) 786404.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("deeptof:freqs=20e6+50e6+70e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(9.0j * turn) + 0.4 * np.exp(10.1j * turn)  # at 9 m and, weaker, at 10.1 m
    >>> depth = dorrington2011(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].round(3).ravel().tolist()
    [9.0, 10.100000381469727]
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    if np.unique(freqs).size < freqs.size:
        msg = f"dorrington2011 needs frequencies that differ, got {freqs.tolist()} Hz; drop one"
        raise ValueError(msg)
    test = lone_return_test(
        sensor, max_range_m, false_alarm=false_alarm, assumed_noise=assumed_noise,
        method="dorrington2011",
    )  # fmt: skip
    check_first_share(first_share)
    _check(max_extra_m, max_ratio, starts)
    k = range_to_phase(1.0, freqs)
    longest = longest_m(freqs, max_range_m)
    cyclic = max_range_m == 0 or longest_m(freqs, 2 * max_range_m) <= max_range_m
    limits = np.array([-np.inf, np.inf] if cyclic else [-GUARD_M, longest])
    bounds = np.array([LEAST_B, max_ratio, min(LEAST_E / k.max(), max_extra_m / 2), max_extra_m])
    wraps = test.walk.last + 1
    if wraps * len(STARTS_B) * max_extra_m * k.max() / STEP_RAD > MOST_STARTS:
        msg = (
            f"got max_range_m={max_range_m} and max_extra_m={max_extra_m}, which make more than "
            f"{MOST_STARTS} starts at these frequencies; lower them"
        )
        raise ValueError(msg)
    table = table_of_starts(k, max_extra_m, max_ratio)
    columns = [kernel_input(array) for array in (table.e, table.b, table.logs)]

    def split(z: NDArray[np.complex128], sigma: F64) -> tuple[F64, F64, F64]:
        found = fit(
            kernel_input(z), kernel_input(sigma), k, wraps, int(starts), bounds, limits, *columns
        )
        ranges = np.stack([found[0], found[0] + found[1]])
        amplitudes = np.stack([found[2], found[2] * found[3]])
        return ranges, np.nan_to_num(amplitudes), _bound_m(ranges, amplitudes, k, sigma)

    def run(phasors: Phasors) -> DepthMap:
        return returns_of(
            phasors, test, split, first_share=first_share, period_m=longest if cyclic else 0.0
        )

    warm_up(run, freqs.size)
    split(np.ones((freqs.size, 1), np.complex128), np.ones((freqs.size, 1)))
    return run


def _check(max_extra_m: float, max_ratio: float, starts: int) -> None:
    for name, value in (("max_extra_m", max_extra_m), ("max_ratio", max_ratio)):
        if not (np.isfinite(value) and value > 0):
            msg = f"{name} must be positive and finite, got {value}"
            raise ValueError(msg)
    if not 1 <= starts <= 1000:
        msg = f"starts must lie in 1..1000, got {starts}; 4 is usual"
        raise ValueError(msg)


def _bound_m(ranges_m: F64, amplitudes: F64, k: F64, sigma: F64) -> F64:
    """Cramer-Rao bound of both ranges (2, N), as `crlb.crlb_returns_m`, for many pixels."""
    turn = np.exp(1j * k[:, None, None] * ranges_m)  # (F, 2, N)
    slope = 1j * k[:, None, None] * amplitudes * turn
    rows = np.concatenate([turn, slope], axis=1) / sigma[:, None, :]  # (F, 4, N)
    information = np.einsum("fan,fbn->nab", rows.conj(), rows).real
    scale = 1 / np.sqrt(np.maximum(np.einsum("naa->na", information), 1e-300))
    scaled = information * scale[:, :, None] * scale[:, None, :] + 1e-12 * np.eye(4)
    solvable = np.isfinite(scaled).all(axis=(1, 2))
    bound = np.full((ranges_m.shape[1], 2), np.nan)
    inverse = np.linalg.inv(scaled[solvable])
    variance = np.einsum("naa->na", inverse)[:, 2:] * scale[solvable, 2:] ** 2
    bound[solvable] = np.sqrt(np.maximum(variance, 0.0))
    return bound.T
