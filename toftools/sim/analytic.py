"""Closed-form captures: scenes whose transport is known to the last digit.

Direct light of a co-located isotropic source on a Lambertian surface is
``B = signal_e * albedo * cos / range^2`` electrons per tap; every scene below gives the complex
sum over its returns at any frequency, so harmonics, several frequencies and the DC level come
from one expression. No sampling, no bins: these captures are the oracle of the tests and the
input of the benchmark where no real capture is at hand. They fail where a scene has no closed
form: use a rendering engine there.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from toftools.phasor import demodulate
from toftools.registry import checked_params, parameters_of
from toftools.sim.noise import Frame, capture_moving, capture_taps, true_phasors
from toftools.sim.planted import returns, two_returns
from toftools.sim.shapes import Transport, cavity, corner, tilted, wall
from toftools.types import C64, Capture, Scene, Shot, Truth

SCENES: Mapping[str, Callable[..., Transport]] = MappingProxyType(
    {
        "wall": wall,
        "tilted": tilted,
        "two_returns": two_returns,
        "returns": returns,
        "cavity": cavity,
        "corner": corner,
    }
)
"""Scene name to its closed form."""


MOVABLE = ("wall", "tilted")
"""Scenes whose only length is their range, so that a camera moving along its axis is trivial."""


def analytic(scene: Scene) -> Callable[[Shot], Capture]:
    """Simulator for the closed-form scenes.

    Parameters
    ----------
    scene : Scene
        Name out of `SCENES` and its parameters (SI units, angles in degrees), plus
        ``ambient_e``, unmodulated electrons per tap, and ``velocity_mps``, the speed of the camera
        along its axis towards the scene, m/s.

    Returns
    -------
    callable
        ``run(shot) -> Capture`` with taps, phasors and truth, the latter at the time of the first
        tap.

    Raises
    ------
    ValueError
        If the scene or a parameter is unknown or out of range.
    """
    if scene.name not in SCENES and (Path(scene.name).suffix or "/" in scene.name):
        msg = (
            f"got the file {scene.name!r}: scene files have no closed form, take the engine path; "
            f"known scenes: {', '.join(SCENES)}"
        )
        raise ValueError(msg)
    if scene.name not in SCENES:
        msg = f"no closed form for scene {scene.name!r}; known: {', '.join(SCENES)}"
        raise ValueError(msg)
    build = SCENES[scene.name]
    defaults = {**parameters_of(build), "ambient_e": 0.0, "velocity_mps": 0.0}
    params = checked_params(f"scene {scene.name}", defaults, scene.params)
    ambient_e = float(params.pop("ambient_e", 0.0))
    if ambient_e < 0:
        msg = f"ambient_e must be non-negative electrons, got {ambient_e}"
        raise ValueError(msg)
    velocity_mps = float(params.pop("velocity_mps", 0.0))
    if velocity_mps and scene.name not in MOVABLE:
        msg = f"no closed form for a camera moving in {scene.name}; it may in {', '.join(MOVABLE)}"
        raise ValueError(msg)

    def run(shot: Shot) -> Capture:
        sensor = shot.sensor
        if any(sensor.emitter_offset_m) or sensor.emitters:
            msg = (
                "closed forms need one isotropic emitter at the camera, got "
                f"{len(sensor.sources)} from {sensor.emitter_offset_m} m; use the engine path"
            )
            raise ValueError(msg)

        def transport_at(time_s: float) -> Transport:
            if not velocity_mps:
                return build(sensor.camera, **params)
            start = params.get("range", parameters_of(build)["range"])
            return build(sensor.camera, **{**params, "range": start - velocity_mps * time_s})

        what = {"scene": scene.name, **scene.params, "ambient_e": ambient_e}
        return _capture(transport_at, ambient_e, shot, what, moves=velocity_mps != 0)

    return run


def _capture(
    transport_at: Callable[[float], Transport],
    ambient_e: float,
    shot: Shot,
    what: Mapping[str, Any],
    *,
    moves: bool,
) -> Capture:
    sensor, seed = shot.sensor, shot.seed if shot.noisy else None
    signal = sensor.noise.signal_e
    transport = transport_at(0.0)

    def frame(transport: Transport) -> Frame:
        return lambda freq_hz: signal * transport.phasor(freq_hz, shot.max_bounces), ambient_e

    if moves:
        taps = capture_moving(lambda time_s: frame(transport_at(time_s)), sensor, seed=seed)
    else:
        taps = capture_taps(*frame(transport), sensor, seed=seed)

    def up_to(bounces: int | None) -> C64:
        return true_phasors(lambda freq_hz: signal * transport.phasor(freq_hz, bounces), sensor)

    direct, every = up_to(0), up_to(shot.max_bounces)
    once = direct if shot.max_bounces == 0 else up_to(1)
    return Capture(
        sensor=sensor,
        taps=taps,
        phasors=demodulate(taps, sensor),
        truth=Truth(
            np.asarray(transport.range_m, np.float32),
            direct,
            one_bounce=once - direct,
            rest=every - once,
        ),
        provenance={
            "engine": "analytic",
            **{key: value for key, value in what.items() if key != "engine"},
            "seed": seed,
            "max_bounces": shot.max_bounces,
        },
    )
