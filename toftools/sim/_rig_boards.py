"""Where a virtual rig holds its board: all parts of the image, tilts every way."""

import numpy as np

from toftools.camera import project, rays_at
from toftools.sim.target import Print, chessboard
from toftools.types import F64, Camera

BOARD = (8, 5, 0.03)
"""Inner corners and square of the chessboard, m: that of `toftools.calib.board`."""
CELLS = [(x, y) for y in (0.0, 0.5, 1.0) for x in (0.0, 0.5, 1.0)]
"""Places of the image, shares of its size."""
STEEPEST_DEG = 40.0
WALL_BEHIND_M = 1.5
"""Distance of the wall behind a board from its origin, along the axis."""
EDGE_PX = 1.5
"""Corners of a board keep as far away from the edge of the image."""


def pattern() -> Print:
    """The printed board of the rig."""
    return chessboard(*BOARD)


def pose_at(camera: Camera, cell: tuple[float, float], rng: np.random.Generator) -> tuple[F64, F64]:
    """A board whose middle lies as near to a place of the image as all of it is seen."""
    import cv2

    turn, tilt = 2 * np.pi * rng.random(), np.radians(STEEPEST_DEG * rng.random() ** 0.5)
    spin = np.radians(rng.uniform(-20, 20))
    lean = cv2.Rodrigues(tilt * np.array([np.cos(turn), np.sin(turn), 0.0]))[0]
    rotation = np.asarray(lean @ cv2.Rodrigues(np.array([0.0, 0.0, spin]))[0], dtype=np.float64)
    width = (BOARD[0] + 1) * BOARD[2]
    z = camera.K[0, 0] * width / (rng.uniform(0.45, 0.75) * camera.width)
    size = np.array([camera.width - 1.0, camera.height - 1.0])
    for _ in range(40):
        for share in np.linspace(1, 0, 11):
            u, v = size * (0.5 + share * (np.asarray(cell) - 0.5))
            ray = rays_at(camera, np.array(u), np.array(v))
            pose = rotation, ray * (z / ray[2]) - rotation @ _middle()
            if _seen(camera, pose):
                return pose
        z *= 1.1
    msg = "no board fits into this image; take a sensor of more pixels or a wider view"
    raise ValueError(msg)


def _middle() -> F64:
    columns, rows, square = BOARD
    return np.array([(columns + 1) * square / 2, (rows + 1) * square / 2, 0.0])


def corners_m(pose: tuple[F64, F64]) -> F64:
    """Outer corners of the squares in the camera frame, m, (4, 3)."""
    box = 2 * _middle() * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    return np.asarray(box @ pose[0].T + pose[1])


def _seen(camera: Camera, pose: tuple[F64, F64]) -> bool:
    u, v = project(camera, corners_m(pose))
    inside = (u >= EDGE_PX) & (v >= EDGE_PX)
    inside &= (u <= camera.width - 1 - EDGE_PX) & (v <= camera.height - 1 - EDGE_PX)
    return bool(inside.all())
