"""Two returns of finite width in closed form from four equispaced frequencies.

Model: reflectivity over range is a sum of two Cauchy distributions, so that every return is an
exponential over frequency, ``z(f) = a exp(-w f) exp(j 4 pi f d / c)``: at ``f_0 + k F`` that is
``z_k = A p^k + B q^k``, k = 0..3, with complex A, B, p, q. Reference: the first method of J. P.
Godbaz, M. J. Cree, A. A. Dorrington, "Closed-form inverses for the mixed pixel/multipath
interference problem in AMCW lidar", Proc. SPIE 8296 (2012) 829618, which by its abstract "models
reflectivity as a Cauchy distribution over range and uses four measurements at different modulation
frequencies". Only the abstract was at hand: that the frequencies are equispaced and the returns
the roots of a characteristic polynomial is recalled, and the formulas are derived here:

    p + q = (z_0 z_3 - z_1 z_2) / D,   p q = (z_1 z_3 - z_2^2) / D,   D = z_0 z_2 - z_1^2,
    A = (z_1 - q z_0) / (p - q),       B = (z_1 - p z_0) / (q - p).

Ours: the range is in both the phase of p (repeating with the spacing F) and that of A (repeating
with f_0); the first says which turn of the second is meant, where f_0 is no multiple of F the two
unwrap each other over the joint ambiguity, and their mean is weighed by their covariance, which
small changes of the data give in closed form (`_duals`). The test for one return is ours too
(_one_or_two.py). Amplitudes are those at the lowest frequency.

Inputs: exactly four frequencies, equispaced, in any order. Amplitudes that fall off exponentially
with frequency, as demodulation contrast roughly does, are a width and do no harm to two returns.
Measured (20 to 80 MHz, noise 1 % of the stronger return, 2000 pixels a figure): 5 mm rms at 2 m of
separation, ratios 0.2 to 0.8; the two-return bound without widths is 2.4 mm: the widths cost that
much and more, the nearer the returns. A frame of 320 x 240 takes 124 ms of processor time where
all pixels have two returns, 85 ms where none has. A lone return whose amplitude falls by 20 % over
the frequencies stays one in 96 % of the pixels.
Fails where returns are close, sooner than the other methods, since a pair looks like one wide
return: at 1 m the rms is 53 to 65 mm (bound 4 mm, one return wrong by 40 to 357 mm) and normalised
errors spread by 1.1 to 1.7; at 0.6 m the median error is 76 to 132 mm and they spread by 2 to 6;
at 0.3 m nothing is gained. With noise of 0.1 % these distances halve: 12 mm at 0.6 m, 66 mm at
0.3 m. Weak second returns (ratio 0.05) are found in 0, 7, 30 and 53 % at 0.3, 0.6, 1 and 2 m.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools.correct import kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._one_or_two import check_first_share, lone_return_test, returns_of
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import TWO_PI, joint_ambiguity_m, range_to_phase

SPACING_TOLERANCE = 1e-3
"""Relative deviation of the spacings from their mean that still passes."""


def godbaz2012_cauchy(
    sensor: Sensor,
    *,
    first_share: float = 0.05,
    false_alarm: float = 0.001,
    assumed_noise: float = 0.01,
) -> Callable[[Phasors], DepthMap]:
    """First of one or two returns from four equispaced frequencies, in closed form.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies: four, equispaced, in any order.
    first_share : float
        Returns weaker than this share of the stronger are ignored.
    false_alarm : float
        Share of lone returns taken for two; one return is the answer where the chi-squared of
        its six degrees of freedom is less improbable than that.
    assumed_noise : float
        Sigma as a share of the rms amplitude, for that test, where sigma is not known.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the noise carried through the inversion, in
        closed form; where only one return counts although it is no sharp one, its half width is
        added. ``info``: `status`, `returns`, `ranges_m`, `amplitudes` (2, H, W), nearest first,
        and `chi2_one`, what one return leaves.

    Raises
    ------
    ValueError
        If the frequencies are not four equispaced ones, a parameter is out of range, or the
        emitter is not at the camera.

    References
    ----------
    J. P. Godbaz, M. J. Cree, A. A. Dorrington, "Closed-form inverses for the mixed
    pixel/multipath interference problem in AMCW lidar", Proc. SPIE 8296 (2012) 829618, first
    method (abstract; formulas derived here).

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("deeptof:freqs=20e6+40e6+60e6+80e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.1j * turn)  # at 2 m and, weaker, at 3.1 m
    >>> depth = godbaz2012_cauchy(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].round(4).ravel().tolist()
    [2.0, 3.0999999046325684]
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    order = np.argsort(freqs)
    steps = np.diff(freqs[order])
    spacing = float(steps.mean()) if steps.size else 0.0
    if freqs.size != 4 or not (np.abs(steps - spacing) < SPACING_TOLERANCE * spacing).all():
        got = f"{freqs.size}; " if freqs.size != 4 else f"{freqs.tolist()} Hz; "
        msg = (
            f"godbaz2012_cauchy needs four equispaced frequencies, got {got}"
            "use 'dorrington2011' for other frequencies"
        )
        raise ValueError(msg)
    check_first_share(first_share)
    test = lone_return_test(
        sensor, 0.0, false_alarm=false_alarm, assumed_noise=assumed_noise,
        method="godbaz2012_cauchy",
    )  # fmt: skip
    period_m = joint_ambiguity_m(freqs)
    wavenumbers = range_to_phase(1.0, [float(freqs[order[0]]), spacing])
    laps = max(round(period_m * float(wavenumbers[1]) / TWO_PI), 1)

    def split(z: NDArray[np.complex128], sigma: F64) -> tuple[F64, F64, F64]:
        range_m, amplitude, sigma_m, width_m = separate(
            kernel_input(z[order]), kernel_input(sigma[order]), wavenumbers[0], wavenumbers[1], laps
        )
        # One wide return that counts may be two close ones: nothing inside its width is known.
        alone = amplitude.min(axis=0) < first_share * amplitude.max(axis=0)
        return range_m, amplitude, np.where(alone, np.hypot(sigma_m, width_m), sigma_m)

    def run(phasors: Phasors) -> DepthMap:
        return returns_of(phasors, test, split, first_share=first_share, period_m=period_m)

    warm_up(run, 4)
    return run


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def separate(
    z: NDArray[np.complex128], sigma: F64, k_first: float, k_step: float, laps: int
) -> tuple[F64, F64, F64, F64]:
    """Both returns of every pixel.

    Parameters
    ----------
    z : ndarray, (4, N), complex
        Phasors in ascending order of frequency.
    sigma : ndarray, (4, N)
        Standard deviation of each phasor component.
    k_first, k_step : float
        Phase per metre of range at the lowest frequency and at the spacing, rad/m.
    laps : int
        Turns of the spacing within the joint ambiguity.

    Returns
    -------
    range_m, amplitude, sigma_m, width_m : ndarray, (2, N)
        Ranges, m, NaN where there is no second return; amplitudes at the lowest frequency;
        standard deviation of the ranges, m; half width at half maximum of the Cauchy
        distributions, m (noise makes it negative, too).
    """
    n = z.shape[1]
    range_m, amplitude = np.full((2, n), np.nan), np.zeros((2, n))
    sigma_m, width_m = np.full((2, n), np.nan), np.full((2, n), np.nan)
    for i in prange(n):
        z0, z1, z2, z3 = z[0, i], z[1, i], z[2, i], z[3, i]
        det = z0 * z2 - z1 * z1
        if abs(det) == 0:
            continue
        half = (z0 * z3 - z1 * z2) / det / 2
        root = np.sqrt(half * half - (z1 * z3 - z2 * z2) / det)
        if abs(root) == 0:
            continue
        for j in range(2):
            p = half + root if j == 0 else half - root
            q = half - root if j == 0 else half + root
            a = (z1 - q * z0) / (p - q)
            if abs(a) == 0 or abs(p) == 0:
                continue
            amplitude[j, i] = abs(a)
            width_m[j, i] = -np.log(abs(p)) / k_step
            variances = _duals(p, q, a, sigma[:, i])
            range_m[j, i], sigma_m[j, i] = _range(p, a, variances, k_first, k_step, laps)
    return range_m, amplitude, sigma_m, width_m


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _duals(p: complex, q: complex, a: complex, sigma: F64) -> tuple[float, float, float]:
    """Variance of the phase of p, of that of A, and their covariance.

    A cubic ``h(x) = sum_k h_k x^k`` turns the data into ``sum_k h_k z_k = A h(p) + B h(q)``. Of
    the cubics that are zero and flat at q, the one with value 0 and slope 1 at p gives ``A dp``
    from small changes of the data, the one with value 1 and slope 0 gives ``dA`` (Hermite).
    """
    d = p - q
    e = 3 * p - q
    slope = (-p * q * q, q * q + 2 * p * q, -2 * q - p, 1.0 + 0.0j)
    value = (q * q * e, -2 * q * q - 2 * q * e, e + 4 * q, -2.0 + 0.0j)
    of_p, of_a, both = 0.0, 0.0, 0.0
    for k in range(4):
        g = slope[k] / (d * d) / (a * p)
        h = value[k] / (d * d * d) / a
        of_p += (abs(g) * sigma[k]) ** 2
        of_a += (abs(h) * sigma[k]) ** 2
        both += (g * np.conj(h)).real * sigma[k] ** 2
    return of_p, of_a, both


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _range(
    p: complex, a: complex, variances: tuple[float, float, float],
    k_first: float, k_step: float, laps: int,
) -> tuple[float, float]:  # fmt: skip
    """Range of a return and its standard deviation, m, from the phases of p and A."""
    by_p = (np.arctan2(p.imag, p.real) % TWO_PI) / k_step
    by_a = np.arctan2(a.imag, a.real) / k_first
    turn = TWO_PI / k_first
    best, near, far = np.inf, 0.0, 0.0
    for lap in range(laps):
        coarse = by_p + lap * TWO_PI / k_step
        fine = by_a + round((coarse - by_a) / turn) * turn
        if abs(coarse - fine) < best:
            best, near, far = abs(coarse - fine), coarse, fine
    v_p, v_a = variances[0] / k_step**2, variances[1] / k_first**2
    both = variances[2] / (k_first * k_step)
    spread = max(v_p + v_a - 2 * both, 1e-300)
    share = (v_p - both) / spread  # of A's range; the least variance of a mean of the two
    variance = (v_p * v_a - both * both) / spread
    return near + share * (far - near), np.sqrt(max(variance, 0.0))
