"""Ratio of indirect to direct light of every pixel, for all bounces or for a stated number.

Out of the measured phasors m, which hold all bounces, all come with one product. In a model of n
bounces the light that has bounced n times goes out no more: what goes out is ``m - T^n d``, d the
direct light as the last iteration found it and ``T x = d h(x)`` one bounce (`_interreflection` says
why the albedo cancels). The first iteration knows no d and takes all bounces. Its use is to say how
many bounces a scene needs: it costs n + 1 products.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange

from toftools._transfer import sincos
from toftools._turns import FAST
from toftools.correct import kernel_input
from toftools.correct._scene import Optics, Surface
from toftools.types import C64, F32
from toftools.units import TWO_PI, path_to_phase


def ratio_of(
    arrived: C64,
    view: Optics,
    seen: Surface,
    flash: F32,
) -> C64:
    """Irradiance phasors, turned by the way to the camera, over those of the flash.

    Parameters
    ----------
    arrived : ndarray, (F, H, W), complex64
        Irradiance phasors.
    view, seen
        Camera and surface.
    flash : ndarray, (F, H, W)
        Amplitude of the flash on the surface.

    Returns
    -------
    ndarray, (F, H, W), complex64
        Indirect over direct light.
    """
    ratio = np.empty_like(arrived)
    turns = np.asarray(path_to_phase(1.0, view.freqs_hz) / TWO_PI, np.float32)
    _to_ratio(_parts(arrived), seen.position, flash, turns, _writable_parts(ratio))
    return ratio


def bounced(
    transport: Callable[[C64], C64], values: C64, before: C64, gain: float, bounces: int
) -> C64:
    """Ratio of indirect to direct light after some bounces.

    Parameters
    ----------
    transport : callable
        Phasors of the light that goes out (F, H, W) to the ratio of what it makes arrive.
    values : ndarray, (F, H, W), complex64
        Measured phasors.
    before : ndarray, (F, H, W), complex64
        Ratio that the last iteration found; zero for none.
    gain : float
        Factor of the ratio.
    bounces : int
        How many are modelled; 0 for all.

    Returns
    -------
    ndarray, (F, H, W), complex64
        The ratio.
    """
    if bounces == 0 or not before.any():
        return transport(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        direct = values / (1 + np.float32(gain) * before)
    last = direct
    for _ in range(bounces):
        last = direct * np.float32(gain) * transport(last)
    return transport(values - last)


def _parts(values: C64) -> F32:
    return kernel_input(values).view(np.float32).reshape(*values.shape, 2)


def _writable_parts(values: C64) -> F32:
    return values.view(np.float32).reshape(*values.shape, 2)


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _to_ratio(arrived: F32, position: F32, flash: F32, turns: F32, ratio: F32) -> None:
    """Irradiance, turned by the way to the camera, over the flash's."""
    for v in prange(arrived.shape[1]):
        for f in range(turns.size):
            for u in range(arrived.shape[2]):
                x, y, z = position[0, v, u], position[1, v, u], position[2, v, u]
                s, c = sincos(-np.sqrt(x * x + y * y + z * z) * turns[f])
                scale = 1 / max(flash[f, v, u], np.float32(1e-9))
                re, im = arrived[f, v, u, 0] * scale, arrived[f, v, u, 1] * scale
                ratio[f, v, u, 0] = re * c - im * s
                ratio[f, v, u, 1] = re * s + im * c
