"""Closed forms of what a calibration bench looks at: any plane, and a printed board before one.

Light of a small source at any place on Lambertian surfaces, direct only: per unit source strength
a ray returns ``albedo cos / d^2`` over the path ``d + range``, d being the leg from the source.
A print is sampled by many rays per pixel. Their complex sum over a surface is written with the
first two moments of the path, ``S exp(j k mean - k^2 variance / 2)``, which is exact to third order
in k times the spread of path within a pixel: a board tilted by 40 degrees at 0.4 m and a wall at
2 m, seen by 320 x 240 pixels of 70 degrees, err by 2e-9 of their light at 70 MHz and by 4e-5 at
2.1 GHz, the 30th harmonic. Board and background are summed apart, so pixels at the edge fly as they
should. No light goes from one surface to another.
"""

from dataclasses import dataclass

import numpy as np

from toftools._arrays import F64, Bool, frozen, set_fields
from toftools.camera import rays_at
from toftools.sim.shapes import C128, Transport, check_albedo, check_positive
from toftools.types import Camera
from toftools.units import path_to_phase

HERE = (0.0, 0.0, 0.0)
FACING = (0.0, 0.0, -1.0)
DARK, LIGHT = 0.08, 0.8
"""Albedo of ink and paper in the near infrared; ink of many printers is far lighter there."""
TEXELS = 60
"""Texels per square of a pattern with markers."""


@dataclass(frozen=True, eq=False)
class Print:
    """A printed pattern on a plane.

    Parameters
    ----------
    albedo : ndarray, (rows, columns)
        Albedo of every texel, 0..1.
    texel_m : float
        Side of a texel, m.
    origin_m : tuple of 2 floats
        Where the outer corner of the first texel lies in the frame of the pattern, m.
    """

    albedo: F64
    texel_m: float
    origin_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        albedo = frozen(self.albedo, np.float64, "albedo", 2)
        if not ((albedo >= 0) & (albedo <= 1)).all():
            msg = f"albedo must lie in 0..1, got {albedo.min()} to {albedo.max()}"
            raise ValueError(msg)
        check_positive(texel_m=self.texel_m)
        set_fields(self, albedo=albedo)

    def at(self, x_m: F64, y_m: F64) -> tuple[F64, Bool]:
        """Albedo at points of the plane, and which of them lie on the print."""
        rows, columns = self.albedo.shape
        with np.errstate(invalid="ignore"):
            u = np.floor((x_m - self.origin_m[0]) / self.texel_m)
            v = np.floor((y_m - self.origin_m[1]) / self.texel_m)
            inside = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
        column, row = (np.where(inside, n, 0).astype(np.intp) for n in (u, v))
        return np.where(inside, self.albedo[row, column], 0.0), inside


def chessboard(
    columns: int, rows: int, square_m: float, *, dark: float = DARK, light: float = LIGHT
) -> Print:
    """A chessboard with a white margin as wide as a square; the first square is dark.

    Parameters
    ----------
    columns, rows : int
        Inner corners.
    square_m : float
        Side of a square, m.
    dark, light : float
        Albedo of ink and paper, 0..1.

    Returns
    -------
    Print
        Origin at the outer corner of the first square, x along the columns.
    """
    y, x = np.mgrid[0 : rows + 1, 0 : columns + 1]
    squares = np.where((x + y) % 2 == 0, dark, light)
    return Print(np.pad(squares, 1, constant_values=light), square_m, (-square_m, -square_m))


def charuco(
    columns: int,
    rows: int,
    square_m: float,
    marker_m: float,
    *,
    dictionary: str = "DICT_4X4_50",
    dark: float = DARK,
    light: float = LIGHT,
) -> Print:
    """A ChArUco board, as OpenCV draws it, with a white margin as wide as a square.

    Parameters
    ----------
    columns, rows : int
        Squares.
    square_m, marker_m : float
        Side of a square and of a marker, m.
    dictionary : str
        OpenCV's name of the marker dictionary.
    dark, light : float
        Albedo of ink and paper, 0..1.

    Returns
    -------
    Print
        Origin at the outer corner of the first square, x along the columns.
    """
    import cv2

    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((columns, rows), square_m, marker_m, words)
    image = board.generateImage((TEXELS * columns, TEXELS * rows), marginSize=0, borderBits=1)
    albedo = np.where(np.asarray(image) < 128, dark, light)
    padded = np.pad(albedo, TEXELS, constant_values=light)
    return Print(padded, square_m / TEXELS, (-square_m, -square_m))


