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

from toftools.sim._field import arriving, light_field
from toftools.sim._image import Order
from toftools.sim._phasors import C128
from toftools.sim._render import tiles_of
from toftools.sim._seen import Seen, points_at, seen
from toftools.sim._sparse import Plan, Surface, place, spread
from toftools.sim._stop import range_errors_m
from toftools.sim._task import Jit, Task
from toftools.sim._viewpoints import Viewpoint, viewpoints
from toftools.sim._virtual import Channels, channels_of
from toftools.types import F64
from toftools.units import path_to_phase

log = logging.getLogger(__name__)

REPLICATES = 4
FIRST, MOST = 1024, 1 << 18
"""Virtual lights of an estimate in the first round, and at the most."""
PLACING = 2048
"""Virtual lights while places are chosen."""
FALL = 0.65
"""Exponent with which the error falls with the number of virtual lights, as measured."""
NOISE, BETWEEN = 0.7, 0.5
"""Shares of the tolerance for scatter and for interpolation; their squares leave room for bias."""
FAINT = 0.01
"""Pixels this much darker than the median do not count for the error: they tell no range."""


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


@dataclass(frozen=True, eq=False)
class _Scene:
    """What all estimates share."""

    task: Task
    order: Order
    what: Seen
    views: tuple[Viewpoint, ...]
    channels: Channels
    direct: C128
    bounces: int | None


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
    scene = _Scene(task, order, what, views, channels, fine.reshape(len(direct), -1), bounces)
    plan = _placed(scene)
    log.info("gathered at %d of %d points", plan.pixels.size, what.diffuse.sum())
    points = points_at(task, what, plan.pixels)
    total, rounds = order.samples or FIRST, 0
    while True:
        runs = [
            _run(scene, plan, points, total, rounds * REPLICATES + i) for i in range(REPLICATES)
        ]
        mean = np.mean([run for run, _ in runs], axis=0)
        error_m = _errors(scene, plan, np.stack([run.sum(axis=0)[order.used] for run, _ in runs]))
        lit = _lit(scene)
        reached_m = float(np.sqrt(np.mean(error_m[lit] ** 2))) if lit.any() else 0.0
        log.info("%d virtual lights, standard error %.2f mm rms", total, 1e3 * reached_m)
        target_m, rounds = NOISE * order.tol_m, rounds + 1
        if order.samples is not None or reached_m <= target_m or total >= MOST:
            break
        more = (reached_m / target_m) ** (1 / FALL)
        total = int(min(MOST, total * np.clip(1.1 * more, 1.5, 16)))
    return _made(scene, plan, mean, error_m, sum(number for _, number in runs), reached_m)


def _run(scene: _Scene, plan: Plan, points: Jit, total: int, number: int) -> tuple[C128, int]:
    """One estimate of one and more bounces at the gathered points, (2, C, S)."""
    seed = (scene.order.seed * 0x10001 + number + 1) * 0x9E3779B1 % (1 << 31)
    field = light_field(scene.task, scene.views, scene.channels, points, total, scene.bounces, seed)
    return np.stack(arriving(scene.task, field, points)), len(field.lights.albedo)


def _placed(scene: _Scene) -> Plan:
    """Points to gather at."""
    task, what, used = scene.task, scene.what, scene.order.used
    wave = scene.order.freqs_hz[used]
    known: dict[str, Any] = {}

    def evaluate(number: Any) -> C128:  # noqa: ANN401 - ints
        points = points_at(task, what, number)
        if not known:
            seed = scene.order.seed + 99
            field = light_field(
                task, scene.views, scene.channels, points, PLACING, scene.bounces, seed
            )
            # Nothing by chance that neighbours do not share: differences are those of the light.
            known["field"] = replace(field, near_m=0.0, sure=0.0)
        one, rest = arriving(task, known["field"], points)
        light = np.asarray((one + rest)[used])
        known.setdefault("total", _roughly(scene, number, light))
        return light

    def errors_m(delta: C128, number: Any) -> F64:  # noqa: ANN401 - ints
        total = known["total"]
        size = np.abs(total).min(axis=0)
        counts = size > FAINT * np.median(size[what.diffuse])
        error_m = range_errors_m(_shown(what, delta, wave, number), total[:, number], wave)
        return np.where(counts[number], error_m, 0.0)

    shape = what.shape
    surface = Surface(
        what.position_m.reshape(*shape, 3),
        what.normal.reshape(*shape, 3),
        what.diffuse.reshape(shape),
    )
    return place(surface, evaluate, errors_m, BETWEEN * scene.order.tol_m)


