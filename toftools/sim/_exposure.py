"""From the light of an image to a capture: what every engine with surfaces does alike."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.phasor import demodulate
from toftools.sim._flash import flashes_of
from toftools.sim._holes import MOST
from toftools.sim._image import Image
from toftools.sim._kept import light_key, light_seed
from toftools.sim._task import Task, first_hits
from toftools.sim.noise import Frame as Exposed
from toftools.sim.noise import (
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


@dataclass(frozen=True, eq=False)
class Frame:
    """One still picture: light of every pixel at every frequency.

    Parameters
    ----------
    image : Image
        The light.
    told : mapping
        What the engine did, and why (JSON values).
    task : Task
        Scene and sources.
    """

    image: Image
    told: Mapping[str, Any]
    task: Task


Expose = Callable[[Task, Shot, Frame | None], Frame]
"""Light at one time; gets the frame of the first time, if there was one."""


def check_antialias(antialias: int) -> None:
    """Refuse numbers of points along a pixel that make no sense."""
    if not 1 <= antialias <= 16:
        msg = f"antialias must be 1..16 points along a pixel, got {antialias}"
        raise ValueError(msg)


def engine(
    name: str, scene: Scene | World, expose: Expose, *, antialias: int, gpu: bool
) -> Callable[[Shot], Capture]:
    """Simulator out of what makes its light.

    Parameters
    ----------
    name : str
        Name of the engine.
    scene : Scene or World
        What to look at.
    expose : callable
        Makes the light.
    antialias : int
        Points along a pixel, for the report.
    gpu : bool
        Trace on an NVIDIA GPU.

    Returns
    -------
    callable
        ``run(shot) -> Capture``.

    Raises
    ------
    ValueError
        If the scene is unknown or broken.
    """
    variant = "cuda_ad_mono" if gpu else "llvm_ad_mono"
    if not isinstance(scene, Scene | World):
        msg = (
            f"{name} got a {type(scene).__name__}, wanted a Scene or a World; a Mitsuba dictionary "
            "becomes one by toftools.sim.scenes.from_dict"
        )
        raise ValueError(msg)
    world = world_of(scene) if isinstance(scene, Scene) else scene
    about: dict[str, Any] = {"engine": name}
    if isinstance(scene, Scene):  # parameters apart: the seed of a room is not that of its noise
        about |= {"scene": scene.name, "scene_params": dict(scene.params)}
    mi = import_mitsuba(variant)
    still = load(world, variant=variant)  # broken scenes are refused here, not at the first shot
    kept: dict[str, Frame] = {}

    def run(shot: Shot) -> Capture:
        moves = bool(world.velocity_mps) and shot.sensor.timing.tap_interval_s > 0
        done: dict[float, Frame] = {}
        freqs_hz, signal_e = light_freqs_hz(shot.sensor), shot.sensor.noise.signal_e

        def frame_at(time_s: float) -> Exposed:
            key = None if time_s else light_key(shot)
            if key is not None and key in kept:
                done[time_s] = kept[key]
            else:
                stage = load(world_at(world, time_s), variant=variant) if time_s else still
                task = Task(mi, stage, flashes_of(mi, stage, shot.sensor))
                done[time_s] = expose(task, shot, done.get(0.0))
            if key is not None:
                kept.clear()  # the last one alone: pictures are large
                kept[key] = done[time_s]
            image, ambient_e = done[time_s].image, done[time_s].task.stage.ambient_e
            total = image.direct + image.one_bounce + image.rest
            return _light(total, freqs_hz, signal_e), ambient_e + signal_e * image.ambient

        seed = shot.seed if shot.noisy else None
        if moves:
            taps = capture_moving(frame_at, shot.sensor, seed=seed)
        else:
            taps = capture_taps(*frame_at(0.0), shot.sensor, seed=seed)
        told = {**about, **_told(shot, done, world), "antialias": antialias}
        return _capture(shot, taps, done[0.0], told)

    return run


def _light(phasors: Any, freqs_hz: F64, signal_e: float) -> Light:  # noqa: ANN401
    """Light by frequency, as the sensor model asks for it."""
    by_freq = {float(f): signal_e * layer for f, layer in zip(freqs_hz, phasors, strict=True)}
    return by_freq.__getitem__


def _capture(shot: Shot, taps: Taps, frame: Frame, told: dict[str, Any]) -> Capture:
    return Capture(
        sensor=shot.sensor,
        taps=taps,
        phasors=demodulate(taps, shot.sensor),
        truth=_truth(shot.sensor, frame),
        provenance=told,
    )


def _truth(sensor: Sensor, frame: Frame) -> Truth:
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


def _told(shot: Shot, frames: dict[float, Frame], world: World) -> dict[str, Any]:
    """What was modelled, and why: the report that travels with the capture."""
    first = frames[0.0]
    error_m = first.image.error_m
    known = np.isfinite(error_m)
    worst_mm = 1e3 * float(error_m[known].max()) if known.any() else None
    judged = shot.samples is None and worst_mm is not None
    lamps = first.task.stage.lamp_modulated
    return {
        "seed": shot.seed if shot.noisy else None,
        "path_seed": light_seed(shot),
        "samples": int(first.image.samples.max()),
        "samples_mean": float(first.image.samples.mean()),
        "standard_error_mm": worst_mm,
        "tolerance_mm": 1e3 * shot.tol_m if shot.samples is None else None,
        "tolerance_met": worst_mm <= 1e3 * shot.tol_m if judged and worst_mm is not None else None,
        "within_tolerance": float((error_m[known] <= shot.tol_m).mean()) if judged else None,
        "ambient_e": world.ambient_e,
        "lamps": {"modulated": int(lamps.sum()), "ambient": int((~lamps).sum())},
        "lamp_gain": world.lamp_gain,
        "frames": len(frames),
        "not_modelled": "caustics: light that mirrors or clear glass throw on other surfaces",
        **first.told,
        **({"scene_notes": list(notes)} if (notes := getattr(world, "notes", ())) else {}),
    }