def plane(
    directions: F64,
    *,
    distance_m: float,
    normal: tuple[float, float, float] = FACING,
    albedo: float = 0.5,
    emitter_m: tuple[float, float, float] = HERE,
) -> Transport:
    """An endless Lambertian plane.

    Parameters
    ----------
    directions : ndarray, (H, W, 3)
        Ray of every pixel, as `toftools.camera.rays` gives them.
    distance_m : float
        Where the plane meets the optical axis, m.
    normal : tuple of 3 floats
        Its normal, towards the camera.
    albedo : float
        Diffuse albedo, 0..1.
    emitter_m : tuple of 3 floats
        Place of the light source, m.

    Returns
    -------
    Transport
        Direct light; rays that miss the plane see nothing.
    """
    check_positive(distance_m=distance_m)
    check_albedo(albedo)
    facing = np.asarray(normal) / np.linalg.norm(normal)
    if not facing[2] < 0:
        msg = f"normal must point towards the camera, z < 0, got {normal}"
        raise ValueError(msg)
    range_m = _meets(directions, distance_m * facing[2], facing)
    strength, path = _lit(directions, range_m, facing, emitter_m)
    strength = albedo * strength
    return Transport(range_m, lambda freq_hz, _bounces: strength * _turn(path, freq_hz))


def printed(
    directions: F64,
    pattern: Print,
    *,
    rotation: F64,
    origin_m: F64,
    wall_m: float,
    wall_albedo: float = 0.3,
    emitter_m: tuple[float, float, float] = HERE,
) -> Transport:
    """A printed board in front of a wall.

    Parameters
    ----------
    directions : ndarray, (S, H, W, 3)
        Rays of every pixel, as `pixel_rays` gives them.
    pattern : Print
        What is printed.
    rotation : ndarray, (3, 3)
        Axes of the pattern in the camera frame as columns; z points away from the camera.
    origin_m : ndarray, (3,)
        Its origin in the camera frame, m.
    wall_m : float
        Distance of the wall behind along the optical axis, m.
    wall_albedo : float
        Its albedo, 0..1.
    emitter_m : tuple of 3 floats
        Place of the light source, m.

    Returns
    -------
    Transport
        Direct light; the range is that of the first ray of every pixel.
    """
    across, facing = rotation[:, :2], -rotation[:, 2]
    wall = np.asarray(FACING)
    moments = np.zeros((2, 3, *directions.shape[1:3]))
    first = np.full(directions.shape[1:3], np.nan)
    for i, ray in enumerate(directions):
        range_m = _meets(ray, float(origin_m @ facing), facing)
        xy = (ray * range_m[..., None] - origin_m) @ across
        albedo, inside = pattern.at(xy[..., 0], xy[..., 1])
        behind = _meets(ray, -wall_m, wall)
        strength, path = _lit(ray, np.where(inside, range_m, np.nan), facing, emitter_m)
        _add(moments[0], albedo * strength, path)
        strength, path = _lit(ray, np.where(inside, np.nan, behind), wall, emitter_m)
        _add(moments[1], wall_albedo * strength, path)
        if i == 0:
            first = np.where(inside, range_m, behind)
    moments /= len(directions)
    return Transport(first, lambda freq_hz, _bounces: _sum(moments, freq_hz))


def pixel_rays(camera: Camera, per_side: int) -> F64:
    """Rays evenly spread over every pixel.

    Parameters
    ----------
    camera : Camera
        Camera, distortion respected.
    per_side : int
        Rays along either side of a pixel.

    Returns
    -------
    ndarray, (per_side^2, H, W, 3)
        Unit vectors; that nearest to the pixel's centre comes first.
    """
    at = (np.arange(per_side) + 0.5) / per_side - 0.5
    offsets = sorted(((x, y) for y in at for x in at), key=lambda xy: xy[0] ** 2 + xy[1] ** 2)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    return np.stack([rays_at(camera, u + du, v + dv) for du, dv in offsets])


def _meets(ray: F64, offset: float, facing: F64) -> F64:
    """Range at which rays meet the plane ``p . facing = offset``; NaN where they do not."""
    slope = ray @ facing
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where((slope < 0) & (offset < 0), offset / slope, np.nan))


def _lit(
    ray: F64, range_m: F64, facing: F64, emitter_m: tuple[float, float, float]
) -> tuple[F64, F64]:
    """Light from white surface points and its path; none and 0 where the range is NaN."""
    if any(emitter_m):
        leg = ray * range_m[..., None] - np.asarray(emitter_m)
        way = np.linalg.norm(leg, axis=-1)
        cosine = -(leg @ facing) / way
    else:
        way, cosine = range_m, -(ray @ facing)
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.nan_to_num(np.maximum(cosine, 0.0) / way**2, nan=0.0, posinf=0.0)
    return strength, np.nan_to_num(range_m + way)


def _turn(path_m: F64, freq_hz: float) -> C128:
    return np.asarray(np.exp(1j * path_to_phase(path_m, freq_hz)))


def _add(moments: F64, strength: F64, path_m: F64) -> None:
    moments[0] += strength
    moments[1] += strength * path_m
    moments[2] += strength * path_m**2


def _sum(moments: F64, freq_hz: float) -> C128:
    """Complex sum over surfaces from the moments of their paths."""
    turn = path_to_phase(1.0, freq_hz)  # rad per metre
    total = np.zeros(moments.shape[2:], np.complex128)
    for strength, first, second in moments:
        some = np.where(strength > 0, strength, 1.0)
        mean = first / some
        variance = np.maximum(second / some - mean**2, 0.0)
        total += strength * np.exp(1j * turn * mean - turn**2 * variance / 2)
    return total
