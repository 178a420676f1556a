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
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.phasor import demodulate
from toftools.sim._flash import flashes_of
from toftools.sim._holes import MOST
from toftools.sim._render import Image, Order, render
from toftools.sim._stop import Depth, needed_bounces
from toftools.sim._task import Task, first_hits
from toftools.sim.noise import (
    Frame,
    Light,
    capture_moving,
    capture_taps,
    light_freqs_hz,
    true_phasors,
)
from toftools.sim.scenes import world_of
from toftools.sim.stage import load
from toftools.sim.world import World, world_at
from toftools.types import C64, F32, F64, Capture, Scene, Sensor, Shot, Taps, Truth

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
    if not 1 <= antialias <= 16:
        msg = f"antialias must be 1..16 points along a pixel, got {antialias}"
        raise ValueError(msg)
    if max_samples < 1:
        msg = f"max_samples must be 1 or more, got {max_samples}"
        raise ValueError(msg)
    variant = "cuda_ad_mono" if gpu else "llvm_ad_mono"
    if not isinstance(scene, Scene | World):
        msg = (
            f"path got a {type(scene).__name__}, wanted a Scene or a World; a Mitsuba dictionary "
            "becomes one by toftools.sim.scenes.from_dict"
        )
        raise ValueError(msg)
    world = world_of(scene) if isinstance(scene, Scene) else scene
    name: dict[str, Any] = {}
    if isinstance(scene, Scene):  # parameters apart: the seed of a room is not that of its noise
        name = {"scene": scene.name, "scene_params": dict(scene.params)}
    mi = import_mitsuba(variant)
    still = load(world, variant=variant)  # broken scenes are refused here, not at the first shot

    def run(shot: Shot) -> Capture:
        moves = bool(world.velocity_mps) and shot.sensor.timing.tap_interval_s > 0
        done: dict[float, _Frame] = {}

        def frame_at(time_s: float) -> Frame:
            stage = load(world_at(world, time_s), variant=variant) if time_s else still
            task = Task(mi, stage, flashes_of(mi, stage, shot.sensor))
            done[time_s] = _expose(task, shot, antialias, max_samples, done.get(0.0))
            return done[time_s].light, done[time_s].ambient_e

        seed = shot.seed if shot.noisy else None
        if moves:
            taps = capture_moving(frame_at, shot.sensor, seed=seed)
        else:
            taps = capture_taps(*frame_at(0.0), shot.sensor, seed=seed)
        return _capture(shot, taps, done[0.0], {**name, **_told(shot, done, world, antialias)})

    return run


@dataclass(frozen=True, eq=False)
class _Frame:
    """One still picture: light of every pixel at every frequency."""

    light: Light
    ambient_e: F64
    image: Image
    depth: Depth
    task: Task


def _expose(
    task: Task, shot: Shot, antialias: int, max_samples: int, earlier: _Frame | None
) -> _Frame:
    """Light at one time; later times of a sequence keep the bounces of the first."""
    sensor, freqs_hz = shot.sensor, light_freqs_hz(shot.sensor)
    if shot.max_bounces is not None:
        depth = Depth(shot.max_bounces, np.nan, f"{shot.max_bounces} bounces were asked for")
    elif earlier is not None:
        depth = earlier.depth
    else:
        centres, mod_hz = rays(sensor.camera).reshape(-1, 3), sensor.modulation.freqs_hz
        depth = needed_bounces(task, centres, mod_hz, shot.tol_m, shot.seed)
        log.info("%s", depth.why)
    order = Order(
        camera=sensor.camera,
        side=antialias,
        freqs_hz=freqs_hz,
        used=np.searchsorted(freqs_hz, sensor.modulation.freqs_hz),
        bounces=depth.bounces,
        ambient_bounces=max(depth.bounces, AMBIENT_BOUNCES if shot.max_bounces is None else 0),
        samples=shot.samples,
        tol_m=shot.tol_m,
        max_samples=max_samples,
        seed=shot.seed,
    )
    image = render(task, order)
    signal_e = sensor.noise.signal_e
    ambient_e = task.stage.ambient_e + signal_e * image.ambient
    light = _light(image.direct + image.one_bounce + image.rest, freqs_hz, signal_e)
    return _Frame(light, ambient_e, image, depth, task)


