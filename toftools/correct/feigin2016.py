"""Returns in closed form from 2 L + 1 equispaced frequencies (Feigin et al.).

On ``f_n = f_0 + n df`` the L returns of a pixel are exponentials in n. The (L + 1)-square Toeplitz
matrix of 2 L + 1 phasors (with more of them, a taller one) is singular; its null vector is the
filter that annihilates them, the roots of the filter are the ranges, and amplitudes follow from
the Vandermonde system: no iteration, no start. Reference: Feigin et al., IEEE Sensors Journal 16
(2016), the journal form of Bhandari et al., IEEE Sensors 2014. Read in their abstracts: spectral
estimation, closed form, non-iterative, 2 L + 1 frequency measurements for L paths; the Toeplitz
matrix is recalled. Input: equispaced frequencies, in any order, with or without sigma.

Ours: the number of returns is the smallest whose residual the noise explains (_spectral.py), and
the roots, which only know the step df, are sharpened by the phases of their amplitudes: positive
amplitudes have none, so the phase left at the middle frequency is range, again in closed form. At
20..100 MHz it takes the error of a lone return from 2.6 to 1.1 times the bound, that of two returns
1 m apart from 13 to 3.5 times.
`bhandari2014_annihilating` asks for one frequency less and iterates afterwards: it attains the
bound, which this closed form does not.

When it fails: two returns at 20, 40 .. 100 MHz, the second half as strong. 2 m apart the error is
1.15 times the Cramer-Rao bound, 1 m apart 3.5 times, 0.6 m apart 10 times (28 mm at 0.5 % noise)
and 0.4 m apart 15 times (34 mm at 0.2 %; from 0.5 % on, 8 % of the pixels are more than 20 cm off
and sigma is too small by half). Time: at 320x240 and five frequencies 1.0 s of CPU for lone
returns and 1.9 s for two, nearly all for sigma. Memory: that of _spectral_run.py.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import refuse_emitter_offset
from toftools.correct._propagate import STEP
from toftools.correct._spectral import check_dials, chi2_limit, equispaced
from toftools.correct._spectral_fit import Fit, fit_returns
from toftools.correct._spectral_prony import parts, ranges_of, root_angles
from toftools.correct._spectral_roots import Complexes
from toftools.correct._spectral_run import runner
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import range_to_phase


def feigin2016(
    sensor: Sensor, *, returns: int = 2, first_share: float = 0.05
) -> Callable[[Phasors], DepthMap]:
    """First of the fewest returns that explain each pixel, in closed form.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, equispaced, at least ``2 returns + 1``.
    returns : int
        Most returns to try, 1..6.
    first_share : float
        The answer is the nearest return of at least this share of the strongest, 0..1.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``, with all returns in ``info``. `sigma_m` is the noise carried
        through the closed form.

    Raises
    ------
    ValueError
        If the frequencies do not fit, a parameter is out of range, or the emitter is not at the
        camera.

    References
    ----------
    M. Feigin, A. Bhandari, S. Izadi, C. Rhemann, M. Schmidt, R. Raskar, "Resolving multipath
    interference in Kinect: an inverse problem approach", IEEE Sensors Journal 16 (2016).

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> camera = sensor("deeptof:freqs=20e6+40e6+60e6+80e6+100e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.0j * turn)
    >>> depth = feigin2016(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].ravel().astype(float).round(3).tolist()
    [2.0, 3.0]
    """
    refuse_emitter_offset(sensor)
    check_dials(returns, 0, first_share)
    order = equispaced(sensor, name="feigin2016", least=2 * returns + 1, harmonic=False)
    freqs = sensor.modulation.freqs_hz[order]
    count, period_m = parts(freqs)

    k = np.asarray(range_to_phase(1.0, freqs))

    def propose(z: Complexes, order: int) -> F64:
        return sharpened(ranges_of(root_angles(z, order, False), z, freqs, count), z, freqs)

    def separate(z: Complexes, noise: F64) -> Fit:
        ranges_m, sigma_m = np.full((2, returns, z.shape[1]), np.nan)
        out = Fit(ranges_m, np.zeros(ranges_m.shape), sigma_m, np.full(z.shape[1], np.inf))
        todo = np.arange(z.shape[1])
        for n in range(1, returns + 1):
            here = np.ascontiguousarray(z[:, todo])
            its_noise = np.ascontiguousarray(noise[:, todo])
            found = fit_returns(here, its_noise, k, propose(here, n), 0)
            done = (found.chi2 <= chi2_limit(2 * (k.size - n))) | (n == returns)
            pixels, found = todo[done], Fit(*(part[..., done] for part in found))
            here = np.ascontiguousarray(here[:, done])
            its_noise = np.ascontiguousarray(its_noise[:, done])
            own = _carried(propose, here, its_noise, found.ranges_m, period_m)
            out.ranges_m[:n, pixels], out.sigma_m[:n, pixels] = found.ranges_m, own
            out.amplitudes[:n, pixels], out.chi2[pixels] = found.amplitudes, found.chi2
            todo = todo[~done]
        return out

    return runner(sensor, separate, order=order, first_share=first_share, period_m=period_m)


def _carried(
    propose: Callable[[Complexes, int], F64], z: Complexes, noise: F64, here: F64, period_m: float
) -> F64:
    """Noise carried through the closed form to all its ranges at once, (L, P), m.

    That of _propagate.py, where a moved return is the nearest of those that come back.
    """
    variance = np.zeros(here.shape)
    for f in range(len(z)):
        for part in (1.0, 1.0j):
            moved = z.copy()
            moved[f] += part * STEP * noise[f]
            change = propose(moved, len(here))[:, None] - here
            change = np.abs(np.mod(change + period_m / 2, period_m) - period_m / 2).min(axis=0)
            variance += (change / STEP) ** 2
    return np.asarray(np.sqrt(variance))


def sharpened(ranges_m: F64, z: Complexes, freqs_hz: F64) -> F64:
    """Ranges that leave the amplitudes no phase at the middle frequency.

    Parameters
    ----------
    ranges_m : ndarray, (L, P)
        Ranges, right to half a turn of the middle frequency, m.
    z : ndarray, (F, P), complex
        Phasors.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.

    Returns
    -------
    ndarray, (L, P)
        Ranges, m.
    """
    middle = freqs_hz[freqs_hz.size // 2]
    turns = np.exp(1j * range_to_phase(ranges_m, (freqs_hz - middle)[:, None, None]))  # (F, L, P)
    gram = np.einsum("flp,fmp->plm", turns.conj(), turns)
    gram += 1e-9 * np.eye(len(ranges_m))  # equal ranges share their amplitude
    right = np.einsum("flp,fp->pl", turns.conj(), z)
    carried = np.linalg.solve(gram, right[..., None])[..., 0].T  # a_l exp(j k_middle d_l)
    left = np.angle(carried * np.exp(-1j * range_to_phase(ranges_m, middle)))
    return np.ascontiguousarray(ranges_m + left / range_to_phase(1.0, middle))
