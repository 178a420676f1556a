"""Light of virtual lights and of camera paths in bins of path length, a batch of pixels at a time.

Eq. (6) and (7) of the seed "Transient instant radiosity" (2019) with lights out of eq. (15) whose
time is that of eq. (12): every pair of a pixel and a virtual light is one contribution in one bin.
Lanes are pixels and all look at the same virtual light at a time, so that their shadow rays run
side by side, which makes exact visibility cheap: nothing here is an imperfect shadow map. A lane
owns the row of its pixel, so that sums come in one order, whatever the threads and the batches.
The loops are those of algorithm 1: batches of the volume, and in them batches of virtual lights,
both within a limit on memory; lights that do not fit are made anew for every batch of pixels.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from toftools.sim._bins import Order, Volume, add, depositor
from toftools.sim._camera_walks import camera_walks
from toftools.sim._samples import MOST_EVENTS, direct_samples, events_per_path, indirect_samples
from toftools.sim._second import scatters_alike, up_of
from toftools.sim._task import Jit, Task, first_hits
from toftools.sim._tracer import Deposit
from toftools.sim._walks import Emission, Lights, virtual_lights
from toftools.types import F64

RAYS = 32
"""Camera paths per pixel: what they leave to virtual lights has no peaks."""
LANE_BYTES, PATH_BYTES = 1024, 4096
"""Room that a pixel takes besides its bins, and a light subpath with its virtual lights."""
FEWEST = 16
"""Pixels and subpaths of a batch at the least, whatever the memory."""


def filled(
    task: Task, sources: tuple[Emission, ...], views: F64, shape: tuple[int, int], order: Order
) -> Volume:
    """All light of diffuse pixels, and the direct light of the others.

    Parameters
    ----------
    task : Task
        Scene and sources.
    sources : tuple of Emission
        Sources with their light subpaths.
    views : ndarray, (P, 3)
        Unit vectors in the camera frame.
    shape : tuple of int
        Image shape (height, width).
    order : Order
        Axis, bounces, seed and memory.

    Returns
    -------
    Volume
        Light per pixel, row by row.
    """
    count = len(views)
    values, missed = np.zeros((count, order.n_bins), np.float32), np.zeros(count, np.float32)
    left, seen = np.zeros((2, count), bool)
    volume = Volume(values, missed, np.zeros(3, np.int64), left, seen, [])
    turn, made = _by_blocks(shape), _Made(task, sources, order)
    each = 2 * 4 * (order.n_bins + 2) + LANE_BYTES
    step = max(FEWEST, min(order.room * 3 // 4 // each, (1 << 31) // (order.n_bins + 2)))
    for start in range(0, count, step):
        _fill(task, views, turn[start : start + step], made, order, volume)
    return volume


def _by_blocks(shape: tuple[int, int]) -> Any:  # noqa: ANN401 - indices
    """Pixels in an order in which those of a packet of rays are neighbours."""
    row, column = (axis.ravel() for axis in np.mgrid[0 : shape[0], 0 : shape[1]])
    return np.lexsort((column, row, column // 4, row // 4, column // 32, row // 32))


class _Made:
    """Virtual lights in batches; kept if one batch holds those of all sources."""

    def __init__(self, task: Task, sources: tuple[Emission, ...], order: Order) -> None:
        self.task, self.sources, self.order = task, sources, order
        self.most = max(FEWEST, order.room // 4 // PATH_BYTES)
        self.kept: list[Lights] | None = None

    def __iter__(self) -> Iterator[Lights]:
        if self.kept is not None:
            return iter(self.kept)
        if sum(source.paths for source in self.sources) <= self.most:
            self.kept = list(self._anew())
            return iter(self.kept)
        return self._anew()

    def _anew(self) -> Iterator[Lights]:
        for number, source in enumerate(self.sources):
            seed = self.order.seed * 0x10001 + 0x3D4D51CB * (number + 1)
            for start in range(0, source.paths, self.most):
                part = start, min(self.most, source.paths - start)
                lights = virtual_lights(self.task, source, part, self.order.bounces, seed)
                if lights is not None:
                    yield lights


def _fill(
    task: Task,
    views: F64,
    pixels: Any,  # noqa: ANN401 - indices
    made: _Made,
    order: Order,
    volume: Volume,
) -> None:
    """One batch of pixels."""
    import drjit as dr

    mi, stride = task.mi, order.n_bins + 2
    first = first_hits(task, views[pixels])
    alike, lanes = scatters_alike(mi, first), len(pixels)
    valid = first.is_valid()
    volume.seen[pixels] = np.asarray(valid.numpy(), bool)
    volume.left[pixels] = np.asarray((valid & ~alike).numpy(), bool)
    rows, none = dr.zeros(mi.Float, lanes * stride), dr.zeros(mi.UInt32, lanes)
    counts = (none, none, none)
    if order.bounces > 0 and made.sources and dr.any(alike):
        lights_seen = 0
        for lights in made:
            lights_seen += dr.width(lights.light)
            counts = gather(task, first, lights, counts, depositor(mi, rows, order, 1.0))
            dr.eval(rows, counts)
        volume.lights[:] = [lights_seen]
        rivals = (order.bounces, RAYS, order.seed)
        share = depositor(mi, rows, order, 1 / RAYS)
        pixel = mi.UInt32(np.ascontiguousarray(pixels, np.uint32))
        for source in made.sources:
            counts = camera_walks(task, first, pixel, source, rivals, counts, share)
            dr.eval(rows, counts)
    found = rows.numpy().reshape(lanes, stride)
    volume.values[pixels] = found[:, 1:-1]
    volume.missed[pixels] = found[:, 0] + found[:, -1]
    volume.counts[:] += [int(part.numpy().sum(dtype=np.int64)) for part in counts]
    direct = direct_samples(task, first)
    add(volume, direct._replace(pixel=pixels[direct.pixel]), order)


def gather(task: Task, first: Jit, lights: Lights, counts: Jit, deposit: Deposit) -> Jit:
    """Light of virtual lights at first surfaces, as far as camera paths leave it to them.

    Parameters
    ----------
    task : Task
        Scene.
    first : SurfaceInteraction3f
        First surfaces; those that are not diffuse get nothing.
    lights : Lights
        Virtual lights.
    counts : pytree
        What `deposit` adds to.
    deposit : callable
        Takes up a contribution.

    Returns
    -------
    pytree
        The sums.
    """
    import drjit as dr

    mi, unit, lanes = task.mi, task.stage.unit_m, dr.width(first.t)
    up, alike, lane = up_of(first), scatters_alike(mi, first), dr.arange(mi.UInt32, lanes)
    albedo = first.bsdf().eval_diffuse_reflectance(first, alike)[0] * dr.inv_pi
    range_m = dr.select(alike, first.t * unit, 0.0)
    dr.eval(up, alike, albedo, range_m)
    limit = dr.opaque(mi.UInt32, dr.width(lights.light))

    def body(j: Jit, counts: Jit) -> tuple[Jit, Jit]:
        there = dr.gather(Lights, lights, j)
        away = there.p - first.p
        square = dr.squared_norm(away)
        leg = dr.maximum(dr.dot(up, away), 0.0) * dr.maximum(-dr.dot(there.n, away), 0.0)
        leg /= dr.square(square) * unit**2
        # The share w of `_walks`.
        value = albedo * leg * there.light / (1 + RAYS * dr.inv_pi * leg / there.density)
        active = alike & (value > 0)
        active &= ~task.stage.scene.ray_test(first.spawn_ray_to(there.p), active)
        path_m = range_m + dr.sqrt(square) * unit + there.path_m
        value = dr.select(active, value, 0.0)
        return j + 1, deposit(counts, lane, j, there.bounce, value, path_m)

    return dr.while_loop((mi.UInt32(0), counts), lambda j, _: j < limit, body)[1]


def add_paths(task: Task, views: F64, samples: int, volume: Volume, order: Order) -> None:
    """Indirect light of the pixels that were left, by the paths of the engine path.

    Parameters
    ----------
    task : Task
        Scene and sources.
    views : ndarray, (P, 3)
        Unit vectors in the camera frame.
    samples : int
        Paths per pixel.
    volume : Volume
        Filled in place.
    order : Order
        Axis, bounces and seed.
    """
    left = np.flatnonzero(volume.left)
    # Independent of the memory given, so that batches do not change the result.
    step = max(1, MOST_EVENTS // (samples * events_per_path(task, order.bounces)))
    # Source by source: a kernel that records can do so once per step.
    for number, flash in enumerate(task.flashes):
        lone = replace(task, flashes=(flash,))
        for start in range(0, left.size, step):
            pixels = left[start : start + step]
            seed = (order.seed + 1) * 0x10001 + start + 0x3D4D51CB * number
            first = first_hits(lone, views[pixels])
            rest = indirect_samples(lone, first, bounces=order.bounces, samples=samples, seed=seed)
            add(volume, rest._replace(pixel=pixels[rest.pixel]), order)
