"""Pixel rays, radial range and axial z, clouds: every geometric step from image to space.

Camera frame: x right, y down, z forward; pixel centres at integer coordinates (OpenCV).
"""

import numpy as np

from toftools.types import F32, F64, Camera


def pinhole(width: int, height: int, *, hfov_deg: float) -> Camera:
    """Undistorted camera with square pixels and its axis at the image centre.

    Parameters
    ----------
    width, height : int
        Image size, px.
    hfov_deg : float
        Horizontal field of view between the outer edges of the image, degrees.

    Returns
    -------
    Camera
        The camera.

    Examples
    --------
    >>> pinhole(320, 240, hfov_deg=90).K[0, 0].round(6)
    np.float64(160.0)
    """
    if not 0 < hfov_deg < 180:
        msg = f"hfov_deg must lie between 0 and 180 degrees, got {hfov_deg}"
        raise ValueError(msg)
    f_px = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    K = np.array([[f_px, 0, (width - 1) / 2], [0, f_px, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, K)


def rays(camera: Camera) -> F64:
    """Unit viewing direction of every pixel.

    Parameters
    ----------
    camera : Camera
        Camera, distortion respected.

    Returns
    -------
    ndarray, (H, W, 3)
        Unit vectors in the camera frame.
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    if camera.dist.any():
        import cv2

        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        flat = cv2.undistortPointsIter if hasattr(cv2, "undistortPointsIter") else None
        if flat is not None:
            xy = flat(pixels, camera.K, camera.dist, None, None, stop)
        else:
            xy = cv2.undistortPoints(pixels, camera.K, camera.dist, criteria=stop)
        x, y = np.asarray(xy, dtype=np.float64).reshape(camera.height, camera.width, 2).T
        x, y = x.T, y.T
    else:
        y = (v - camera.K[1, 2]) / camera.K[1, 1]
        x = (u - camera.K[0, 2] - camera.K[0, 1] * y) / camera.K[0, 0]
    directions = np.stack([x, y, np.ones_like(x)], axis=-1)  # (H, W, 3)
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def range_to_z(camera: Camera, range_m: F32 | F64) -> F32:
    """Axial z of a radial range image.

    Parameters
    ----------
    camera : Camera
        Camera.
    range_m : ndarray, (H, W)
        Radial range, m.

    Returns
    -------
    ndarray, (H, W), float32
        Distance along the optical axis, m.
    """
    return np.asarray(range_m * rays(camera)[..., 2], dtype=np.float32)


def z_to_range(camera: Camera, z_m: F32 | F64) -> F32:
    """Radial range of an axial z image: the inverse of `range_to_z`.

    Parameters
    ----------
    camera : Camera
        Camera.
    z_m : ndarray, (H, W)
        Distance along the optical axis, m.

    Returns
    -------
    ndarray, (H, W), float32
        Radial range, m.
    """
    return np.asarray(z_m / rays(camera)[..., 2], dtype=np.float32)


def points(camera: Camera, range_m: F32 | F64) -> F32:
    """Point of every pixel in the camera frame.

    Parameters
    ----------
    camera : Camera
        Camera.
    range_m : ndarray, (H, W)
        Radial range, m; NaN gives NaN points.

    Returns
    -------
    ndarray, (H, W, 3), float32
        Points x right, y down, z forward, m.
    """
    return np.asarray(rays(camera) * range_m[..., None], dtype=np.float32)
