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

from toftools.sim._field import Field, arriving, light_field, share_met
from toftools.sim._image import Order
from toftools.sim._phasors import C128
from toftools.sim._placing import placed
from toftools.sim._seen import Seen, points_at
from toftools.sim._sparse import Plan
from toftools.sim._task import Task
from toftools.sim._wanted import Wanted, errors_of, pixels_of, pooled, wanted, wrong_m
from toftools.types import F64

log = logging.getLogger(__name__)

REPLICATES = 4
FIRST, MOST = 1024, 1 << 16
"""Virtual lights of an estimate in the first round, and at the most."""
LOOSE_M = 0.005
"""Tolerance from which a quarter of the first lights may do."""
FALL = 0.8
"""Exponent with which the error falls with the number of virtual lights, as measured."""
NOISE, ENOUGH, CLOSE = 0.5, 0.65, 1.3
"""Shares of the tolerance at which scatter is aimed, with which it is content, and how much more
than that calls for more estimates in place of better ones."""
ROUNDS = 3
AUDIT, PILOTS = 768, 4
"""Rounds at the most; points that measure errors, and rounds at those alone."""
FEWEST_OPEN, PER_OPEN = 512, 8
"""Rays that tell how open the scene is from a point: at the least, and virtual lights to one."""


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
    """

    one_bounce: C128
    rest: C128
    ambient: F64
    error_m: F64
    told: dict[str, Any]


def indirect(task: Task, order: Order, direct: C128, bounces: int | None, what: Seen) -> Indirect:
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
    what : Seen
        What the camera sees.

    Returns
    -------
    Indirect
        Light and its error.
    """
    scene = wanted(task, order, direct, bounces, what)
    plan = placed(scene)
    log.info("gathered at %d of %d points", plan.pixels.size, what.diffuse.sum())
    apart, rounds = _audited(scene), 0
    fields, few = _enough(scene, plan, apart)
    while True:
        total = fields[0].lights.total
        runs, rounds = _runs(scene, fields, plan.pixels), rounds + 1
        error_m = errors_of(scene, plan, runs.sum(axis=1)[:, order.used])
        reached_m = float(np.sqrt(np.mean(error_m[scene.lit] ** 2))) if scene.lit.any() else 0.0
        log.info("%d virtual lights, standard error %.2f mm rms", total, 1e3 * reached_m)
        done = order.samples is not None or total >= MOST or rounds == ROUNDS
        if done or reached_m <= ENOUGH * order.tol_m:
            break
        fields = _better(scene, plan, fields, reached_m, PILOTS + rounds)
        few = _runs(scene, fields, apart)
    mean = runs.mean(axis=0)
    found_m = _between(scene, plan, apart, *(x.mean(axis=0).sum(axis=0) for x in (runs, few)))
    lights = sum(len(field.lights.albedo) for field in fields)
    return _made(scene, replace(plan, error_m=found_m), mean, error_m, (lights, reached_m))


def _better(
    scene: Wanted, plan: Plan, fields: list[Field], reached_m: float, rounds: int
) -> list[Field]:
    """Fields that will do: as many again where little is missing, else others with more lights.

    Numbers of lights are powers of two, for stratification; how the error falls tells which.
    """
    total, tol_m = fields[0].lights.total, scene.order.tol_m
    if reached_m <= CLOSE * ENOUGH * tol_m:
        return fields + _fields(scene, plan, total, rounds)
    more = np.clip((reached_m / (NOISE * tol_m)) ** (1 / FALL), 2, 16)
    return _fields(scene, plan, int(min(MOST, 2 ** round(np.log2(total * more)))), rounds)


def _audited(scene: Wanted) -> Any:  # noqa: ANN401 - ints
    """Points drawn evenly among those that count, gathered at only to measure errors."""
    able = np.flatnonzero(scene.counted if scene.lit.any() else scene.what.diffuse)
    rng = np.random.default_rng(scene.order.seed)
    return np.sort(rng.choice(able, min(AUDIT, able.size), replace=False))


