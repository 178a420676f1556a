"""Poses of boards and cameras: their algebra, their derivatives, and the pose of one board.

A pose X = R P + t takes points from one frame to another. Small changes are turns about the axes of
the frame it leads into, applied after it: exp(w) R.
"""

from dataclasses import dataclass

import numpy as np

from toftools.camera import project, rays_at
from toftools.types import F64, Camera

Pose = tuple[F64, F64]
"""Rotation (3, 3) and translation (3,), m."""
STEP = 1e-6
"""Step of a derivative along a unit of length at the distance of the point."""
LOST_PX = 1e3
"""Where a point is put that the camera cannot see from a pose under trial."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Board corners in one image.

    Parameters
    ----------
    board_m : ndarray, (N, 3)
        Corners in the board frame, m, in one plane.
    px : ndarray, (N, 2)
        Where they were found: column and row, px.
    """

    board_m: F64
    px: F64


def moved(pose: Pose, points_m: F64) -> F64:
    """Points after a pose.

    Parameters
    ----------
    pose : Pose
        Rotation and translation.
    points_m : ndarray, (N, 3)
        Points, m.

    Returns
    -------
    ndarray, (N, 3)
        R x + t.
    """
    return np.asarray(points_m @ pose[0].T + pose[1])


def after(second: Pose, first: Pose) -> Pose:
    """One pose after another.

    Parameters
    ----------
    second, first : Pose
        Poses.

    Returns
    -------
    Pose
        What does first `first`, then `second`.
    """
    return second[0] @ first[0], second[0] @ first[1] + second[1]


def inverse(pose: Pose) -> Pose:
    """The way back.

    Parameters
    ----------
    pose : Pose
        A pose.

    Returns
    -------
    Pose
        Its inverse.
    """
    return pose[0].T, -pose[0].T @ pose[1]


def seen_px(camera: Camera, points_m: F64) -> F64:
    """Projection as one array.

    Parameters
    ----------
    camera : Camera
        Camera.
    points_m : ndarray, (N, 3)
        Points in its frame, m.

    Returns
    -------
    ndarray, (N, 2)
        Column and row, px.
    """
    return np.stack(project(camera, points_m), axis=-1)


def board_poses(camera: Camera, sight: Sight) -> list[Pose]:
    """Poses of one board that explain one image, the better one first.

    Parameters
    ----------
    camera : Camera
        Camera.
    sight : Sight
        At least 4 corners.

    Returns
    -------
    list of Pose
        One or two: a small or distant board looks alike from two sides. Empty where the corners
        fix none.

    References
    ----------
    T. Collins and A. Bartoli, Infinitesimal plane-based pose estimation, IJCV 109(3), 2014.
    """
    import cv2

    way = rays_at(camera, sight.px[:, 0], sight.px[:, 1])
    ahead = way[:, 2] > 0.1
    if ahead.sum() < 4:
        return []
    flat = np.ascontiguousarray(way[ahead, :2] / way[ahead, 2:])
    board = np.ascontiguousarray(sight.board_m[ahead])
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            board, flat, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    starts = [(cv2.Rodrigues(r)[0], np.ravel(t)) for r, t in zip(turns, shifts, strict=True)]
    found = [_single(camera, sight, (np.asarray(r), np.asarray(t))) for r, t in starts if t[2] > 0]
    return [pose for _, pose in sorted(found, key=lambda item: item[0])]


def _single(camera: Camera, sight: Sight, start: Pose) -> tuple[float, Pose]:
    """Pose of one board by least squares in pixels, and its mean square error."""
    from scipy.optimize import least_squares

    def error(x: F64) -> F64:
        return (seen_or_lost(camera, moved(changed(start, x), sight.board_m)) - sight.px).ravel()

    def slope(x: F64) -> F64:
        place, by_pose = moved_slopes(start, x, sight.board_m)
        return (projection_slopes(camera, place) @ by_pose).reshape(-1, 6)

    found = least_squares(error, np.zeros(6), jac=slope, loss="soft_l1", f_scale=1.0)
    return float(np.mean(error(found.x) ** 2)), changed(start, found.x)


def seen_or_lost(camera: Camera, place: F64) -> F64:
    """Projection in which a point out of view is merely far off.

    Parameters
    ----------
    camera : Camera
        Camera.
    place : ndarray, (N, 3)
        Points in its frame, m.

    Returns
    -------
    ndarray, (N, 2)
        Column and row, px.
    """
    return np.nan_to_num(seen_px(camera, place), nan=LOST_PX)


def changed(pose: Pose, x: F64) -> Pose:
    """A pose with a small change on top.

    Parameters
    ----------
    pose : Pose
        A pose.
    x : ndarray, (6,)
        Turn (rad) about the axes it leads into, and shift (m).

    Returns
    -------
    Pose
        ``exp(turn) R`` and ``t + shift``.
    """
    import cv2

    return np.asarray(cv2.Rodrigues(x[:3])[0]) @ pose[0], pose[1] + x[3:]


def moved_slopes(start: Pose, x: F64, points_m: F64) -> tuple[F64, F64]:
    """Points after a changed pose, and their derivatives by the change.

    Parameters
    ----------
    start : Pose
        The pose.
    x : ndarray, (6,)
        Its change.
    points_m : ndarray, (N, 3)
        Points, m.

    Returns
    -------
    tuple of ndarray (N, 3), ndarray (N, 3, 6)
        Points and derivatives.
    """
    import cv2

    turn, by_turn = cv2.Rodrigues(x[:3])
    turned = points_m @ start[0].T
    slopes = np.zeros((len(points_m), 3, 6))
    slopes[:, :, :3] = np.einsum("kij,nj->nik", np.asarray(by_turn).reshape(3, 3, 3), turned)
    slopes[:, :, 3:] = np.eye(3)
    return turned @ np.asarray(turn).T + start[1] + x[3:], slopes


def projection_slopes(camera: Camera, place: F64) -> F64:
    """Derivatives of the pixel by the point.

    Parameters
    ----------
    camera : Camera
        Camera.
    place : ndarray, (N, 3)
        Points in its frame, m.

    Returns
    -------
    ndarray, (N, 2, 3)
        By central differences, px per m.
    """
    step = STEP * np.linalg.norm(place, axis=1)
    columns = []
    for axis in np.eye(3):
        shift = step[:, None] * axis
        rise = seen_or_lost(camera, place + shift) - seen_or_lost(camera, place - shift)
        columns.append(rise / (2 * step[:, None]))
    return np.stack(columns, axis=-1)
