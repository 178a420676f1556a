"""Two returns in closed form from two frequencies in the ratio 2:1.

Model: ``z_1 = a u + b v``, ``z_2 = a u^2 + b v^2`` with positive amplitudes and u, v on the unit
circle, the phases of the two returns at the lower frequency. Reference: the second method of J. P.
Godbaz, M. J. Cree, A. A. Dorrington, "Closed-form inverses for the mixed pixel/multipath
interference problem in AMCW lidar", Proc. SPIE 8296 (2012) 829618, which by its abstract "uses
attenuation ratios to determine the amplitude and phase of up to two component returns". Only the
abstract was at hand: that two frequencies of ratio 2:1 and their bispectrum ``z_1*^2 z_2`` serve
it is recalled, and the formulas are derived here. The unknown is s = a + b, the amplitude that
light without modulation frequency would have; ``|z_i| / s`` are the attenuations. Two returns make
the Toeplitz matrix of ``s, z_1, z_2`` and their conjugates singular (Caratheodory, Pisarenko):

    s^3 - s (2 |z_1|^2 + |z_2|^2) + 2 Re(z_1*^2 z_2) = 0,                                       (1)

largest root, trigonometric form of the cubic. With ``u v = exp(2 j m)``, ``u / v = exp(2 j e)``:

    exp(2 j m) ~ z_1^2 - s z_2,   s cos e = Re(z_1 exp(-j m)),
    (a - b) sin e = Im(z_1 exp(-j m)).                                                          (2)

So every pair of phasors is explained by exactly one pair of returns within one turn of the lower
frequency: nothing to choose, and an inverse of four real data by four unknowns, whose noise is the
two-return Cramer-Rao bound (derivation at `_sigma`). The test for one return (_one_or_two.py) and
the sigma are ours.

Inputs: exactly two frequencies, ratio 2:1, calibrated to the same amplitude.
Measured (30 and 60 MHz, noise 1 % of the stronger return, 2000 pixels a figure): at the bound for
ratios 0.2 to 0.8 and separations of 1 m (11 mm rms) and 2 m (4 mm), where one return is wrong by
46 to 410 mm. A frame of 320 x 240 takes 94 ms of processor time where all pixels have two returns,
67 ms where none has.
Fails where returns are close: at 0.6 m the rms is 32 to 41 mm (bound 31 mm), at 0.3 m the bound is
125 mm, the median error 48 to 72 mm, a third of the pixels are more than 0.1 m off and normalised
errors spread by 1.5 to 1.8. Fails to notice weak ones: a ratio of 0.05 is found in 0, 9, 56 and
54 % of the pixels at 0.3, 0.6, 1 and 2 m, the others keep their bias (10 to 21 mm). Fails where
the amplitudes are not alike: a lone return 5 % weaker at the doubled frequency counts as two in
47 % of the pixels, 10 % weaker in all, and is then 0.2 m off. Three and more returns have no sign.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct import kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._one_or_two import check_first_share, lone_return_test, returns_of
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import TWO_PI, joint_ambiguity_m, range_to_phase

RATIO_TOLERANCE = 1e-3
"""Relative deviation from 2:1 that still passes: a phase error of a milliturn per turn."""


def godbaz2012_ratio(
    sensor: Sensor,
    *,
    first_share: float = 0.05,
    false_alarm: float = 0.001,
    assumed_noise: float = 0.01,
) -> Callable[[Phasors], DepthMap]:
    """First of one or two returns from a frequency and its double, in closed form.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies: two, one the double of the other, in any order.
    first_share : float
        Returns weaker than this share of the stronger are ignored.
    false_alarm : float
        Share of lone returns taken for two; one return is the answer where the chi-squared of
        its two degrees of freedom is less improbable than that.
    assumed_noise : float
        Sigma as a share of the rms amplitude, for that test, where sigma is not known.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the noise carried through the inversion, in
        closed form. ``info``: `status`, `returns`, `ranges_m`, `amplitudes` (2, H, W), nearest
        first, and `chi2_one`, what one return leaves.

    Raises
    ------
    ValueError
        If the frequencies are not two in the ratio 2:1, a parameter is out of range, or the
        emitter is not at the camera.

    References
    ----------
    J. P. Godbaz, M. J. Cree, A. A. Dorrington, "Closed-form inverses for the mixed
    pixel/multipath interference problem in AMCW lidar", Proc. SPIE 8296 (2012) 829618, second
    method (abstract; formulas derived here).

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("deeptof:freqs=30e6+60e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.1j * turn)  # at 2 m and, weaker, at 3.1 m
    >>> depth = godbaz2012_ratio(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].round(4).ravel().tolist()
    [2.0, 3.0999999046325684]
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    order = np.argsort(freqs)
    low, high = float(freqs[order[0]]), float(freqs[order[-1]])
    if freqs.size != 2 or abs(high / low - 2) > 2 * RATIO_TOLERANCE:
        got = f"{freqs.size}; " if freqs.size != 2 else f"{freqs.tolist()} Hz; "
        msg = (
            f"godbaz2012_ratio needs two frequencies in the ratio 2:1, got {got}"
            "use 'dorrington2011' for other ratios and more frequencies"
        )
        raise ValueError(msg)
    check_first_share(first_share)
    test = lone_return_test(
        sensor, 0.0, false_alarm=false_alarm, assumed_noise=assumed_noise, method="godbaz2012_ratio"
    )
    wavenumber = float(range_to_phase(1.0, low))
    period_m = joint_ambiguity_m(freqs)

    def split(z: NDArray[np.complex128], sigma: F64) -> tuple[F64, F64, F64]:
        found = separate(kernel_input(z[order]), kernel_input(sigma[order]))
        return found[0] / wavenumber, found[1], found[2] / wavenumber

    def run(phasors: Phasors) -> DepthMap:
        return returns_of(phasors, test, split, first_share=first_share, period_m=period_m)

    warm_up(run, 2)
    return run


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def separate(z: NDArray[np.complex128], sigma: F64) -> tuple[F64, F64, F64]:
    """Both returns of every pixel.

    Parameters
    ----------
    z : ndarray, (2, N), complex
        Phasors at the lower and at the doubled frequency.
    sigma : ndarray, (2, N)
        Standard deviation of each phasor component.

    Returns
    -------
    phase_rad : ndarray, (2, N)
        Phases at the lower frequency, rad, in [0, 2 pi); NaN where there is one return.
    amplitude : ndarray, (2, N)
        Amplitudes.
    sigma_rad : ndarray, (2, N)
        Standard deviation of the phases, rad.
    """
    n = z.shape[1]
    phase, amplitude, spread = np.full((2, n), np.nan), np.zeros((2, n)), np.full((2, n), np.nan)
    for p in prange(n):
        x, y = z[0, p], z[1, p]
        xx, yy = abs(x) ** 2, abs(y) ** 2
        # (1): s^3 - 3 t^2 s + 2 r = 0
        t = np.sqrt((2 * xx + yy) / 3)
        r = (np.conj(x) ** 2 * y).real
        if not t > 0:
            continue
        s = 2 * t * np.cos(np.arccos(min(max(-r / t**3, -1.0), 1.0)) / 3)
        # (2)
        product = x * x - s * y
        m = np.arctan2(product.imag, product.real) / 2
        seen = x * np.exp(-1j * m)
        sine = np.sqrt(max(1 - (seen.real / s) ** 2, 0.0))
        if not sine > 0:
            continue
        e = np.arctan2(sine, seen.real / s)
        difference = seen.imag / sine
        phase[0, p], phase[1, p] = (m + e) % TWO_PI, (m - e) % TWO_PI
        amplitude[0, p], amplitude[1, p] = (s + difference) / 2, (s - difference) / 2
        for i in range(2):
            spread[i, p] = _sigma(phase[i, p], phase[1 - i, p], sigma[0, p], sigma[1, p])
            spread[i, p] /= max(amplitude[i, p], 1e-300)
    return phase, amplitude, spread


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _sigma(own: float, other: float, sigma_low: float, sigma_high: float) -> float:
    """Standard deviation of one return's phase, times its amplitude.

    A real trigonometric polynomial ``h(t) = sum_k h_k exp(j k t)`` of degree 2 without constant
    term turns the data into ``2 Re sum_k h_k z_k = a h(own) + b h(other)``. With h zero at both
    phases, flat at the other and of slope one at its own, small changes of the data give
    ``2 Re(h_1 dz_1 + h_2 dz_2) = a d(own)``. That is
    ``h = (1 - cos(t - other)) (alpha sin(t - own) + beta (1 - cos(t - own)))`` with alpha for the
    slope and beta against the constant.
    """
    apart = other - own
    alpha = 1 / max(1 - np.cos(apart), 1e-300)
    beta = alpha * np.sin(apart) / (2 + np.cos(apart))
    u, v = np.exp(-1j * own), np.exp(-1j * other)
    first = u * (-0.5j * alpha - 0.5 * beta)
    h1, h2 = first - 0.5 * beta * v, -0.5 * v * first
    return float(2 * np.sqrt((abs(h1) * sigma_low) ** 2 + (abs(h2) * sigma_high) ** 2))
