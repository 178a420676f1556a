"""Points inside pixels, and the direct light that a pixel gathers over its area without noise.

With one point a pixel looks through its centre. With n x n it averages a grid over its area, and
where those points disagree (at an edge, a shadow, a texture) a grid four times as fine.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from toftools.camera import rays_at
from toftools.sim._phasors import Light, direct_light, indirect_light
from toftools.sim._task import Jit, Task, first_hits
from toftools.types import F64, Camera

MAX_LANES = 1 << 20
"""Lanes of one kernel call: bounds the memory of structures and sums."""
FINER = 4
UNLIKE = 0.02
"""Spread of the direct light inside a pixel, against its mean, from which a finer grid is used."""


def views(camera: Camera, pixels: Any, side: int) -> F64:  # noqa: ANN401 - ints
    """Viewing directions of a grid of points inside pixels.

    Parameters
    ----------
    camera : Camera
        Camera, distortion respected.
    pixels : ndarray of int, (M,)
        Pixels by number, row by row.
    side : int
        Points along each side of a pixel.

    Returns
    -------
    ndarray, (M, side * side, 3)
        Unit vectors in the camera frame.
    """
    row, column = (part[:, None].astype(np.float64) for part in np.divmod(pixels, camera.width))
    steps = (np.arange(side) + 0.5) / side - 0.5
    down, right = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    return rays_at(camera, column + right, row + down)


def in_parts(
    camera: Camera,
    pixels: Any,  # noqa: ANN401
    side: int,
    lights: Callable[[F64, int], list[Light]],
) -> list[Light]:
    """Light of pixels, a bounded number of lanes at a time.

    Parameters
    ----------
    camera : Camera
        Camera.
    pixels : ndarray of int, (M,)
        Pixels by number.
    side : int
        Points along each side of a pixel.
    lights : callable
        Directions (N * side * side, 3), and the place of the first of these pixels in the list,
        to the light of N pixels, as many times over as there are estimates of it.

    Returns
    -------
    list of Light
        Every estimate, of all pixels.
    """
    step = max(1, MAX_LANES // side**2)
    done = [
        lights(views(camera, pixels[start : start + step], side).reshape(-1, 3), start)
        for start in range(0, len(pixels), step)
    ]
    names = ("direct", "one_bounce", "rest", "ambient")
    return [
        Light(*(np.concatenate([getattr(x, n) for x in parts], axis=-1) for n in names))
        for parts in zip(*done, strict=True)
    ]


def averaged(light: Light, inside: int) -> Light:
    """Mean over the points inside every pixel.

    Parameters
    ----------
    light : Light
        Of points, those of a pixel in a row.
    inside : int
        Points per pixel.

    Returns
    -------
    Light
        Of pixels.
    """
    parts = (light.direct, light.one_bounce, light.rest, light.ambient)
    return Light(*(p.reshape(*p.shape[:-1], -1, inside).mean(axis=-1) for p in parts))


def direct_of_pixels(task: Task, camera: Camera, pixels: Any, side: int, freqs_hz: F64) -> Light:  # noqa: ANN401
    """Direct light of pixels, over their area if `side` is more than one.

    Parameters
    ----------
    task : Task
        Scene and sources.
    camera : Camera
        Camera.
    pixels : ndarray of int, (M,)
        Pixels by number.
    side : int
        Points along each side of a pixel.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.

    Returns
    -------
    Light
        Direct light and what the camera sees of lamps.
    """
    unlike = np.zeros(len(pixels), bool)

    def light(directions: F64, start: int) -> list[Light]:
        points = direct_light(task, first_hits(task, directions), freqs_hz)
        mean = averaged(points, side**2)
        spread = np.abs(points.direct.reshape(len(freqs_hz), -1, side**2) - mean.direct[..., None])
        limit = UNLIKE * np.abs(mean.direct)
        unlike[start : start + mean.direct.shape[1]] = (spread.max(axis=-1) > limit).any(axis=0)
        return [mean]

    [coarse] = in_parts(camera, pixels, side, light)
    if side == 1 or not unlike.any():
        return coarse

    def fine_light(directions: F64, _start: int) -> list[Light]:
        points = direct_light(task, first_hits(task, directions), freqs_hz)
        return [averaged(points, (FINER * side) ** 2)]

    [fine] = in_parts(camera, pixels[unlike], FINER * side, fine_light)
    for name in ("direct", "ambient"):
        getattr(coarse, name)[..., unlike] = getattr(fine, name)
    return coarse


def own_light(
    task: Task,
    first: Jit,
    freqs_hz: F64,
    *,
    inside: int = 1,
    bounces: int,
    samples: int,
    seed: int,
) -> Light:
    """Indirect light of pixels with several points, every path for its own point alone.

    Parameters
    ----------
    task, first, freqs_hz, inside, bounces, samples, seed
        As `indirect_light` takes them, but samples per pixel: a multiple of `inside`, the number of
        points of a pixel, which lie in a row.

    Returns
    -------
    Light
        Mean per pixel.
    """
    each = max(1, samples // inside)
    light = indirect_light(task, first, freqs_hz, bounces=bounces, samples=each, seed=seed)
    return averaged(light, inside)
