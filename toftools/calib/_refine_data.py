"""What phase stages are refined on: pixels of every capture, one frequency at a time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toftools.calib.chain import Chain, applied
from toftools.calib.residuals import phase_error_rad, wrap_half
from toftools.conditions import conditions_of, with_conditions
from toftools.phasor import phase_sigma_rad, phasors_of
from toftools.types import F64, Bool, Capture

KINDS = ("rail", "delay", "wall", "gray", "warmup")
KEPT = 60_000
"""Most measurements to keep per frequency."""
LEAST_PIXELS = 16


@dataclass(frozen=True, eq=False)
class Pool:
    """Measurements of one frequency; C captures of P pixels.

    Parameters
    ----------
    phase_rad : ndarray, (C, P)
        Measured phase, rad.
    corrected_rad, amplitude : ndarray, (C, P)
        Phase and amplitude that the amplitude stage gets to see.
    celsius : ndarray, (C, 2)
        Temperatures of sensor and light source, degrees Celsius; NaN where unknown.
    error_rad : ndarray, (C, P)
        Measured minus expected phase, rad; 0 without weight.
    weight : ndarray, (C, P)
        Inverse variance; 0 for what is unusable.
    group : ndarray, (C,), int
        Captures of one group share the constant of each pixel. Targets at unknown distances are
        groups of their own.
    """

    phase_rad: F64
    corrected_rad: F64
    amplitude: F64
    celsius: F64
    error_rad: F64
    weight: F64
    group: np.ndarray[tuple[int], np.dtype[np.intp]]


def usable_captures(chain: Chain, captures: Sequence[Capture]) -> list[Capture]:
    """Captures that say something about phase, temperatures included where the chain needs them.

    Parameters
    ----------
    chain : Chain
        Stages to refine.
    captures : sequence of Capture
        Anything with conditions.

    Returns
    -------
    list of Capture
        Those of `KINDS` whose temperatures are known if the temperature stage needs them.
    """
    stage = chain.stage("temperature")
    needs: tuple[str, ...] = getattr(stage, "needs", ())
    found = []
    for capture in captures:
        told = conditions_of(capture)
        warm = all(np.isfinite(getattr(told, name)) for name in needs)
        if told.kind in KINDS and warm:
            found.append(capture)
    return found


def pools(chain: Chain, captures: Sequence[Capture], *, step: int = 0) -> tuple[Pool, ...]:
    """Measurements per frequency.

    Parameters
    ----------
    chain : Chain
        Phase stages to refine, applied to find the phase that the amplitude stage sees.
    captures : sequence of Capture
        Captures out of `usable_captures`, corrected for lens and response.
    step : int
        Pixels from one that is kept to the next; 0 keeps as many as `KEPT` allows.

    Returns
    -------
    tuple of Pool
        One per frequency.
    """
    middle = chain.before("amplitude")
    height, width = captures[0].sensor.camera.shape
    per_capture = max(LEAST_PIXELS, KEPT // len(captures))
    step = step or max(1, int(np.ceil(np.sqrt(height * width / per_capture))))
    grid = (slice(None), slice(step // 2, None, step), slice(step // 2, None, step))
    lines = [_line(middle, capture, grid) for capture in captures]
    phase, corrected, level, error, weight = (np.stack(part) for part in zip(*lines, strict=True))
    celsius = np.array([[c.sensor_c, c.light_c] for c in map(conditions_of, captures)])
    group = _groups(captures)
    return tuple(
        _pool(phase[:, f], corrected[:, f], level[:, f], celsius, error[:, f], weight[:, f], group)
        for f in range(phase.shape[1])
    )


def _line(
    middle: Chain, capture: Capture, grid: tuple[slice, ...]
) -> tuple[F64, F64, F64, F64, F64]:
    """Phase, corrected phase, amplitude, error and weight of one capture, (F, P) each."""
    told = conditions_of(capture)
    if told.reference == "plane" and not told.known:
        capture = with_conditions(capture, replace(told, distance_m=1.0))
    phasors, seen = phasors_of(capture), phasors_of(applied(middle, capture))
    n = phasors.values.shape[0]
    values, later = phasors.values[grid].reshape(n, -1), seen.values[grid].reshape(n, -1)
    error = phase_error_rad(capture)[grid].reshape(n, -1)
    good = np.isfinite(error) & seen.valid[grid[1:]].ravel()
    sigma = phase_sigma_rad(phasors)
    weight = good.astype(np.float64)
    if sigma is not None:
        noise = sigma[grid].reshape(n, -1).astype(np.float64)
        weight = np.where(good & np.isfinite(noise), 1 / np.maximum(noise, 1e-7) ** 2, 0.0)
    # A pixel that is not a number has no weight, and must not spoil sums by its value.
    values, later = (np.where(good, z, 1) for z in (values, later))
    phase, corrected = (np.asarray(np.angle(z), dtype=np.float64) for z in (values, later))
    level = np.asarray(np.abs(later), dtype=np.float64)
    return phase, corrected, level, np.where(good, error, 0.0), weight


def _groups(captures: Sequence[Capture]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    names = []
    for told in map(conditions_of, captures):
        known = told.known or told.reference == "depth"
        names.append("known" if known else told.kind)
    order = sorted(set(names))
    return np.array([order.index(name) for name in names], dtype=np.intp)


def _pool(
    phase: F64, corrected: F64, level: F64, celsius: F64, error: F64, weight: F64,
    group: np.ndarray[tuple[int], np.dtype[np.intp]],
) -> Pool:  # fmt: skip
    """Measurements whose errors do not jump by a turn, none weighing far more than the median."""
    used = weight > 0
    if used.any():
        typical = float(np.median(weight[used]))
        weight = np.where(used, 1 / (1 / np.where(used, weight, 1.0) + 1 / typical), 0.0)
    for g in np.unique(group):
        mine = group == g
        turn = (np.exp(1j * error[mine]) * weight[mine]).sum(axis=0)
        middle = np.angle(np.where(np.abs(turn) > 0, turn, 1.0))
        error[mine] = middle + wrap_half(error[mine] - middle)
    return Pool(phase, corrected, level, celsius, np.where(used, error, 0.0), weight, group)


def centred(pool: Pool, rows: F64, weight: F64) -> F64:
    """Rows less their weighted mean over the captures of a group, pixel by pixel.

    Parameters
    ----------
    pool : Pool
        Gives the groups.
    rows : ndarray, (C, P, K)
        Columns of a model, or errors.
    weight : ndarray, (C, P)
        Weights.

    Returns
    -------
    ndarray, (C, P, K)
        What the constants of the pixels cannot explain.
    """
    out = np.empty_like(rows)
    for g in np.unique(pool.group):
        mine = pool.group == g
        w = weight[mine][..., None]
        total = np.maximum(w.sum(axis=0), 1e-300)
        out[mine] = rows[mine] - (rows[mine] * w).sum(axis=0) / total
    return out


def kept(weight: F64, rest_rad: F64, cut: float) -> tuple[F64, Bool]:
    """Weights without outliers, and which those are.

    Parameters
    ----------
    weight, rest_rad : ndarray, (C, P)
        Weights and residuals.
    cut : float
        Residuals beyond so many robust deviations do not count.

    Returns
    -------
    ndarray, ndarray
        Weights, and outliers.
    """
    away = np.abs(rest_rad) * np.sqrt(weight)
    usual = 1.4826 * float(np.median(away[weight > 0])) + 1e-12
    far = away > cut * usual
    return np.where(far, 0.0, weight), far
