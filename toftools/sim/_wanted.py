"""What indirect light is wanted for: an image, and what errors of light mean for its range."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._image import Order
from toftools.sim._phasors import C128
from toftools.sim._render import tiles_of
from toftools.sim._seen import Seen
from toftools.sim._sparse import Plan, spread
from toftools.sim._stop import range_errors_m
from toftools.sim._task import Task
from toftools.sim._viewpoints import Viewpoint, viewpoints
from toftools.sim._virtual import Channels, channels_of
from toftools.types import F64
from toftools.units import path_to_phase

FAINT = 0.01
"""Pixels this much darker than the median do not count for the error: they tell no range."""


@dataclass(frozen=True, eq=False)
class Wanted:
    """What all estimates share; pixels whose range counts are `lit`, their points `counted`."""

    task: Task
    order: Order
    what: Seen
    views: tuple[Viewpoint, ...]
    channels: Channels
    direct: C128
    bounces: int | None
    lit: Any
    counted: Any


def wanted(task: Task, order: Order, direct: C128, bounces: int | None, what: Seen) -> Wanted:
    """What an image wants; `direct` is that of its pixels, (Q, H, W)."""
    side = order.side
    fine = direct.repeat(side, axis=1).repeat(side, axis=2).reshape(len(direct), -1)
    lit = lit_of(order, direct, what)
    counted = lit.repeat(side, axis=0).repeat(side, axis=1).ravel()
    channels = channels_of(task, order.freqs_hz)
    views = viewpoints(task, order.seed)
    return Wanted(task, order, what, views, channels, fine, bounces, lit, counted)


def shown(what: Seen, light: C128, freqs_hz: F64, number: Any) -> C128:  # noqa: ANN401 - ints
    """Radiance at the camera out of mean radiance over the hemisphere of points."""
    turned = np.exp(1j * path_to_phase(what.range_m[number], freqs_hz[:, None]))
    return np.asarray(what.albedo[number] * light * turned)


def pixels_of(scene: Wanted, plan: Plan, values: C128, freqs_hz: F64) -> C128:
    """Radiance of pixels, (C, H, W), out of values (C, S) at the gathered points."""
    every = np.arange(len(scene.what.range_m))
    light = spread(plan, values).reshape(len(values), -1)
    return np.asarray(averaged(scene.order, shown(scene.what, light, freqs_hz, every)))


def averaged(order: Order, values: Any) -> Any:  # noqa: ANN401 - any kind
    """Mean over the points of every pixel, (..., H, W)."""
    (height, width), side = order.camera.shape, order.side
    fine = values.reshape(*values.shape[:-1], height, side, width, side)
    return fine.mean(axis=(-3, -1))


def total_of(scene: Wanted) -> C128:
    return np.asarray(averaged(scene.order, scene.direct[scene.order.used]))


def lit_of(order: Order, direct: C128, what: Seen) -> Any:  # noqa: ANN401 - bools
    """Pixels whose range counts, (H, W)."""
    size = np.abs(direct[order.used]).min(axis=0)
    if not size.any():
        return size > 0
    diffuse = averaged(order, what.diffuse.astype(float)) == 1
    return diffuse & (size > FAINT * np.median(size[size > 0]))


def errors_of(scene: Wanted, plan: Plan, runs: C128) -> F64:
    """Standard error of the range of the runs' mean, (H, W), m; runs are (P, F, S)."""
    wave, shape = scene.order.freqs_hz[scene.order.used], scene.order.camera.shape
    mean = runs.mean(axis=0)
    total = total_of(scene) + pixels_of(scene, plan, mean, wave)
    total = total.reshape(len(wave), -1)
    variance = np.zeros(total.shape[1])
    for run in runs:
        apart = pixels_of(scene, plan, run - mean, wave).reshape(len(wave), -1)
        variance += range_errors_m(apart, total, wave) ** 2
    return np.sqrt(variance / (len(runs) - 1) / len(runs)).reshape(shape)


def wrong_m(scene: Wanted, delta: C128, light: C128, number: Any) -> F64:  # noqa: ANN401 - ints
    """Errors of range that errors (..., F, M) of the indirect light (F, M) make at points, m."""
    used, what = scene.order.used, scene.what
    wave = scene.order.freqs_hz[used]
    total = scene.direct[used][:, number] + shown(what, light, wave, number)
    wrong = range_errors_m(shown(what, delta, wave, number), total, wave)
    return np.where(scene.counted[number], wrong, 0.0)


def pooled(error_m: F64, lit: Any) -> F64:  # noqa: ANN401 - bools
    """Root mean square of errors over every tile of the image."""
    tile, turn = tiles_of(*error_m.shape)
    count = np.bincount(tile, lit.ravel()[turn])
    total = np.bincount(tile, (error_m**2 * lit).ravel()[turn])
    pooled = np.empty(error_m.size)
    pooled[turn] = np.sqrt(total / np.maximum(count, 1))[tile]
    return pooled.reshape(error_m.shape)
