"""Range of a ToF camera in the image of another camera, and the other way round its colours.

Model: every ToF pixel is a small quadrangle in space, its corners shared with those neighbours into
which the surface goes on; the quadrangles are drawn into the other image, the nearest in front. A
ToF pixel that lies behind what is drawn where it appears is hidden and gets no colour. A surface
goes on where the range changes by less than `slope` times the distance between the pixels' rays.
Inputs: a pose (`toftools.calib.extrinsics`), ranges corrected before. Fails where the ToF camera
itself sees no occluder that the other camera sees: what lies behind such a one gets its colour.
A rectangle at 1 m before a wall at 2 m, 320 x 240 px, baseline 60 mm (benchmarks/second_camera.py):
beside 1280 x 960 px, 0.94 % of the pixels get a wrong colour by plain projection, 0.88 % with a
depth test by OpenCV 5's registerDepth (dilated), 0.04 % here, where 0.13 % lose the colour they
should have; beside 320 x 240 px, 1.03 %, 0.15 % (0.35 % lost) and 0.13 % (0.05 % lost).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools._arrays import kernel_input
from toftools.calib._register_kernel import COLOURED, HIDDEN, NO_RANGE, OUTSIDE, cover, pick
from toftools.calib.extrinsics import Extrinsics
from toftools.camera import project, range_to_z, rays, rays_at
from toftools.types import F32, F64, Bool, Camera

__all__ = ["COLOURED", "HIDDEN", "NO_RANGE", "OUTSIDE", "colours_of", "register_depth"]

NOISE_SIGMAS = 4.2
"""Three standard deviations of the difference of two ranges, in those of one."""
CORNERS = ((-1, -1), (-1, 1), (1, 1), (1, -1))
"""Rows and columns from a pixel to its corners, in order around."""
STEPS = (*CORNERS, (-1, 0), (0, 1), (1, 0), (0, -1))


def register_depth(
    extrinsics: Extrinsics,
    camera: Camera,
    range_m: F32 | F64,
    *,
    sigma_m: float | F32 = 0.0,
    slope: float = 5.0,
) -> F32:
    """Axial z in the image of the second camera.

    Parameters
    ----------
    extrinsics : Extrinsics
        Pose and optics of the second camera.
    camera : Camera
        The ToF camera.
    range_m : ndarray, (H, W)
        Its radial range, m; NaN where unknown.
    sigma_m : float or ndarray, (H, W)
        Standard deviation of the range, m: noise tears no surface.
    slope : float
        Change of range over distance beside it up to which a surface goes on.

    Returns
    -------
    ndarray, (Hc, Wc), float32
        Distance along the axis of the second camera of the nearest surface behind each of its
        pixels, m; NaN where the ToF camera saw none.

    Raises
    ------
    ValueError
        If the range is of another size than the camera.
    """
    nearest = _drawn(extrinsics, camera, range_m, (slope, _noise_m(sigma_m)), grow_px=0.0)
    with np.errstate(divide="ignore"):
        distance = np.where(nearest > 0, 1 / nearest, np.nan)
    if extrinsics.colour.model == "fisheye":
        return range_to_z(extrinsics.colour, distance)
    return distance.astype(np.float32)


def colours_of(
    extrinsics: Extrinsics,
    camera: Camera,
    range_m: F32 | F64,
    image: NDArray[Any],
    *,
    sigma_m: float | F32 = 0.0,
    slope: float = 5.0,
    grow_px: float = 0.4,
) -> tuple[F32, NDArray[np.uint8]]:
    """Colour of every ToF pixel that the second camera sees.

    Parameters
    ----------
    extrinsics : Extrinsics
        Pose and optics of the second camera.
    camera : Camera
        The ToF camera.
    range_m : ndarray, (H, W)
        Its radial range, m; NaN where unknown.
    image : ndarray, (Hc, Wc, C)
        Picture of the second camera.
    slope : float
        Change of range over distance beside it up to which a surface goes on.
    grow_px : float
        ToF pixels by which surfaces reach further at their rims, since the true rim may lie
        anywhere up to the centre of the next pixel.

    Returns
    -------
    tuple of ndarray (H, W, C) float32, ndarray (H, W) uint8
        Colours in the unit of the image, NaN where there is none, and why: `COLOURED`,
        `NO_RANGE`, `OUTSIDE` the picture, or `HIDDEN` from the second camera.

    Raises
    ------
    ValueError
        If range or picture are of another size than their cameras.
    """
    wanted = extrinsics.colour.shape
    if image.ndim != 3 or image.shape[:2] != wanted:
        msg = (
            f"got a picture of shape {image.shape}, wanted {wanted} and colours, as the camera of "
            "the calibration"
        )
        raise ValueError(msg)
    noise_m = _noise_m(sigma_m)
    nearest = _drawn(extrinsics, camera, range_m, (slope, noise_m), grow_px)
    way = rays(camera)
    u, v, w = _seen(extrinsics, _points(way, range_m).reshape(-1, 3))
    lax = slope * _pitch(way) * np.where(range_m > 0, range_m, 0.0) + noise_m
    colours = np.zeros((range_m.size, image.shape[2]), np.float32)
    status = np.zeros(range_m.size, np.uint8)
    pick(
        (kernel_input(u), kernel_input(v), kernel_input(w)),
        kernel_input(lax.ravel().astype(np.float64)),
        kernel_input(nearest),
        kernel_input(image if image.dtype == np.uint8 else image.astype(np.float32)),
        colours,
        status,
    )
    return colours.reshape(*range_m.shape, -1), status.reshape(range_m.shape)


def _noise_m(sigma_m: float | F32) -> F64:
    """Difference that noise alone may make between two pixels."""
    known = np.asarray(sigma_m, dtype=np.float64)
    return np.asarray(NOISE_SIGMAS * np.where(np.isfinite(known), known, 0.0))


def _points(way: F64, range_m: F32 | F64) -> F64:
    known = np.isfinite(range_m) & (range_m > 0)
    return np.asarray(way * np.where(known, range_m, np.nan)[..., None])


def _pitch(way: F64) -> F64:
    """Distance between the rays of neighbouring pixels, at 1 m."""
    if min(way.shape[:2]) < 2:
        return np.full(way.shape[:2], np.inf)
    return np.asarray(
        np.maximum(
            np.linalg.norm(np.gradient(way, axis=0), axis=-1),
            np.linalg.norm(np.gradient(way, axis=1), axis=-1),
        )
    )


def _seen(extrinsics: Extrinsics, points_m: F64) -> tuple[F64, F64, F64]:
    """Column, row and inverse distance in the second camera: of z, for a fisheye of the range.

    The inverse distance is 0 where the camera cannot see the point, NaN where there is none.
    """
    # einsum, since BLAS wakes all its threads for a (N, 3) by (3, 3) product
    place = np.einsum("ij,nj->ni", extrinsics.rotation, points_m) + extrinsics.translation_m
    u, v = project(extrinsics.colour, place)
    fisheye = extrinsics.colour.model == "fisheye"
    distance = np.linalg.norm(place, axis=-1) if fisheye else place[..., 2]
    with np.errstate(divide="ignore"):
        w = np.where(np.isfinite(u) & (distance > 0), 1 / distance, 0.0)
    w[np.isnan(distance)] = np.nan
    return u, v, w


def _drawn(
    extrinsics: Extrinsics,
    camera: Camera,
    range_m: F32 | F64,
    limits: tuple[float, F64],
    grow_px: float,
) -> F64:
    """Inverse distance of the nearest surface behind every pixel of the image; 0 if none."""
    if range_m.shape != camera.shape:
        msg = f"got ranges of {range_m.shape} pixels, wanted the camera's {camera.shape}"
        raise ValueError(msg)
    corners = _corners(camera, np.asarray(range_m, dtype=np.float64), limits, grow_px)
    u, v, w = (part.reshape(-1, 4) for part in _seen(extrinsics, corners.reshape(-1, 3)))
    known = (np.isfinite(u) & np.isfinite(v) & (w > 0)).all(axis=1)
    nearest = np.zeros(extrinsics.colour.shape)
    cover(*(kernel_input(part[known]) for part in (u, v, w)), nearest)
    return nearest


def _corners(camera: Camera, range_m: F64, limits: tuple[float, F64], grow_px: float) -> F64:
    """Corners (H, W, 4, 3) of the surface that every pixel sees, m.

    Along a plane 1 / range is linear in the ray: a corner inside a surface has the mean of the
    pixels around it, one at the rim goes on as its own pixel does.
    """
    way = rays(camera)
    inverse = 1 / np.where(np.isfinite(range_m) & (range_m > 0), range_m, np.nan)
    rise = {
        step: np.where(_joined(inverse, way, step, limits), _moved(inverse, step) - inverse, np.nan)
        for step in STEPS
    }
    noise = limits[1] * inverse**2
    down_rise = _rise(rise[1, 0], rise[-1, 0], noise)
    right_rise = _rise(rise[0, 1], rise[0, -1], noise)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    corners = []
    for down, right in CORNERS:
        around = (rise[down, 0] + rise[0, right] + rise[down, right]) / 4
        beyond_v = down * (0.5 + grow_px * np.isnan(rise[down, 0]))
        beyond_u = right * (0.5 + grow_px * np.isnan(rise[0, right]))
        onward = np.where(np.isnan(around), beyond_v * down_rise + beyond_u * right_rise, around)
        # Never nearer than half the range, however steep the surface.
        there = inverse + np.clip(onward, -0.5 * inverse, inverse)
        corners.append(rays_at(camera, u + beyond_u, v + beyond_v) / there[..., None])
    return np.stack(corners, axis=2)


def _joined(inverse: F64, way: F64, step: tuple[int, int], limits: tuple[float, F64]) -> Bool:
    """Whether the surface goes on into the neighbour; false where one is unknown."""
    other, beside = _moved(inverse, step), np.linalg.norm(way - _moved(way, step), axis=-1)
    # |r - r'| <= slope * beside * min(r, r') + noise, in inverse ranges
    most = limits[0] * beside * np.minimum(inverse, other) + limits[1] * inverse * other
    return np.asarray(np.abs(inverse - other) <= most)


def _rise(ahead: F64, back: F64, noise: F64) -> F64:
    """Rise per pixel from the neighbours on the surface; 0 if none is, or within the noise."""
    known = 1.0 * ~np.isnan(ahead) + ~np.isnan(back)
    rise = (np.nan_to_num(ahead) - np.nan_to_num(back)) / np.maximum(known, 1)
    return np.asarray(np.where(np.abs(rise) > noise, rise, 0.0))


def _moved(image: F64, step: tuple[int, int]) -> F64:
    """The neighbour in that direction; NaN beyond the rim."""
    height, width = image.shape[:2]
    padded = np.pad(image, [(1, 1), (1, 1)] + [(0, 0)] * (image.ndim - 2), constant_values=np.nan)
    return padded[1 + step[0] : 1 + step[0] + height, 1 + step[1] : 1 + step[1] + width]
