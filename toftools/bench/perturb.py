"""Phasors perturbed in a known way: noisier, farther, one pixel aside; `sensitivity` says how."""

from dataclasses import replace
from typing import Any

import numpy as np

from toftools.types import F64, Phasors
from toftools.units import range_to_phase

DEEPER = 0.01
"""Part of the range by which the scene moves away."""
SEED = 811_401
"""Of the noise; no capture of a suite has it."""


def noisier(phasors: Phasors) -> Phasors:
    """Phasors with one more draw of their own noise.

    Parameters
    ----------
    phasors : Phasors
        With sigma.

    Returns
    -------
    Phasors
        Perturbed, of the same sigma.
    """
    rng = np.random.default_rng(SEED)
    draw = rng.standard_normal((2, *phasors.values.shape))
    sigma = np.asarray(phasors.sigma)
    return replace(
        phasors, values=_kept(phasors, phasors.values + sigma * (draw[0] + 1j * draw[1]))
    )


def deeper(phasors: Phasors, true_m: F64, freqs_hz: F64) -> Phasors:
    """Phasors of light that comes from 1 % of the range farther.

    Parameters
    ----------
    phasors : Phasors
        (F, H, W).
    true_m : ndarray, (H, W)
        Range, m; NaN moves nothing.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.

    Returns
    -------
    Phasors
        Turned.
    """
    way_m = np.nan_to_num(DEEPER * true_m)
    turn = np.exp(1j * range_to_phase(way_m, freqs_hz[:, None, None]))
    return replace(phasors, values=_kept(phasors, phasors.values * turn))


def aside(phasors: Phasors) -> Phasors:
    """Phasors one column to the right.

    Parameters
    ----------
    phasors : Phasors
        (F, H, W).

    Returns
    -------
    Phasors
        The last column comes first, invalid.
    """
    valid = np.roll(phasors.valid, 1, axis=1)
    valid[:, 0] = False
    sigma = None if phasors.sigma is None else np.roll(phasors.sigma, 1, axis=2)
    return Phasors(np.roll(phasors.values, 1, axis=2), sigma, valid)


def _kept(phasors: Phasors, values: Any) -> Any:  # noqa: ANN401 - complex arrays
    """Perturbed values; what is invalid stays as it was, whatever it holds."""
    return np.where(phasors.valid, values, phasors.values).astype(np.complex64)
