"""A scene of your own: how much of the range error is multipath, bounce by bounce.

Run: python examples/04_your_own_scene.py
"""

import numpy as np

from toftools import Phasors, Shot
from toftools.correct.crt import crt
from toftools.sensors import sensor
from toftools.sim.radiosity import radiosity
from toftools.sim.scenes import from_dict
from toftools.sim.world import look_at


def paint(albedo):
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}}


def square(centre, normal, half, albedo):
    return {"type": "rectangle", "to_world": place(centre, normal, half), "bsdf": paint(albedo)}


def place(centre, normal, half):
    """Mitsuba's rectangle spans -1..1 in x and y and looks along z."""
    pose = look_at((0, 0, 0), normal, (0, 0, 1) if abs(normal[1]) > 0.9 else (0, 1, 0))
    pose[:3, :3] *= half
    pose[:3, 3] = centre
    return pose


# A tray before a wall, metres, y up: a scene is a Mitsuba dictionary of shapes, nothing more.
world = from_dict(
    {
        "floor": square((0, 0, 0), (0, 1, 0), 1.0, 0.8),
        "wall": square((0, 1, -1), (0, 0, 1), 1.0, 0.8),
        "ball": {"type": "sphere", "center": (0.1, 0.25, -0.5), "radius": 0.25, "bsdf": paint(0.4)},
    },
    to_world=look_at((0.3, 0.8, 1.5), (0, 0.4, -0.6)),
)
camera = sensor("opt8241:width=80,height=60,hfov_deg=55,beam_deg=80")
capture = radiosity(world)(Shot(camera, seed=1, tol_m=3e-3))
told = capture.provenance
print(f"{told['virtual_lights']} virtual lights, gathered at {told['gathered']} points")
print(f"errors {told['scatter_mm']:.1f} mm by scatter, {told['interpolation_mm']:.1f} mm between")

truth, unwrap = capture.truth, crt(camera)
layers = {"direct": truth.direct, "one bounce": truth.one_bounce, "all others": truth.rest}
light, error_mm = np.zeros_like(truth.direct), {}
for name, layer in layers.items():
    light = light + layer
    off_m = unwrap(Phasors(light)).range_m - truth.range_m
    error_mm[name] = 1e3 * np.nanmedian(off_m)
    print(f"range error with {name:<10} {error_mm[name]:+6.1f} mm at the median")
noise_mm = 1e3 * np.nanmedian(unwrap(capture.phasors).sigma_m)
print(f"noise of the sensor        {noise_mm:6.1f} mm")

assert abs(error_mm["direct"]) < 0.1
assert error_mm["all others"] >= error_mm["one bounce"] > 5
