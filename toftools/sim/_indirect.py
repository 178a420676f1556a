"""Indirect light of an image out of virtual lights: where to gather, how many lights, how sure.

Gathered is at few points, chosen by the error of interpolating between them (`_sparse`). Four
independent estimates, each with its own virtual lights, scatter by their standard error; it falls
nearly with the number of lights, so that the second or third round has enough. Both errors are of
range, in m, and both are measured: nothing is asked of the user but millimetres.
"""

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toftools.sim._field import arriving, light_field, share_met
from toftools.sim._image import Order
from toftools.sim._phasors import C128
from toftools.sim._placing import placed
from toftools.sim._seen import points_at, seen
from toftools.sim._sparse import Plan
from toftools.sim._task import Jit, Task
from toftools.sim._viewpoints import viewpoints
from toftools.sim._virtual import channels_of
from toftools.sim._wanted import Wanted, errors_of, lit_of, pixels_of, pooled, wrong_m
from toftools.types import F64

log = logging.getLogger(__name__)

REPLICATES = 4
FIRST, MOST = 1024, 1 << 16
"""Virtual lights of an estimate in the first round, and at the most."""
FALL = 0.65
"""Exponent with which the error falls with the number of virtual lights, as measured."""
NOISE, ENOUGH = 0.6, 0.75
"""Shares of the tolerance at which scatter is aimed, and with which it is content."""
ROUNDS = 3
AUDIT, PILOTS = 768, 4
"""Rounds at the most; points that measure errors, and rounds at those alone."""


@dataclass(frozen=True, eq=False)
class Indirect:
    """Indirect light of diffuse pixels.

    Parameters
    ----------
    one_bounce, rest : ndarray, (Q, H, W), complex128
        Phasors in units of `Noise.signal_e`.
    ambient : ndarray, (H, W)
        Indirect light of sources without modulation.
    error_m : ndarray, (H, W)
        Standard error of range, interpolation included, m.
    told : dict
        How it was made (JSON values).
    lights : int
        Virtual lights of all estimates.
    """

    one_bounce: C128
    rest: C128
    ambient: F64
    error_m: F64
    told: dict[str, Any]
    lights: int


def indirect(task: Task, order: Order, direct: C128, bounces: int | None) -> Indirect:
    """Indirect light at all pixels that see a diffuse surface.

    Parameters
    ----------
    task : Task
        Scene and sources.
    order : Order
        Camera, frequencies, tolerance or number of virtual lights, seed.
    direct : ndarray, (Q, H, W), complex128
        Direct light, against which errors of phase count.
    bounces : int or None
        Indirect bounces; None for all.

    Returns
    -------
    Indirect
        Light and its error.
    """
    what = seen(task, order.camera, order.side)
    channels = channels_of(task, order.freqs_hz)
    fine = direct.repeat(order.side, axis=1).repeat(order.side, axis=2)
    views = viewpoints(task, order.seed)
    scene = Wanted(task, order, what, views, channels, fine.reshape(len(direct), -1), bounces)
    plan = placed(scene)
    log.info("gathered at %d of %d points", plan.pixels.size, what.diffuse.sum())
    apart = _audited(scene)
    total = order.samples or _enough(scene, plan, apart)
    rounds = 0
    while True:
        number = np.concatenate([plan.pixels, apart])
        runs, lights = _runs(scene, plan, number, total, 100 + rounds)
        mean, rounds = runs.mean(axis=0), rounds + 1
        error_m = errors_of(scene, plan, runs[..., : plan.pixels.size].sum(axis=1)[:, order.used])
        lit = lit_of(scene)
        reached_m = float(np.sqrt(np.mean(error_m[lit] ** 2))) if lit.any() else 0.0
        log.info("%d virtual lights, standard error %.2f mm rms", total, 1e3 * reached_m)
        done = order.samples is not None or total >= MOST or rounds == ROUNDS
        if done or reached_m <= ENOUGH * order.tol_m:
            break
        total = _more(total, reached_m, order.tol_m)
    found_m = _between(scene, plan, apart, mean.sum(axis=0)[order.used])
    return _made(scene, replace(plan, error_m=found_m), mean, error_m, (lights, reached_m))


