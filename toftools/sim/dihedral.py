"""Light that bounces once from one wall of a corner to the other, by Gauss quadrature.

The kernel ``cos cos / (pi r^2)`` peaks where both points near the common edge; both variables are
substituted so that the integrand stays smooth there: the distance from the edge exponentially at
the receiver's own scale, the height by the angle seen from the receiver. Errors are below 3e-6 up
to 120 MHz over walls of 3 m, and 2e-4 at 620 MHz (its 31st harmonic at 20 MHz), by refinement.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.types import F64
from toftools.units import path_to_phase

NODES_OUT, NODES_UP = 32, 24
_CHUNK = 4096  # receivers at a time: 4096 x 32 x 24 complex numbers are 50 MB


@dataclass(frozen=True, eq=False)
class Wall:
    """Rectangle with one side on the vertical edge at ``(0, y, edge_m)``.

    Parameters
    ----------
    edge_m : float
        Axial distance of the edge, m.
    out : ndarray, (3,)
        Unit vector from the edge along the wall.
    normal : ndarray, (3,)
        Unit normal towards the other wall.
    size_m, height_m : float
        Extent along `out` and along the edge (centred on the axis), m.
    """

    edge_m: float
    out: F64
    normal: F64
    size_m: float
    height_m: float

    @classmethod
    def open(
        cls, side: int, edge_m: float, angle_deg: float, size_m: float, height_m: float
    ) -> "Wall":
        """Wall on one side (+1 right, -1 left) of a symmetric corner opened by `angle_deg`."""
        half = np.radians(angle_deg) / 2
        out = np.array([side * np.sin(half), 0.0, -np.cos(half)])
        normal = np.array([-side * np.cos(half), 0.0, -np.sin(half)])
        return cls(edge_m, out, normal, size_m, height_m)

    @property
    def origin(self) -> F64:
        """Foot of the edge on the optical axis."""
        return np.array([0.0, 0.0, self.edge_m])

    def intersect(self, directions: F64) -> F64:
        """Range at which rays from the camera hit the rectangle, NaN where they miss.

        Parameters
        ----------
        directions : ndarray, (..., 3)
            Unit rays from the camera centre.

        Returns
        -------
        ndarray, (...)
            Radial range, m.
        """
        slope = directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = (self.origin @ self.normal) / slope
            at = directions * range_m[..., None] - self.origin
            along, up = at @ self.out, at[..., 1]
            inside = (slope < 0) & (range_m > 0) & (along >= 0) & (along <= self.size_m)
            inside &= np.abs(up) <= self.height_m / 2
        return np.asarray(np.where(inside, range_m, np.nan))


Radiosity = Callable[[F64], F64]


def co_located(albedo: float, source: Wall) -> Radiosity:
    """Radiosity of a wall lit from the camera centre, per unit source strength.

    Parameters
    ----------
    albedo : float
        Diffuse albedo of the wall.
    source : Wall
        The lit wall.

    Returns
    -------
    callable
        Points (..., 3) to ``albedo cos / range^2``.
    """

    def radiosity(at: F64) -> F64:
        squared = np.sum(at * at, axis=-1)
        return np.asarray(albedo * (-at @ source.normal) / squared**1.5)

    return radiosity


def one_bounce(
    receivers: F64,
    receiver_wall: Wall,
    source_wall: Wall,
    albedo: float,
    freq_hz: float,
) -> NDArray[np.complex128]:
    """Irradiance phasor at points of one wall from the camera's light off the other.

    Parameters
    ----------
    receivers : ndarray, (N, 3)
        Points on `receiver_wall`, m.
    receiver_wall, source_wall : Wall
        The two walls.
    albedo : float
        Diffuse albedo of the source wall.
    freq_hz : float
        Frequency, Hz.

    Returns
    -------
    ndarray, (N,)
        ``int radiosity cos cos / (pi r^2) exp(j 2 pi f (d_v + r + d_u) / c) dA``.
    """
    radiosity = co_located(albedo, source_wall)
    parts = [
        _gather(receivers[i : i + _CHUNK], receiver_wall, source_wall, radiosity, freq_hz)
        for i in range(0, len(receivers), _CHUNK)
    ]
    return np.concatenate(parts) if parts else np.zeros(0, np.complex128)


def _gather(
    receivers: F64, receiver_wall: Wall, source_wall: Wall, radiosity: Radiosity, freq_hz: float
) -> NDArray[np.complex128]:
    edge = receivers - receiver_wall.origin
    s = np.maximum(edge @ receiver_wall.out, 1e-9)[:, None, None]  # (N, 1, 1) from the edge
    y = receivers[:, 1][:, None, None]
    cos_open = float(receiver_wall.out @ source_wall.out)
    x, wx = _gauss(NODES_OUT)
    top = np.log1p(source_wall.size_m / s)
    t = s * np.expm1(top * x[:, None])  # (N, T, 1)
    dt = wx[:, None] * top * (t + s)
    foot = np.sqrt(s**2 + t**2 - 2 * s * t * cos_open)  # distance in the plane of constant y
    low = np.arctan((-source_wall.height_m / 2 - y) / foot)
    high = np.arctan((source_wall.height_m / 2 - y) / foot)
    a, wa = _gauss(NODES_UP)
    theta = low + (high - low) * a  # (N, T, Y)
    dtheta = wa * (high - low)
    r = foot / np.cos(theta)
    points = source_wall.origin + t[..., None] * source_wall.out
    points = points + (y + foot * np.tan(theta))[..., None] * np.array([0.0, 1.0, 0.0])
    away = points - receivers[:, None, None, :]
    cosines = (away @ receiver_wall.normal) * -(away @ source_wall.normal)  # times r^2
    # dy = foot / cos^2(theta) dtheta = r^2 / foot dtheta
    kernel = cosines / (np.pi * r**4) * (r**2 / foot) * dt * dtheta
    path = np.linalg.norm(points, axis=-1) + r + np.linalg.norm(receivers, axis=-1)[:, None, None]
    turn = np.exp(1j * path_to_phase(path, freq_hz))
    return np.asarray((radiosity(points) * kernel * turn).sum(axis=(1, 2)))


def _gauss(n: int) -> tuple[F64, F64]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return (nodes + 1) / 2, weights / 2
