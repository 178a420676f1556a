"""Annihilating filter on equispaced frequencies, the closed form of Bhandari et al.

On ``f_n = f_0 + n df`` the L returns of a pixel are exponentials in n; the filter of L + 1 taps
that annihilates them is the null vector of the Toeplitz matrix of the phasors, its roots are the
ranges modulo ``c / (2 df)``, and amplitudes follow by least squares: no iteration. Reference:
Bhandari et al., "Resolving multipath interference in Kinect" (below; abstract read, formulation
recalled). The abstract asks for 2 L + 1 frequency measurements; 2 L complex phasors determine the
filter, and are what is asked for here. Input: equispaced frequencies. Against `kirmani2013` the
runs count in one direction only, as in Prony's method. Ours: the fit after it (`refine`), the
chi-squared test of L, and the joint ambiguity where f_0 is no multiple of df.

When it fails: where kirmani2013 fails, and see there for the figures. With four frequencies and
two returns the filter is exact, so that all noise goes into its roots: as published
(``refine=0``) its efficiency at 2 % noise and ratio 0.6 is 0.02 for returns 2 m apart and below
0.005 for 1.2 m and less, where a third of the second returns is lost besides (0.8 m). The fit
makes up for it, 1.0 as in kirmani2013, but lives on starting again from elsewhere
(`_spectral_restart`); at 0.5 % noise, ratio 0.2 and 0.4 m 1.4 % still end in a false minimum. Time
as kirmani2013.
"""

from collections.abc import Callable

from toftools.correct import refuse_emitter_offset
from toftools.correct._spectral import check_dials, equispaced, least_returns
from toftools.correct._spectral_prony import parts, ranges_of, root_angles
from toftools.correct._spectral_roots import Complexes
from toftools.correct._spectral_run import runner
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import range_to_phase


def bhandari2014_annihilating(
    sensor: Sensor, *, returns: int = 2, refine: int = 20, first_share: float = 0.05
) -> Callable[[Phasors], DepthMap]:
    """First of the fewest returns that explain each pixel, by an annihilating filter.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, equispaced, at least ``2 returns``.
    returns : int
        Most returns to try, 1..6.
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
    A. Bhandari, M. Feigin, S. Izadi, C. Rhemann, M. Schmidt, R. Raskar, "Resolving multipath
    interference in Kinect: an inverse problem approach", IEEE Sensors 2014.

    Examples
    --------
    >>> import numpy as np
    >>> from toftools.sensors import sensor
    >>> camera = sensor("deeptof:freqs=20e6+40e6+60e6+80e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.0j * turn)
    >>> depth = bhandari2014_annihilating(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].ravel().astype(float).round(3).tolist()
    [2.0, 3.0]
    """
    refuse_emitter_offset(sensor)
    check_dials(returns, refine, first_share)
    order = equispaced(sensor, name="bhandari2014_annihilating", least=2 * returns, harmonic=False)
    freqs = sensor.modulation.freqs_hz[order]
    k = range_to_phase(1.0, freqs)
    count, period_m = parts(freqs)

    def propose(z: Complexes, noise: F64, n_returns: int) -> F64:
        return ranges_of(root_angles(z, n_returns, False), z, freqs, count)

    separate = least_returns(k, propose, most=returns, refine=refine, period_m=period_m)
    return runner(sensor, separate, order=order, first_share=first_share, period_m=period_m)