def _enough(scene: Wanted, plan: Plan, apart: Any) -> tuple[list[Field], C128]:  # noqa: ANN401
    """Fields that reach the tolerance at some points, and what they tell there."""
    first = FIRST if scene.order.tol_m < LOOSE_M else FIRST // 4
    total, rounds = scene.order.samples or first, 1
    fields = _fields(scene, plan, total, 0)
    while True:
        runs = _runs(scene, fields, apart)
        if scene.order.samples is not None:
            return fields, runs
        each = runs.sum(axis=1)[:, scene.order.used]
        mean = each.mean(axis=0)
        wrong = wrong_m(scene, each - mean, mean, apart)
        reached_m = float(np.sqrt(np.sum(wrong**2) / apart.size / (len(each) - 1) / len(each)))
        total = fields[0].lights.total
        log.info("%d virtual lights, %.2f mm rms at %d points", total, 1e3 * reached_m, apart.size)
        if reached_m <= ENOUGH * scene.order.tol_m or total >= MOST or rounds == PILOTS:
            return fields, runs
        fields, rounds = _better(scene, plan, fields, reached_m, rounds), rounds + 1


def _between(scene: Wanted, plan: Plan, apart: Any, gathered: C128, few: C128) -> float:  # noqa: ANN401
    """Error of interpolation, rms over all points, m: what audited ones have gathered tells."""
    if not apart.size:
        return 0.0
    told, here = (plan.matrix[apart] @ gathered.T).T, scene.order.used
    fresh = ~np.isin(apart, plan.pixels)
    wrong = wrong_m(scene, (told - few)[here], few[here], apart)
    return float(np.sqrt(np.mean((wrong * fresh) ** 2)))


def _fields(scene: Wanted, plan: Plan, total: int, rounds: int) -> list[Field]:
    """Independent fields of virtual lights."""
    places = points_at(scene.task, scene.what, plan.pixels)
    seeds = (scene.order.seed * 0x10001 + rounds * REPLICATES + i + 1 for i in range(REPLICATES))
    return [
        light_field(scene.task, scene.views, scene.channels, places, total, scene.bounces,
                    seed * 0x9E3779B1 % (1 << 31))
        for seed in seeds
    ]  # fmt: skip


def _runs(scene: Wanted, fields: list[Field], number: Any) -> C128:  # noqa: ANN401 - ints
    """Light of one and of more bounces that each field brings to points, (P, 2, C, S)."""
    points = points_at(scene.task, scene.what, number)

    def of(field: Field) -> C128:
        rays = max(FEWEST_OPEN, field.lights.total // PER_OPEN)
        rays = 1 << (rays - 1).bit_length()
        met = share_met(scene.task, points, rays, field.seed + 0x31)
        return np.stack(arriving(scene.task, field, points, met))

    return np.stack([of(field) for field in fields])


def _made(
    scene: Wanted, plan: Plan, mean: C128, error_m: F64, facts: tuple[int, float]
) -> Indirect:
    kinds, (lights, reached_m) = len(scene.order.freqs_hz), facts
    one, rest = (pixels_of(scene, plan, part, scene.channels.freqs_hz) for part in mean)
    told = {
        "virtual_lights": lights,
        "viewpoints": len(scene.views),
        "gathered": int(plan.pixels.size),
        "interpolation_mm": 1e3 * plan.error_m,
        "scatter_mm": 1e3 * reached_m,
    }
    if scene.order.samples is None:
        told["tolerance_met"] = bool(np.hypot(reached_m, plan.error_m) <= scene.order.tol_m)
    both = pooled(np.sqrt(error_m**2 + plan.error_m**2), scene.lit)
    plain = (one + rest)[kinds:].real.sum(axis=0)
    return Indirect(one[:kinds], rest[:kinds], plain, both, told)
