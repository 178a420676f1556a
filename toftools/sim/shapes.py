"""The transport of each closed-form scene: range and the sum of its returns at any frequency.

All phasors are per unit source strength: a white, fronto-parallel surface at 1 m gives 1.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.camera import rays
from toftools.sim.dihedral import Wall, one_bounce
from toftools.types import F64, Camera
from toftools.units import path_to_phase, range_to_phase

C128 = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Transport:
    """What a camera receives from a scene.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Radial range of the first surface, m; NaN where the ray leaves the scene.
    phasor : callable
        ``phasor(freq_hz, max_bounces) -> (H, W)`` complex sum of all returns with at most that
        many indirect bounces (None for all the closed form has).
    """

    range_m: F64
    phasor: Callable[[float, int | None], C128]


def check_positive(**positive: float) -> None:
    """Refuse what is not a positive number, by its name."""
    for name, value in positive.items():
        if not (np.isfinite(value) and value > 0):
            msg = f"{name} must be a positive number, got {value}"
            raise ValueError(msg)


def check_albedo(albedo: float) -> None:
    """Refuse an albedo that no surface has."""
    if not 0 < albedo <= 1:
        msg = f"albedo must be in (0, 1], got {albedo}"
        raise ValueError(msg)


def _lambert(range_m: F64, cosine: F64, albedo: float) -> F64:
    """Direct strength ``albedo cos / range^2``, zero where the ray hits nothing."""
    return np.asarray(np.nan_to_num(albedo * cosine / range_m**2, nan=0.0))


def _turn(range_m: F64, freq_hz: float) -> C128:
    return np.asarray(np.exp(1j * np.nan_to_num(range_to_phase(range_m, freq_hz))))


def wall(camera: Camera, *, range: float = 2.0, albedo: float = 0.5) -> Transport:
    """Fronto-parallel Lambertian plane.

    Parameters
    ----------
    camera : Camera
        Camera.
    range : float
        Distance along the optical axis, m.
    albedo : float
        Diffuse albedo, 0..1.

    Returns
    -------
    Transport
        Direct light only: a plane has no second bounce.
    """
    return tilted(camera, range=range, tilt=0.0, albedo=albedo)


def tilted(
    camera: Camera, *, range: float = 2.0, tilt: float = 30.0, albedo: float = 0.5
) -> Transport:
    """Lambertian plane turned about the vertical axis through its point on the optical axis.

    Parameters
    ----------
    camera : Camera
        Camera.
    range : float
        Distance of the plane along the optical axis, m.
    tilt : float
        Angle between the plane's normal and the optical axis, degrees.
    albedo : float
        Diffuse albedo, 0..1.

    Returns
    -------
    Transport
        Direct light only; rays that miss the plane see nothing.
    """
    check_positive(range=range)
    check_albedo(albedo)
    if not -89 <= tilt <= 89:
        msg = f"tilt must lie within +-89 degrees, got {tilt}"
        raise ValueError(msg)
    normal = np.array([np.sin(np.radians(tilt)), 0.0, np.cos(np.radians(tilt))])
    cosine = rays(camera) @ normal  # (H, W) between ray and inward normal
    with np.errstate(divide="ignore"):
        range_m = np.where(cosine > 1e-6, range * normal[2] / cosine, np.nan)
    strength = _lambert(range_m, cosine, albedo)
    return Transport(range_m, lambda freq_hz, _bounces: strength * _turn(range_m, freq_hz))


def cavity(camera: Camera, *, radius: float = 2.0, albedo: float = 0.8) -> Transport:
    """Lambertian sphere seen from its centre: every bounce, exactly.

    Inside a sphere each bounce lands uniformly and the chord pdf is ``l / (2 R^2)``, so one
    bounce multiplies by ``albedo P(k)`` and all of them sum as a geometric series.

    Parameters
    ----------
    camera : Camera
        Camera at the centre.
    radius : float
        Sphere radius R, m.
    albedo : float
        Diffuse albedo, 0..1, below 1.

    Returns
    -------
    Transport
        All bounces, or the partial sum up to `max_bounces`.

    References
    ----------
    Derived in research of this project; the chord density is that of E. S. Fry et al.,
    "Integrating cavities: temporal response", Applied Optics 45 (2006) 9053.
    """
    check_positive(radius=radius)
    check_albedo(albedo)
    if albedo >= 1:
        msg = f"a closed cavity needs albedo below 1, got {albedo}"
        raise ValueError(msg)
    range_m = np.full(camera.shape, float(radius))

    def phasor(freq_hz: float, max_bounces: int | None) -> C128:
        gain = albedo * cavity_bounce(radius, freq_hz)
        total = 1 / (1 - gain)
        if max_bounces is not None:
            total *= 1 - gain ** (max_bounces + 1)
        return np.asarray(albedo / radius**2 * total * _turn(range_m, freq_hz))

    return Transport(range_m, phasor)


def cavity_bounce(radius_m: float, freq_hz: float) -> complex:
    """Mean phasor of one bounce inside a sphere, ``P(k) = int l/(2R^2) exp(+jkl) dl``.

    Parameters
    ----------
    radius_m : float
        Sphere radius R, m.
    freq_hz : float
        Frequency, Hz; 0 gives 1.

    Returns
    -------
    complex
        ``[exp(2jkR)(1 - 2jkR) - 1] / (2 R^2 k^2)`` with k = 2 pi f / c.

    Examples
    --------
    >>> cavity_bounce(2.0, 0.0)
    (1+0j)
    """
    x = float(path_to_phase(2 * radius_m, freq_hz))  # 2 k R
    if abs(x) < 1e-3:  # the closed form cancels; its series is exact here to 1e-13
        return complex(1 - x**2 / 4, 2 * x / 3 - x**3 / 15)
    return complex(2 * (np.exp(1j * x) * (1 - 1j * x) - 1) / x**2)


def corner(
    camera: Camera,
    *,
    range: float = 2.0,
    angle: float = 90.0,
    albedo: float = 0.7,
    size: float = 2.0,
    height: float = 3.0,
) -> Transport:
    """Concave corner of two Lambertian walls, direct light and one bounce by quadrature.

    The edge is vertical, on the optical axis; the walls open symmetrically towards the camera.

    Parameters
    ----------
    camera : Camera
        Camera.
    range : float
        Distance of the edge along the optical axis, m.
    angle : float
        Angle between the walls, degrees.
    albedo : float
        Diffuse albedo of both walls, 0..1.
    size, height : float
        Extent of each wall away from the edge, and along it, m.

    Returns
    -------
    Transport
        Direct light plus at most one bounce.
    """
    check_positive(range=range, size=size, height=height)
    check_albedo(albedo)
    if not 10 <= angle < 180:
        msg = f"angle must lie in 10..180 degrees, got {angle}"
        raise ValueError(msg)
    walls = [Wall.open(side, range, angle, size, height) for side in (+1, -1)]
    directions = rays(camera)
    hits = np.stack([w.intersect(directions) for w in walls])  # (2, H, W)
    with np.errstate(invalid="ignore"):
        range_m = np.fmin(hits[0], hits[1])
        on_first = hits[0] == range_m
    strength = np.zeros(camera.shape)
    for side, w in enumerate(walls):
        mine = np.isfinite(range_m) & (on_first if side == 0 else ~on_first)
        strength[mine] = albedo * (-directions[mine] @ w.normal) / range_m[mine] ** 2

    def phasor(freq_hz: float, max_bounces: int | None) -> C128:
        total = strength * _turn(range_m, freq_hz)
        if max_bounces == 0:
            return total
        for side, w in enumerate(walls):
            mine = np.isfinite(range_m) & (on_first if side == 0 else ~on_first)
            at = directions[mine] * range_m[mine, None]
            total[mine] += albedo * one_bounce(at, w, walls[1 - side], albedo, freq_hz)
        return total

    return Transport(range_m, phasor)
