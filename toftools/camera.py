"""Pixel rays, radial range and axial z, clouds: every geometric step from image to space.

Camera frame: x right, y down, z forward; pixel centres at integer coordinates (OpenCV).
"""

from dataclasses import replace

import numpy as np

from toftools._lens import fisheye_angle, fisheye_limit, fisheye_radius, pinhole_limit
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


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The same field of view on another pixel grid.

    Parameters
    ----------
    camera : Camera
        Original camera.
    width, height : int
        New image size, px.

    Returns
    -------
    Camera
        Intrinsics scaled about the outer image corner (pixel centres at integers).
    """
    sx, sy = width / camera.width, height / camera.height
    K = np.array(camera.K)
    K[0, :2] *= sx
    K[1, :2] *= sy
    K[0, 2] = (camera.K[0, 2] + 0.5) * sx - 0.5
    K[1, 2] = (camera.K[1, 2] + 0.5) * sy - 0.5
    return replace(camera, width=width, height=height, K=K)


def undistorted(camera: Camera, *, most_deg: float = 70.0) -> Camera:
    """A pinhole without distortion that sees what this camera sees, for tools that know no other.

    Parameters
    ----------
    camera : Camera
        Any camera.
    most_deg : float
        Rays further off the axis are left out: a pinhole image of them would need too many pixels.

    Returns
    -------
    Camera
        Camera of the same image size; `toftools.calib.register.register_depth` with no turn and
        no shift brings a range image to it.

    Raises
    ------
    ValueError
        If no ray is left, or `most_deg` is not between 0 and 90.

    Examples
    --------
    >>> camera = pinhole(320, 240, hfov_deg=90)
    >>> bool(np.allclose(undistorted(camera).K, camera.K))
    True
    """
    if not 0 < most_deg < 90:
        msg = f"most_deg must lie between 0 and 90 degrees, got {most_deg}"
        raise ValueError(msg)
    way = rays(camera)
    kept = way[way[..., 2] > np.cos(np.radians(most_deg))]
    if camera.width < 2 or camera.height < 2 or not len(kept):
        msg = f"no pinhole can be fitted to the rays of a {camera.width} x {camera.height} px image"
        raise ValueError(msg)
    xy = kept[:, :2] / kept[:, 2:]
    low, high = xy.min(axis=0), xy.max(axis=0)
    f_px = (np.array([camera.width, camera.height]) - 1) / (high - low)
    K = np.array([[f_px[0], 0, -f_px[0] * low[0]], [0, f_px[1], -f_px[1] * low[1]], [0, 0, 1]])
    return Camera(camera.width, camera.height, K)


def rays(camera: Camera) -> F64:
    """Unit viewing direction of every pixel.

    Parameters
    ----------
    camera : Camera
        Camera, distortion respected.

    Returns
    -------
    ndarray, (H, W, 3)
        Unit vectors in the camera frame; NaN where the distortion polynomial folds back on
        itself, so that no ray belongs to the pixel. Rays of a fisheye may point backwards (z < 0).
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    return rays_at(camera, u, v)


def rays_at(camera: Camera, u_px: F64, v_px: F64) -> F64:
    """Unit viewing direction of any points of the image.

    Parameters
    ----------
    camera : Camera
        Camera, distortion respected.
    u_px, v_px : ndarray, (...)
        Column and row, px; whole numbers are pixel centres.

    Returns
    -------
    ndarray, (..., 3)
        Unit vectors in the camera frame; NaN where no ray belongs to the point.
    """
    if camera.model == "fisheye":
        return _fisheye_rays(camera, u_px, v_px)
    if camera.dist.any():
        x, y = _undistorted(camera, u_px, v_px)
    else:
        x, y = _normalised(camera, u_px, v_px)
    directions = np.stack([x, y, np.ones_like(x)], axis=-1)  # (..., 3)
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def _normalised(camera: Camera, u: F64, v: F64) -> tuple[F64, F64]:
    """Image points at focal length 1, distortion left in."""
    y = (v - camera.K[1, 2]) / camera.K[1, 1]
    return (u - camera.K[0, 2] - camera.K[0, 1] * y) / camera.K[0, 0], y