def _more(total: int, reached_m: float, tol_m: float) -> int:
    """Virtual lights that will do, by how the error falls."""
    more = (reached_m / (NOISE * tol_m)) ** (1 / FALL)
    return int(min(MOST, total * np.clip(1.1 * more, 1.3, 16)))


def _audited(scene: Wanted) -> Any:  # noqa: ANN401 - ints
    """Points drawn evenly among all, whose light is gathered only to measure errors."""
    able = np.flatnonzero(scene.what.diffuse)
    rng = np.random.default_rng(scene.order.seed)
    return np.sort(rng.choice(able, min(AUDIT, able.size), replace=False))


def _enough(scene: Wanted, plan: Plan, apart: Any) -> int:  # noqa: ANN401 - ints
    """Virtual lights that reach the tolerance at some points."""
    total, used = FIRST, scene.order.used
    for rounds in range(PILOTS):
        runs, _ = _runs(scene, plan, apart, total, rounds)
        each = runs.sum(axis=1)[:, used]
        mean = each.mean(axis=0)
        wrong = wrong_m(scene, each - mean, mean, apart)
        reached_m = float(np.sqrt(np.sum(wrong**2) / apart.size / (len(each) - 1) / len(each)))
        log.info("%d virtual lights, %.2f mm rms at %d points", total, 1e3 * reached_m, apart.size)
        if reached_m <= NOISE * scene.order.tol_m or total >= MOST:
            break
        total = _more(total, reached_m, scene.order.tol_m)
    return total


def _between(scene: Wanted, plan: Plan, apart: Any, mean: C128) -> float:  # noqa: ANN401 - ints
    """Error of interpolation, rms over all points, m: what audited ones have gathered tells."""
    count = plan.pixels.size
    told = (plan.matrix[apart] @ mean[:, :count].T).T
    fresh = ~np.isin(apart, plan.pixels)
    wrong = wrong_m(scene, told - mean[:, count:], mean[:, count:], apart)
    return float(np.sqrt(np.mean((wrong * fresh) ** 2))) if apart.size else 0.0


def _runs(
    scene: Wanted,
    plan: Plan,
    number: Any,  # noqa: ANN401 - ints
    total: int,
    rounds: int,
) -> tuple[C128, int]:
    """Independent estimates at points, (P, 2, C, S), and their virtual lights."""
    places = points_at(scene.task, scene.what, plan.pixels)
    points = points_at(scene.task, scene.what, number)
    met = share_met(scene.task, points, scene.order.seed)
    runs = [
        _run(scene, places, (points, met), total, rounds * REPLICATES + i)
        for i in range(REPLICATES)
    ]
    return np.stack([run for run, _ in runs]), sum(lights for _, lights in runs)


def _run(
    scene: Wanted, places: Jit, points: tuple[Jit, F64], total: int, number: int
) -> tuple[C128, int]:
    """One estimate of one and more bounces at points, (2, C, S)."""
    seed = (scene.order.seed * 0x10001 + number + 1) * 0x9E3779B1 % (1 << 31)
    field = light_field(scene.task, scene.views, scene.channels, places, total, scene.bounces, seed)
    return np.stack(arriving(scene.task, field, *points)), len(field.lights.albedo)


def _made(
    scene: Wanted, plan: Plan, mean: C128, error_m: F64, facts: tuple[int, float]
) -> Indirect:
    kinds, (lights, reached_m) = len(scene.order.freqs_hz), facts
    gathered = mean[..., : plan.pixels.size]
    one, rest = (pixels_of(scene, plan, part, scene.channels.freqs_hz) for part in gathered)
    told = {
        "virtual_lights": lights,
        "viewpoints": len(scene.views),
        "gathered": int(plan.pixels.size),
        "interpolation_mm": 1e3 * plan.error_m,
        "scatter_mm": 1e3 * reached_m,
    }
    if scene.order.samples is None:
        told["tolerance_met"] = bool(np.hypot(reached_m, plan.error_m) <= scene.order.tol_m)
    both = pooled(np.sqrt(error_m**2 + plan.error_m**2), lit_of(scene))
    plain = (one + rest)[kinds:].real.sum(axis=0)
    return Indirect(one[:kinds], rest[:kinds], plain, both, told, lights)
