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
from numpy.typing import NDArray

from toftools.phasor import demodulate
from toftools.registry import checked_params, parameters_of
from toftools.sim.noise import clean_taps, expose
from toftools.sim.shapes import Transport, cavity, corner, tilted, two_returns, wall
from toftools.types import Capture, Scene, Sensor, Shot, Truth

SCENES: Mapping[str, Callable[..., Transport]] = MappingProxyType(
    {
        "wall": wall,
        "tilted": tilted,
        "two_returns": two_returns,
        "cavity": cavity,
        "corner": corner,
    }
)
"""Scene name to its closed form."""


def analytic(scene: Scene) -> Callable[[Shot], Capture]:
    """Simulator for the closed-form scenes.

    Parameters
    ----------
    scene : Scene
        Name out of `SCENES` and its parameters (SI units, angles in degrees), plus
        ``ambient_e``, unmodulated electrons per tap.

    Returns
    -------
    callable
        ``run(shot) -> Capture`` with taps, phasors and truth.

    Raises
    ------
    ValueError
        If the scene or a parameter is unknown or out of range.
    """
    if scene.name not in SCENES and (Path(scene.name).suffix or "/" in scene.name):
        msg = (
            f"got the file {scene.name!r}: scene files need a rendering engine, which this version "
            f"does not have; known scenes: {', '.join(SCENES)}"
        )
        raise ValueError(msg)
    if scene.name not in SCENES:
        msg = f"no closed form for scene {scene.name!r}; known: {', '.join(SCENES)}"
        raise ValueError(msg)
    build = SCENES[scene.name]
    defaults = {**parameters_of(build), "ambient_e": 0.0}
    params = checked_params(f"scene {scene.name}", defaults, scene.params)
    ambient_e = float(params.pop("ambient_e", 0.0))
    if ambient_e < 0:
        msg = f"ambient_e must be non-negative electrons, got {ambient_e}"
        raise ValueError(msg)

    def run(shot: Shot) -> Capture:
        sensor = shot.sensor
        if any(sensor.emitter_offset_m) or sensor.emitters:
            msg = (
                "closed forms need one isotropic emitter at the camera, got "
                f"{len(sensor.sources)} from {sensor.emitter_offset_m} m; use the engine path"
            )
            raise ValueError(msg)
        transport = build(sensor.camera, **params)
        return _capture(transport, ambient_e, shot, {"scene": scene.name, **scene.params})

    return run


def _capture(
    transport: Transport, ambient_e: float, shot: Shot, what: Mapping[str, Any]
) -> Capture:
    sensor, signal = shot.sensor, shot.sensor.noise.signal_e

    def light(freq_hz: float) -> NDArray[np.complex128]:
        return signal * transport.phasor(freq_hz, shot.max_bounces)

    rng = np.random.default_rng(shot.seed) if shot.noisy else None
    taps = expose(clean_taps(light, ambient_e, sensor), sensor, rng)
    direct = _direct(transport, sensor)
    return Capture(
        sensor=sensor,
        taps=taps,
        phasors=demodulate(taps, sensor),
        truth=Truth(np.asarray(transport.range_m, np.float32), direct),
        provenance={
            "engine": "analytic",
            **{key: value for key, value in what.items() if key != "engine"},
            "ambient_e": ambient_e,
            "seed": shot.seed if shot.noisy else None,
            "max_bounces": shot.max_bounces,
        },
    )


def _direct(transport: Transport, sensor: Sensor) -> NDArray[np.complex64]:
    """Phasors of the direct light in the unit of the taps."""
    unit = sensor.noise.dn_per_e or 1.0
    scale = unit * sensor.noise.signal_e * sensor.noise.contrast
    layers = [scale * transport.phasor(float(f), 0) for f in sensor.modulation.freqs_hz]
    return np.asarray(layers, dtype=np.complex64)
