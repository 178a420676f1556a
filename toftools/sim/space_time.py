"""Transient instant radiosity: the space-time histogram of a scene out of virtual point lights.

The method of the seed "Transient instant radiosity" (2019): light subpaths leave virtual lights
with an optical path each (eq. 12, 15, 17), and every pixel gathers from all of them into bins of
path length (eq. 6, 7; algorithm 1), so that its transient has as many contributions as there are
virtual lights, not as it has paths of its own. The limits of the paper are gone: subpaths of any
length instead of one bounce (eq. 16), any sources of the camera instead of one spotlight, shadow
rays instead of imperfect shadow maps, no clamping (`_walks` has the weights that replace it), and
pixels that look at mirrors, glass or gloss are left to path samples instead of being refused.
Neighbouring pixels share their lights, so their errors are alike: banding in time where the lights
are few. Caustics are not modelled; light of the scene's own lamps is left to `transients`.

References
----------
The seed, eq. (6), (7), (12), (15), (16), (17) and algorithm 1.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sim._bins import Order, Volume
from toftools.sim._flash import flashes_of
from toftools.sim._kept import light_seed
from toftools.sim._samples import DEFAULT_SAMPLES
from toftools.sim._space_time import RAYS, add_paths, filled
from toftools.sim._stop import needed_bounces
from toftools.sim._task import Task
from toftools.sim._walks import LAST, emissions
from toftools.sim.scenes import world_of
from toftools.sim.stage import load
from toftools.sim.transients import check_axis
from toftools.sim.world import World
from toftools.transient import Transient
from toftools.types import F64, Scene, Sensor, Shot

DEFAULT_PATHS = 128 * 128
"""Light subpaths where none are asked for: those of the paper's largest setting."""


def space_time(
    scene: Scene | World,
    shot: Shot,
    *,
    bin_m: float = 0.01,
    n_bins: int = 2048,
    start_m: float = 0.0,
    memory_mb: float = 2048,
    gpu: bool = False,
) -> Transient:
    """Transient of every pixel by virtual lights, through the centres of the pixels.

    Parameters
    ----------
    scene : Scene or World
        Scene name or file with its parameters, or a world made by hand.
    shot : Shot
        Sensor, seed, most bounces (None: all), and light subpaths as its ``samples`` (16384 if not
        given). Its tolerance and noise do not count.
    bin_m, n_bins, start_m
        Axis, m of whole optical path, as for `transients.histogram`.
    memory_mb : float
        Working memory beside the result itself, MB; less of it means more batches, not another
        result.
    gpu : bool
        Trace on an NVIDIA GPU (same kernels, built by CUDA; not covered by tests).

    Returns
    -------
    Transient
        Relative light, direct light in its bin; `missed` is the light outside the axis. Keys of
        `info` as of `transients.transient`, and: ``paths`` light subpaths made ``virtual_lights``;
        ``camera_paths`` per pixel; ``left_to_path`` pixels (``left_share`` of those that see
        something) were left to path samples.

    Raises
    ------
    ValueError
        If the scene is broken, its lamps are modulated, or the axis or memory make no sense.
    """
    check_axis(shot.sensor.camera.shape, bin_m, n_bins, start_m)
    if not (np.isfinite(memory_mb) and memory_mb > 0):
        msg = f"memory_mb must be a positive number of megabytes, got {memory_mb}"
        raise ValueError(msg)
    task = _task(scene, shot.sensor, "cuda_ad_mono" if gpu else "llvm_ad_mono")
    views = rays(shot.sensor.camera).reshape(-1, 3)
    sources = emissions(task, shot.samples or DEFAULT_PATHS)
    bounces = LAST if shot.max_bounces is None else min(shot.max_bounces, LAST)
    order = Order(start_m, bin_m, n_bins, bounces, light_seed(shot), int(memory_mb * 1e6))
    volume = filled(task, sources, views, shot.sensor.camera.shape, order)
    told: dict[str, Any] = {
        "engine": "instant radiosity",
        "max_bounces": shot.max_bounces,
        "paths": sum(source.paths for source in sources),
        "path_seed": light_seed(shot),
        "virtual_lights": sum(volume.lights),
        "camera_paths": RAYS if bounces else 0,
        "left_to_path": int(volume.left.sum()),
        "left_share": float(volume.left.sum() / max(1, volume.seen.sum())),
    }
    if volume.left.any() and bounces:
        _leave(task, shot, views, volume, order)
    return _transient(volume, shot.sensor, order, told)


def _task(scene: Scene | World, sensor: Sensor, variant: str) -> Task:
    """Scene and modulated sources."""
    if not isinstance(scene, Scene | World):
        msg = f"space_time got a {type(scene).__name__}, wanted a Scene or a World"
        raise ValueError(msg)
    mi = import_mitsuba(variant)
    stage = load(world_of(scene) if isinstance(scene, Scene) else scene, variant=variant)
    if stage.lamp_gain > 0 and stage.lamp_modulated.any():
        msg = (
            "space_time takes light from the camera's sources, and this scene has lamps that are "
            "modulated; use toftools.sim.transients.transient"
        )
        raise ValueError(msg)
    flashes = tuple(flash for flash in flashes_of(mi, stage, sensor) if flash.modulated)
    return Task(mi, stage, flashes).without_lamps()


def _leave(task: Task, shot: Shot, views: F64, volume: Volume, order: Order) -> None:
    """Pixels whose first surface is not diffuse."""
    bounces = shot.max_bounces
    if bounces is None:
        freqs_hz = shot.sensor.modulation.freqs_hz
        bounces = needed_bounces(task, views, freqs_hz, shot.tol_m, light_seed(shot)).bounces
    add_paths(task, views, DEFAULT_SAMPLES, volume, replace(order, bounces=bounces))


def _transient(volume: Volume, sensor: Sensor, order: Order, told: dict[str, Any]) -> Transient:
    counts = dict(zip(("samples", "before", "beyond"), volume.counts.tolist(), strict=True))
    shape = sensor.camera.shape
    return Transient(
        volume.values.T.reshape(order.n_bins, *shape),  # a view: bins stay side by side
        order.bin_m,
        np.asarray(order.start_m),
        missed=volume.missed.reshape(shape),
        info={"method": "histogram", "passes": 1, **counts, **told},
    )
