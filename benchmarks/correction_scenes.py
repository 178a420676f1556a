"""Scenes with diffuse interreflection: rendered once, kept as captures, put together by bounces.

What depends on albedo alone is put together from one capture: a corner of albedo r has direct
light r D and one bounce r^2 B. Phasors are the expected ones; their sigma is that of the taps.
"""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from toftools.io.native import read_capture, write_capture
from toftools.phasor import phasors_of
from toftools.sensors import sensor as preset
from toftools.sim import solids
from toftools.sim.analytic import analytic
from toftools.sim.path import path
from toftools.sim.scenes import world_of
from toftools.types import Capture, Modulation, Phasors, Scene, Shot

FREQS = "deeptof:freqs=20e6+40e6+70e6"  # rendered once, for two cameras
SENSORS = {"20 MHz": (0,), "40 + 70 MHz": (1, 2)}
ALBEDOS = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
BOUNCES = {"1": 1, "2": 2, "4": 4, "all": None}
TOL_M = 5e-3  # what bounces beyond the last may move range by
SAMPLES, LIVING_SAMPLES = 128, 256  # the room's light comes by narrow ways
# As in benchmarks/transport.py: the file's camera stands 17 mm before a wall.
LIVING = {"lamps": 0.0, "camera": (4.53, 0.776, -2.16), "target": (3.57, 0.85, -1.897)}
VIEWS = {"corner": "hfov_deg=70", "cavity": "hfov_deg=70", "cornell": "hfov_deg=46",
         "living": "hfov_deg=70"}  # fmt: skip


def device(scene, size):
    """The camera of all frequencies looking at a scene with (width, height) pixels."""
    return preset(f"{FREQS},width={size[0]},height={size[1]},{VIEWS[scene]}")


def seen_by(capture, which):
    """The capture as the camera of some of its frequencies takes it."""
    mod, index = capture.sensor.modulation, list(which)
    sensor = replace(capture.sensor, modulation=Modulation(mod.freqs_hz[index], mod.steps_rad[0]))
    truth, phasors = capture.truth, phasors_of(capture)
    parts = {key: getattr(truth, key) for key in ("direct", "one_bounce", "rest")}
    parts = {key: None if part is None else part[index] for key, part in parts.items()}
    sigma = None if phasors.sigma is None else phasors.sigma[index]
    return replace(capture, sensor=sensor, taps=None, truth=replace(truth, **parts),
                   phasors=Phasors(phasors.values[index], sigma, phasors.valid))  # fmt: skip


def living_room():
    """The living room's file, or None."""
    data = os.environ.get("TOFTOOLS_DATA", "")
    file = Path(data).parent / "scenes/living-room/scene.xml"
    return file if data and file.is_file() else None


def kept(job, name, make):
    """A capture out of the cache, made first if it is not there."""
    file = job.cache / f"{name}.h5"
    if not file.is_file():
        job.log(f"rendering {name}")
        write_capture(file, make())
    return read_capture(file)


def painted(scene, albedo):
    """The scene with every surface of one albedo."""
    world = world_of(Scene(scene))
    paint = solids.material("diffuse", albedo)
    shapes = {key: {**entry, "bsdf": paint} for key, entry in world.description.items()}
    return replace(world, description=shapes)


def rendered(job, scene, size, *, bounces=None, albedo=None, samples=0):
    """Path-traced capture without noise; `cornell` and the living room keep their own albedos."""
    sensor = device(scene, size)
    usual = LIVING_SAMPLES if scene == "living" else SAMPLES
    samples = 16 if job.quick else samples or usual
    told = [scene, f"{size[0]}x{size[1]}", f"s{samples}", f"b{bounces}" if bounces else "",
            f"a{albedo}" if albedo else ""]  # fmt: skip

    def make():
        if scene == "living":
            what = Scene(str(living_room()), LIVING)
        elif albedo is not None:
            what = painted(scene, albedo)
        else:
            what = Scene(scene)
        shot = Shot(sensor, noisy=False, max_bounces=bounces, tol_m=TOL_M, samples=samples)
        return path(what)(shot)

    return kept(job, "-".join(filter(None, told)), make)


def with_light(capture, values):
    """The capture with other light: its phasors, and the sigma that taps of it have."""
    noise, n_taps = capture.sensor.noise, capture.sensor.modulation.n_taps
    offset = np.abs(values) / np.mean(noise.contrast)
    sigma = np.sqrt(2 * (offset + noise.read_e**2) / n_taps)
    return replace(capture, taps=None, phasors=Phasors(values.astype(np.complex64), sigma))


def corner_once(job, size):
    """Function from albedo to the closed-form corner with its one bounce."""
    sensor = device("corner", size)

    def make():
        return analytic(Scene("corner", {"albedo": 1.0}))(Shot(sensor, noisy=False))

    one = kept(job, f"corner-closed-{size[0]}x{size[1]}", make)
    direct, total = one.truth.direct, one.phasors.values

    def at(albedo):
        return with_light(one, albedo * direct + albedo**2 * (total - direct))

    return at


def cavity(size, bounces, albedo):
    """Closed form of the sphere seen from its centre."""
    shot = Shot(device("cavity", size), noisy=False, max_bounces=bounces)
    made = analytic(Scene("cavity", {"albedo": albedo}))(shot)
    return with_light(made, made.phasors.values)


def sweep(job, size):
    """Title to a function from albedo to a capture."""
    found = {
        "corner, one bounce": corner_once(job, size),
        "cavity, one bounce": partial(cavity, size, 1),
        "cavity, all bounces": partial(cavity, size, None),
    }
    if not job.quick:
        found["corner, all bounces"] = partial(_albedo, job, "corner", size)
        half = size[0] // 2, size[1] // 2  # up to 36 bounces
        found["Cornell box, all bounces"] = partial(_albedo, job, "cornell", half)
    return found


def _albedo(job, scene, size, albedo):
    return rendered(job, scene, size, albedo=albedo)


def by_bounces(job, scene, size) -> dict[str, Capture]:
    """The scene with so many bounces at most; one bounce is taken out of the last render."""
    whole = rendered(job, scene, size)
    truth = whole.truth
    found = {"1": with_light(whole, truth.direct + truth.one_bounce)}
    for label, bounces in BOUNCES.items():
        if bounces not in (1, None):
            found[label] = rendered(job, scene, size, bounces=bounces)
    return {**found, "all": whole}
