"""What fits of phase stages share: errors of known targets, their noise, robust means.

A fit sees captures as one array of phase errors with a standard deviation each. Where phasors
carry no sigma it is taken from differences of neighbouring pixels, which a white pixel pattern
inflates: honest, if wide, for one capture, and replaced by the scatter of several.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib.residuals import phase_error_rad, same_sensor, wrap_half
from toftools.conditions import conditions_of, name_of
from toftools.phasor import phase_sigma_rad, phasors_of
from toftools.types import F64, Bool, Capture

LEAST_SHARE = 0.05
"""A frame with fewer usable pixels than this share is refused."""
LEAST_COHERENCE = 0.5
"""Mean resultant of phase differences of neighbours below which a frame holds noise: pure noise
has 0, a phase noise of 0.6 rad 0.7."""
GATE = 6.0
"""Pixels farther from the median than this many robust standard deviations are outliers."""
DECILES = 2.563
"""Distance of the first and the ninth decile of a normal distribution, standard deviations."""
MAD_TO_SIGMA = 1.4826
LEAST_SIGMA_RAD = 1e-7


@dataclass(frozen=True, eq=False)
class Errors:
    """Phase errors of K captures of one sensor.

    Parameters
    ----------
    names : tuple of str, K
        Their files.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    error_rad : ndarray, (K, F, H, W)
        Measured minus expected phase, rad, near their common centre; NaN where unusable.
    sigma_rad : ndarray, (K, F, H, W)
        Standard deviation by noise, rad.
    told : bool
        Whether that came with the phasors; False where it was guessed from neighbours.
    """

    names: tuple[str, ...]
    freqs_hz: F64
    error_rad: F64
    sigma_rad: F64
    told: bool


def picked(captures: Sequence[Capture], slot: str, *groups: tuple[str, ...]) -> list[Capture]:
    """Captures of the first group of kinds that occurs at all.

    Parameters
    ----------
    captures : sequence of Capture
        Anything with conditions.
    slot : str
        Stage that asks, for the message.
    *groups : tuple of str
        Kinds, in order of preference.

    Returns
    -------
    list of Capture
        At least one, all of one sensor.

    Raises
    ------
    ValueError
        If there is none, or resolutions or frequencies differ.
    """
    kinds = [conditions_of(capture).kind for capture in captures]
    for group in groups:
        found = [capture for capture, kind in zip(captures, kinds, strict=True) if kind in group]
        if found:
            same_sensor(found)
            return found
    wanted = ", or else ".join(" or ".join(group) for group in groups)
    got = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds))) or "none"
    msg = f"{slot} needs captures of kind {wanted}; got {got}"
    raise ValueError(msg)


def errors_of(captures: Sequence[Capture]) -> Errors:
    """Phase errors of captures of known targets.

    Parameters
    ----------
    captures : sequence of Capture
        One or more of the same sensor.

    Returns
    -------
    Errors
        Errors and noise.

    Raises
    ------
    ValueError
        If a target's distance is unknown, or a frame is black, saturated or otherwise unusable.
    """
    pairs = [error_and_sigma(capture) for capture in captures]
    error = np.stack([pair[0] for pair in pairs])
    for f in range(error.shape[1]):
        error[:, f] = around_centre(error[:, f])
    return Errors(
        tuple(name_of(capture) for capture in captures),
        captures[0].sensor.modulation.freqs_hz,
        error,
        np.stack([pair[1] for pair in pairs]),
        all(phasors_of(capture).sigma is not None for capture in captures),
    )


def error_and_sigma(capture: Capture) -> tuple[F64, F64]:
    """Phase error of a capture and its standard deviation, rad, (F, H, W); refuses empty frames."""
    phasors = phasors_of(capture)
    error = phase_error_rad(capture)
    refuse_empty(capture, error)
    told = phase_sigma_rad(phasors)
    if told is None:
        amplitude = np.abs(phasors.values).astype(np.float64)
        with np.errstate(divide="ignore"):
            # Shot noise: the variance of the phase goes with 1 / amplitude.
            shape = 1 / np.sqrt(amplitude / np.median(amplitude, axis=(1, 2), keepdims=True))
        sigma = np.asarray(_local_spread(error)[:, None, None] * shape)
    else:
        sigma = told.astype(np.float64)
    return error, np.maximum(np.where(np.isfinite(error), sigma, np.nan), LEAST_SIGMA_RAD)


def refuse_empty(capture: Capture, error_rad: F64) -> None:
    """Refuse a frame that holds no phase: saturated, black or invalid.

    Parameters
    ----------
    capture : Capture
        Where it comes from.
    error_rad : ndarray, (F, H, W)
        Its errors, NaN where unusable.

    Raises
    ------
    ValueError
        By name.
    """
    share = float(np.isfinite(error_rad).all(axis=0).mean())
    if share < LEAST_SHARE:
        msg = (
            f"{name_of(capture)} has {100 * share:.0f} % usable pixels (the others are saturated, "
            "black or invalid); take it again with an exposure that fits, or leave it out"
        )
        raise ValueError(msg)
    step = np.diff(error_rad, axis=-1)
    for f in range(error_rad.shape[0]):
        steps = step[f][np.isfinite(step[f])]
        if steps.size > 20 and abs(np.exp(1j * steps).mean()) < LEAST_COHERENCE:
            freq = capture.sensor.modulation.freqs_hz[f]
            msg = (
                f"{name_of(capture)} holds noise instead of a phase at {freq / 1e6:g} MHz (black "
                "or clipped?); take it again with more light, or leave it out"
            )
            raise ValueError(msg)


def _local_spread(error_rad: F64) -> F64:
    """Standard deviation of the phase per frequency from differences of neighbours, (F,)."""
    step = wrap_half(np.diff(error_rad, axis=-1)).reshape(error_rad.shape[0], -1)
    if step.shape[1] == 0:
        return np.full(error_rad.shape[0], np.pi)
    spread = MAD_TO_SIGMA * np.nanmedian(np.abs(step), axis=1) / np.sqrt(2)
    return np.asarray(np.nan_to_num(spread, nan=np.pi))


def around_centre(error_rad: F64) -> F64:
    """Angles within half a turn of their circular median, NaN kept.

    Parameters
    ----------
    error_rad : ndarray
        Angles, rad.

    Returns
    -------
    ndarray
        The same directions without a wrap near the centre.

    Examples
    --------
    >>> around_centre(np.array([3.1, -3.1])).round(2).tolist()
    [3.1, 3.18]
    """
    finite = error_rad[np.isfinite(error_rad)]
    if not finite.size:
        return error_rad
    mean = float(np.angle(np.exp(1j * finite).sum()))
    median = mean + float(np.median(wrap_half(finite - mean)))
    return np.asarray(median + wrap_half(error_rad - median))


def inliers(values: F64) -> Bool:
    """Values that are finite and near their median, by the spread of the deciles.

    Parameters
    ----------
    values : ndarray
        Numbers, NaN for none.

    Returns
    -------
    ndarray of bool
        False for up to a tenth of outliers on each side; a wide or lopsided pattern loses none.
    """
    low, middle, high = np.percentile(values[np.isfinite(values)], (10, 50, 90))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(values - middle) <= GATE * max((high - low) / DECILES, 1e-12))


def centre(values: F64) -> float:
    """Mean of the inliers: the plain mean where there are no outliers.

    Parameters
    ----------
    values : ndarray
        Numbers, NaN for none.

    Returns
    -------
    float
        The gauge of common phase and fixed pattern alike.
    """
    return float(values[inliers(values)].mean())