def _roughly(scene: _Scene, number: Any, light: C128) -> C128:  # noqa: ANN401 - ints
    """All modulated light of all points, the indirect part that of the nearest of some points."""
    from scipy.spatial import cKDTree

    what = scene.what
    place = np.where(what.met[:, None], what.position_m, 0.0)
    rows = np.concatenate([place, what.normal], axis=1)
    _, nearest = cKDTree(rows[number]).query(rows, workers=-1)
    wave = scene.order.freqs_hz[scene.order.used]
    every = np.arange(len(place))
    indirect = _shown(what, light[:, nearest], wave, every)
    return np.asarray(scene.direct[scene.order.used] + indirect)


def _shown(what: Seen, light: C128, freqs_hz: F64, number: Any) -> C128:  # noqa: ANN401 - ints
    """Radiance at the camera out of mean radiance over the hemisphere of points."""
    turned = np.exp(1j * path_to_phase(what.range_m[number], freqs_hz[:, None]))
    return np.asarray(what.albedo[number] * light * turned)


def _pixels(scene: _Scene, plan: Plan, values: C128, freqs_hz: F64) -> C128:
    """Radiance of pixels, (C, H, W), out of values (C, S) at the gathered points."""
    every = np.arange(len(scene.what.range_m))
    light = spread(plan, values).reshape(len(values), -1)
    return np.asarray(_averaged(scene, _shown(scene.what, light, freqs_hz, every)))


def _averaged(scene: _Scene, values: Any) -> Any:  # noqa: ANN401 - any kind
    """Mean over the points of every pixel, (..., H, W)."""
    (height, width), side = scene.order.camera.shape, scene.order.side
    fine = values.reshape(*values.shape[:-1], height, side, width, side)
    return fine.mean(axis=(-3, -1))


def _total(scene: _Scene) -> C128:
    return np.asarray(_averaged(scene, scene.direct[scene.order.used]))


def _lit(scene: _Scene) -> Any:  # noqa: ANN401 - bools
    """Pixels whose range counts."""
    size = np.abs(_total(scene)).min(axis=0)
    if not size.any():
        return size > 0
    diffuse = _averaged(scene, scene.what.diffuse.astype(float)) == 1
    return diffuse & (size > FAINT * np.median(size[size > 0]))


def _errors(scene: _Scene, plan: Plan, runs: C128) -> F64:
    """Standard error of the range of the runs' mean, (H, W), m; runs are (P, F, S)."""
    wave, shape = scene.order.freqs_hz[scene.order.used], scene.order.camera.shape
    mean = runs.mean(axis=0)
    total = _total(scene) + _pixels(scene, plan, mean, wave)
    total = total.reshape(len(wave), -1)
    variance = np.zeros(total.shape[1])
    for run in runs:
        apart = _pixels(scene, plan, run - mean, wave).reshape(len(wave), -1)
        variance += range_errors_m(apart, total, wave) ** 2
    return np.sqrt(variance / (len(runs) - 1) / len(runs)).reshape(shape)


def _made(
    scene: _Scene, plan: Plan, mean: C128, error_m: F64, lights: int, reached_m: float
) -> Indirect:
    kinds = len(scene.order.freqs_hz)
    one, rest = (_pixels(scene, plan, part, scene.channels.freqs_hz) for part in mean)
    told = {
        "virtual_lights": lights,
        "viewpoints": len(scene.views),
        "gathered": int(plan.pixels.size),
        "interpolation_mm": 1e3 * plan.error_m,
        "scatter_mm": 1e3 * reached_m,
    }
    if scene.order.samples is None:
        told["tolerance_met"] = bool(np.hypot(reached_m, plan.error_m) <= scene.order.tol_m)
    both = _pooled(np.sqrt(error_m**2 + plan.error_m**2), _lit(scene))
    plain = (one + rest)[kinds:].real.sum(axis=0)
    return Indirect(one[:kinds], rest[:kinds], plain, both, told, lights)


def _pooled(error_m: F64, lit: Any) -> F64:  # noqa: ANN401 - bools
    """Root mean square of errors over every tile of the image."""
    tile, turn = tiles_of(*error_m.shape)
    count = np.bincount(tile, lit.ravel()[turn])
    total = np.bincount(tile, (error_m**2 * lit).ravel()[turn])
    pooled = np.empty(error_m.size)
    pooled[turn] = np.sqrt(total / np.maximum(count, 1))[tile]
    return pooled.reshape(error_m.shape)
