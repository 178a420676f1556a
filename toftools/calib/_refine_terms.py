"""The phase stages as linear terms: columns, coefficients, and the stage of new coefficients."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toftools.calib._basis import fourier, spline
from toftools.calib._phase_surface import design
from toftools.calib._refine_data import Pool
from toftools.calib.amplitude import Amplitude
from toftools.calib.stage import Stage
from toftools.calib.temperature import Temperature
from toftools.calib.wiggling import Wiggling
from toftools.calib.wiggling_lut import WigglingLut
from toftools.calib.wiggling_spline import WigglingSpline
from toftools.types import F64

WEAK_RAD = 1.0
"""Standard deviation of the prior that holds what the data leave open."""
DRIFT = ("sensor_c", "light_c")


@dataclass(frozen=True, eq=False)
class Term:
    """One stage as a linear model.

    Parameters
    ----------
    slot : str
        Its place.
    columns : callable
        ``columns(pool, f) -> (C, P, K)``.
    start : tuple of ndarray, (K,)
        Coefficients of the first fit, per frequency.
    rebuilt : callable
        ``rebuilt(coefficients, covariances, dof) -> stage``, lists over frequencies.
    """

    slot: str
    columns: Callable[[Pool, int], F64]
    start: tuple[F64, ...]
    rebuilt: Callable[[Sequence[F64], Sequence[F64], int], Stage]


def term_of(stage: Stage) -> Term | None:
    """The term of a stage.

    Parameters
    ----------
    stage : Stage
        Any stage.

    Returns
    -------
    Term or None
        None for stages without coefficients to refine: lens, response, patterns, a user's own.
    """
    match stage:
        case Wiggling():
            return _waves(stage)
        case WigglingSpline():
            return _knots(stage, 3)
        case WigglingLut():
            return _knots(stage, 1)
        case Amplitude() if stage.knot_rad.any():
            return _surface(stage)
        case Temperature() if stage.needs:
            return _drift(stage)
        case _:
            return None


def _waves(stage: Wiggling) -> Term:
    orders = stage.harmonics

    def columns(pool: Pool, f: int) -> F64:
        return fourier(pool.phase_rad.ravel(), orders[f]).reshape(*pool.phase_rad.shape, -1)

    pairs = np.stack([stage.cos_rad, stage.sin_rad], axis=2)  # (F, M, 2)
    start = tuple(pairs[f, :n].ravel() for f, n in enumerate(orders))

    def rebuilt(values: Sequence[F64], covariances: Sequence[F64], dof: int) -> Wiggling:
        new, sd = np.zeros(pairs.shape), np.full(pairs.shape, np.nan)
        for f, n in enumerate(orders):
            new[f, :n] = values[f].reshape(n, 2)
            sd[f, :n] = np.sqrt(np.diag(covariances[f])).reshape(n, 2)
        return replace(
            stage,
            cos_rad=new[..., 0],
            sin_rad=new[..., 1],
            cos_sd_rad=sd[..., 0],
            sin_sd_rad=sd[..., 1],
            dof=dof,
        )

    return Term(stage.slot, columns, start, rebuilt)


def _knots(stage: WigglingSpline | WigglingLut, degree: int) -> Term:
    def columns(pool: Pool, f: int) -> F64:
        flat = spline(pool.phase_rad.ravel(), stage.knots[f], degree)
        return flat.reshape(*pool.phase_rad.shape, -1)

    start = tuple(stage.knot_rad[f, :n] for f, n in enumerate(stage.knots))

    def rebuilt(values: Sequence[F64], covariances: Sequence[F64], dof: int) -> Stage:
        knots, sd = np.zeros(stage.knot_rad.shape), np.full(stage.knot_rad.shape, np.nan)
        for f, n in enumerate(stage.knots):
            flat = np.eye(n) - 1 / n  # their mean is the common phase's
            knots[f, :n] = flat @ values[f]
            sd[f, :n] = np.sqrt(np.maximum(np.diag(flat @ covariances[f] @ flat), 0))
        return replace(stage, knot_rad=knots, knot_sd_rad=sd, dof=dof)

    return Term(stage.slot, columns, start, rebuilt)


def _surface(stage: Amplitude) -> Term:
    """The amplitude error, 0 at its reference amplitude at every phase.

    What depends on phase alone would belong to the wiggling as well; so wiggling is that of the
    reference amplitude, and the surface the difference to it.
    """
    shape = (stage.knot_rad.shape[1], stage.knot_rad.shape[2])
    gauges = [_gauge(stage, f) for f in range(stage.knot_rad.shape[0])]

    def columns(pool: Pool, f: int) -> F64:
        level, phase = pool.amplitude.ravel(), pool.corrected_rad.ravel()
        there = np.full_like(level, stage.reference_amplitude[f])
        flat = design(level, phase, stage.span[f], shape)
        flat -= design(there, phase, stage.span[f], shape)
        return flat.reshape(*pool.amplitude.shape, -1)

    start = tuple(
        gauge @ knots.ravel() for gauge, knots in zip(gauges, stage.knot_rad, strict=True)
    )

    def rebuilt(values: Sequence[F64], covariances: Sequence[F64], dof: int) -> Amplitude:
        knots = [gauge @ value for gauge, value in zip(gauges, values, strict=True)]
        spread = [g @ c @ g.T for g, c in zip(gauges, covariances, strict=True)]
        return replace(
            stage,
            knot_rad=np.stack(knots).reshape(stage.knot_rad.shape),
            covariance_rad2=np.stack(spread),
        )

    return Term(stage.slot, columns, start, rebuilt)


def _gauge(stage: Amplitude, f: int) -> F64:
    """Matrix that takes the surface at the reference amplitude off, phase by phase."""
    count, turn = stage.knot_rad.shape[1:]
    level = np.atleast_1d(stage.reference_amplitude[f])
    there = design(level, np.zeros(1), stage.span[f], (count, 1))[0]  # (A,), they add up to 1
    return np.kron(np.eye(count) - there[None, :], np.eye(turn))


def _drift(stage: Temperature) -> Term:
    which = [DRIFT.index(name) for name in stage.needs]

    def columns(pool: Pool, f: int) -> F64:
        above = (pool.celsius - stage.reference_c)[:, which]
        return np.broadcast_to(above[:, None, :], (*pool.phase_rad.shape, len(which))).copy()

    start = tuple(slope[which] for slope in stage.slope_rad_per_k)

    def rebuilt(values: Sequence[F64], covariances: Sequence[F64], dof: int) -> Temperature:
        slope, sigma = np.zeros(stage.slope_rad_per_k.shape), np.zeros(stage.slope_rad_per_k.shape)
        slope[:, which] = np.stack(values)
        sigma[:, which] = np.sqrt(np.stack([np.diag(c) for c in covariances]))
        return replace(stage, slope_rad_per_k=slope, sigma_rad_per_k=sigma)

    return Term(stage.slot, columns, start, rebuilt)
