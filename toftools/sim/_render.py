"""Light of a whole image to a tolerance: passes over the tiles that still need them.

Every tile gets four independent passes a round, from which its standard error follows; tiles above
the tolerance go into the next round, with as many paths as they have had.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from toftools.sim._image import Image, Order
from toftools.sim._phasors import C128, Light
from toftools.sim._reuse import shared_light, worth_sharing
from toftools.sim._stop import range_errors_m
from toftools.sim._task import Task, first_hits
from toftools.sim._views import direct_of_pixels, in_parts, own_light, views
from toftools.types import F64

log = logging.getLogger(__name__)

TILE = 16
BLOCK = (4, 8)
"""Rows and columns of the blocks of pixels that share paths, `GROUP` in all."""
PASSES = 4
FIRST_PATHS = 4
PILOT = 1024
"""Pixels that tell whether paths are worth sharing."""
AMBIENT_PATHS = 64
"""Paths for the light of lamps, which is offset and shot noise only."""
FAINT = 0.01
"""Pixels this much darker than the median do not count for a tile's error: they tell no range."""


def render(task: Task, order: Order, only: Any = None) -> Image:  # noqa: ANN401 - bools
    """Direct light exactly and indirect light to a tolerance.

    Parameters
    ----------
    task : Task
        Scene and sources.
    order : Order
        What to render.
    only : ndarray of bool, (H, W), or None
        Pixels that are wanted; others stay dark.

    Returns
    -------
    Image
        Light per pixel.
    """
    height, width = order.camera.shape
    tiles, turn = tiles_of(height, width)  # neighbours in the image become neighbours in the list
    if only is not None:
        chosen = only.ravel()[turn]
        tiles, turn = tiles[chosen], turn[chosen]
    direct = direct_of_pixels(task, order.camera, turn, order.side, order.freqs_hz)
    sums = _Sums(len(order.freqs_hz), len(turn))
    if task.lamps and not task.stage.lamp_modulated.any():
        # Ambient light moves no phase: a few paths of its own, none among those that count.
        sums.ambient_only = ambient_of_lamps(task, order, turn)
        task = task.without_lamps()
    if order.bounces > 0 or task.chance_direct:
        _rounds(task, order, turn, direct.direct, tiles, sums)
    known, count = sums.samples > 0, np.maximum(sums.samples, 1)

    def image(values: Any) -> Any:  # noqa: ANN401 - (..., N) to (..., H, W), any kind
        back = np.zeros((*values.shape[:-1], height * width), values.dtype)
        back[..., turn] = values
        return back.reshape(*values.shape[:-1], height, width)

    return Image(
        direct=image(direct.direct + sums.parts[0] / count),
        one_bounce=image(sums.parts[1] / count),
        rest=image(sums.parts[2] / count),
        ambient=image(direct.ambient + sums.ambient / count + sums.ambient_only),
        samples=image(sums.samples),
        error_m=image(np.where(known, sums.error_m, 0.0)),
    )


class _Sums:
    """Running sums of all pixels, weighted by numbers of paths."""

    def __init__(self, freqs: int, pixels: int) -> None:
        self.parts = np.zeros((3, freqs, pixels), np.complex128)
        self.ambient = np.zeros(pixels)
        self.ambient_only = np.zeros(pixels)  # a mean of its own, not a sum
        self.samples = np.zeros(pixels)
        self.scatter = np.zeros(pixels)  # sum of (paths * standard error)^2
        self.judged = np.zeros(pixels)  # paths whose scatter is in the sum
        self.error_m = np.full(pixels, np.nan)


def _rounds(
    task: Task,
    order: Order,
    turn: Any,  # noqa: ANN401
    direct: C128,
    tiles: Any,  # noqa: ANN401
    sums: _Sums,
) -> None:
    """Add rounds of passes until every tile is good enough, or has had the most paths."""
    estimate, least = _estimator(task, order, turn)
    wanted = min(PASSES * max(FIRST_PATHS, least), order.max_samples)
    wanted = wanted if order.samples is None else order.samples
    active, number = np.ones(len(turn), bool), 0
    while active.any():
        chosen = np.flatnonzero(active)
        sizes = _split(wanted, least)
        found = _passes(estimate, order, turn[chosen], sizes, number)
        number += len(sizes)
        _add(sums, chosen, found, sizes)
        total = direct + sums.parts.sum(axis=0) / np.maximum(sums.samples, 1)
        _judge(sums, chosen, found, total[order.used], order, tiles)
        most = int(sums.samples[chosen].max())
        _tell(most, active, sums.error_m[chosen])
        if order.samples is not None:
            return
        active &= ~(sums.error_m <= order.tol_m) & (sums.samples < order.max_samples)
        wanted = most  # doubles what there is


