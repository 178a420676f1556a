"""What the spectral methods share: checks of the frequencies, and how many returns a pixel has.

A method proposes the ranges of L returns. Here L = 1, 2, ... are tried in turn, each fitted by
`_spectral_fit`, until the residual is explained by the noise: chi-squared of 2 F - 2 L degrees of
freedom below the value that noise alone exceeds in a share `FALSE_ALARM` of the pixels.
Reference: the chi-squared test of nested models is textbook; that a pixel gets no more returns
than its noise asks for is ours (the papers fix the number or read it from eigenvalues), and
without it lone returns come with false ones. Inputs: a method's proposals. Fails, by design, where
a second return is hidden in the noise: the pixel then counts as one return, and the bias that is
left is not in its sigma.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.correct._propagate import propagated_sigma_m
from toftools.correct._spectral_fit import Fit, fit_returns
from toftools.correct._spectral_restart import add, split
from toftools.correct._spectral_roots import MOST, Complexes
from toftools.correct._spectral_run import Separate
from toftools.types import F64, Bool, Sensor

FALSE_ALARM = 1e-4
"""Share of pixels with L returns that are tried with more."""
POOR = 0.05
"""Chi-squared that noise exceeds in this share of the pixels makes the fit start again."""
Propose = Callable[[Complexes, F64, int], F64]
"""Phasors (F, P), noise (F, P) and number of returns L to ranges (L, P), m."""


def equispaced(sensor: Sensor, *, name: str, least: int, harmonic: bool) -> NDArray[np.intp]:
    """Order in which the frequencies of a sensor ascend in equal steps.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies.
    name : str
        Method, for the error message.
    least : int
        Frequencies it needs.
    harmonic : bool
        Whether the step must be the lowest frequency: f, 2 f, 3 f ...

    Returns
    -------
    ndarray, (F,), int
        Indices of ascending frequencies.

    Raises
    ------
    ValueError
        If there are too few frequencies, or they are not equispaced (to 1e-6 of the step).
    """
    freqs = sensor.modulation.freqs_hz
    order = np.argsort(freqs)
    ascending = freqs[order]
    fits = freqs.size >= max(least, 2)
    if fits:
        step = (ascending[-1] - ascending[0]) / (freqs.size - 1)
        first = step if harmonic else ascending[0]
        wanted = first + step * np.arange(freqs.size)
        fits = step > 0 and bool((np.abs(ascending - wanted) <= 1e-6 * step).all())
    if not fits:
        kind = "f, 2 f, 3 f, ..." if harmonic else "in equal steps"
        got = f"{freqs.tolist()} Hz"
        msg = f"{name} needs {least} or more frequencies {kind}, got {got}; use 'bhandari2014'"
        raise ValueError(msg)
    return order


def check_dials(returns: int, refine: int, first_share: float) -> None:
    """Refuse parameters out of range.

    Parameters
    ----------
    returns, refine : int
        Most returns, most steps of the fit.
    first_share : float
        Least share of a return.

    Raises
    ------
    ValueError
        If one is out of range.
    """
    if not 1 <= returns <= MOST:
        msg = f"returns must be 1..{MOST}, got {returns}"
        raise ValueError(msg)
    if refine < 0:
        msg = f"refine must be 0 or more steps, got {refine}"
        raise ValueError(msg)
    if not 0 < first_share < 1:
        msg = f"first_share must be between 0 and 1, got {first_share}"
        raise ValueError(msg)


def least_returns(
    k: F64, propose: Propose, *, most: int, refine: int, period_m: float, rough_m: float = 0.0
) -> Separate:
    """Separation into the fewest returns that explain each pixel.

    Parameters
    ----------
    k : ndarray, (F,)
        ``4 pi f / c``, rad/m.
    propose : callable
        The method.
    most : int
        Most returns to try.
    refine : int
        Most steps of the fit per number of returns; 0 keeps what is proposed.
    period_m : float
        Range after which all phases repeat, m.
    rough_m : float
        Step of the grid that proposals lie on, m; 0 where they are a smooth function of the data.

    Returns
    -------
    callable
        Phasors and noise to `Fit` of (most, P) returns, NaN and amplitude 0 for none. `sigma_m`
        is the bound, which the fit reaches; that of proposals as they are is carried through
        them, or has the grid added. Where no number of returns explains the pixel, that of
        the fit and that of a grid are stretched by the root of chi-squared over its degrees of
        freedom.
    """

    def one_order(z: Complexes, noise: F64, before: Fit, order: int) -> tuple[Fit, Bool]:
        """Best fit of up to so many returns, and where that leaves the pixel unexplained."""
        free = max(2 * (k.size - order), 1)
        # Indexing leaves arrays in either order, and kernels want one.
        z, noise = np.ascontiguousarray(z), np.ascontiguousarray(noise)
        start = np.ascontiguousarray(propose(z, noise, order))
        found = fit_returns(z, noise, k, start, refine)
        if refine == 0:
            own = _spread(found, z, noise, propose, period_m, rough_m)
            found = found._replace(sigma_m=own)
        best = _better(before, found)
        if refine and order > 1:
            best = _again(best, before, z, noise, k, order, refine, period_m)
        return best, best.chi2 > chi2_limit(free)

    def separate(z: Complexes, noise: F64) -> Fit:
        n = z.shape[1]
        ranges_m, sigma_m = np.full((2, most, n), np.nan)
        best = Fit(ranges_m, np.zeros((most, n)), sigma_m, np.full(n, np.inf))
        todo = np.arange(n)
        for order in range(1, most + 1):
            if todo.size == 0:
                break
            found, still = one_order(z[:, todo], noise[:, todo], _some(best, todo), order)
            for whole, part in zip(best, found, strict=True):
                whole[..., todo] = part
            todo = todo[still]
        free = max(2 * (k.size - most), 1)
        if refine or rough_m:
            best.sigma_m[:, todo] *= np.sqrt(np.minimum(best.chi2[todo], 1e12) / free)
        return best

    return separate


def _again(
    best: Fit,
    before: Fit,
    z: Complexes,
    noise: F64,
    k: F64,
    order: int,
    refine: int,
    period_m: float,
) -> Fit:
    """Fits that start from elsewhere, where the residual is larger than noise usually leaves."""
    limit = chi2_limit(max(2 * (k.size - order), 1), POOR)
    for restart in (split, add):
        poor = best.chi2 > limit
        if not poor.any():
            break
        some = np.ascontiguousarray(z[:, poor])
        its_noise = np.ascontiguousarray(noise[:, poor])
        start = restart(some, its_noise, k, _some(before, poor), order, period_m)
        found = fit_returns(some, its_noise, k, np.ascontiguousarray(start), refine)
        for whole, part in zip(best, _better(_some(best, poor), found), strict=True):
            whole[..., poor] = part
    return best


def _some(fit: Fit, pixels: NDArray[Any]) -> Fit:
    return Fit(*(part[..., pixels] for part in fit))


def _better(before: Fit, found: Fit) -> Fit:
    """The new fit where it has positive amplitudes, determined ranges, a smaller residual."""
    n = len(found.amplitudes)
    sound = (found.amplitudes > 0) & np.isfinite(found.sigma_m)
    better = sound.all(axis=0) & (found.chi2 < before.chi2)
    out = Fit(*(part.copy() for part in before))
    for whole, part in zip(out[:3], found[:3], strict=True):
        whole[:n, better] = part[:, better]
    out.chi2[better] = found.chi2[better]
    return out


def _spread(
    found: Fit, z: Complexes, noise: F64, propose: Propose, period_m: float, rough_m: float
) -> F64:
    """Standard deviation of ranges as proposed, (L, P)."""
    if rough_m:
        return np.asarray(np.hypot(found.sigma_m, rough_m / np.sqrt(12)))

    def of_one(here: F64) -> F64:
        def nearest(values: Complexes) -> F64:
            ranges_m = propose(values, noise, len(found.ranges_m))
            off = np.mod(ranges_m - here + period_m / 2, period_m) - period_m / 2
            best = np.abs(off).argmin(axis=0)[None]
            return np.asarray(np.take_along_axis(ranges_m, best, axis=0)[0])

        return propagated_sigma_m(nearest, z, noise, period_m=period_m)

    return np.stack([of_one(here) for here in found.ranges_m])


def chi2_limit(free: int, share: float = FALSE_ALARM) -> float:
    """Chi-squared that noise alone exceeds in a share of the pixels.

    Parameters
    ----------
    free : int
        Degrees of freedom.
    share : float
        Share of the pixels.

    Returns
    -------
    float
        The limit.

    Examples
    --------
    >>> round(chi2_limit(2), 2)  # -2 ln 1e-4
    18.42
    """
    from scipy.stats import chi2

    return float(chi2.isf(share, free))
