"""The tilt of a wall out of phase errors, where it can be told from the pattern of the pixels.

A plane ``z`` metres away whose normal is off by a small angle reads wrong by ``z h(u, v)``: in
proportion to the distance and alike in metres at all frequencies. A delay that grows across the
sensor (its clock tree) is alike in metres too, but does not grow with distance. So walls at
different distances that share a normal tell them apart, and walls at one distance do not: then all
that looks like a tilt is taken for one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toftools.calib._phase_errors import Errors
from toftools.calib._phase_pixels import two_way
from toftools.camera import rays
from toftools.conditions import conditions_of, name_of, with_conditions
from toftools.types import F64, Bool, Capture
from toftools.units import phase_to_range

LEAST_LEVER = 1.3
"""Ratio of the farthest to the nearest wall from which on tilt and pattern are separated."""
MOST_PIXELS = 4000
ROUNDS = 3


@dataclass(frozen=True)
class Tilt:
    """Estimated normal of all walls.

    Parameters
    ----------
    normal : tuple of 3 floats
        Normal, z component -1.
    sigma_deg : float
        Standard deviation of its direction, degrees.
    separated : bool
        Whether distances tell it from the pattern of the pixels.
    """

    normal: tuple[float, float, float]
    sigma_deg: float
    separated: bool


def check_tiltable(captures: Sequence[Capture]) -> None:
    """Refuse captures whose reference is no plane, or whose planes differ already.

    Parameters
    ----------
    captures : sequence of Capture
        Walls.

    Raises
    ------
    ValueError
        By name.
    """
    first = conditions_of(captures[0])
    for capture in captures:
        told = conditions_of(capture)
        if told.reference != "plane" or not np.allclose(told.normal, first.normal, atol=1e-6):
            msg = (
                f"{name_of(capture)} has another normal than {name_of(captures[0])}, or no plane "
                "as reference; tilt=true estimates one normal that all walls share"
            )
            raise ValueError(msg)


def tilted(captures: Sequence[Capture], normal: tuple[float, float, float]) -> list[Capture]:
    """The same captures of walls with another normal."""
    return [
        with_conditions(capture, replace(conditions_of(capture), normal=normal))
        for capture in captures
    ]


def estimate(captures: Sequence[Capture], errors: Errors) -> Tilt:
    """Least-squares normal, one for all walls, given errors under the normal they state.

    Parameters
    ----------
    captures : sequence of Capture
        Walls that state one normal.
    errors : Errors
        Their errors.

    Returns
    -------
    Tilt
        Normal and how sure.
    """
    from scipy.optimize import least_squares

    told = conditions_of(captures[0]).normal
    distances = np.array([conditions_of(capture).distance_m for capture in captures])
    separated = bool(distances.max() >= LEAST_LEVER * distances.min())
    slope, sigma = _per_metre(errors, distances, separated=separated)  # (F, N) each
    picked = _picked(np.asarray(np.isfinite(slope).all(axis=0)))
    directions = rays(captures[0].sensor.camera).reshape(-1, 3)[picked]
    slope, sigma = slope[:, picked], sigma[:, picked]
    level = _height(directions, np.asarray(told) / -told[2])

    def misfit(params: F64) -> F64:
        model = _height(directions, np.array([params[0], params[1], -1.0])) - level
        return np.asarray(((slope - model - params[2:, None]) / sigma).ravel())

    start = np.r_[told[0] / -told[2], told[1] / -told[2], np.median(slope, axis=1)]
    spread = max(float(np.median(np.abs(misfit(start)))), 1e-9)
    fit = least_squares(misfit, start, loss="soft_l1", f_scale=3 * spread, x_scale="jac")
    scatter = float(np.sqrt(np.mean(misfit(fit.x) ** 2)))
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * scatter**2
    normal = (float(fit.x[0]), float(fit.x[1]), -1.0)
    angle = float(np.degrees(np.sqrt(covariance[0, 0] + covariance[1, 1])))
    return Tilt(normal, angle, separated)


def _per_metre(errors: Errors, distances: F64, *, separated: bool) -> tuple[F64, F64]:
    """Range error per metre of distance and its noise, (F, N), per pixel.

    The slope over the walls of different distances; for one distance the pattern itself.
    """
    fit = two_way(errors)
    freqs = errors.freqs_hz[:, None, None]
    level = errors.error_rad - fit.capture_rad[:, :, None, None]
    range_m = phase_to_range(np.where(fit.weight > 0, level, 0.0), freqs)
    per_rad = phase_to_range(1.0, freqs)
    weight = fit.weight / per_rad**2
    total = weight.sum(axis=0)
    distance = distances[:, None, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (weight * distance).sum(axis=0) / total if separated else 0.0
        lever = np.asarray(distance - mean)
        information = (weight * lever**2).sum(axis=0)
        slope = (weight * lever * range_m).sum(axis=0) / information
        sigma = 1 / np.sqrt(information)
    known = np.isfinite(slope) & np.isfinite(sigma)
    flat = (errors.freqs_hz.size, -1)
    return np.where(known, slope, np.nan).reshape(flat), np.where(known, sigma, 1.0).reshape(flat)


def _picked(usable: Bool) -> NDArray[np.intp]:
    """Indices of at most `MOST_PIXELS` usable pixels, evenly spread."""
    indices = np.flatnonzero(usable)
    return indices[:: max(1, indices.size // MOST_PIXELS)]


def _height(directions: F64, normal: F64) -> F64:
    """Range per metre of axial distance along each ray of a plane."""
    return np.asarray(normal[2] / (directions @ normal))
