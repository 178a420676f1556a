"""A second camera: is its pose as well known as stated, and how many pixels get a wrong colour?

``python benchmarks/second_camera.py [SEEDS]`` prints JSON. `pose`: planted poses, 8 random views of
a chessboard at 0.45 to 1 m with 0.08 px (ToF) and 0.2 px (colour) of scatter; how many of the seeds
lie inside the stated 95 % interval, for every turn and shift. `colours`: a rectangle at 1 m before
a wall at 2 m, whose visible surface is known for every ray; percent of the ToF pixels that get the
colour of the other surface, and of those that lose the colour they should have.
"""

import json
import sys

import cv2
import numpy as np

from toftools.calib._poses import Sight, moved, seen_px
from toftools.calib._stereo import Pair
from toftools.calib.board import parse_board
from toftools.calib.extrinsics import Extrinsics, extrinsics_of_pairs
from toftools.calib.register import COLOURED, colours_of
from toftools.camera import pinhole, points, project, range_to_z, rays
from toftools.types import Camera

TOF = Camera(320, 240, np.array([[230.0, 0, 158], [0, 231, 119], [0, 0, 1]]),
             np.array([-0.2, 0.05, 1e-3, 0, 0]))  # fmt: skip
SECOND = {
    "pinhole": Camera(1280, 960, np.array([[1000.0, 0, 640], [0, 1002, 470], [0, 0, 1]]),
                      np.array([0.1, -0.1, 1e-3, 0, 0.02])),
    "fisheye": Camera(1280, 960, np.array([[600.0, 0, 640], [0, 602, 470], [0, 0, 1]]),
                      np.array([0.02, -0.004, 3e-4, 0]), "fisheye"),
}  # fmt: skip
TURN, SHIFT = cv2.Rodrigues(np.array([0.02, -0.05, 0.03]))[0], np.array([-0.032, 0.002, 0.004])
CORNERS = parse_board("chessboard:columns=8,rows=5,square_m=0.03").points()
SCATTER = (0.08, 0.2)
RECTANGLE = np.array([[-0.3, -0.2], [0.25, 0.22]])


def inside(camera, px):
    return np.isfinite(px).all() and (px > 0).all() and (px < [camera.width, camera.height]).all()


def views(seed, colour, count=8):
    rng, pairs = np.random.default_rng(seed), []
    while len(pairs) < count:
        turn = cv2.Rodrigues(rng.normal(0, 0.4, 3))[0]
        middle = [rng.uniform(-0.25, 0.25), rng.uniform(-0.2, 0.2), rng.uniform(0.45, 1.0)]
        place = moved((turn, middle - turn @ CORNERS.mean(0)), CORNERS)
        seen = seen_px(TOF, place), seen_px(colour, place @ TURN.T + SHIFT)
        if inside(TOF, seen[0]) and inside(colour, seen[1]):
            sights = [Sight(CORNERS, px + rng.normal(0, sigma, px.shape))
                      for px, sigma in zip(seen, SCATTER, strict=True)]  # fmt: skip
            pairs.append(Pair(f"view{len(pairs)}", *sights))
    return pairs


def pose(colour, seeds):
    scores, errors = [], []
    for seed in range(seeds):
        stage = extrinsics_of_pairs(views(seed, colour), (TOF, colour))
        turn = cv2.Rodrigues(stage.rotation @ TURN.T)[0].ravel()
        scores.append(np.r_[turn, stage.translation_m - SHIFT] / stage.sigma)
        residual = stage.residual
        errors.append([residual.after, residual.held_out, residual.noise])
    scores = np.array(scores)
    names = ("after_px", "held_out_px", "noise_px")
    return {
        "seeds": seeds,
        "inside_95": (np.abs(scores) < 1.96).sum(axis=0).tolist(),
        "mean_square": np.round((scores**2).mean(axis=0), 2).tolist(),
        **dict(zip(names, np.round(np.mean(errors, axis=0), 3).tolist(), strict=True)),
    }


def on_rectangle(centre, way):
    length = (1 - centre[2]) / way[..., 2]
    at = centre[:2] + length[..., None] * way[..., :2]
    return length, ((at > RECTANGLE[0]) & (at < RECTANGLE[1])).all(-1)


def two_planes(camera, turn, shift):
    way, centre = rays(camera) @ turn, -turn.T @ shift
    length, front = on_rectangle(centre, way)
    return np.where(front, length, (2 - centre[2]) / way[..., 2]), front


def colours(size, baseline_m, noise_m):
    """Shares in percent: wrong and lost, of three ways to colour."""
    tof, second = pinhole(320, 240, hfov_deg=70), pinhole(*size, hfov_deg=80)
    turn = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
    shift = np.array([-baseline_m, 0.004, 0.003])
    range_m, front = two_planes(tof, np.eye(3), np.zeros(3))
    _, seen = two_planes(second, turn, shift)
    centre = -turn.T @ shift
    hidden = on_rectangle(centre, points(tof, range_m) - centre)[1] & ~front
    noisy = range_m + np.random.default_rng(0).normal(0, noise_m, range_m.shape)
    place = points(tof, noisy) @ turn.T + shift
    u, v = (np.rint(x).astype(int) for x in project(second, place))

    def shares(colour, told):
        wrong = told & (np.abs(colour - 1.0 * front) > 0.5)
        return {"wrong": percent(wrong), "lost": percent(~told & ~hidden)}

    plain = seen[v, u].astype(float)
    found = {"hidden": percent(hidden), "plain": shares(plain, np.ones_like(hidden))}
    if hasattr(cv2, "registerDepth"):
        motion = np.vstack([np.column_stack([turn, shift]), [0, 0, 0, 1]])
        z = cv2.registerDepth(tof.K, second.K, np.zeros(5), motion, range_to_z(tof, noisy), size,
                              depthDilation=True)[v, u]  # fmt: skip
        behind = np.isfinite(z) & (z > 0) & (place[..., 2] - z > 0.1)
        found["opencv"] = shares(plain, ~behind)
    image = np.repeat(seen[..., None], 3, axis=-1).astype(np.float32)
    stage = Extrinsics(turn, shift, second)
    picked, status = colours_of(stage, tof, noisy, image, sigma_m=noise_m)
    found["toftools"] = shares(picked[..., 0], status == COLOURED)
    return found


def percent(mask):
    return round(100 * float(np.mean(mask)), 3)


def main():
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    answer = {"pose": {name: pose(camera, seeds) for name, camera in SECOND.items()}}
    answer["colours"] = {
        f"{size[0]}x{size[1]}, {1e3 * base:.0f} mm, noise {1e3 * noise:.0f} mm": colours(
            size, base, noise
        )
        for size in ((1280, 960), (320, 240))
        for base, noise in ((0.03, 0.0), (0.06, 0.0), (0.06, 0.02), (0.12, 0.0))
    }
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main()
