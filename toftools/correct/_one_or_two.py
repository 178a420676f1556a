"""One return or two: what the two-return methods share around their inversions.

A two-return inversion is singular where there is only one: the second return is then made of
noise, and being anywhere, it may well be the nearer. So each pixel is first explained by one
return, ``z_i = a exp(j k_i d)`` at the most likely range of the walk in _wraps.py, and only where
the chi-squared of that, of 2 F - 2 degrees of freedom, is improbable are two returns asked for.
Reference: the test is textbook (likelihood ratio, Gaussian noise) and ours: the published methods
have none. Inputs: phasors whose amplitude depends on the frequency by no more than the contrast
that the sensor states. Fails where it does (a contrast not stated or calibrated away counts as a
second return), and where the second return is too weak to be noticed: the bias that it leaves, up
to some two or three sigma, is not in `sigma_m`. Memory: some 120 bytes per pixel of the frame.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toftools.correct._returns import answer, sorted_returns
from toftools.correct._wraps import Plan, plan, search
from toftools.types import F32, F64, DepthMap, Phasors, Sensor
from toftools.units import range_to_phase

BLOCK = 1 << 16
"""Pixels at a time: what a block needs is small against a frame of 4 Mpixel."""
LEAST_NOISE = 1e-5
"""Noise never counts as less than this share of the amplitude: phasors and ranges are float32."""

Split = Callable[[NDArray[np.complex128], F64], tuple[F64, F64, F64]]
"""Phasors (F, N) and their sigma to ranges, amplitudes and sigma of ranges, each (2, N)."""


@dataclass(frozen=True, eq=False)
class Test:
    """When one return is enough.

    Parameters
    ----------
    wavenumber : ndarray, (F,)
        Phase per metre of range, rad/m.
    gain : ndarray, (F,)
        What brings all frequencies to the same contrast; of mean 1.
    walk : Plan
        Search for the one return.
    limit : float
        Largest chi-squared that one return may leave.
    assumed_noise : float
        Sigma as a share of the rms amplitude where the noise is not known.
    """

    __test__ = False  # no test of pytest

    wavenumber: F64
    gain: F64
    walk: Plan
    limit: float
    assumed_noise: float


def lone_return_test(
    sensor: Sensor, max_range_m: float, *, false_alarm: float, assumed_noise: float, method: str
) -> Test:
    """Prepare the test of one return.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more.
    max_range_m : float
        Longest range, m; 0 for the joint ambiguity.
    false_alarm : float
        Share of lone returns that count as two, 0..1.
    assumed_noise : float
        Sigma as a share of the rms amplitude where the noise is not known.
    method : str
        Name for error messages.

    Returns
    -------
    Test
        What `returns_of` needs.

    Raises
    ------
    ValueError
        If a parameter is out of its bounds.
    """
    from scipy.special import chdtri

    if not 0 < false_alarm < 1:
        msg = f"false_alarm must lie between 0 and 1, got {false_alarm}; 0.001 is usual"
        raise ValueError(msg)
    if not (np.isfinite(assumed_noise) and assumed_noise > 0):
        msg = f"assumed_noise must be a positive share, got {assumed_noise}; 0.01 is usual"
        raise ValueError(msg)
    freqs = sensor.modulation.freqs_hz
    walk = plan(sensor, max_range_m, least_freqs=2, method=method)
    limit = float(chdtri(2 * freqs.size - 2, false_alarm))
    gain = 1 / np.broadcast_to(np.asarray(sensor.noise.contrast, dtype=np.float64), freqs.shape)
    return Test(range_to_phase(1.0, freqs), gain / gain.mean(), walk, limit, float(assumed_noise))


def check_first_share(first_share: float) -> None:
    """Refuse a share that no return can have.

    Parameters
    ----------
    first_share : float
        Least amplitude of a return, relative to the strongest.

    Raises
    ------
    ValueError
        If it is not in [0, 1).
    """
    if not 0 <= first_share < 1:
        msg = f"first_share must lie in 0..1, got {first_share}; 0.05 is usual"
        raise ValueError(msg)


def returns_of(
    phasors: Phasors, test: Test, split: Split, *, first_share: float, period_m: float
) -> DepthMap:
    """The first of one or two returns, pixel by pixel.

    Parameters
    ----------
    phasors : Phasors
        Values (F, H, W), with or without sigma.
    test : Test
        When one return is enough.
    split : callable
        The two-return inversion, for the pixels where it is not.
    first_share : float
        Returns weaker than this share of the strongest are ignored.
    period_m : float
        Range after which answers repeat, m; 0 if they do not.

    Returns
    -------
    DepthMap
        As `_returns.answer` has it, and ``info["chi2_one"]`` (H, W): what one return leaves.

    Raises
    ------
    ValueError
        If the number of frequencies is not the one planned for.
    """
    n_freqs, height, width = phasors.values.shape
    shape, n_pixels = (height, width), height * width
    noise, known = _noise(phasors, test.assumed_noise)
    found = search(Phasors(phasors.values, noise, phasors.valid), test.walk, top=1)
    usable = phasors.valid & (found.information > 0)
    values, noise = phasors.values.reshape(n_freqs, -1), noise.reshape(n_freqs, -1)
    lone_m, flat = found.range_m.reshape(-1), usable.reshape(-1)
    ranges, amplitudes = np.full((2, n_pixels), np.nan), np.zeros((2, n_pixels))
    sigma_m, chi2 = np.full(n_pixels, np.nan), np.full(n_pixels, np.nan, np.float32)
    for begin in range(0, n_pixels, BLOCK):
        at = begin + np.flatnonzero(flat[begin : begin + BLOCK])
        z = values[:, at].astype(np.complex128) * test.gain[:, None]
        s = noise[:, at].astype(np.float64) * test.gain[:, None]
        own_r, own_a, own_s, chi2[at] = _one(z, s, lone_m[at].astype(np.float64), test)
        more = np.flatnonzero(chi2[at] > test.limit)
        own_r[:, more], own_a[:, more], own_s[:, more] = split(z[:, more], s[:, more])
        ranges[:, at], amplitudes[:, at] = sorted_returns(
            own_r, own_a, first_share=first_share, period_m=period_m
        )
        sigma_m[at] = np.where(amplitudes[0, at] == own_a[0], own_s[0], own_s[1])
    sigma_m[~known.reshape(-1)] = np.nan
    several = (2, *shape)
    depth = answer(
        ranges.reshape(several),
        amplitudes.reshape(several),
        usable,
        sigma_m=None if phasors.sigma is None else sigma_m.reshape(shape),
    )
    return replace(depth, info={**depth.info, "chi2_one": chi2.reshape(shape)})


def _noise(phasors: Phasors, assumed: float) -> tuple[F32, NDArray[np.bool_]]:
    """Sigma of every phasor, assumed where unknown, and where it is known."""
    power = np.where(phasors.valid, np.abs(phasors.values), np.float32(0)).astype(np.float64) ** 2
    rms = np.sqrt(power.mean(axis=0))
    rms = np.where(rms > 0, rms, 1).astype(np.float32)  # kernels divide by the noise of all pixels
    if phasors.sigma is None:
        noise = np.broadcast_to(np.float32(assumed) * rms, power.shape)
        return np.asarray(noise, np.float32), np.zeros(rms.shape, np.bool_)
    known = np.all(np.isfinite(phasors.sigma) & (phasors.sigma > 0), axis=0, keepdims=True)[0]
    noise = np.where(known, phasors.sigma, np.float32(assumed) * rms)
    return np.asarray(np.maximum(noise, np.float32(LEAST_NOISE) * rms), np.float32), known


def _one(
    z: NDArray[np.complex128], sigma: F64, range_m: F64, test: Test
) -> tuple[F64, F64, F64, F64]:
    """The return at a given range: ranges, amplitudes, sigma (2, N), and chi-squared (N,)."""
    turn = np.exp(1j * test.wavenumber[:, None] * range_m)  # (F, N)
    weight = 1 / np.maximum(sigma, 1e-30) ** 2
    amplitude = np.sum(weight * (z * turn.conj()).real, axis=0) / weight.sum(axis=0)
    chi2 = np.sum(weight * np.abs(z - amplitude * turn) ** 2, axis=0)
    slope = np.sum(weight * test.wavenumber[:, None] ** 2, axis=0)
    sigma_m = 1 / np.sqrt(slope) / np.maximum(np.abs(amplitude), 1e-30)
    none = np.full_like(range_m, np.nan)
    amplitudes = np.stack([amplitude, np.zeros_like(amplitude)])
    return np.stack([range_m, none]), amplitudes, np.stack([sigma_m, none]), chi2
