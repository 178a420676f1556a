"""Flying pixels removed against good pixels lost, on path-traced frames with mixed pixels.

python benchmarks/flying_pixels.py     render four scenes (a minute) and print the table

A pixel is mixed if the surfaces in it, seen through 5 x 5 points, have a gap of more than 6 cm;
flying if its answer lies more than 3 cm from all of them; good if it is not mixed.
"""

import dataclasses

import numpy as np

from toftools.camera import points, rays, resized
from toftools.chain import find_method
from toftools.registry import FILTERS, SIMULATORS
from toftools.sensors import sensor
from toftools.types import Scene, Shot

SCENES = (
    ("room", {"seed": 5}),
    ("room", {"seed": 8}),
    ("room", {"seed": 11}),
    ("prism", {"range": 0.7}),
)
FINE = 5


def frames():
    """Capture, and the ranges of the surfaces in every pixel (H, W, 25)."""
    device = sensor("opt8241:width=160,height=120,beam_deg=100")
    height, width = device.camera.shape
    lens = resized(device.camera, FINE * width, FINE * height)
    for name, params in SCENES:
        scene = Scene(name, params)
        capture = SIMULATORS["path"].build(scene, antialias=4)(Shot(device, seed=1, tol_m=1e-2))
        still = Shot(dataclasses.replace(device, camera=lens), max_bounces=0, noisy=False)
        fine = SIMULATORS["path"].build(scene)(still).truth.range_m
        inside = fine.reshape(height, FINE, width, FINE).transpose(0, 2, 1, 3)
        yield capture, inside.reshape(height, width, FINE**2)


def steep(camera, range_m, angle_deg):
    """The usual filter: the line to a neighbour lies within an angle of the ray."""
    xyz, ray = points(camera, range_m).astype(float), rays(camera)
    found = np.zeros(range_m.shape, bool)
    for axis in (0, 1):
        for shift in (-1, 1):
            line = np.roll(xyz, shift, axis) - xyz
            length = np.maximum(np.linalg.norm(line, axis=-1), 1e-9)
            cosine = np.abs((line * ray).sum(-1)) / length
            near = cosine > np.cos(np.radians(angle_deg))
            border = [slice(None)] * 2
            border[axis] = 0 if shift > 0 else -1
            near[tuple(border)] = False
            found |= near
    return found


def shares(cases, judge):
    """Percent of flying removed, of those off by > 10 cm, of good lost, of good away from edges."""
    from scipy.ndimage import binary_dilation

    counts = np.zeros((4, 2), int)
    for capture, depth, inside in cases:
        gap = np.diff(np.sort(inside, axis=-1), axis=-1).max(axis=-1)
        off = np.abs(depth.range_m[..., None] - inside).min(axis=-1)
        mixed, known = gap > 0.06, np.isfinite(depth.range_m)
        gone = judge(capture.sensor, depth)
        away = ~binary_dilation(mixed) & known
        masks = mixed & (off > 0.03), mixed & (off > 0.1), ~mixed & known, away
        counts += [((gone & mask).sum(), mask.sum()) for mask in masks]
    return 100 * counts[:, 0] / counts[:, 1], counts[:, 1]


def main():
    taken = list(frames())
    for method in ("crt:max_range_m=10", "smooth > crt:max_range_m=10"):
        cases = [(c, find_method(method).build(c.sensor)(c.phasors), inside) for c, inside in taken]
        print(f"{method}: removed %, of those off by > 10 cm %, lost %, lost away from edges %")
        for wanted in (1, 2, 3, 4, 5):

            def ours(device, depth, wanted=wanted):
                run = FILTERS["flying_pixels"].build(device, least_neighbours=wanted)
                return run(depth, None).info["flying"]

            found, counts = shares(cases, ours)
            print(f"  least_neighbours={wanted}", np.round(found, 2), counts)
        for angle_deg in (2, 5, 10):
            found, _ = shares(cases, lambda s, d, a=angle_deg: steep(s.camera, d.range_m, a))
            print(f"  angle below {angle_deg} degrees", np.round(found, 2))


if __name__ == "__main__":
    main()
