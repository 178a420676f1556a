"""What light transport needs of a frame: places, normals, areas, and how the flash lights them.

Places and normals come from planes through small windows (`_planes`). Light from the camera's
flash on a patch is ``E = S beam cos / range^2`` in the unit of the phasors, S = contrast *
signal_e (`Noise`), so that a patch of albedo a sends the camera a phasor of amplitude a E.
Inputs: a sensor, a range image. Fails where objects are smaller than a window.
"""

from dataclasses import dataclass

import numpy as np

from toftools._transfer import Patches
from toftools.camera import rays, resized
from toftools.correct import kernel_input
from toftools.correct._planes import choose, fit
from toftools.types import C64, F32, F64, Bool, Sensor
from toftools.units import path_to_phase

LEAST_FORWARD = 0.05
"""Cosine of the widest ray off the axis for which x / z still makes sense."""


@dataclass(frozen=True, eq=False)
class Optics:
    """What does not change from frame to frame.

    Parameters
    ----------
    rays : ndarray, (3, H, W)
        Unit viewing directions, float32; zero where no ray belongs to a pixel.
    steps : ndarray, (4, H, W)
        Columns and rows per unit of x / z, columns and rows per unit of y / z, float32.
    solid_angle_sr : ndarray, (H, W)
        Solid angle of each pixel, sr, float32.
    flash : ndarray, (F, H, W)
        Phasor amplitude of a white surface facing the camera at 1 m, float32.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    """

    rays: F32
    steps: F32
    solid_angle_sr: F32
    flash: F32
    freqs_hz: F64


@dataclass(frozen=True, eq=False)
class Surface:
    """Surface elements seen by the pixels.

    Parameters
    ----------
    position, normal : ndarray, (3, H, W)
        Place, m, and unit normal towards the camera, float32.
    cosine : ndarray, (H, W)
        Between normal and the way to the camera, at least `LEAST_COS`.
    area_m2 : ndarray, (H, W)
        Area seen by the pixel, m^2.
    known : ndarray, (H, W), bool
        False without a range.
    flat : ndarray, (H, W), bool
        False at edges too, whose normal is not to be trusted: they emit nothing.
    """

    position: F32
    normal: F32
    cosine: F32
    area_m2: F32
    known: Bool
    flat: Bool


def optics(sensor: Sensor, shape: tuple[int, int] | None = None) -> Optics:
    """Rays, solid angles and flash of a sensor.

    Parameters
    ----------
    sensor : Sensor
        Camera, light sources (those that are modulated, all taken to sit at the camera),
        contrast and signal; in DN if the sensor has a conversion gain.
    shape : (int, int) or None
        Height and width of the frame; another than the camera's is the same view on another grid.

    Returns
    -------
    Optics
        For frames of that shape.
    """
    camera = sensor.camera
    if shape is not None and shape != camera.shape:
        camera = resized(camera, shape[1], shape[0])
    way = rays(camera)  # (H, W, 3)
    if (way[..., 2] < LEAST_FORWARD).any():
        aside_deg = np.degrees(np.arccos(np.nanmin(way[..., 2])))
        msg = (
            f"this camera sees {aside_deg:.0f} degrees off its axis, and corrections that fit "
            "planes to z reach 87; crop the image to that, or use a method without a scene model"
        )
        raise ValueError(msg)
    way = np.where(np.isfinite(way).all(axis=-1, keepdims=True), way, 0.0)
    return Optics(
        kernel_input(np.moveaxis(way, -1, 0).astype(np.float32)),
        kernel_input(_steps(camera.K, way).astype(np.float32)),
        kernel_input(_solid_angle_sr(camera.K, way).astype(np.float32)),
        kernel_input(flash_of(sensor, way)),
        sensor.modulation.freqs_hz,
    )


def flash_of(sensor: Sensor, way: F64) -> F32:
    """Light of the flash along viewing directions.

    Parameters
    ----------
    sensor : Sensor
        Light sources (those that are modulated, all taken to sit at the camera), contrast, signal.
    way : ndarray, (H, W, 3)
        Unit viewing directions.

    Returns
    -------
    ndarray, (F, H, W)
        Phasor amplitude of a white surface facing the camera at 1 m, float32.
    """
    noise, n_freqs = sensor.noise, sensor.modulation.n_freqs
    signal = np.broadcast_to(noise.contrast, n_freqs) * noise.signal_e * (noise.gain_dn_per_e or 1)
    angle_deg = np.degrees(np.arccos(np.clip(way[..., 2], -1, 1)))
    beam = np.zeros(way.shape[:2])
    for source in sensor.sources:
        if source.modulated:
            table = np.array([[0.0, 1.0], [180.0, 1.0]]) if source.beam is None else source.beam
            beam += source.strength * np.interp(angle_deg, table[:, 0], table[:, 1], right=0.0)
    return np.asarray(signal[:, None, None] * beam, np.float32)


