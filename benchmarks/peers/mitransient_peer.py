"""mitransient 1.3.1 (Diego Royo and others) as an AMCW renderer: phasors in our convention.

Nothing is held against it that its user could set or mend: the near plane lies at 0.1 mm and the
way up to it, which the renderer leaves out, is put back; frequencies are given as a list, which
works although the film documents a range only; the sampler can be its best instead of its default.
It integrates over the pixel, jittered, whatever the film's filter says.
"""

import numpy as np

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sim.scenes import world_of
from toftools.sim.stage import TURN, load
from toftools.types import Scene
from toftools.units import path_to_phase

NEAR_M = 1e-4
FAR_M = 1e3
RR_DEPTH = 5  # its default; switched off it is 10 to 30 % worse at equal time


def make(
    scene,
    sensor,
    *,
    max_bounces,
    sampler="independent",
    near_m=NEAR_M,
    mend=True,
    lamps=False,
):
    """Function ``render(samples, seed) -> phasors (F, H, W), None``; white at 1 m is 1."""
    mi = import_mitsuba()
    import mitransient  # registers its plug-ins with the variant that is set

    stage = load(world_of(scene) if isinstance(scene, Scene) else scene)
    unit = stage.unit_m
    entries = {"type": "scene", "camera": _camera(stage, sensor, sampler, near_m)}
    for i, shape in enumerate(stage.scene.shapes()):
        if lamps or not shape.is_emitter():
            entries[f"shape{i}"] = shape
    if lamps:
        own = [lamp for lamp in stage.scene.emitters() if lamp.get_shape() is None]
        entries |= {f"lamp{i}": lamp for i, lamp in enumerate(own)}
    # A flash whose return from white at 1 m is 1: intensity pi, per square scene unit.
    flash = {"type": "rgb", "value": np.pi / unit**2}
    entries["flash"] = {"type": "point", "position": stage.to_world[:3, 3], "intensity": flash}
    world = mi.load_dict(entries)
    # Length of the path in scene units at which the phase has made a turn, as its inverse.
    turns = [unit * float(path_to_phase(1.0, f)) / (2 * np.pi) for f in sensor.modulation.freqs_hz]
    film = world.sensors()[0].film()
    film.frequencies = mitransient.utils.ArrayXf([mi.Float(turn) for turn in turns])
    # Its depth counts the segments after the camera's: 2 is direct light.
    integrator = mi.load_dict(
        {"type": "transient_path", "max_depth": max_bounces + 2, "rr_depth": RR_DEPTH}
    )
    lost_m = near_m / rays(sensor.camera)[..., 2] if mend else np.zeros(sensor.camera.shape)
    turn_back = np.exp(
        1j * np.stack([path_to_phase(lost_m, f) for f in sensor.modulation.freqs_hz])
    )

    def render(samples, seed):
        _, parts = integrator.render(world, seed=seed, spp=samples)
        parts = np.array(parts)  # (H, W, F, 2), of exp(-j phi)
        phasors = np.moveaxis(parts[..., 0] - 1j * parts[..., 1], -1, 0)
        return np.asarray(phasors * turn_back, np.complex64), None

    return render


def _camera(stage, sensor, sampler, near_m):
    """Its sensor with the field of view of ours; axis in the middle and square pixels only."""
    import mitsuba as mi

    camera = sensor.camera
    middle = [(camera.width - 1) / 2, (camera.height - 1) / 2]
    if not np.allclose([*camera.K[:2, 2], camera.K[1, 1]], [*middle, camera.K[0, 0]]):
        raise ValueError(f"the peer's camera is a plain pinhole, got K = {camera.K.tolist()}")
    film = {
        "type": "phasor_hdr_film", "width": camera.width, "height": camera.height,
        "wl_mean": 10.0, "wl_sigma": 1e30, "temporal_bins": 64, "bin_width_opl": 10.0 / 64,
        "start_opl": 0.0, "rfilter": {"type": "box"},
    }  # fmt: skip
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0]))),
        "fov_axis": "x",
        "near_clip": near_m / stage.unit_m,
        "far_clip": FAR_M / stage.unit_m,
        "to_world": mi.ScalarTransform4f(stage.to_world @ TURN),
        "sampler": {"type": sampler, "sample_count": 4},
        "film": film,
    }
