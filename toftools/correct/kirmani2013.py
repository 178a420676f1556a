"""SPUMIC: unwrapping and multipath in one, by spectral estimation on equispaced frequencies.

On ``f_n = f_0 + n df`` the returns of a pixel are exponentials in n, whose frequencies are the
ranges modulo ``c / (2 df)``: no phase is ever unwrapped, multipath or not. The annihilating
polynomial of L returns comes from total least squares over all runs of L + 1 neighbours, forward
and reversed, since its roots lie on the unit circle; L is what the noise asks for. Reference:
Kirmani, Benedetti, Chou, ICME 2013 (below). Of the paper only the abstract and the introduction
could be read; equispaced frequencies, roots and detection of L are as recalled, both directions
and total least squares are the standard form of what it calls robust. Input: at least 3 L / 2
equispaced frequencies, f_0 any. Ours: the fit after it (`refine`), the chi-squared test of L, and
the joint ambiguity where f_0 is no multiple of df (50, 70, 90 MHz: 15 m instead of 7.5 m).

When it fails; 20/40/60/80 MHz, noise in percent of the first return, ratio of second to first:

- As published (``refine=0``) it is far from the Cramer-Rao bound: at 2 % noise its efficiency
  (variance at the bound over its own) is 0.11 for returns 0.8 m apart, 0.02 for 1.2 m and 0.07 for
  2 m (ratio 0.6). With the fit it is 1.0 from 0.4 m on at ratio 0.6, from 0.8 m at ratio 0.2.
- Returns 0.4 m apart, ratio 0.2: half of the second ones go unseen at 2 % noise, nearly all at
  5 %; the bias of 5 cm stays, and `sigma_m` does not tell. Ratio 0.6: 58 % unseen at 5 %, none at
  2 %. From 0.8 m and ratio 0.6 on, none is missed at 5 %.
- Light that is no few returns (diffuse) is fitted by the most there may be.
- 320x240 pixels take 0.15 s of one core with one return each, 0.6 s with two; the pixels are shared
  by all cores.
"""

from collections.abc import Callable

from toftools.correct import refuse_emitter_offset
from toftools.correct._spectral import check_dials, equispaced, least_returns
from toftools.correct._spectral_prony import parts, ranges_of, root_angles
from toftools.correct._spectral_roots import Complexes
from toftools.correct._spectral_run import runner
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import range_to_phase


def kirmani2013(
    sensor: Sensor, *, returns: int = 2, refine: int = 20, first_share: float = 0.05
) -> Callable[[Phasors], DepthMap]:
    """First of the fewest returns that explain each pixel, by total least squares.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, equispaced, at least ``3 returns / 2``.
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
    A. Kirmani, A. Benedetti, P. A. Chou, "SPUMIC: Simultaneous phase unwrapping and multipath
    interference cancellation in time-of-flight cameras using spectral methods", ICME 2013.

    Examples
    --------
    >>> import numpy as np
    >>> from toftools.sensors import sensor
    >>> camera = sensor("deeptof:freqs=50e6+70e6+90e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(12.0j * turn) + 0.4 * np.exp(12.8j * turn)  # c / 2 df is 7.5 m
    >>> depth = kirmani2013(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"].ravel().astype(float).round(3).tolist()
    [12.0, 12.8]
    """
    refuse_emitter_offset(sensor)
    check_dials(returns, refine, first_share)
    # Runs of L + 1 neighbours, both ways: 2 (F - L) equations must be at least L.
    least = (3 * returns + 1) // 2
    order = equispaced(sensor, name="kirmani2013", least=least, harmonic=False)
    freqs = sensor.modulation.freqs_hz[order]
    k = range_to_phase(1.0, freqs)
    count, period_m = parts(freqs)

    def propose(z: Complexes, noise: F64, n_returns: int) -> F64:
        return ranges_of(root_angles(z, n_returns, True), z, freqs, count)

    separate = least_returns(k, propose, most=returns, refine=refine, period_m=period_m)
    return runner(sensor, separate, order=order, first_share=first_share, period_m=period_m)