def _steps(K: F64, way: F64) -> F64:
    """Inverse Jacobian of (x / z, y / z) over columns and rows; (4, H, W)."""
    height, width = way.shape[:2]
    if min(height, width) < 3:
        linear = np.linalg.inv(K[:2, :2])
        jacobian = np.broadcast_to(linear[:, :, None, None], (2, 2, height, width))
    else:
        xy = np.moveaxis(way[..., :2] / np.maximum(way[..., 2:], 1e-3), -1, 0)
        jacobian = np.stack([np.gradient(xy, axis=2), np.gradient(xy, axis=1)], axis=1)
    (xu, xv), (yu, yv) = jacobian
    det = xu * yv - xv * yu
    det = np.where(np.abs(det) > 1e-12, det, np.inf)
    return np.stack([yv, -yu, -xv, xu]) / det


def _solid_angle_sr(K: F64, way: F64) -> F64:
    """Cross product of the steps to the neighbouring rays; of the pinhole where there is none."""
    height, width = way.shape[:2]
    if min(height, width) < 3:
        return np.asarray(way[..., 2] ** 3 / (K[0, 0] * K[1, 1]))
    across = np.cross(np.gradient(way, axis=1), np.gradient(way, axis=0))
    return np.asarray(np.abs(np.sum(across * way, axis=-1)))


def surface(
    view: Optics, range_m: F32, *, noise_m: F32 | float = 0.0, reach_px: int = 1
) -> Surface:
    """Place, normal and area of what every pixel sees.

    Parameters
    ----------
    view : Optics
        Of the camera.
    range_m : ndarray, (H, W)
        Range, m; NaN where unknown.
    noise_m : float or ndarray, (H, W)
        Standard deviation of the range, m: windows that fit equally well within it are equal,
        and the centred one is taken.
    reach_px : int
        Windows are 2 reach + 1 pixels wide.

    Returns
    -------
    Surface
        Float32. Pixels that no window with all pixels known holds face the camera and are not
        flat.
    """
    range_m = np.asarray(range_m, np.float32)
    noise = np.broadcast_to(np.asarray(noise_m, np.float32), range_m.shape)
    shape = range_m.shape
    noise = kernel_input(noise / np.maximum(range_m, np.float32(1e-3)))
    planes = np.empty((4, *shape), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_z = np.where(
            (range_m > 0) & (view.rays[2] > 0), 1 / (range_m * view.rays[2]), np.nan
        )
    fit(kernel_input(inverse_z.astype(np.float32)), noise, reach_px, planes)
    vectors = np.empty((2, 3, *shape), np.float32)
    scalars = np.empty((2, *shape), np.float32)
    masks = np.empty((2, *shape), np.bool_)
    choose(
        view.rays, view.steps, view.solid_angle_sr, kernel_input(range_m), noise, reach_px, planes,
        vectors, scalars, masks,
    )  # fmt: skip
    return Surface(*vectors, *scalars, *masks)


def patches(seen: Surface, where: Bool) -> Patches:
    """Chosen pixels as patches of the transfer kernel.

    Parameters
    ----------
    seen : Surface
        Surface elements.
    where : ndarray, (H, W), bool
        Which; `flat` ones may emit, `known` ones may receive.

    Returns
    -------
    Patches
        N of them, in the order of the image.
    """
    return Patches(seen.position[:, where], seen.normal[:, where], seen.area_m2[where])


def radiosity(view: Optics, values: C64, range_m: F32) -> C64:
    """Phasors as they leave the surface: the way to the camera taken off.

    Parameters
    ----------
    view : Optics
        Of the camera.
    values : ndarray, (F, ...)
        Measured phasors: light of any number of bounces.
    range_m : ndarray, (...)
        Range of each, m.

    Returns
    -------
    ndarray, (F, ...), complex64
        ``m exp(-j 2 pi f range / c)``: radiosity in the unit of the phasors.
    """
    freqs = view.freqs_hz.reshape(-1, *(1,) * np.ndim(range_m))
    turn = np.exp(-1j * path_to_phase(range_m, freqs))
    return np.asarray(values * turn, np.complex64)


def lit(view: Optics, seen: Surface) -> F32:
    """Irradiance of the flash on what every pixel sees, in the unit of the phasors.

    Parameters
    ----------
    view : Optics
        Of the camera.
    seen : Surface
        Surface elements.

    Returns
    -------
    ndarray, (F, H, W), float32
        ``S beam cos / range^2``; albedo is the amplitude of direct light over this.
    """
    squared = np.sum(seen.position * seen.position, axis=0)
    return np.asarray(view.flash * (seen.cosine / np.maximum(squared, 1e-6)), np.float32)
