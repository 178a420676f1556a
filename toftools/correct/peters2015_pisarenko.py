"""Pisarenko estimate of Peters et al.: m returns from m harmonic frequencies.

Phasors at f, 2 f, ... m f are the trigonometric moments ``c_n = sum_l a_l exp(j n phi_l)``. Their
Hermitian Toeplitz matrix with c_0, the total light, on its diagonal is positive semi-definite, and
singular exactly when m or fewer returns make it up: then its null vector is a polynomial whose
roots lie on the unit circle, at the returns (Caratheodory). c_0 is not measured, since ambient
light adds to it; the matrix itself tells: it is the matrix with zero diagonal plus c_0, so the
least c_0 that is possible is minus its smallest eigenvalue, and is the right one for up to m
returns. Reference: Peters et al., SIGGRAPH Asia 2015 (below; abstract read, the rest derived here;
that Pisarenko needs no c_0 is a classical fact). Input: two or more harmonics of the lowest
frequency. The first `_spectral_roots.MOST` of them make the matrix. Ours: the order of the
returns, by what each explains; fewer of them where the noise is content with fewer; and the fit
to all phasors after it (`refine`).

When it fails; 20/40/60/80 MHz, noise in percent of the first return:

- Amplitudes that depend on frequency (uncalibrated contrast) break the moments.
- As published it always finds m returns, all positive: noise of 2 % makes small ones, and may
  split a return in two. The test against the noise and `first_share` are there for that.
- Its efficiency as published is 0.3 to 0.4 at 2 % noise and 0.4 to 2 m, the best of the closed
  forms here: returns on the unit circle with positive amplitudes are built in. With the fit it is
  at the Cramer-Rao bound like kirmani2013, and sees what that sees.
- 320x240 pixels take 0.15 s of one core with one return each, 1.2 s with two.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import refuse_emitter_offset
from toftools.correct._spectral import check_dials, equispaced, least_returns
from toftools.correct._spectral_moments import pisarenko
from toftools.correct._spectral_prony import root_angles
from toftools.correct._spectral_roots import MOST, Complexes
from toftools.correct._spectral_run import runner
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import TWO_PI, ambiguity_m, phase_to_range, range_to_phase


def peters2015_pisarenko(
    sensor: Sensor, *, returns: int = 3, refine: int = 20, first_share: float = 0.05
) -> Callable[[Phasors], DepthMap]:
    """First of the fewest returns that explain each pixel, by the Pisarenko estimate.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies f, 2 f, 3 f ..., two or more.
    returns : int
        Most returns to try, 1..6; no more than there are frequencies.
    refine : int
        Most steps of the fit that follows per number of returns (ours); 0 answers with what the
        method itself finds.
    first_share : float
        The answer is the nearest return of at least this share of the strongest, 0..1.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``, with all returns in ``info``. `sigma_m` is the Cramer-Rao
        bound of as many returns as were found.

    Raises
    ------
    ValueError
        If the frequencies do not fit, a parameter is out of range, or the emitter is not at the
        camera.

    References
    ----------
    C. Peters, J. Klein, M. B. Hullin, R. Klein, "Solving trigonometric moment problems for fast
    transient imaging", ACM Transactions on Graphics 34 (2015), SIGGRAPH Asia.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> camera = sensor("deeptof:freqs=20e6+40e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(4.0j * turn)  # two returns, two frequencies
    >>> depth = peters2015_pisarenko(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].ravel().astype(float).round(3).tolist()
    [2.0, 4.0]
    """
    refuse_emitter_offset(sensor)
    check_dials(returns, refine, first_share)
    order = equispaced(sensor, name="peters2015_pisarenko", least=2, harmonic=True)
    freqs = sensor.modulation.freqs_hz[order]
    period_m = float(ambiguity_m(freqs[0]))

    def propose(z: Complexes, noise: F64, n_returns: int) -> F64:
        angles = root_angles(z, 1, True) if n_returns == 1 else pisarenko(z[:MOST])[0][:n_returns]
        return phase_to_range(np.mod(angles, TWO_PI), freqs[0])

    k = range_to_phase(1.0, freqs)
    most = min(returns, freqs.size)
    separate = least_returns(k, propose, most=most, refine=refine, period_m=period_m)
    return runner(sensor, separate, order=order, first_share=first_share, period_m=period_m)
