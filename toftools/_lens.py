"""How far from the axis a lens model can be trusted, and the equidistant (fisheye) model itself.

A distortion polynomial that turns back would send two directions to one pixel; everything beyond
its first turning point has no pixel, and every pixel beyond its largest radius no direction.
"""

from functools import lru_cache

import numpy as np

from toftools._arrays import F64

TABLE = 1024
"""Nodes of the table that starts the inversion of the fisheye polynomial."""
NEWTON_STEPS = 8
"""Steps after the table; four reach 1e-15 rad away from the turning point."""


def _first_root(falling: F64) -> float:
    """Smallest positive real root of a polynomial, coefficients from the highest; inf if none."""
    roots = np.roots(falling)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))) & (roots.real > 0)]
    return float(real.min()) if real.size else float("inf")


def pinhole_limit(dist: F64) -> float:
    """Largest x / z up to which OpenCV's radial polynomial rises.

    Parameters
    ----------
    dist : ndarray, (n,)
        Distortion coefficients in OpenCV order, n in {0, 4, 5, 8, 12, 14}.

    Returns
    -------
    float
        Distance from the axis at z = 1; inf without a turning point.

    Examples
    --------
    >>> round(pinhole_limit(np.array([-0.1, 0, 0, 0])), 6)  # 1 - 3 * 0.1 r^2 = 0
    1.825742
    """
    k1, k2, _, _, k3, k4, k5, k6 = [*dist.tolist(), *8 * [0.0]][:8]
    return _rising_up_to((k3, k2, k1, 1.0), (k6, k5, k4, 1.0))


@lru_cache(maxsize=64)
def _rising_up_to(above: tuple[float, ...], below: tuple[float, ...]) -> float:
    """Limit of r above(r^2) / below(r^2), coefficients from the highest."""
    s = np.array([2.0, 0.0])
    rise: F64 = np.polysub(
        np.polymul(np.polyadd(above, np.polymul(s, np.polyder(above))), below),
        np.polymul(s, np.polymul(above, np.polyder(below))),
    )
    return float(np.sqrt(min(_first_root(rise), _first_root(np.asarray(below)))))


def fisheye_limit(dist: F64) -> float:
    """Largest angle from the axis up to which the fisheye polynomial rises.

    Parameters
    ----------
    dist : ndarray, (4,)
        Coefficients k1..k4.

    Returns
    -------
    float
        Angle, rad; at most pi.
    """
    k1, k2, k3, k4 = dist.tolist()
    return _angle_up_to(k1, k2, k3, k4)


@lru_cache(maxsize=64)
def _angle_up_to(k1: float, k2: float, k3: float, k4: float) -> float:
    rise = np.array([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    return float(min(np.pi, np.sqrt(_first_root(rise))))


def fisheye_radius(theta_rad: F64, dist: F64) -> F64:
    """Image radius at focal length 1 of an angle from the axis.

    Parameters
    ----------
    theta_rad : ndarray
        Angle from the optical axis, rad.
    dist : ndarray, (4,)
        Coefficients k1..k4.

    Returns
    -------
    ndarray
        ``theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``.

    References
    ----------
    OpenCV, module calib, namespace fisheye; J. Kannala and S. Brandt, A generic camera model and
    calibration method for conventional, wide-angle, and fish-eye lenses, PAMI 28(8), 2006.
    """
    s = theta_rad * theta_rad
    bent = 1 + s * (dist[0] + s * (dist[1] + s * (dist[2] + s * dist[3])))
    return np.asarray(theta_rad * bent)


def fisheye_angle(radius: F64, dist: F64) -> F64:
    """Angle from the axis of an image radius: the inverse of `fisheye_radius`.

    Parameters
    ----------
    radius : ndarray
        Image radius at focal length 1.
    dist : ndarray, (4,)
        Coefficients k1..k4.

    Returns
    -------
    ndarray
        Angle, rad, in [0, `fisheye_limit`]; NaN beyond the largest radius.

    Examples
    --------
    >>> lens = np.array([0.02, -0.01, 0.0, 0.0])
    >>> bool(np.isclose(fisheye_angle(fisheye_radius(np.float64(1.9), lens), lens), 1.9))
    True
    """
    last = fisheye_limit(dist)
    nodes = np.linspace(0.0, last, TABLE)
    reached = fisheye_radius(nodes, dist)
    theta = np.interp(radius, reached, nodes)
    step = nodes[1]
    low, high = theta - step, np.minimum(theta + step, last)
    for _ in range(NEWTON_STEPS):
        s = theta * theta
        slope = 1 + s * (3 * dist[0] + s * (5 * dist[1] + s * (7 * dist[2] + s * 9 * dist[3])))
        missing = fisheye_radius(theta, dist) - radius
        theta = np.clip(theta - missing / np.maximum(slope, 1e-9), low, high)
    return np.asarray(np.where(radius <= reached[-1], theta, np.nan))
