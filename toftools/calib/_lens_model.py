"""One camera as a vector of numbers, and how board points of one pose appear in it."""

from dataclasses import dataclass, replace

import numpy as np

from toftools._arrays import F64
from toftools.camera import rays_at
from toftools.types import Camera


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one view: where they lie on the board, (N, 3) m, and in the image, (N, 2) px."""

    name: str
    points: F64
    pixels: F64


def unknowns(camera: Camera) -> F64:
    """Free numbers of a camera: fx, fy, cx, cy and its distortion.

    Parameters
    ----------
    camera : Camera
        Camera.

    Returns
    -------
    ndarray, (4 + n,)
        Numbers.
    """
    K = camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.dist])


def with_unknowns(camera: Camera, theta: F64) -> Camera:
    """The camera with other numbers: the inverse of `unknowns`.

    Parameters
    ----------
    camera : Camera
        Size and model.
    theta : ndarray, (4 + n,)
        Numbers.

    Returns
    -------
    Camera
        Camera.
    """
    fx, fy, cx, cy = theta[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return replace(camera, K=K, dist=theta[4:])


def projected(camera: Camera, pose: F64, points: F64) -> tuple[F64, F64, F64]:
    """Board points in the image, with derivatives.

    Parameters
    ----------
    camera : Camera
        Camera.
    pose : ndarray, (6,)
        Rotation vector and translation, board to camera, m.
    points : ndarray, (N, 3)
        Board points, m.

    Returns
    -------
    pixels : ndarray, (N, 2)
        Image points, px.
    by_camera, by_pose : ndarray, (2 N, 4 + n) and (2 N, 6)
        Derivatives, rows x0, y0, x1, ...
    """
    import cv2

    rotation, shift, n = pose[:3].copy(), pose[3:].copy(), camera.dist.size
    if camera.model == "fisheye":
        # Columns: focal 2, centre 2, distortion 4, rotation 3, translation 3, skew.
        pixels, by = cv2.fisheye.projectPoints(
            points.reshape(1, -1, 3), rotation, shift, camera.K, camera.dist
        )
        return np.asarray(pixels).reshape(-1, 2), by[:, :8], by[:, 8:14]
    # Columns: rotation 3, translation 3, focal 2, centre 2, distortion.
    dist = camera.dist if n else np.zeros(5)
    pixels, by = cv2.projectPoints(points, rotation, shift, camera.K, dist)[:2]
    return np.asarray(pixels).reshape(-1, 2), by[:, 6 : 10 + n], by[:, :6]


def first_pose(camera: Camera, view: Corners) -> F64:
    """Pose of the board in one view from its homography.

    Parameters
    ----------
    camera : Camera
        Camera.
    view : Corners
        View.

    Returns
    -------
    ndarray, (6,)
        Rotation vector and translation, m.
    """
    import cv2

    rays = rays_at(camera, view.pixels[:, 0], view.pixels[:, 1])
    good = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)
    if good.sum() < 6:
        plain = Camera(camera.width, camera.height, camera.K)
        rays, good = rays_at(plain, *view.pixels.T), np.ones(len(rays), bool)
    xy = rays[good, :2] / rays[good, 2:]
    done, rotation, shift = cv2.solvePnP(
        view.points[good], xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not done or not np.isfinite(rotation).all() or not np.isfinite(shift).all():
        rotation, shift = np.zeros(3), np.array([0, 0, 1.0])
    return np.concatenate([np.ravel(rotation), np.ravel(shift)]).astype(np.float64)
