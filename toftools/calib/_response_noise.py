"""Photon transfer: conversion gain and read noise from how variance grows with level.

``variance = K level + dark variance`` with the level above dark, K in DN per electron (EMVA
Standard 1288, Release 4.0 Linear). The variance is that of repeated taps: the same tap in captures
of one exposure, or the taps of one node where the light is not modulated. Patterns drop out of
differences between repeats, and so does a lamp that flickers, whose mean is taken off each repeat.
What rounding to numbers of the converter adds is known and taken off.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib._response_data import Level
from toftools.calib._response_fit import curve_values
from toftools.types import F64, Bool


@dataclass(frozen=True, eq=False)
class Transfer:
    """What photon transfer tells, in raw units.

    Parameters
    ----------
    gain, gain_sd : float
        Conversion gain, DN per electron; NaN without repeats of a flat.
    variance, variance_sd : float
        Temporal variance of a dark tap without that of rounding, DN squared; NaN if nothing
        repeats.
    noisy : ndarray, (H, W), bool
        Pixels whose variance is beyond what chance allows.
    covariance : float
        Of `gain` and `variance`.
    rounding : float
        Variance that the converter adds to a dark tap, DN squared.
    """

    gain: float
    gain_sd: float
    variance: float
    variance_sd: float
    noisy: Bool
    covariance: float = 0.0
    rounding: float = 0.0

    @property
    def read_e(self) -> float:
        """Noise of a dark tap, electrons."""
        return float(np.sqrt(max(self.variance, 0.0)) / self.gain)

    @property
    def read_e_sd(self) -> float:
        """Its standard deviation, electrons."""
        clean = max(self.variance, 1e-30)
        shares = self.variance_sd / (2 * clean), self.gain_sd / self.gain
        mixed = self.covariance / (clean * self.gain)
        return self.read_e * float(np.sqrt(max(shares[0] ** 2 + shares[1] ** 2 - mixed, 0)))


@dataclass(frozen=True, eq=False)
class Repeats:
    """Mean above dark (S, H, W) and variance (S, H, W) of S series of R repeats each."""

    mean: F64
    variance: F64
    spare: int
    use: Bool


def transfer(
    dark: Sequence[Level],
    lit: Sequence[Level],
    terms: F64,
    top: float,
    offset: F64,
    good: Bool,
    z_bad: float,
) -> Transfer:
    """Photon transfer over all exposures with repeats.

    Parameters
    ----------
    dark, lit : sequence of Level
        Levels.
    terms : ndarray, (J,)
        Curve.
    top : float
        Its unit.
    offset : ndarray, (N, H, W)
        Dark level, raw units.
    good : ndarray, (H, W), bool
        Pixels to average.
    z_bad : float
        Standard deviations of a normal law beyond which a pixel counts as noisy.

    Returns
    -------
    Transfer
        Gain, dark variance and noisy pixels.
    """
    groups = [list(dark)] + [
        [level for level in lit if level.exposure == e] for e in sorted({x.exposure for x in lit})
    ]
    found = [repeats(group, terms, top, offset, good) for group in groups]
    kept = [one for one in found if one is not None]
    if not kept:
        return Transfer(*(4 * (float("nan"),)), np.zeros_like(good))
    if all(one is None for one in found[1:]):  # the dark alone tells a variance, but no gain
        variance = _points(kept, np.zeros_like(good), typical=True)[1]
        noisy = _noisy(kept, (0.0, float(variance.mean())), z_bad)
        slope, sd = _flat(*_points(kept, noisy, typical=False)[1:])
    else:
        rough, _ = _line(*_points(kept, np.zeros_like(good), typical=True))
        noisy = _noisy(kept, rough, z_bad)
        slope, sd = _line(*_points(kept, noisy, typical=False))
    rounding = float(np.mean([np.mean(level.rounding) for level in dark]))
    return Transfer(slope[0], sd[0], slope[1], sd[1], noisy, sd[2], rounding)


def repeats(
    group: Sequence[Level], terms: F64, top: float, offset: F64, good: Bool
) -> Repeats | None:
    """Repeated taps among captures of one exposure.

    Parameters
    ----------
    group : sequence of Level
        Captures of one exposure.
    terms, top, offset, good
        As of `transfer`.

    Returns
    -------
    Repeats or None
        Mean and variance; None where nothing repeats.
    """
    nodes = offset.shape[0]
    values = np.stack([level.taps.values for level in group]).astype(np.float64)
    values = top * curve_values(terms, np.where(np.isfinite(values), values, 0.0) / top)
    r, f, k, h, w = values.shape
    values = values.reshape(r, f * k, h, w) - offset[np.arange(f * k) % nodes]
    rounding = np.stack([np.broadcast_to(x.rounding, (f, k, h, w)) for x in group])
    if r < 2:
        if group[0].modulated or f * k == nodes:
            return None
        values = values.reshape(f * k // nodes, nodes, h, w)
    rounding = rounding.reshape(values.shape).mean(axis=0)
    use = good & np.logical_and.reduce([level.ok for level in group])
    if not use.any():
        return None
    common = values[:, :, use].mean(axis=-1)
    values = values - (common - common.mean(axis=0))[:, :, None, None]
    variance = values.var(axis=0, ddof=1) - rounding
    return Repeats(values.mean(axis=0), variance, values.shape[0] - 1, use)


def _points(kept: Sequence[Repeats], noisy: Bool, *, typical: bool) -> tuple[F64, F64, F64]:
    """Level, variance and number of degrees of freedom per series."""
    from scipy.stats import chi2

    rows = []
    for one in kept:
        use = one.use & ~noisy
        for mean, variance in zip(one.mean, one.variance, strict=True):
            seen = variance[use]
            share = float(chi2.median(one.spare)) / one.spare
            size = float(np.median(seen)) / share if typical else float(seen.mean())
            rows.append((float(mean[use].mean()), size, float(use.sum() * one.spare)))
    level, size, count = np.array(rows).T
    return level, size, count


def _line(
    level: F64, variance: F64, count: F64
) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Weighted line: slope and value at the dark level, their deviations and covariance."""
    if not np.ptp(level) > 1e-3 * float(np.abs(level).max()):
        return _flat(variance, count)
    fitted = np.maximum(variance, 1e-30)
    basis = np.stack([level, np.ones_like(level)], axis=1)
    for _ in range(5):
        root = np.sqrt(count / 2) / np.maximum(fitted, 1e-12 * variance.max() + 1e-300)
        covariance = np.linalg.pinv((basis * root[:, None]).T @ (basis * root[:, None]))
        answer = covariance @ (basis * root[:, None]).T @ (variance * root)
        fitted = np.maximum(basis @ answer, 0.1 * variance)
    sd = np.sqrt(np.diag(covariance))
    return (float(answer[0]), float(answer[1])), (
        float(sd[0]),
        float(sd[1]),
        float(covariance[0, 1]),
    )


def _flat(variance: F64, count: F64) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """As `_line`, from one level: no slope."""
    mean = float(np.average(variance, weights=count))
    return (float("nan"), mean), (float("nan"), mean * float(np.sqrt(2 / count.sum())), 0.0)


def _noisy(kept: Sequence[Repeats], line: tuple[float, float], z_bad: float) -> Bool:
    """Pixels whose summed variance, over what the line expects, is no chi squared."""
    from scipy.stats import chi2, norm

    shape = kept[0].use.shape
    total, spare = np.zeros(shape), np.zeros(shape)
    slope = 0.0 if np.isnan(line[0]) else line[0]
    for one in kept:
        expected = np.maximum(line[1] + slope * np.maximum(one.mean, 0), 1e-30)
        total += np.where(one.use, (one.variance / expected).sum(axis=0) * one.spare, 0)
        spare += one.use * one.spare * one.mean.shape[0]
    limit = chi2.isf(norm.sf(z_bad), np.maximum(spare, 1))
    return np.asarray((spare > 0) & (total > limit))
