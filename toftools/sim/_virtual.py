"""Virtual lights: points on diffuse surfaces, each with the area it stands for and its light.

A virtual light at y of area A and radiance phasor L (as it leaves, per frequency) adds

    rho(x) / pi  L(y) A cos_x cos_y / r^2 V(x, y) exp(j 2 pi f r / c)

to the radiance of a diffuse x, r = |x - y|: eq. (6), (7) and (15) of the seed "Transient instant
radiosity" (2019) in the frequency domain, where the delta in time becomes a phase. There the light
of a virtual light comes along one path; here its direct part is known without chance, and later
bounces are solved for (`_cache`), since lights that walk make all pixels wrong together.
"""

from dataclasses import dataclass

import numpy as np

from toftools.sim._flash import flash_light
from toftools.sim._phasors import C128, turned
from toftools.sim._task import Jit, Task
from toftools.sim._viewpoints import Viewpoint, counts, density, shoot
from toftools.types import F64


@dataclass(frozen=True, eq=False)
class Channels:
    """What is summed up: phasors at frequencies, and light without modulation.

    Parameters
    ----------
    freqs_hz : ndarray, (C,)
        Frequency of each channel, Hz.
    modulated : tuple of bool
        Whether a channel takes modulated sources, or the others.
    """

    freqs_hz: F64
    modulated: tuple[bool, ...]


def channels_of(task: Task, freqs_hz: F64) -> Channels:
    """Channels for a scene: one more where a source of the camera is not modulated.

    Parameters
    ----------
    task : Task
        Sources.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.

    Returns
    -------
    Channels
        The Q frequencies first.
    """
    plain = any(not flash.modulated for flash in task.flashes)
    return Channels(np.append(freqs_hz, [0.0] * plain), (True,) * len(freqs_hz) + (False,) * plain)


@dataclass(frozen=True, eq=False)
class Virtual:
    """Virtual lights.

    Parameters
    ----------
    at : list of SurfaceInteraction3f
        Points, viewpoint by viewpoint.
    p, n : Point3f, Normal3f
        Place in scene units, and normal.
    area_m2 : ndarray, (M,)
        Area that each stands for, m^2.
    albedo : ndarray, (M,)
        Diffuse albedo.
    direct : ndarray, (C, M), complex128
        Radiance by the camera's sources alone.
    total : int
        Directions drawn, of which these points came.
    """

    at: list[Jit]
    p: Jit
    n: Jit
    area_m2: F64
    albedo: F64
    direct: C128
    total: int


def virtual_lights(
    task: Task, views: tuple[Viewpoint, ...], total: int, channels: Channels, seed: int
) -> Virtual:
    """Put virtual lights on surfaces and light them directly.

    Parameters
    ----------
    task : Task
        Scene and sources.
    views : tuple of Viewpoint
        From where surfaces are sampled.
    total : int
        Directions.
    channels : Channels
        What is summed up.
    seed : int
        Of the sequences.

    Returns
    -------
    Virtual
        Lights; none where nothing diffuse is hit.
    """
    import drjit as dr

    mi = task.mi
    parts = [
        shoot(task, view, number, seed * 0x10001 + 0x3D4D51CB * i)
        for i, (view, number) in enumerate(zip(views, counts(views, total), strict=True))
    ]
    parts = [part for part in parts if dr.width(part[0].t)]
    if not parts:
        none = np.zeros(0)
        blank = np.zeros((len(channels.freqs_hz), 0), np.complex128)
        return Virtual([], mi.Point3f(), mi.Normal3f(), none, none, blank, total)
    p = mi.Point3f(np.concatenate([np.asarray(si.p.numpy()).reshape(3, -1) for si, _ in parts], 1))
    n = mi.Normal3f(np.concatenate([np.asarray(n.numpy()).reshape(3, -1) for _, n in parts], 1))
    dense = np.asarray(density(task, views, total, p, n, mi.Bool(True)).numpy(), np.float64)
    area = np.divide(1.0, dense, out=np.zeros_like(dense), where=dense > 0)
    at = [si for si, _ in parts]
    return Virtual(
        at=at,
        p=p,
        n=n,
        area_m2=area,
        albedo=np.concatenate([albedo_of(si) for si in at]),
        direct=np.concatenate([direct_of(task, si, channels) for si in at], axis=1),
        total=total,
    )


def albedo_of(si: Jit) -> F64:
    """Diffuse albedo of surface points.

    Parameters
    ----------
    si : SurfaceInteraction3f
        Points.

    Returns
    -------
    ndarray, (N,)
        Albedo.
    """
    value = si.bsdf().eval_diffuse_reflectance(si, si.is_valid())[0]
    return np.asarray(np.broadcast_to(value.numpy(), np.shape(si.t.numpy())), np.float64)


def direct_of(task: Task, si: Jit, channels: Channels) -> C128:
    """Radiance of diffuse points by the camera's sources.

    Parameters
    ----------
    task : Task
        Sources.
    si : SurfaceInteraction3f
        Points.
    channels : Channels
        What is summed up.

    Returns
    -------
    ndarray, (C, N), complex128
        Radiance phasors as they leave the points.
    """
    light = np.zeros((len(channels.freqs_hz), np.size(si.t.numpy())), np.complex128)
    for flash in task.flashes:
        mine = np.flatnonzero(np.array(channels.modulated) == flash.modulated)
        value, far_m = flash_light(task.mi, task.stage, flash, si, si.is_valid())
        values, ways_m = (np.asarray(x.numpy(), np.float64) for x in (value, far_m))
        light[mine] += turned(values, ways_m, channels.freqs_hz[mine])
    return light
