"""Where to look at a cloud from: to the right of the sensor and above it.

From the sensor itself every cloud looks like its image, and a flying pixel cannot be seen.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

YAW_DEG, PITCH_DEG = 35.0, 22.0  # of the view, from the sensor's own
FOV_DEG = 30.0


@dataclass(frozen=True)
class View:
    """A pinhole camera that sees a whole cloud."""

    K: F64
    extrinsic: F64
    size: tuple[int, int]

    def project(self, points: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) and depths (N,) of points (N, 3)."""
        local = points @ self.extrinsic[:3, :3].T + self.extrinsic[:3, 3]
        z = local[:, 2]
        homogeneous = local @ self.K.T
        return homogeneous[:, :2] / np.where(z > 0, z, np.nan)[:, None], z


def oblique(points: F64, size: tuple[int, int]) -> View:
    """View from the right and above that holds nearly all points.

    Parameters
    ----------
    points : ndarray, (N, 3)
        Finite points, x right, y down, z forward, m.
    size : (int, int)
        Width and height of the picture, px.

    Returns
    -------
    View
        The camera.
    """
    yaw, pitch = np.radians(YAW_DEG), np.radians(PITCH_DEG)
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    nod = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    rotation = nod @ turn
    seen = points @ rotation.T
    # A few wrapped pixels far behind must not shrink the rest to a dot: frame 98 % per axis.
    low, high = np.percentile(seen, [1, 99], axis=0)
    centre, reach = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    f_px = 0.5 * min(size) / np.tan(np.radians(FOV_DEG / 2))
    half = 0.86 * np.array(size) / 2  # a margin around what is framed
    distance = float(np.max(reach[:2] * f_px / half)) + float(reach[2])
    extrinsic = np.eye(4)
    extrinsic[:3, :3] = rotation
    extrinsic[:3, 3] = np.array([0, 0, distance]) - centre
    K = np.array([[f_px, 0, size[0] / 2 - 0.5], [0, f_px, size[1] / 2 - 0.5], [0, 0, 1]])
    return View(K, extrinsic, size)
