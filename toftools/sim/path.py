"""Path tracing of any scene: unbiased phasors at all frequencies and harmonics in one pass.

The engine for what has no closed form: Mitsuba 3 finds intersections and materials, everything that
makes a time-of-flight camera is here. The origin of path length is the camera centre; ambient light
adds offset only; refraction carries optical length; direct light has no noise. Paths are drawn
until the standard error of range is below the tolerance, bounces until the rest cannot move range
by more. It cannot see light that reaches a surface by way of a mirror or of clear glass from the
camera's point source, which then lies in shadow; rough reflectors take many paths.

References
----------
Radiance along paths: J. Kajiya, "The Rendering Equation", 1986. A phasor is its Fourier transform
over path length, so the same paths carry ``exp(+j 2 pi f l / c)`` as weight at every f.
"""

import logging
from collections.abc import Callable

import numpy as np

from toftools.camera import rays
from toftools.sim._exposure import Frame, check_antialias, engine
from toftools.sim._image import Order
from toftools.sim._kept import light_seed
from toftools.sim._render import render
from toftools.sim._stop import Depth, needed_bounces
from toftools.sim._task import Task
from toftools.sim.noise import light_freqs_hz
from toftools.sim.world import World
from toftools.types import Capture, Scene, Shot

log = logging.getLogger(__name__)

AMBIENT_BOUNCES = 12
"""Bounces of unmodulated light at the least: at albedo 0.7, 1 % of it bounces on."""


def path(
    scene: Scene | World, *, antialias: int = 1, max_samples: int = 4096, gpu: bool = False
) -> Callable[[Shot], Capture]:
    """Simulator for any scene with surfaces.

    Parameters
    ----------
    scene : Scene or World
        Scene name or file with its parameters, or a world made by hand.
    antialias : int
        Points per pixel along each side: 1 looks through the pixel's centre, more average over its
        area (and make flying pixels at edges, where the grid of the direct light is finer still).
    max_samples : int
        Paths per pixel at which a tile is left even above the tolerance.
    gpu : bool
        Trace on an NVIDIA GPU (same kernels, built by CUDA; not covered by tests).

    Returns
    -------
    callable
        ``run(shot) -> Capture`` with taps, phasors and truth; `provenance` says what was modelled
        and why.

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
        depth = depth_of(task, shot, earlier)
        order = order_of(shot, depth, antialias, max_samples)
        return Frame(render(task, order), told_of(depth), task)

    return engine("path", scene, expose, antialias=antialias, gpu=gpu)


def depth_of(task: Task, shot: Shot, earlier: Frame | None) -> Depth:
    """Bounces to model; later times of a sequence keep those of the first.

    Parameters
    ----------
    task : Task
        Scene and sources.
    shot : Shot
        What is asked for.
    earlier : Frame or None
        The first frame.

    Returns
    -------
    Depth
        Bounces, and why.
    """
    if shot.max_bounces is not None:
        return Depth(shot.max_bounces, np.nan, f"{shot.max_bounces} bounces were asked for")
    if earlier is not None and "max_bounces" in earlier.told:
        told = earlier.told
        left_mm = told["left_out_mm"]
        left_m = np.nan if left_mm is None else 1e-3 * left_mm
        return Depth(told["max_bounces"], left_m, told["max_bounces_why"])
    centres, mod_hz = rays(shot.sensor.camera).reshape(-1, 3), shot.sensor.modulation.freqs_hz
    depth = needed_bounces(task, centres, mod_hz, shot.tol_m, light_seed(shot))
    log.info("%s", depth.why)
    return depth


def told_of(depth: Depth) -> dict[str, object]:
    """What is said about bounces.

    Parameters
    ----------
    depth : Depth
        Bounces, and why.

    Returns
    -------
    dict
        Entries of the provenance.
    """
    return {
        "max_bounces": depth.bounces,
        "max_bounces_why": depth.why,
        "left_out_mm": None if np.isnan(depth.left_m) else 1e3 * depth.left_m,
    }


def order_of(shot: Shot, depth: Depth, antialias: int, max_samples: int) -> Order:
    """What to render for a shot.

    Parameters
    ----------
    shot : Shot
        What is asked for.
    depth : Depth
        Bounces.
    antialias, max_samples : int
        As of `path`.

    Returns
    -------
    Order
        For `render`.
    """
    freqs_hz = light_freqs_hz(shot.sensor)
    return Order(
        camera=shot.sensor.camera,
        side=antialias,
        freqs_hz=freqs_hz,
        used=np.searchsorted(freqs_hz, shot.sensor.modulation.freqs_hz),
        bounces=depth.bounces,
        ambient_bounces=max(depth.bounces, AMBIENT_BOUNCES if shot.max_bounces is None else 0),
        samples=shot.samples,
        tol_m=shot.tol_m,
        max_samples=max_samples,
        seed=light_seed(shot),
    )
