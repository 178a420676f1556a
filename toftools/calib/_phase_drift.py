"""Robust linear fit of mean phases of warm-up frames over temperatures.

``mean[k, f] = offset[target, f] + slope[f] (T[k] - mean T)``: each target has an offset of its own,
outliers lose their weight (Huber, nothing beyond six deviations), and how many temperatures are
used is decided on held-out parts of the warm-up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.calib._choice import smallest
from toftools.calib._phase_errors import MAD_TO_SIGMA
from toftools.calib._phase_frames import LEAST_SPAN_K, WHICH, Frames
from toftools.types import F64

TOGETHER_K = 0.2
"""Two temperatures whose difference varies by less than this about a line are one, K."""
PARTS = 8
HUBER, CUT = 1.5, 6.0
ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Drift:
    """Fitted drift.

    Parameters
    ----------
    slope, sigma : ndarray, (F, 2)
        Drift and its standard deviation, rad/K.
    needs : tuple of str
        Temperatures in use.
    level_rad : ndarray, (K, F)
        What the fit says of each frame, offset included, rad.
    before_rad, after_rad, held_out_rad : ndarray, (K, F)
        Errors less the offset of the target: without, with, and with the stage fitted elsewhere;
        NaN for outliers.
    correlation : float
        Correlation of the residuals of neighbouring frames.
    notes : tuple of str
        Sentences.
    """

    slope: F64
    sigma: F64
    needs: tuple[str, ...]
    level_rad: F64
    before_rad: F64
    after_rad: F64
    held_out_rad: F64
    correlation: float
    notes: tuple[str, ...]


def fitted(frames: Frames) -> Drift:
    """Fit the drift with as few temperatures as the data ask for.

    Parameters
    ----------
    frames : Frames
        Means of frames.

    Returns
    -------
    Drift
        The fit.
    """
    models, notes = _models(frames.celsius)
    parts = _parts(frames)
    held = [_held_out(frames, model, parts) for model in models]
    scale = _spreads(frames, _fit(frames, models[-1])[2], models[-1])
    used = np.unique(parts)
    # Outliers count alike against all models.
    costs = [np.minimum((h / scale) ** 2, CUT**2).sum(axis=1) for h in held]
    losses = np.array([[cost[parts == p].sum() for p in used] for cost in costs])
    shares = np.array([(parts == p).sum() for p in used], dtype=np.float64)
    # Of the models with one temperature only the better one competes.
    order = [0, 1 + int(np.argmin(losses[1:3].sum(axis=1))), *range(3, len(models))]
    if len(models) == 2:
        order = [0, 1]
    best = order[smallest(losses[order], shares)]
    columns = models[best]
    slope, sigma, after, level, correlation = _fit(frames, columns)
    if not columns:
        notes.append("held-out parts of the warm-up show no drift: the stage changes nothing")
    limit = CUT * _spreads(frames, after, columns)
    bad = np.asarray((np.abs(after) > limit).any(axis=1), dtype=np.bool_)
    if bad.any():
        names = ", ".join(name for name, out in zip(frames.names, bad, strict=True) if out)
        notes.append(f"taken for outliers and left out: {names}")
    above = frames.celsius[:, columns] - frames.celsius[:, columns].mean(axis=0)
    before = after + above @ slope[:, columns].T
    left = [np.where(bad[:, None], np.nan, x) for x in (before, after, held[best])]
    needs = tuple(WHICH[c] for c in columns)
    return Drift(slope, sigma, needs, level, left[0], left[1], left[2], correlation, tuple(notes))


def _spreads(frames: Frames, rest: F64, columns: list[int]) -> F64:
    rank = int(frames.target.max()) + 1 + len(columns)
    noise = np.median(frames.sigma_rad, axis=0)
    pairs = zip(rest.T, noise, strict=True)
    return np.array([_spread(column, rank, float(least)) for column, least in pairs])


def _models(celsius: F64) -> tuple[list[list[int]], list[str]]:
    """Columns of temperatures of each candidate, from small to large, and what to know."""
    known = [c for c in range(2) if np.isfinite(celsius[:, c]).all()]
    alive = [c for c in known if np.ptp(celsius[:, c]) >= LEAST_SPAN_K]
    models, notes = [[], *([c] for c in alive)], []
    if len(known) == 1:
        notes.append(f"only {WHICH[known[0]]} is known: it stands for both temperatures")
    elif len(alive) == 1:
        notes.append(f"{WHICH[1 - alive[0]]} hardly changed: the drift is fitted to the other one")
    else:
        first, second = (celsius - celsius.mean(axis=0)).T
        apart = second - first * (first @ second) / (first @ first)
        if float(np.sqrt(np.mean(apart**2))) >= TOGETHER_K:
            models.append([0, 1])
        else:
            notes.append(
                "sensor_c and light_c rise together (apart by "
                f"{np.sqrt(np.mean(apart**2)):.2f} K rms about a line): one is fitted for both"
            )
    return models, notes


def _parts(frames: Frames) -> NDArray[np.intp]:
    """Which part of the warm-up each frame belongs to: neighbours, equal ways of temperature."""
    part = np.zeros(frames.target.size, dtype=np.intp)
    known = np.isfinite(frames.celsius[0])
    for number in np.unique(frames.target):
        own = np.flatnonzero(frames.target == number)
        steps = np.abs(np.diff(frames.celsius[own][:, known], axis=0)).sum(axis=1)
        way = np.cumsum(np.r_[0.0, steps])
        share = way / way[-1] if way[-1] > 0 else np.linspace(0, 1, own.size)
        part[own] = np.minimum(share * PARTS, PARTS - 1).astype(np.intp)
    return part


def _fit(
    frames: Frames, columns: list[int], keep: NDArray[np.bool_] | None = None
) -> tuple[F64, F64, F64, F64, float]:
    """Slopes (F, 2), their sigma, residuals (K, F), fitted levels and correlation.

    Frames outside `keep` have no part in the fit, but a residual.
    """
    inside = np.ones(frames.target.size, bool) if keep is None else keep
    above = (frames.celsius - frames.celsius.mean(axis=0))[:, columns]
    dummies = (frames.target[:, None] == np.arange(frames.target.max() + 1)).astype(np.float64)
    design = np.hstack([dummies, above])
    n_freqs, n = frames.freqs_hz.size, dummies.shape[1]
    slope, sigma = np.zeros((n_freqs, 2)), np.zeros((n_freqs, 2))
    rest, correlations = np.zeros_like(frames.mean_rad), []
    for f in range(n_freqs):
        noise = float(np.median(frames.sigma_rad[:, f]))
        theta, covariance, weight = _robust(design[inside], frames.mean_rad[inside, f], noise)
        rest[:, f] = frames.mean_rad[:, f] - design @ theta
        near = rest[inside, f][weight > 0]
        correlations.append(_neighbours(near))
        # Residuals that follow each other count for fewer; white ones scatter by 1 / sqrt(K).
        lag = min(0.9, max(0.0, correlations[-1] - 2 / np.sqrt(near.size)))
        slope[f, columns] = theta[n:]
        sigma[f, columns] = np.sqrt(np.diag(covariance)[n:] * (1 + lag) / (1 - lag))
    return slope, sigma, rest, frames.mean_rad - rest, float(np.mean(correlations))


def _robust(design: F64, value: F64, noise: float) -> tuple[F64, F64, F64]:
    """Parameters, their covariance and final weights by iterated reweighting."""
    rank = int(np.linalg.matrix_rank(design))
    weight = np.ones(value.size)
    theta = np.linalg.pinv(design) @ value
    for _ in range(ROUNDS):
        rest = value - design @ theta
        away = np.abs(rest) / _spread(rest, rank, noise)
        weight = np.where(away < CUT, HUBER / np.maximum(away, HUBER), 0.0)
        weighted = design * weight[:, None]
        theta = np.linalg.pinv(weighted.T @ design) @ (weighted.T @ value)
    rest = value - design @ theta
    used, inner = weight > 0, weight == 1
    freedom = max(1, int(used.sum()) - rank)
    # Huber (1981), asymptotic variance: E psi^2 / (E psi')^2.
    scatter = float(((weight * rest) ** 2).sum()) / freedom / max(0.1, inner[used].mean()) ** 2
    covariance = np.linalg.pinv(design[used].T @ design[used]) * max(scatter, noise**2)
    return theta, covariance, weight


def _spread(rest: F64, rank: int, noise: float) -> float:
    """Robust standard deviation of residuals of a fit of some rank, no less than their noise."""
    shrunk = np.sqrt(rest.size / max(1, rest.size - rank))
    usual = MAD_TO_SIGMA * shrunk * float(np.median(np.abs(rest - np.median(rest))))
    return float(max(usual, noise, 1e-9))


def _neighbours(rest: F64) -> float:
    """Correlation of neighbours in a series."""
    total = float((rest**2).sum())
    return float((rest[1:] * rest[:-1]).sum()) / total if total > 0 and rest.size > 2 else 0.0


def _held_out(frames: Frames, columns: list[int], parts: NDArray[np.intp]) -> F64:
    """Error of each frame under a fit to the other parts, (K, F)."""
    out = np.full(frames.mean_rad.shape, np.nan)
    for part in np.unique(parts):
        inside = parts != part
        rest = _fit(frames, columns, inside)[2]
        out[~inside] = rest[~inside]
    return out
