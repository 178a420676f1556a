"""Multipath interference compensation of Fuchs, between all pixels: the reference of `fuchs2010`.

Model, inputs and failures are those of `fuchs2010`; every pixel lights every other. Reference:
S. Fuchs, "Multipath interference compensation in time-of-flight camera images", ICPR 2010,
3583-3586. Ours: `bounces`, a model that ends after so many, to see how many a scene needs
(`_bounced`). Time grows with the square of the pixels: 320 x 240 at two frequencies are 12 thousand
million pairs, 4 s an iteration on two cores; memory does not.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from toftools._transfer import gather
from toftools.correct import refuse_emitter_offset, warm_up
from toftools.correct._interreflection import Recipe, freed
from toftools.correct._scene import Optics, Surface, optics, patches, radiosity
from toftools.correct._wraps import plan
from toftools.registry import CORRECTIONS, find
from toftools.types import C64, DepthMap, Phasors, Sensor


def fuchs2010_all_pairs(
    sensor: Sensor,
    *,
    iterations: int = 3,
    albedo_gain: float = 1.0,
    max_range_m: float = 0.0,
    start: str = "semi_global",
    bounces: int = 0,
) -> Callable[[Phasors], DepthMap]:
    """Range without diffuse interreflection, all pixels lighting all pixels.

    Parameters
    ----------
    sensor : Sensor
        As for `fuchs2010`.
    iterations, albedo_gain, max_range_m, start
        As for `fuchs2010`.
    bounces : int
        Bounces that are modelled, to learn how many a scene needs; 0 models all, which costs one
        product of all pairs where n bounces cost n + 1. The first iteration takes all.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap`` as `fuchs2010` gives it.

    Raises
    ------
    ValueError
        If a parameter is out of range or the emitter is not at the camera.

    References
    ----------
    S. Fuchs, "Multipath interference compensation in time-of-flight camera images", ICPR 2010.
    """
    refuse_emitter_offset(sensor)
    name = "fuchs2010_all_pairs"
    if bounces < 0:
        msg = f"bounces must be 1 or more, or 0 for all, got {bounces}"
        raise ValueError(msg)
    recipe = checked(sensor, all_pairs, iterations, albedo_gain, max_range_m, name, start=start)
    recipe = replace(recipe, bounces=int(bounces))
    own = optics(sensor)

    def run(phasors: Phasors) -> DepthMap:
        shape = phasors.valid.shape
        return freed(
            phasors, own if shape == sensor.camera.shape else optics(sensor, shape), recipe
        )

    warm_up(run, sensor.modulation.n_freqs)
    return run


def checked(
    sensor: Sensor,
    irradiance: Callable[[Optics, Surface, C64], C64],
    iterations: int,
    albedo_gain: float,
    max_range_m: float,
    method: str,
    stride_px: int = 1,
    start: str = "",
) -> Recipe:
    """A recipe from the parameters of a method, refused if one is out of range."""
    if iterations < 1:
        msg = f"iterations must be 1 or more, got {iterations}"
        raise ValueError(msg)
    if not (np.isfinite(albedo_gain) and albedo_gain >= 0):
        msg = f"albedo_gain must be positive, or 0 to fit it, got {albedo_gain}"
        raise ValueError(msg)
    walk = plan(sensor, max_range_m, least_freqs=1, method=method)
    several = sensor.modulation.n_freqs > 1
    run = None
    if start and several:
        run = find(CORRECTIONS, start).build(sensor, max_range_m=max_range_m)
    return Recipe(walk, irradiance, int(iterations), float(albedo_gain), stride_px, run)


def all_pairs(view: Optics, seen: Surface, values: C64) -> C64:
    """Irradiance phasors on all pixels from all pixels.

    Parameters
    ----------
    view, seen
        Camera and surface.
    values : ndarray, (F, H, W)
        Measured phasors.

    Returns
    -------
    ndarray, (F, H, W), complex64
        Zero where no surface is known.
    """
    range_m = np.sqrt(np.sum(seen.position * seen.position, axis=0))
    light = radiosity(view, values[:, seen.flat], range_m[seen.flat])
    arrived = np.zeros_like(values)
    arrived[:, seen.known] = gather(
        patches(seen, seen.known), patches(seen, seen.flat), light, view.freqs_hz
    )
    return arrived
