"""Path samples out of the tracer: every contribution with its pixel and its path, for transients.

The same paths that the phasor engine sums up, written down one by one instead. Contributions are
ordered before they are handed on, so that a seed gives the same transient however many threads
wrote them. It needs room for all contributions of a pass: 12 bytes each on the device.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sim._flash import flash_light, flashes_of
from toftools.sim._kept import light_seed
from toftools.sim._lamps import lamps_seen
from toftools.sim._stop import needed_bounces
from toftools.sim._task import Jit, Task, first_hits
from toftools.sim._tracer import trace
from toftools.sim.scenes import world_of
from toftools.sim.stage import load
from toftools.sim.world import World
from toftools.transient import Samples
from toftools.types import F64, Scene, Shot

FEWEST_PASSES, DEFAULT_SAMPLES = 16, 256
"""Passes over which the kernel shrinks at least, and paths per pixel where none are asked for."""
MOST_EVENTS = 1 << 22
"""Contributions of a pass: more passes rather than more room than 100 MB."""


class Traced(NamedTuple):
    """All modulated light of a scene as path samples.

    Parameters
    ----------
    direct : Samples
        Direct light, exact.
    passes : iterator of Samples
        Independent estimates of the rest; none where no light bounces.
    told : mapping
        What was modelled (JSON values).
    """

    direct: Samples
    passes: Iterator[Samples]
    told: Mapping[str, Any]


def traced(scene: Scene | World, shot: Shot) -> Traced:
    """Paths of a scene through the centres of a sensor's pixels.

    Parameters
    ----------
    scene : Scene or World
        What to look at.
    shot : Shot
        Sensor, seed, bounces and paths per pixel.

    Returns
    -------
    Traced
        Path samples, made as they are asked for.

    Raises
    ------
    ValueError
        If the scene is broken.
    """
    mi = import_mitsuba()
    stage = load(world_of(scene) if isinstance(scene, Scene) else scene)
    task = Task(mi, stage, flashes_of(mi, stage, shot.sensor))
    views = rays(shot.sensor.camera).reshape(-1, 3)
    first = first_hits(task, views)
    bounces = shot.max_bounces
    if bounces is None:
        freqs_hz = shot.sensor.modulation.freqs_hz
        bounces = needed_bounces(task, views, freqs_hz, shot.tol_m, light_seed(shot)).bounces
    by_chance = bounces > 0 or task.lamps or task.holes
    wanted = (shot.samples or DEFAULT_SAMPLES) if by_chance else 0
    fit = MOST_EVENTS // (len(views) * events_per_path(task, bounces))
    each = max(1, min(wanted // FEWEST_PASSES, fit))

    def passes() -> Iterator[Samples]:
        for number in range(-(-wanted // each)):
            # As the engine path seeds its passes.
            seed = light_seed(shot) * 0x10001 + number
            yield indirect_samples(task, first, bounces=bounces, samples=each, seed=seed)

    told = {"engine": "path", "max_bounces": bounces, "paths": -(-wanted // each) * each,
            "path_seed": light_seed(shot)}  # fmt: skip
    return Traced(direct_samples(task, first), passes(), told)


def direct_samples(task: Task, first: Jit) -> Samples:
    """Light that needs no chance, one contribution per source and lane.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane.

    Returns
    -------
    Samples
        Modulated direct light, in units of `Noise.signal_e`.
    """
    mi, stage, valid = task.mi, task.stage, first.is_valid()
    range_m = _numpy(first.t) * stage.unit_m
    parts = []
    for flash in task.flashes:
        if flash.modulated:
            value, far_m = flash_light(mi, stage, flash, first, valid, lit=flash.at_camera)
            parts.append((_numpy(value), range_m + _numpy(far_m)))
    if task.lamps:
        light = lamps_seen(mi, stage, first, mi.Bool(True))
        parts.append((_numpy(light.modulated), _numpy(light.far_m)))
    lane = np.arange(range_m.size)
    shining = [weight > 0 for weight, _ in parts]
    return Samples(
        np.concatenate([lane[lit] for lit in shining]),
        np.concatenate([path_m[lit] for (_, path_m), lit in zip(parts, shining, strict=True)]),
        np.concatenate([weight[lit] for (weight, _), lit in zip(parts, shining, strict=True)]),
    )


def indirect_samples(task: Task, first: Jit, *, bounces: int, samples: int, seed: int) -> Samples:
    """One independent estimate of all modulated light that `direct_samples` leaves out.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane.
    bounces, samples, seed : int
        As `trace` takes them.

    Returns
    -------
    Samples
        Weights of a lane sum to its estimate.
    """
    import drjit as dr

    room = dr.width(first.t) * samples * events_per_path(task, bounces)
    while True:
        lane, path_m, weight, count = _record(task, first, bounces, samples, seed, room)
        if count <= room:
            break
        room = count  # holes make more events than bounces; now their number is known
    order = _order(lane, path_m, weight)
    return Samples(lane[order].astype(np.int64), path_m[order], weight[order] / samples)


def _order(lane: Any, path_m: F64, weight: F64) -> Any:  # noqa: ANN401 - indices
    """One order of the samples, however they came; fast where no two share lane and path."""
    bits = path_m.astype(np.float32).view(np.uint32)  # of single precision on the device
    key = lane.astype(np.uint64) << np.uint64(32) | bits
    order = np.argsort(key)
    tied = key[order[1:]] == key[order[:-1]]
    return np.lexsort((weight, key)) if tied.any() else order


def events_per_path(task: Task, bounces: int) -> int:
    """Contributions that a path makes at most where no surface has holes.

    Parameters
    ----------
    task : Task
        Scene and sources.
    bounces : int
        Indirect bounces.

    Returns
    -------
    int
        At least 1.
    """
    sources = sum(flash.modulated for flash in task.flashes)
    return max(1, bounces * sources + (2 * (bounces + 1) if task.lamps else 0))


def _record(
    task: Task, first: Jit, bounces: int, samples: int, seed: int, room: int
) -> tuple[Any, F64, F64, int]:
    """Lane, path and weight of the first `room` contributions, and how many there were."""
    import drjit as dr

    mi = task.mi
    lanes, counter = dr.zeros(mi.UInt32, room), dr.zeros(mi.UInt32, 1)
    paths, weights = dr.zeros(mi.Float, room), dr.zeros(mi.Float, room)

    def deposit(sums: Jit, lane: Jit, _number: Jit, _bounce: Jit, light: Jit, path_m: Jit) -> Jit:
        shines = light > 0
        slot: Jit = dr.scatter_inc(counter, mi.UInt32(0), shines)
        shines &= slot < room
        for target, value in ((lanes, lane), (paths, path_m), (weights, light)):
            dr.scatter(target, value, slot, shines)
        return sums

    sums, _ = trace(
        task,
        first,
        bounces=bounces,
        samples=samples,
        seed=seed,
        sums=dr.zeros(mi.Float, dr.width(first.t)),
        deposit=deposit,
    )
    dr.eval(sums, lanes, paths, weights, counter)
    count = int(counter.numpy()[0])
    kept = slice(0, min(count, room))
    return lanes.numpy()[kept], _numpy(paths)[kept], _numpy(weights)[kept], count


def _numpy(values: Jit) -> F64:
    return np.asarray(values.numpy(), dtype=np.float64)
