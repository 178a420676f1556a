"""Transient instant radiosity: indirect light from virtual lights, to a tolerance.

Direct light is exact, as in `path`. Surfaces carry virtual lights whose direct light is known and
whose indirect light, of all bounces at once, is solved for; few points of the image gather it with
exact visibility, the others interpolate. So the noise of a path tracer, a pixel's own, becomes an
error that falls nearly as one over the number of virtual lights and costs the same at any
resolution. Phasors of all frequencies and harmonics come out at once.

Surfaces that are not diffuse are followed where the light meets them between diffuse ones; pixels
that look at one are left to `path`, as are whole images that show more such surfaces than diffuse
ones, scenes with modulated lamps, and with lamps and holes. Which share that is, is told. Like
`path` it cannot see light that reaches a surface by way of a mirror or of clear glass from the
camera's point source.

References
----------
Seed "Transient instant radiosity" (2019): eq. (6), (7), (15), (17); there one indirect bounce, a
histogram over time (here `space_time`), visibility from shadow maps, and a clamped geometry term.
A. Keller, "Instant radiosity", SIGGRAPH 1997.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from toftools.sim._exposure import Frame, check_antialias, engine
from toftools.sim._image import Image, Order
from toftools.sim._indirect import MOST, indirect
from toftools.sim._render import ambient_of_lamps, render, tiles_of
from toftools.sim._seen import Seen, seen
from toftools.sim._stop import Depth
from toftools.sim._task import Task
from toftools.sim._views import direct_of_pixels
from toftools.sim.path import depth_of, order_of, told_of
from toftools.sim.world import World
from toftools.types import Capture, Scene, Shot

SOLVED = Depth(512, 0.0, "all of them, as diffuse light is solved for")
"""Bounces of an image whose light is solved for; the number is that of `path` at its most."""

LEAST_DIFFUSE = 0.5
"""Share of what is seen below which virtual lights do not pay: light goes by way of the rest."""
BENT = ("BumpMap", "NormalMap")
"""Materials that scatter about a normal of their own."""


def radiosity(
    scene: Scene | World, *, antialias: int = 1, max_samples: int = 4096, gpu: bool = False
) -> Callable[[Shot], Capture]:
    """Simulator for scenes of mostly diffuse surfaces.

    Parameters
    ----------
    scene : Scene or World
        Scene name or file with its parameters, or a world made by hand.
    antialias : int
        Points per pixel along each side: 1 looks through the pixel's centre, more average over its
        area.
    max_samples : int
        Paths per pixel at the most where `path` is needed.
    gpu : bool
        Trace on an NVIDIA GPU (same kernels, built by CUDA; not covered by tests).

    Returns
    -------
    callable
        ``run(shot) -> Capture`` with taps, phasors and truth; `provenance` says what was modelled
        and why. ``Shot.tol_m`` bounds the error of range, root mean square over the image;
        ``Shot.samples`` is the number of virtual lights instead (and of paths, where needed).

    Raises
    ------
    ValueError
        If the scene or a parameter is unknown, broken or out of range.
    """
    check_antialias(antialias)
    if max_samples < 1:
        msg = f"max_samples must be 1 or more, got {max_samples}"
        raise ValueError(msg)

    def expose(task: Task, shot: Shot, earlier: Frame | None) -> Frame:
        what = seen(task, shot.sensor.camera, antialias)
        obstacle = _obstacle(task, shot, what) if earlier is None else _left(earlier)
        if obstacle is None:
            return _frame(task, shot, earlier, what, (antialias, max_samples))
        depth = depth_of(task, shot, earlier)
        image = render(task, order_of(shot, depth, antialias, max_samples))
        return Frame(image, {**told_of(depth), "left_to_path": 1.0, "left_why": obstacle}, task)

    return engine("radiosity", scene, expose, antialias=antialias, gpu=gpu)


def _left(earlier: Frame) -> str | None:
    """What left the whole first frame of a sequence to `path`: all its frames go one way."""
    return None if "path_bounces" in earlier.told else earlier.told.get("left_why")


def _obstacle(task: Task, shot: Shot, what: Seen) -> str | None:
    """What leaves the whole scene to `path`."""
    if what.met.any() and what.diffuse.sum() < LEAST_DIFFUSE * what.met.sum():
        return "most of what is seen is not diffuse"
    if task.lamps and task.holes:
        return "surfaces have holes or veils, and lamps shine"
    if task.lamps and task.stage.lamp_modulated.any():
        return "lamps of the scene are modulated"
    if shot.max_bounces is not None and not _all_diffuse(task):
        return "a number of bounces was asked for, and not all surfaces are diffuse"
    return None


def _all_diffuse(task: Task) -> bool:
    """Whether no material of the scene has a part that is not diffuse."""
    kinds = task.mi.BSDFFlags
    other = kinds.Glossy | kinds.Delta | kinds.DiffuseTransmission
    shapes = (shape.bsdf() for shape in task.stage.scene.shapes())
    # Flags tell nothing of bent normals; what a material is made of does.
    return not any(
        bsdf.flags() & other or any(name in str(bsdf) for name in BENT)
        for bsdf in shapes
        if bsdf is not None
    )


def _frame(
    task: Task, shot: Shot, earlier: Frame | None, what: Seen, limits: tuple[int, int]
) -> Frame:
    """Diffuse pixels out of virtual lights, the others out of paths."""
    if shot.samples is not None and shot.samples > MOST:
        msg = f"radiosity takes at most {MOST} virtual lights (spp), got {shot.samples}"
        raise ValueError(msg)
    depth = SOLVED if shot.max_bounces is None else depth_of(task, shot, None)
    order = order_of(shot, depth, *limits)
    image = _directly(task, order)
    other, diffuse = _kinds(what, order)
    told: dict[str, Any] = {**told_of(depth), "left_to_path": float(other.mean())}
    if shot.max_bounces != 0 and diffuse.any():
        light = indirect(task, order, image.direct, shot.max_bounces, what)
        image = replace(
            image,
            one_bounce=light.one_bounce,
            rest=light.rest,
            ambient=image.ambient + light.ambient,
            error_m=light.error_m,
        )
        told |= light.told
    if task.lamps:
        _, turn = tiles_of(*order.camera.shape)
        mine = turn[~other.ravel()[turn]]
    if task.lamps and mine.size:
        image.ambient.reshape(-1)[mine] += ambient_of_lamps(task, order, mine)
    if not other.any():
        return Frame(image, told, task)
    deep = _earlier(earlier) or depth_of(task, shot, None)
    paths = render(task, order_of(shot, deep, *limits), only=other)
    told |= {"left_why": "their surfaces are not diffuse", "path_bounces": deep.bounces}
    if "tolerance_met" in told:
        told["tolerance_met"] &= not (paths.error_m[other] > shot.tol_m).any()  # NaN is no error
    return Frame(_merged(image, paths, other), told, task)


def _earlier(earlier: Frame | None) -> Depth | None:
    """Bounces of the paths of the first frame of a sequence, if that had any."""
    if earlier is None or "path_bounces" not in earlier.told:
        return None
    return Depth(int(earlier.told["path_bounces"]), np.nan, "as at the first time")


def _directly(task: Task, order: Order) -> Image:
    """The image without indirect light."""
    height, width = order.camera.shape
    every = np.arange(height * width)
    found = direct_of_pixels(task, order.camera, every, order.side, order.freqs_hz)
    direct = found.direct.reshape(-1, height, width)
    none, blank = np.zeros_like(direct), np.zeros((height, width))
    return Image(direct, none, none, found.ambient.reshape(height, width), blank, blank)


def _kinds(what: Seen, order: Order) -> tuple[Any, Any]:
    """Pixels that see anything that is not diffuse, and those that see only what is, (H, W)."""
    height, width = order.camera.shape
    shape = (height, order.side, width, order.side)
    other, diffuse = (
        flags.reshape(shape).any(axis=(1, 3)) for flags in (what.met & ~what.diffuse, what.diffuse)
    )
    return other, diffuse & ~other


def _merged(image: Image, paths: Image, other: Any) -> Image:  # noqa: ANN401 - bools
    """One image with some pixels of the other."""
    names = (field.name for field in fields(Image))
    return Image(
        **{name: np.where(other, getattr(paths, name), getattr(image, name)) for name in names}
    )
