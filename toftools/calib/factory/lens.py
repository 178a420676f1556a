"""Lens of a factory table: a camera, and how well it stands for what the table says.

Tables hold rays or a distortion model of their maker. Everything here works with OpenCV's models,
so a camera is fitted to them; the residual is the distance, in pixels, that this costs.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from toftools.calib.stage import Residual
from toftools.types import F64, Camera, Phasors


@dataclass(frozen=True, eq=False)
class FactoryLens:
    """Optics of the factory.

    Parameters
    ----------
    camera : Camera
        Intrinsics and distortion.
    residual : Residual
        Distance of its pixels from those of the table, px.
    """

    slot: ClassVar[str] = "lens"

    camera: Camera
    residual: Residual = field(default_factory=lambda: Residual("px"))

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors as they are: a lens changes where a pixel looks, not what it measures.

        Parameters
        ----------
        phasors : Phasors
            Any phasors.

        Returns
        -------
        Phasors
            The same.
        """
        return phasors


def fit_camera(
    size: tuple[int, int], xy: F64, uv: F64, weight: F64, *, n_dist: int
) -> tuple[Camera, F64]:
    """Pinhole camera with OpenCV distortion that sends directions to given pixels.

    Parameters
    ----------
    size : tuple of 2 ints
        Width and height, px.
    xy : ndarray, (N, 2)
        Directions x / z and y / z.
    uv : ndarray, (N, 2)
        Their pixels.
    weight : ndarray, (N, 2)
        Weights of column and row.
    n_dist : {5, 8}
        Distortion coefficients to fit.

    Returns
    -------
    tuple of Camera and ndarray (N, 2)
        The camera, and projected minus given pixels, px.
    """
    from scipy.optimize import least_squares

    def camera_at(p: F64) -> Camera:
        return Camera(*size, np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1.0]]), p[4:])

    def missed(p: F64) -> F64:
        return np.asarray(weight * (projected(camera_at(p), xy) - uv))

    start = np.zeros(4 + n_dist)
    for axis in (0, 1):
        kept = weight[:, axis] > 0
        start[axis], start[2 + axis] = np.polyfit(xy[kept, axis], uv[kept, axis], 1)
    found = least_squares(lambda p: missed(p).ravel(), start, x_scale="jac")
    camera = camera_at(found.x)
    return camera, projected(camera, xy) - uv


def projected(camera: Camera, xy: F64) -> F64:
    """Pixels of directions.

    Parameters
    ----------
    camera : Camera
        Pinhole camera.
    xy : ndarray, (N, 2)
        Directions x / z and y / z.

    Returns
    -------
    ndarray, (N, 2)
        Column and row, px.
    """
    import cv2

    points = np.column_stack([xy, np.ones(len(xy))])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.dist)[0]
    return np.asarray(seen, dtype=np.float64).reshape(-1, 2)


def rms_px(missed: F64, weight: F64) -> float:
    """Weighted root mean square distance of pixels.

    Parameters
    ----------
    missed, weight : ndarray, (N, 2)
        Differences, px, and weights.

    Returns
    -------
    float
        Distance, px.
    """
    return float(np.sqrt(2 * np.average(missed**2, weights=weight**2)))
