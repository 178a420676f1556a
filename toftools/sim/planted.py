"""Closed forms whose later returns are planted: the models of methods for several returns.

A wall answers, and after it as much light as one likes, as late as one likes; no geometry makes
it. Input: a camera. Fails nowhere: it is what it says.
"""

import numpy as np

from toftools.sim.shapes import C128, Transport, check_positive, wall
from toftools.types import Camera
from toftools.units import range_to_phase


def two_returns(
    camera: Camera,
    *,
    range: float = 2.0,
    extra: float = 0.7,
    ratio: float = 0.3,
    albedo: float = 0.5,
) -> Transport:
    """Wall with one planted indirect return per pixel: the model of two-return methods.

    Parameters
    ----------
    camera : Camera
        Camera.
    range : float
        Distance of the wall along the optical axis, m.
    extra : float
        How much farther the second return seems to lie, m of range.
    ratio : float
        Strength of the second return relative to the first.
    albedo : float
        Diffuse albedo, 0..1.

    Returns
    -------
    Transport
        The second return counts as one indirect bounce.
    """
    return returns(camera, count=2, range=range, extra=extra, ratio=ratio, albedo=albedo)


def returns(
    camera: Camera,
    *,
    count: int = 3,
    range: float = 2.0,
    extra: float = 0.5,
    ratio: float = 0.5,
    albedo: float = 0.5,
) -> Transport:
    """Wall with several planted returns per pixel, evenly apart, each weaker than the one before.

    Parameters
    ----------
    camera : Camera
        Camera.
    count : int
        Returns in all, the wall's included.
    range : float
        Distance of the wall along the optical axis, m.
    extra : float
        How much farther each return seems to lie than the one before, m of range.
    ratio : float
        Strength of each return relative to the one before.
    albedo : float
        Diffuse albedo, 0..1.

    Returns
    -------
    Transport
        The nth return after the first counts as n indirect bounces.
    """
    check_positive(extra=extra)
    if not (count >= 1 and ratio >= 0):
        msg = f"count must be 1 or more and ratio must be 0 or more, got {count} and {ratio}"
        raise ValueError(msg)
    first = wall(camera, range=range, albedo=albedo)

    def phasor(freq_hz: float, max_bounces: int | None) -> C128:
        most = count if max_bounces is None else min(count, max_bounces + 1)
        later = ratio * np.exp(1j * range_to_phase(extra, freq_hz))
        return np.asarray(first.phasor(freq_hz, 0) * sum(later**n for n in np.arange(most)))

    return Transport(first.range_m, phasor)
