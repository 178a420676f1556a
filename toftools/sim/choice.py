"""Engine `auto`: the closed form where one covers the whole request, virtual lights elsewhere.

A closed form has no noise and takes milliseconds, but only for the transport it was derived for:
an isotropic emitter at the camera, diffuse surfaces and, in the corner, one bounce. Virtual lights
take any scene, and leave to path tracing what is not diffuse; a number of paths asks for paths.
"""

from collections.abc import Mapping
from types import MappingProxyType

from toftools.registry import parameters_of
from toftools.sim.analytic import MOVABLE, SCENES
from toftools.sim.scenes import WORLDS
from toftools.types import Scene, Sensor

LAST_BOUNCE: Mapping[str, int] = MappingProxyType({"corner": 1})
"""Closed forms that end after some bounces although the light goes on."""


def choose(
    scene: Scene, sensor: Sensor, *, max_bounces: int | None = None, samples: int | None = None
) -> tuple[str, str]:
    """Name of the engine for a request, and the reason.

    Parameters
    ----------
    scene : Scene
        What to look at.
    sensor : Sensor
        Camera and emitters.
    max_bounces : int or None
        Indirect bounces asked for; None for all that matter.
    samples : int or None
        Paths per pixel asked for; None for no wish.

    Returns
    -------
    tuple of str and str
        Name out of `registry.SIMULATORS`, and why as a clause.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> choose(Scene("cavity"), sensor("deeptof"))
    ('analytic', 'the scene has a closed form')
    >>> choose(Scene("corner"), sensor("deeptof"))
    ('radiosity', 'the closed form of corner ends after 1 indirect bounce')
    >>> choose(Scene("corner"), sensor("deeptof"), max_bounces=1)[0]
    'analytic'
    """
    if scene.name in SCENES and scene.name not in WORLDS:
        return "analytic", f"{scene.name} plants its light and has no geometry to trace"
    obstacle = _obstacle(scene, sensor, max_bounces, samples)
    if obstacle is None:
        return "analytic", "the scene has a closed form"
    return ("radiosity" if samples is None else "path"), obstacle


def _obstacle(
    scene: Scene, sensor: Sensor, max_bounces: int | None, samples: int | None
) -> str | None:
    """What keeps a closed form from answering."""
    name = scene.name
    if name not in SCENES:
        return f"{name if name in WORLDS else 'a scene file'} has no closed form"
    if samples is not None:
        return "a number of paths was asked for"
    if sensor.emitters or any(sensor.emitter_offset_m):
        return "closed forms have one isotropic emitter at the camera"
    known = {*parameters_of(SCENES[name]), "ambient_e"}
    known |= {"velocity_mps"} if name in MOVABLE else set()
    for key in scene.params:
        if key not in known:
            return f"the closed form of {name} has no {key}"
    last = LAST_BOUNCE.get(name)
    if last is not None and (max_bounces is None or max_bounces > last):
        return f"the closed form of {name} ends after {last} indirect bounce"
    return None