def _light(phasors: Any, freqs_hz: F64, signal_e: float) -> Light:  # noqa: ANN401
    """Light by frequency, as the sensor model asks for it."""
    by_freq = {float(f): signal_e * layer for f, layer in zip(freqs_hz, phasors, strict=True)}
    return by_freq.__getitem__


def _capture(shot: Shot, taps: Taps, frame: _Frame, told: dict[str, Any]) -> Capture:
    return Capture(
        sensor=shot.sensor,
        taps=taps,
        phasors=demodulate(taps, shot.sensor),
        truth=_truth(shot.sensor, frame),
        provenance={"engine": "path", **told},
    )


def _truth(sensor: Sensor, frame: _Frame) -> Truth:
    """What the camera should have seen, through the centres of its pixels."""
    stage, shape = frame.task.stage, sensor.camera.shape
    views = rays(sensor.camera).reshape(-1, 3)
    first = first_hits(frame.task, views, hole=MOST)
    hit = np.asarray(first.is_valid().numpy(), bool)
    range_m = np.where(hit, first.t.numpy() * stage.unit_m, np.nan)
    normals = first.n.numpy().T @ stage.to_world[:3, :3]  # scene to camera frame
    facing = np.sign(-(normals * np.nan_to_num(views)).sum(axis=1, keepdims=True))
    albedo = first.bsdf().eval_diffuse_reflectance(first, first.is_valid())[0].numpy()
    image, freqs_hz, signal_e = frame.image, light_freqs_hz(sensor), sensor.noise.signal_e
    parts: dict[str, C64] = {
        name: true_phasors(_light(getattr(image, name), freqs_hz, signal_e), sensor)
        for name in ("direct", "one_bounce", "rest")
    }
    normals = np.where(hit[:, None], normals * facing, np.nan).reshape(*shape, 3)
    # Mitsuba's diffuse reflectance of a metal is its highlight, which has no bound.
    albedo = np.where(hit & (albedo < 1.001), albedo, np.nan).reshape(shape)
    return Truth(_f32(range_m.reshape(shape)), **parts, normals=_f32(normals), albedo=_f32(albedo))


def _f32(values: F64) -> F32:
    return np.asarray(values, dtype=np.float32)


def _told(shot: Shot, frames: dict[float, _Frame], world: World, antialias: int) -> dict[str, Any]:
    """What was modelled, and why: the report that travels with the capture."""
    first = frames[0.0]
    error_m = first.image.error_m
    known = np.isfinite(error_m)
    worst_mm = 1e3 * float(error_m[known].max()) if known.any() else None
    lamps = first.task.stage.lamp_modulated
    return {
        "seed": shot.seed if shot.noisy else None,
        "path_seed": shot.seed,
        "max_bounces": first.depth.bounces,
        "max_bounces_why": first.depth.why,
        "left_out_mm": None if np.isnan(first.depth.left_m) else 1e3 * first.depth.left_m,
        "samples": int(first.image.samples.max()),
        "samples_mean": float(first.image.samples.mean()),
        "standard_error_mm": worst_mm,
        "tolerance_mm": 1e3 * shot.tol_m if shot.samples is None else None,
        "tolerance_met": None if shot.samples is not None or worst_mm is None
        else worst_mm <= 1e3 * shot.tol_m,
        "within_tolerance": None if shot.samples is not None or worst_mm is None
        else float((error_m[known] <= shot.tol_m).mean()),
        "antialias": antialias,
        "ambient_e": world.ambient_e,
        "lamps": {"modulated": int(lamps.sum()), "ambient": int((~lamps).sum())},
        "lamp_gain": world.lamp_gain,
        "frames": len(frames),
        "not_modelled": "caustics: light that mirrors or clear glass throw on other surfaces",
        **({"scene_notes": list(notes)} if (notes := getattr(world, "notes", ())) else {}),
    }  # fmt: skip