def _fisheye_rays(camera: Camera, u: F64, v: F64) -> F64:
    x, y = _normalised(camera, u, v)
    radius = np.hypot(x, y)
    theta = fisheye_angle(radius, camera.dist)
    # sin(theta) / radius goes to 1 on the axis.
    aside = np.where(radius > 0, np.sin(theta) / np.where(radius > 0, radius, 1.0), 1.0)
    return np.stack([aside * x, aside * y, np.cos(theta)], axis=-1)


def _undistorted(camera: Camera, u: F64, v: F64) -> tuple[F64, F64]:
    """Normalised image coordinates x / z and y / z of points, distortion taken out."""
    import cv2

    u = u - camera.K[0, 1] * (v - camera.K[1, 2]) / camera.K[1, 1]  # OpenCV knows no skew
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    # OpenCV 5 takes the stop criterion in undistortPoints, 4.x in a function of its own.
    solve = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    xy = np.asarray(solve(pixels, camera.K, camera.dist, R=None, P=None, criteria=stop))
    forward = cv2.convertPointsToHomogeneous(xy.reshape(-1, 1, 2))
    back = cv2.projectPoints(forward, np.zeros(3), np.zeros(3), camera.K, camera.dist)[0]
    missed = np.abs(np.asarray(back).reshape(-1, 2) - pixels.reshape(-1, 2)).max(axis=1) > 1e-2
    flat = np.where(missed[:, None], np.nan, xy.reshape(-1, 2))
    x, y = np.moveaxis(flat.reshape(*u.shape, 2), -1, 0)
    return x, y


def project(camera: Camera, points_m: F32 | F64) -> tuple[F64, F64]:
    """Where points of space appear in the image: the inverse of `rays_at`.

    Parameters
    ----------
    camera : Camera
        Camera, distortion respected.
    points_m : ndarray, (..., 3)
        Points in the camera frame, m; only their direction counts.

    Returns
    -------
    u_px, v_px : ndarray, (...)
        Column and row, px, inside the image or not; NaN where the model has no pixel for the
        direction: behind a pinhole, or beyond the angle at which the distortion turns back.

    Examples
    --------
    >>> u_px, v_px = project(pinhole(320, 240, hfov_deg=90), np.array([0.5, 0.0, 1.0]))
    >>> round(float(u_px), 6), round(float(v_px), 6)
    (239.5, 119.5)
    """
    place = np.asarray(points_m, dtype=np.float64)
    along = _fisheye_image if camera.model == "fisheye" else _pinhole_image
    x, y = along(camera, place)
    K = camera.K
    return K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]


def _fisheye_image(camera: Camera, place: F64) -> tuple[F64, F64]:
    """Image points at focal length 1, fisheye."""
    aside = np.hypot(place[..., 0], place[..., 1])
    theta = np.arctan2(aside, place[..., 2])
    radius = fisheye_radius(theta, camera.dist)
    off_axis = aside > 0
    scale = np.where(off_axis, radius / np.where(off_axis, aside, 1.0), 0.0)
    # Straight ahead the radius is 0; straight behind the direction of the radius is open.
    seen = (theta <= fisheye_limit(camera.dist)) & (off_axis | (place[..., 2] > 0))
    scale = np.where(seen, scale, np.nan)
    return scale * place[..., 0], scale * place[..., 1]


def _pinhole_image(camera: Camera, place: F64) -> tuple[F64, F64]:
    """Image points at focal length 1, pinhole, with the distortion."""
    ahead = place[..., 2] > 0
    xy = place[..., :2] / np.where(ahead, place[..., 2], np.nan)[..., None]
    if camera.dist.any():
        import cv2

        seen = np.hypot(xy[..., 0], xy[..., 1]) <= pinhole_limit(camera.dist)
        at = cv2.convertPointsToHomogeneous(np.where(seen[..., None], xy, 0.0).reshape(-1, 1, 2))
        bent = cv2.projectPoints(at, np.zeros(3), np.zeros(3), np.eye(3), camera.dist)[0]
        xy = np.where(seen[..., None], np.asarray(bent).reshape(xy.shape), np.nan)
    return xy[..., 0], xy[..., 1]


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
        Distance along the optical axis, m; not positive where a fisheye looks sideways or back.
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
        Radial range, m; NaN where the ray of a fisheye never reaches that z.
    """
    forward = rays(camera)[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.asarray(z_m / forward, dtype=np.float32)
    reached = (forward > 0) | ((range_m > 0) & np.isfinite(range_m))
    return np.asarray(np.where(reached, range_m, np.float32(np.nan)))


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
