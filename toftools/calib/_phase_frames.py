"""Frames of a warm-up as mean phases with temperatures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.calib._phase_errors import around_centre, centre, error_and_sigma, inliers
from toftools.conditions import conditions_of, name_of
from toftools.types import F64, Capture

WHICH = ("sensor_c", "light_c")
LEAST_FRAMES = 4
LEAST_SPAN_K = 2.0
"""Temperatures that rise by less say nothing about drift, K."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Means of the frames of a warm-up.

    Parameters
    ----------
    names : tuple of str, K
        Their files.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    mean_rad, sigma_rad : ndarray, (K, F)
        Mean phase error of each frame and its standard deviation by pixel noise, rad.
    celsius : ndarray, (K, 2)
        Temperatures of sensor and light; NaN throughout for one that no frame says.
    target : ndarray, (K,)
        Number of the target.
    """

    names: tuple[str, ...]
    freqs_hz: F64
    mean_rad: F64
    sigma_rad: F64
    celsius: F64
    target: NDArray[np.intp]


def frames_of(captures: Sequence[Capture]) -> Frames:
    """Means of frames with their temperatures.

    Parameters
    ----------
    captures : sequence of Capture
        Frames of a warm-up in the order of time.

    Returns
    -------
    Frames
        One row per frame.

    Raises
    ------
    ValueError
        If there are too few, a temperature is missing, or they span too little.
    """
    if len(captures) < LEAST_FRAMES:
        msg = f"temperature needs {LEAST_FRAMES} frames of kind warmup, got {len(captures)}"
        raise ValueError(msg)
    celsius = _celsius(captures)
    means, sigmas, places, targets = [], [], [], []
    for capture in captures:
        error, sigma = error_and_sigma(capture)
        layers = [around_centre(layer) for layer in error]
        near = [inliers(layer) for layer in layers]
        means.append([centre(layer) for layer in layers])
        sigmas.append(
            [np.sqrt((s[ok] ** 2).sum()) / ok.sum() for s, ok in zip(sigma, near, strict=True)]
        )
        told = conditions_of(capture)
        places.append((told.distance_m, told.normal, told.delay_s, told.reference))
        targets.append(places.index(places[-1]))
    mean = np.array(means)
    for f in range(mean.shape[1]):
        mean[:, f] = around_centre(mean[:, f])
    freqs = captures[0].sensor.modulation.freqs_hz
    names = tuple(name_of(capture) for capture in captures)
    target = np.unique(targets, return_inverse=True)[1]
    return Frames(names, freqs, mean, np.array(sigmas), celsius, target)


def _celsius(captures: Sequence[Capture]) -> F64:
    """Temperatures (K, 2), each known for all frames or for none."""
    told = [conditions_of(capture) for capture in captures]
    celsius = np.array([[c.sensor_c, c.light_c] for c in told])
    known = np.isfinite(celsius)
    if not known.any():
        msg = (
            f"{name_of(captures[0])} says neither sensor_c nor light_c, and no other frame of the "
            "warm-up does; add them to conditions.csv"
        )
        raise ValueError(msg)
    for column, name in enumerate(WHICH):
        gap = np.flatnonzero(~known[:, column])
        if known[:, column].any() and gap.size:
            msg = (
                f"{name_of(captures[int(gap[0])])} does not say {name}, which other frames of the "
                "warm-up say; add it to conditions.csv, or leave the frame out"
            )
            raise ValueError(msg)
    span = np.ptp(celsius[:, known[0]], axis=0)
    if span.max() < LEAST_SPAN_K:
        msg = (
            f"the warm-up spans {span.max():.1f} K, wanted {LEAST_SPAN_K:g} K or more; start it "
            "with a cold camera"
        )
        raise ValueError(msg)
    return celsius