def _split(wanted: int, least: int) -> list[int]:
    """Paths of each pass of a round: nearly alike, every one a multiple of `least`.

    Examples
    --------
    >>> _split(10, 1)
    [3, 3, 2, 2]
    """
    units = max(1, round(wanted / least))
    passes = min(PASSES, units)
    return [least * (units // passes + (i < units % passes)) for i in range(passes)]


def _tell(paths: int, active: Any, error_m: F64) -> None:  # noqa: ANN401
    known = error_m[np.isfinite(error_m)]
    error = f", standard error up to {known.max() * 1e3:.2f} mm" if known.size else ""
    log.info("%d paths a pixel in %.0f %% of the image%s", paths, 100 * active.mean(), error)


def _estimator(task: Task, order: Order, turn: Any) -> tuple[Callable[..., Light], int]:  # noqa: ANN401
    """What estimates indirect light, and the fewest paths of a pixel that it can work with."""
    some = views(order.camera, turn[:: max(1, len(turn) // PILOT)], 1).reshape(-1, 3)
    able = order.bounces > 0 and not (task.holes and task.lamps)  # lamps behind veils count once
    shares = able and worth_sharing(task, first_hits(task, some), order.seed)
    log.info("paths are %s", "shared among neighbouring pixels" if shares else "not shared")
    if shares:
        return partial(shared_light, task), 1
    return partial(own_light, task), order.side**2


def _passes(
    estimate: Callable[..., Light],
    order: Order,
    pixels: Any,  # noqa: ANN401
    sizes: list[int],
    number: int,
) -> list[Light]:
    """Independent estimates of some pixels, with paths of given numbers."""
    task: Task = estimate.args[0]  # type: ignore[attr-defined]  # a partial

    def lights(directions: F64, place: int) -> list[Light]:
        first = first_hits(task, directions)
        settings: dict[str, Any] = {"inside": order.side**2, "bounces": order.bounces}
        roots = [(order.seed * 0x10001 + number + i) * 0x3D4D51CB for i in range(len(sizes))]
        return [  # another seed for every part and pass
            estimate(first, order.freqs_hz, samples=paths, seed=root + place, **settings)
            for root, paths in zip(roots, sizes, strict=True)
        ]

    return in_parts(order.camera, pixels, order.side, lights)


def ambient_of_lamps(task: Task, order: Order, turn: Any) -> F64:  # noqa: ANN401
    """Light of unmodulated lamps by way of surfaces, from `AMBIENT_PATHS` paths a pixel.

    Parameters
    ----------
    task : Task
        Scene and sources.
    order : Order
        What to render.
    turn : ndarray of int, (M,)
        Pixels.

    Returns
    -------
    ndarray, (M,)
        Radiance.
    """
    dark, inside = task.without_flashes(), order.side**2
    each = inside * max(1, AMBIENT_PATHS // inside)
    settings: dict[str, Any] = {
        "inside": inside,
        "bounces": order.ambient_bounces,
        "samples": each,
    }

    def light(directions: F64, place: int) -> list[Light]:
        first, seed = first_hits(dark, directions), order.seed ^ (place + 1)
        return [own_light(dark, first, np.zeros(1), seed=seed, **settings)]

    [found] = in_parts(order.camera, turn, order.side, light)
    return found.ambient


def _add(sums: _Sums, chosen: Any, found: list[Light], sizes: list[int]) -> None:  # noqa: ANN401
    for light, paths in zip(found, sizes, strict=True):
        stacked = np.stack([light.direct, light.one_bounce, light.rest])
        sums.parts[:, :, chosen] += paths * stacked
        sums.ambient[chosen] += paths * light.ambient
        sums.samples[chosen] += paths


def _judge(
    sums: _Sums,
    chosen: Any,  # noqa: ANN401
    found: list[Light],
    total: C128,
    order: Order,
    tiles: Any,  # noqa: ANN401
) -> None:
    """Standard error of the chosen pixels' range, pooled over their tiles."""
    if len(found) < 2:
        return
    phasors = np.stack([light.total[order.used] for light in found])  # (P, F, M)
    freqs_hz, seen = order.freqs_hz[order.used], total[:, chosen]
    errors = range_errors_m(phasors - phasors.mean(axis=0), seen, freqs_hz)
    variance = (errors**2).sum(axis=0) / (len(found) - 1) / len(found)  # of the round's mean
    size = np.abs(seen).min(axis=0)
    lit = size > FAINT * np.median(size[size > 0], keepdims=True) if size.any() else size > 0
    fresh = sums.samples[chosen] - sums.judged[chosen]
    sums.judged[chosen] = sums.samples[chosen]
    sums.scatter[chosen] += fresh**2 * variance
    error2 = sums.scatter[chosen] / sums.samples[chosen] ** 2
    count = np.bincount(tiles[chosen], lit, minlength=tiles.max() + 1)
    pooled = np.bincount(tiles[chosen], error2 * lit, minlength=tiles.max() + 1)
    sums.error_m[chosen] = np.sqrt(pooled / np.maximum(count, 1))[tiles[chosen]]


def tiles_of(height: int, width: int) -> tuple[Any, Any]:
    """Tile of every pixel in the order of work, and that order: tiles, and small blocks in them.

    Parameters
    ----------
    height, width : int
        Shape of the image.

    Returns
    -------
    tuple of ndarray of int, (H * W,)
        Number of the tile, and of the pixel.
    """
    row, column = (axis.ravel() for axis in np.mgrid[0:height, 0:width])
    tile = row // TILE * (-(-width // TILE)) + column // TILE
    turn = np.lexsort((column, row, column // BLOCK[1], row // BLOCK[0], tile))
    return tile[turn], turn
