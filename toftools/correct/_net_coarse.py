"""One bounce of light between patches of the visible scene: the physics a network starts from.

On a grid of about `COLUMNS` columns, each cell one patch: irradiance by the others' light
(`_transfer`, model of S. Fuchs, ICPR 2010), as a phasor relative to that of the direct light,

    rho_f = E_f exp(-j 2 pi f r / c) / (S beam cos / r^2),

the shift of range that it would cause alone, ``arg(1 + rho_f) / k_f``, normals and distances. Since
amplitudes have no unit here, albedos are those of a frame whose median is `MIDDLE_ALBEDO`. Cost:
300 patches, a tenth of a million pairs. Fails where light comes from out of view; a network that
has seen the whole room in training makes up for that.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toftools._transfer import gather
from toftools.camera import resized
from toftools.correct import kernel_input
from toftools.correct._scene import Optics, Surface, lit, optics, patches, surface
from toftools.types import C64, F32, F64, Bool, Sensor
from toftools.units import path_to_phase, range_to_phase

COLUMNS = 20
MIDDLE_ALBEDO = 0.5
"""Albedo of the frame's middle, since amplitudes have no unit."""
COARSE = 5
"""Channels besides two per frequency: normal (3), range, share of the cell that is known."""
STEP = 4
"""Pixels of the image per pixel of the output."""
MOST = 8.0
"""Shifts and residuals count as no larger, in units of `SHIFT_M`."""
RANGE_M, SHIFT_M = 4.0, 0.1
"""Units of range and of corrections, m."""
LEAST_KNOWN = 0.25
"""Share of a cell's samples that must have a signal."""
I64 = NDArray[np.int64]
SAMPLES = 4
"""Rows and columns of pixels that a cell looks at."""


@dataclass(frozen=True, eq=False)
class Coarse:
    """The view on few pixels.

    Parameters
    ----------
    optics : Optics
        Rays, solid angles; the flash is relative to its brightest.
    k : ndarray, (F,)
        Phase per range, rad/m.
    rows, columns : ndarray, (cells, SAMPLES)
        Rows and columns of the image that a row or column of cells looks at.
    """

    optics: Optics
    k: F64
    rows: I64
    columns: I64


def coarse_optics(sensor: Sensor) -> Coarse:
    """The view on few pixels.

    Parameters
    ----------
    sensor : Sensor
        Camera, light and frequencies.

    Returns
    -------
    Coarse
        The coarse view.
    """
    height, width = sensor.camera.shape
    rows, columns = grid(sensor.camera.shape, COLUMNS)
    small = optics(replace(sensor, camera=resized(sensor.camera, columns, rows), maps=None))
    flash = kernel_input(small.flash / max(float(small.flash.max()), 1e-30))
    return Coarse(
        replace(small, flash=flash), range_to_phase(1.0, small.freqs_hz),
        _samples(height, rows), _samples(width, columns),
    )  # fmt: skip


def grid(shape: tuple[int, int], most: int) -> tuple[int, int]:
    """Rows and columns of a grid of about square cells.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the image.
    most : int
        Largest number of columns.

    Returns
    -------
    tuple of int
        Rows and columns, each at most one per pixel.

    Examples
    --------
    >>> grid((240, 320), 20), grid((4, 3), 20)
    ((15, 20), (4, 3))
    """
    height, width = shape
    columns = min(most, width)
    return max(min(round(columns * height / width), height, 4 * most), 1), columns


def _samples(pixels: int, cells: int) -> I64:
    middles = (np.arange(cells * SAMPLES) + 0.5) * pixels / (cells * SAMPLES)
    return np.minimum(middles.astype(np.int64), pixels - 1).reshape(cells, SAMPLES)


def coarse_light(range_m: F32, reflectance: F32, lit_px: Bool, view: Coarse, metre: float) -> F32:
    """Channels of patches.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Likeliest range, m.
    reflectance : ndarray, (H, W)
        Logarithm of reflectance relative to the frame's median.
    lit_px : ndarray, (H, W), bool
        Pixels with a signal.
    view : Coarse
        Of the camera.
    metre : float
        Ratio of the frequencies to those trained.

    Returns
    -------
    ndarray, (D, H / 4, W / 4), float32
        Normal, range, share known; then real part of rho and shift of range of each frequency.
    """
    pick = np.ix_(view.rows.ravel(), view.columns.ravel())
    share = _cells(lit_px[pick].astype(np.float32), view).mean(axis=-1)
    known = share >= LEAST_KNOWN
    some = np.where(lit_px[pick], range_m[pick], np.float32(np.inf))
    middle = np.where(known, _median(_cells(some, view), share), np.float32(np.nan))
    seen = surface(view.optics, middle)
    albedo = MIDDLE_ALBEDO * np.exp(_cells(reflectance[pick], view).mean(axis=-1))
    rho = _relative_light(middle, albedo, known & seen.flat, seen, view)
    k = view.k[:, None, None]
    shift = np.angle(1 + rho) / k * (metre / SHIFT_M)
    range_out = np.where(known, middle, 0) * (metre / RANGE_M)
    planes = [*seen.normal, range_out, share]
    for f in range(k.size):
        planes += [np.minimum(rho[f].real, MOST), np.clip(shift[f], -MOST, MOST)]
    stacked = np.stack(planes, axis=-1).astype(np.float32)
    height, width = range_m.shape
    wide = cv2.resize(stacked, (-(-width // STEP), -(-height // STEP)), interpolation=1)
    return np.ascontiguousarray(np.moveaxis(wide.reshape(*wide.shape[:2], -1), -1, 0))


def _median(samples: F32, share: F32) -> F32:
    """Median of the finite samples of every cell; anything where there are none."""
    count = np.rint(share * samples.shape[-1]).astype(np.int64)[..., None]
    in_order = np.sort(samples, axis=-1)
    low = np.take_along_axis(in_order, np.maximum(count - 1, 0) // 2, axis=-1)
    high = np.take_along_axis(in_order, np.minimum(count // 2, samples.shape[-1] - 1), axis=-1)
    return np.asarray((low + high)[..., 0] / 2, np.float32)


def _relative_light(range_m: F32, albedo: F32, emits: Bool, seen: Surface, view: Coarse) -> C64:
    """Indirect phasor over direct one, (F, rows, columns); zero where nothing is known."""
    freqs = view.optics.freqs_hz
    turn = np.exp(1j * path_to_phase(np.where(seen.known, range_m, 0), freqs[:, None, None]))
    flash = view.optics.flash[0] / np.maximum(np.where(seen.known, range_m, 1), 1e-3) ** 2
    leaves = (albedo * flash * turn).astype(np.complex64)
    arrived = np.zeros_like(leaves)
    arrived[:, seen.known] = gather(
        patches(seen, seen.known), patches(seen, emits), leaves[:, emits], freqs
    )
    direct = lit(view.optics, seen)[0]
    rho = arrived * turn.conj() / np.maximum(direct, np.float32(1e-6))
    return np.where(seen.known, rho, 0).astype(np.complex64)


def _cells(sampled: F32, view: Coarse) -> F32:
    """Samples of every cell, (rows, columns, SAMPLES^2)."""
    rows, columns = view.rows.shape[0], view.columns.shape[0]
    parts = sampled.reshape(rows, SAMPLES, columns, SAMPLES)
    return parts.transpose(0, 2, 1, 3).reshape(rows, columns, SAMPLES * SAMPLES)
