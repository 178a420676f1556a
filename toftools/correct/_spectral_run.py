"""What the spectral methods share: from phasors to the answer, block by block.

The noise of every pixel, the method itself, and the nearest strong return of what it finds.
Reference: ours. Inputs: a method that separates pixels, as `_spectral.least_returns` makes one.
Where the noise is unknown it is taken as `UNKNOWN_NOISE` of the root-mean-square amplitude.
Memory: some 16 (L + 1) bytes per pixel of the frame for at most L returns, and 30 MB for a block.
Fails on nothing of its own.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.correct import warm_up
from toftools.correct._returns import answer, sorted_returns
from toftools.correct._spectral_fit import Fit
from toftools.correct._spectral_roots import Complexes
from toftools.types import F64, Bool, DepthMap, Phasors, Sensor

UNKNOWN_NOISE = 0.01
"""Noise taken where it is unknown, relative to the root-mean-square amplitude."""
LEAST_NOISE = 1e-6
"""Noise below this, relative to that amplitude, is that of float32 phasors anyway."""
BLOCK = 32_768
"""Pixels at a time: bounds the memory of big frames."""

Separate = Callable[[Complexes, F64], Fit]
"""Phasors (F, P) and noise (F, P) to returns, NaN of amplitude 0 for none."""


def noise_of(values: Complexes, sigma: NDArray[Any] | None) -> tuple[F64, Bool]:
    """Noise of every pixel, assumed where it is not known.

    Parameters
    ----------
    values : ndarray, (F, P), complex
        Phasors.
    sigma : ndarray, (F, P), or None
        Standard deviation of their components, if known.

    Returns
    -------
    noise : ndarray, (F, P)
        Standard deviation, positive wherever there is light.
    known : ndarray, (P,), bool
        Where it was given.
    """
    level = np.sqrt((np.abs(values) ** 2).mean(axis=0))
    if sigma is None:
        return np.tile(UNKNOWN_NOISE * level, (len(values), 1)), np.zeros(level.shape, bool)
    given = np.asarray(sigma, dtype=np.float64)
    known = np.asarray((np.isfinite(given) & (given >= 0)).all(axis=0))
    least = np.where(known, LEAST_NOISE, UNKNOWN_NOISE) * level
    return np.fmax(np.where(known, given, 0.0), least), known


def _sorted(
    separate: Separate,
    z: Complexes,
    sigma: NDArray[Any] | None,
    first_share: float,
    period_m: float,
) -> F64:
    """Ranges, amplitudes and the standard deviation of the first return of a block, in rows."""
    noise, known = noise_of(z, sigma)
    found = separate(z, noise)
    ranges_m, amplitudes = sorted_returns(
        found.ranges_m, found.amplitudes, first_share=first_share, period_m=period_m
    )
    first = (found.amplitudes == amplitudes[0]).argmax(axis=0)[None]
    sigma_m = np.take_along_axis(found.sigma_m, first, axis=0)
    sigma_m = np.where(known & np.isfinite(sigma_m), sigma_m, np.nan)
    return np.concatenate([ranges_m, amplitudes, sigma_m])


def runner(
    sensor: Sensor,
    separate: Separate,
    *,
    order: NDArray[np.intp],
    first_share: float,
    period_m: float,
) -> Callable[[Phasors], DepthMap]:
    """The correction that answers with the nearest strong return.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies.
    separate : callable
        The method, on frequencies in `order`.
    order : ndarray, (F,), int
        Indices of the frequencies.
    first_share : float
        Least amplitude of the answer, relative to the strongest.
    period_m : float
        Range after which all phases repeat, m.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``, compiled.
    """
    n_freqs = sensor.modulation.n_freqs

    def run(phasors: Phasors) -> DepthMap:
        if phasors.values.shape[0] != n_freqs:
            msg = f"phasors must have {n_freqs} frequencies, got {phasors.values.shape[0]}"
            raise ValueError(msg)
        usable = phasors.valid & (phasors.values != 0).any(axis=0)
        pixels = np.flatnonzero(usable)
        whole = np.empty((0, 0), np.float32)
        for i in range(0, max(pixels.size, 1), BLOCK):
            here = pixels[i : i + BLOCK]
            z = phasors.values.reshape(n_freqs, -1)[:, here][order].astype(np.complex128)
            sigma = phasors.sigma
            if sigma is not None:
                sigma = sigma.reshape(n_freqs, -1)[:, here][order]
            part = _sorted(separate, z, sigma, first_share, period_m)
            if whole.size == 0:
                whole = np.full((len(part), usable.size), np.nan, np.float32)
            whole[:, here] = part
        images: NDArray[Any] = whole.reshape(-1, *usable.shape)
        most = len(whole) // 2
        return answer(
            images[:most],
            np.nan_to_num(images[most:-1], nan=0.0),
            usable,
            sigma_m=None if phasors.sigma is None else images[-1],
        )

    # Phasors that no few returns explain, so that every number of returns gets compiled.
    odd = np.exp(1j * np.arange(n_freqs) ** 2.0)[:, None, None].astype(np.complex64)
    run(Phasors(odd, np.full(odd.shape, 1e-3, np.float32)))
    warm_up(run, n_freqs)
    return run
