"""Views of a printed board with known truth, for the lens: corners, and amplitude images.

An image is the light of a co-located source that a board (albedo 0.8 and 0.08) and a wall behind
it (0.3) send back: albedo cos / range^2, times cos^4 of the angle from the axis for vignetting, as
the mean over SUB x SUB rays of every pixel through the true lens, then shot and read noise.
"""

import cv2
import numpy as np

from toftools.calib._lens_model import Corners, projected
from toftools.calib._lens_views import View
from toftools.calib.board import dark_at
from toftools.camera import rays_at

SUB = 3
MARGIN = 0.4  # white paper around the squares, in squares
WALL_M = 2.5


def camera_rays(camera, sub=SUB):
    """(H sub, W sub, 3) rays; make them once per camera."""
    shift = (np.arange(sub) + 0.5) / sub - 0.5
    v = (np.arange(camera.height)[:, None] + shift).ravel()
    u = (np.arange(camera.width)[:, None] + shift).ravel()
    return rays_at(camera, *np.meshgrid(u, v))


def poses(rng, count, camera, board, *, tilt_deg=(10, 45), spin=0.5, fill=(0.4, 0.75), edge_px=4):
    """Boards that lie wholly in the image, tilted every way: list of (6,)."""
    points, found = board.points(), []
    width, height = board.size_m
    outer = np.array([[0, 0, 0], [width, 0, 0], [0, height, 0], [width, height, 0]])
    size = np.array([camera.width, camera.height])
    while len(found) < count:
        turn, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*tilt_deg))
        lean = cv2.Rodrigues(tilt * np.array([np.cos(turn), np.sin(turn), 0.0]))[0]
        rotation = lean @ cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-spin, spin)]))[0]
        z = camera.K[0, 0] * width / (rng.uniform(*fill) * camera.width)
        at = rng.uniform(0.15, 0.85, 2) * size
        ray = rays_at(camera, *at)
        shift = ray * (z / ray[2]) - rotation @ points.mean(axis=0)
        pose = np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), shift])
        seen = projected(camera, pose, outer)[0]
        if (seen > edge_px).all() and (seen < size - 1 - edge_px).all():
            found.append(pose)
    return found


def corners(rng, count, camera, board, noise_px, **how):
    """Views as the true corners plus normal noise."""
    points = board.points()
    return [
        Corners(f"{i}.h5", points, projected(camera, pose, points)[0]
                + noise_px * rng.normal(size=(len(points), 2)))
        for i, pose in enumerate(poses(rng, count, camera, board, **how))
    ]  # fmt: skip


def image(rays, pose, board, *, sub=SUB):
    """Noise-free amplitude (H, W), 1 for a white board that faces the camera at 1 m."""
    rotation = cv2.Rodrigues(pose[:3])[0]
    slope = rays @ rotation[:, 2]
    range_m = (pose[3:] @ rotation[:, 2]) / slope
    place = (rays * range_m[..., None] - pose[3:]) @ rotation
    x, y = place[..., 0], place[..., 1]
    (width, height), rim = board.size_m, MARGIN * board.square_m
    on = (x > -rim) & (y > -rim) & (x < width + rim) & (y < height + rim) & (range_m > 0)
    dark = np.zeros(on.shape, bool)
    dark[on] = dark_at(board, x[on], y[on])
    cos = rays[..., 2]
    wall = 0.3 * cos**3 / WALL_M**2
    light = np.where(on, np.where(dark, 0.08, 0.8) * np.abs(slope) / range_m**2, wall) * cos**4
    shape = rays.shape[0] // sub, sub, rays.shape[1] // sub, sub
    return np.nan_to_num(light).reshape(shape).mean(axis=(1, 3))


def view(rng, name, amplitude, *, white_e=1500.0, read_e=15.0):
    """Amplitude with noise, in electrons; `white_e` is its 99th percentile."""
    light = amplitude / np.percentile(amplitude, 99) * white_e
    noisy = rng.poisson(light) + read_e * rng.normal(size=light.shape)
    return View(name, np.abs(noisy).astype(np.float32))
