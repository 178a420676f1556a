"""Rays that met surfaces which are not diffuse, scattered on to the first diffuse one.

So do rays that pass through holes and veils; what they meet is still the first surface.
"""

from toftools.sim._flash import flash_light
from toftools.sim._phasors import cycles_per_m, turn
from toftools.sim._second import scatters_alike
from toftools.sim._sobol import hashed, pair, single
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._virtual import Channels

LONGEST = 32
"""Surfaces in a row that are not diffuse."""


def direct_along(
    task: Task, si: Jit, active: Jit, weight: Jit, path_m: Jit, channels: Channels, ior: Jit = 1.0
) -> list[tuple[Jit, Jit]]:
    """Direct light of surfaces, turned by the way to the viewer.

    Parameters
    ----------
    task : Task
        Scene and sources.
    si : SurfaceInteraction3f
        Surfaces.
    active : Bool
        Which of them count.
    weight : Float
        Factor of their light.
    path_m : Float
        Optical way to the viewer, m.
    channels : Channels
        What is summed up.
    ior : Float
        Refractive index on the viewer's side.

    Returns
    -------
    list of tuple of Float
        Real and imaginary part of each channel.
    """
    mi = task.mi
    sums = [(mi.Float(0), mi.Float(0)) for _ in channels.modulated]
    cycles = cycles_per_m(channels.freqs_hz)
    for flash in task.flashes:
        value, far_m = flash_light(mi, task.stage, flash, si, active & (weight > 0), ior=ior)
        light = value * weight
        for i, (cycle, modulated) in enumerate(zip(cycles, channels.modulated, strict=True)):
            if modulated == flash.modulated:
                turns = (*turn(mi, cycle, path_m + far_m), mi.Float(0))
                sums[i] = (sums[i][0] + light * turns[0], sums[i][1] + light * turns[1])
    return sums


def followed(
    task: Task, begin: tuple[Jit, ...], draw: tuple[Jit, Jit], channels: Channels
) -> tuple[Jit, ...]:
    """Scatter rays on until they meet a diffuse surface.

    Parameters
    ----------
    task : Task
        Scene and sources.
    begin : tuple of SurfaceInteraction3f, Float, Float, Float
        Surfaces that are met, weight of the rays, their way so far, m, and refractive index.
    draw : tuple of UInt32
        Numbers of the rays, and roots of their random numbers.
    channels : Channels
        What is summed up.

    Returns
    -------
    list of tuple of Float
        Direct light of surfaces met by way of nothing but holes, as in `direct_along`.
    list of tuple of Float
        Direct light of all others.
    SurfaceInteraction3f, Float, Float
        Last surface, weight there (0 if none is diffuse), and optical way to it, m.
    """
    import drjit as dr

    mi, (number, key) = task.mi, draw

    def body(active: Jit, step: Jit, at: Jit, state: Jit, sums: Jit) -> tuple[Jit, ...]:
        (weight, length_m, ior, straight), (one, rest) = state, sums
        seed = hashed(mi, key + hashed(mi, 4 * step + 0x1001))
        lobe, square = single(mi, number, seed), pair(mi, number, seed, mi.UInt32(1))
        sample, value = at.bsdf().sample(mi.BSDFContext(), at, lobe, square, active)
        ior = dr.select(active, ior * sample.eta, ior)
        nearby = next_hit(task, at, at.to_world(sample.wo), active & (value[0] > 0))
        hit = active & (value[0] > 0) & nearby.is_valid()
        weight = dr.select(active, dr.select(hit, weight * value[0], 0.0), weight)
        far_m = nearby.t * task.stage.unit_m
        length_m = length_m + dr.select(hit, ior * far_m, 0.0)
        light = direct_along(task, nearby, hit, weight, length_m, channels, ior)
        straight &= mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        one, rest = (
            [(a + dr.select(mine, c, 0.0), b + dr.select(mine, d, 0.0))
             for (a, b), (c, d) in zip(part, light, strict=True)]
            for part, mine in ((one, straight), (rest, ~straight))
        )  # fmt: skip
        ended = hit & scatters_alike(mi, nearby)
        at = dr.select(hit, nearby, at)
        state = (weight, length_m, ior, straight)
        return hit & ~ended & (step < LONGEST), step + 1, at, state, (one, rest)

    at, weight, length_m, ior = begin
    lanes = dr.width(at.t)
    zeros = [(dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)) for _ in channels.modulated]
    state = (weight, length_m, ior + dr.zeros(mi.Float, lanes), weight > 0)
    start = (weight > 0, dr.zeros(mi.UInt32, lanes), at, state, (zeros, zeros))
    _, step, end, (weight, length_m, *_), (one, rest) = dr.while_loop(
        start, lambda active, *_: active, body
    )
    # Who was given up after the most surfaces brings nothing more.
    return one, rest, end, dr.select(step > LONGEST, 0.0, weight), length_m
