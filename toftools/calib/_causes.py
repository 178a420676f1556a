"""Which cause could explain how much of an error that is larger than its noise."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from toftools.types import F64

CAUSES = ("offset", "temperature", "lens", "cyclic", "amplitude", "pattern", "unexplained")
"""From the one with the least freedom to that with the most."""
NEARLY = 0.85
"""A cause that explains this share of what the largest one does is enough."""
LITTLE = 0.25
"""Share of the excess below which the largest cause is none."""
HARMONICS = 12
BEND = 4
"""Degree of the polynomials that stand for wrong rays."""
AMPLITUDE_BINS = 12
LEAST_SPAN_K = 1.0
"""Captures whose temperatures lie closer together than this say nothing about drift."""
LEAST_SPAN_LOG = 0.2
"""The same for amplitudes, natural logarithm of largest over smallest."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Range errors of one capture and what they may depend on.

    Parameters
    ----------
    error_mm, noise_mm : ndarray, (F, N)
        Measured minus expected range and its standard deviation, mm; NaN where unusable.
    phase_rad, amplitude : ndarray, (F, N)
        Measured phase, rad, and amplitude.
    place : ndarray, (2, N)
        Column and row of the pixels, from -1 at the left and upper edge to 1 at the others.
    distance_m : float
        Distance of the target along the axis, m; NaN if unknown.
    sensor_c, light_c : float
        Temperatures, degrees Celsius; NaN if unknown.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    """

    error_mm: F64
    noise_mm: F64
    phase_rad: F64
    amplitude: F64
    place: F64
    distance_m: float
    sensor_c: float
    light_c: float
    freqs_hz: F64

    @property
    def together(self) -> tuple[F64, F64]:
        """Error (N,) and noise (N,) of the mean weighted by inverse variances, mm."""
        weight = self.weights
        error = (weight * self.error_mm).sum(axis=0)
        return np.asarray(error), np.sqrt(((weight * self.noise_mm) ** 2).sum(axis=0))

    @property
    def weights(self) -> F64:
        """Share of every frequency in that mean, (F, N); squared frequencies without noise."""
        noisy = (self.noise_mm > 0).all(axis=0) | np.isnan(self.noise_mm).any(axis=0)
        precision = np.where(noisy, 1 / np.where(noisy, self.noise_mm, 1) ** 2,
                             self.freqs_hz[:, None] ** 2)  # fmt: skip
        return np.asarray(precision / precision.sum(axis=0))


def causes_mm2(errors: Sequence[Errors]) -> dict[str, float]:
    """Part of the excess variance that each cause could explain on its own.

    Parameters
    ----------
    errors : sequence of Errors
        Held-out captures after the chain.

    Returns
    -------
    dict of str to float
        Cause out of `CAUSES` to mm^2 of the mean over frequencies and pixels; what no cause
        explains is what the largest one leaves.
    """
    total = dict.fromkeys(CAUSES, 0.0)
    weight = np.nanmean(np.concatenate([one.weights for one in errors], axis=1), axis=1)
    for f, share in enumerate(weight / weight.sum()):
        for name, part in _causes_of(errors, f).items():
            total[name] += float(share) * part
    return total


def named_cause(parts: Mapping[str, float]) -> str:
    """The simplest cause that explains nearly as much as the one that explains most.

    Parameters
    ----------
    parts : mapping of str to float
        As `causes_mm2` gives them.

    Returns
    -------
    str
        A name out of `CAUSES`.

    Examples
    --------
    >>> named_cause({"offset": 9.0, "cyclic": 9.1, "pattern": 10.0, "unexplained": 0.5})
    'offset'
    """
    causes = {name: part for name, part in parts.items() if name != "unexplained"}
    most, rest = max(causes.values()), parts.get("unexplained", 0.0)
    if most <= LITTLE * (most + rest):
        return "unexplained"
    return next(name for name in CAUSES if causes.get(name, -1.0) >= NEARLY * most)


def _causes_of(errors: Sequence[Errors], f: int) -> dict[str, float]:
    e = np.stack([one.error_mm[f] for one in errors])  # (C, N)
    known = np.isfinite(e)
    noise2 = np.stack([one.noise_mm[f] for one in errors])[known] ** 2
    level = float(noise2.mean())
    excess = max(float(np.mean(e[known] ** 2)) - level, 0.0)
    offset = float(e[known].mean())
    centred = np.where(known, e - offset, np.nan)
    phase = np.stack([one.phase_rad[f] for one in errors])
    log_amplitude = np.log(np.maximum(np.stack([one.amplitude[f] for one in errors]), 1e-12))
    parts: Mapping[str, float] = {
        "offset": offset**2,
        "pattern": _pattern(centred, level),
        "lens": _lens(errors, centred, level),
        "cyclic": _explained(_waves(phase[known]), centred[known], level),
        "temperature": _temperature(errors, centred, level, offset),
        "amplitude": _amplitude(log_amplitude[known], centred[known], level),
    }
    found = {name: min(part, excess) for name, part in parts.items()}
    return {**found, "unexplained": excess - max(found.values())}


def _pattern(centred: F64, level: float) -> float:
    """Variance of the mean of every pixel over captures, beyond what their noise makes it."""
    known = np.isfinite(centred)
    count = known.sum(axis=0)
    seen = count > 0
    mean = np.where(known, centred, 0).sum(axis=0)[seen] / count[seen]
    return max(float(np.mean(mean**2) - level * np.mean(1 / count[seen])), 0.0)


def _lens(errors: Sequence[Errors], centred: F64, level: float) -> float:
    """A smooth course over the image that grows with distance, as wrong rays make it."""
    distance = np.array([one.distance_m for one in errors])
    known = np.isfinite(centred)
    if not np.isfinite(distance).all():
        return 0.0
    x, y = errors[0].place
    powers = [(i, j) for i in range(BEND + 1) for j in range(BEND + 1) if 0 < i + j <= BEND]
    shapes = np.stack([np.ones_like(x), *(x**i * y**j for i, j in powers)], axis=-1)  # (N, B)
    basis = distance[:, None, None] * shapes
    return _explained(basis[known], centred[known], level)


def _waves(phase_rad: F64) -> F64:
    order = np.arange(1, HARMONICS + 1)
    angle = np.multiply.outer(phase_rad, order)
    ones = np.ones((phase_rad.size, 1))
    return np.concatenate([ones, np.cos(angle), np.sin(angle)], axis=-1)


def _explained(basis: F64, centred: F64, level: float) -> float:
    """Variance of the least-squares fit of a few functions, less what noise makes of them."""
    fit = basis @ (np.linalg.pinv(basis.T @ basis, rcond=1e-12) @ (basis.T @ centred))
    part: float = float(np.mean(fit**2)) - level * basis.shape[1] / len(centred)
    return max(part, 0.0)


def _temperature(errors: Sequence[Errors], centred: F64, level: float, offset: float) -> float:
    """Course of the captures' means with their temperatures, straight lines.

    The offset counts with it: the check is usually colder or warmer than the walls were.
    """
    columns = []
    for name in ("sensor_c", "light_c"):
        values = np.array([getattr(one, name) for one in errors])
        if np.isfinite(values).all() and np.ptp(values) >= LEAST_SPAN_K:
            columns.append(values - values.mean())
    if not columns or len(errors) < 3 * len(columns):
        return 0.0
    means = np.array([np.nanmean(row) for row in centred])
    basis = np.stack([np.ones(len(errors)), *columns], axis=1)
    pixels = float(np.mean(np.isfinite(centred).sum(axis=1)))
    part = _explained(basis, means, level / pixels)
    return part + offset**2 if part else 0.0


def _amplitude(log_amplitude: F64, centred: F64, level: float) -> float:
    """Means over bins of amplitude, each holding as many pixels."""
    edges = np.quantile(log_amplitude, np.linspace(0, 1, AMPLITUDE_BINS + 1))
    if not math.isfinite(edges[-1]) or edges[-1] - edges[0] < LEAST_SPAN_LOG:
        return 0.0
    place = np.clip(np.searchsorted(edges, log_amplitude, "right") - 1, 0, AMPLITUDE_BINS - 1)
    count = np.bincount(place, minlength=AMPLITUDE_BINS)
    mean = np.bincount(place, centred, minlength=AMPLITUDE_BINS) / np.maximum(count, 1)
    part = float(count @ mean**2) - level * AMPLITUDE_BINS
    return max(part / centred.size, 0.0)
