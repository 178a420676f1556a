"""What no unbiased method can beat at a capture: the Cramer-Rao bound of its range.

The model is one return per pixel in all frequencies, turns known, with the measured amplitude and
the phasors' own sigma (`crlb_multi_range_m`). An error beside it tells efficiency, as long as one
return is all there is: multipath is no noise, and of two returns the nearer one cannot be told as
well as a lone one (`crlb_returns_m`; its ranges and strengths are not known here).
"""

import numpy as np

from toftools.crlb import crlb_multi_range_m
from toftools.types import F64, Bool, Phasors


def bound_of(phasors: Phasors, freqs_hz: F64) -> F64:
    """Cramer-Rao bound of the range of every pixel, one return in it, turns known.

    Parameters
    ----------
    phasors : Phasors
        With sigma.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.

    Returns
    -------
    ndarray, (H, W)
        Standard deviation, m; infinite without signal, 0 without noise.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = np.abs(phasors.values).astype(np.float64) / np.asarray(phasors.sigma, np.float64)
        return crlb_multi_range_m(freqs_hz, snr)


def median_bound_m(phasors: Phasors, freqs_hz: F64, where: Bool) -> float | None:
    """Median of the bound over the pixels that are scored.

    Parameters
    ----------
    phasors : Phasors
        With or without sigma.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    where : ndarray, (H, W), bool
        Which pixels.

    Returns
    -------
    float or None
        m; None without a sigma or a pixel.
    """
    if phasors.sigma is None:
        return None
    bound_m = bound_of(phasors, freqs_hz)[where & phasors.valid]
    bound_m = bound_m[np.isfinite(bound_m)]
    return float(np.median(bound_m)) if bound_m.size else None
