"""Phasor path tracing in one kernel: all frequencies and harmonics of every path, no time bins.

Paths start at the first surface that a pixel sees, which is found once. At every further surface
the camera's point sources are connected without chance; lamps of the scene are sampled (with
multiple importance sampling). One lane of the kernel serves one pixel and starts a new path as soon
as one ends, so that lanes stay busy and nothing is stored per path. There is no Russian roulette:
a path ends after the last bounce asked for, in the open, or in black.

References
----------
E. Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, chapter 9 (the balance
between sampling lamps and materials). Fails for light that reaches a surface by way of a mirror or
of clear glass from a point source: no path finds it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from toftools.sim._flash import flash_light
from toftools.sim._holes import MAX_PASSED
from toftools.sim._lamps import lamps_at, lamps_hit
from toftools.sim._sobol import hashed, pair, single
from toftools.sim._task import Jit, Task, next_hit

Deposit = Callable[[Jit, Jit, Jit, Jit, Jit, Jit], Jit]
"""(sums, lane, path number, bounce, radiance, path in m) -> sums with one contribution more."""


@dataclass
class Path:
    """Where a path stands; a structure that Dr.Jit can loop over.

    Parameters
    ----------
    si : SurfaceInteraction3f
        Its surface.
    throughput : Float
        Radiance at the pixel per radiance here.
    length_m : Float
        Optical path to the pixel, m.
    ior : Float
        Refractive index of the medium that it stands in.
    bounce : UInt32
        Indirect bounces so far.
    """

    si: Jit
    throughput: Jit
    length_m: Jit
    ior: Jit
    bounce: Jit


@dataclass(frozen=True, eq=False)
class Draw:
    """Random numbers of one step of one path.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    number, key, step : UInt32
        Number of the path, root of its lane's sequences, and step of the path.
    """

    mi: Any
    number: Jit
    key: Jit
    step: Jit

    def lobe(self) -> Jit:
        """Number that chooses among what a material can do."""
        return single(self.mi, self.number, self._seed(1, self.step))

    def direction(self) -> Jit:
        """Direction; those of two steps in a row are one point of four dimensions."""
        return pair(self.mi, self.number, self._seed(2, self.step >> 1), self.step & 1)

    def lamp(self) -> tuple[Jit, Jit]:
        """Place on a lamp, and number that chooses the lamp."""
        mi, seed = self.mi, self._seed(3, self.step)
        return pair(mi, self.number, seed, mi.UInt32(0)), single(mi, self.number, seed ^ 0x55)

    def _seed(self, use: int, step: Jit) -> Jit:
        return hashed(self.mi, self.key + hashed(self.mi, 4 * step + use))


def trace(
    task: Task,
    first: Jit,
    *,
    bounces: int,
    samples: int,
    seed: int,
    sums: Jit,
    deposit: Deposit,
) -> tuple[Jit, Jit]:
    """Indirect light of the camera's sources, and all light of the scene's lamps, of every lane.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane, out of `first_hits`.
    bounces : int
        Indirect bounces to follow.
    samples : int
        Paths per lane; powers of two are stratified best.
    seed : int
        Of the sequences; other seeds give independent estimates.
    sums : pytree
        What `deposit` adds to, per lane.
    deposit : callable
        Takes up one contribution of modulated light.

    Returns
    -------
    pytree, Float
        The sums over all paths (not their mean), and the sum of the unmodulated radiance.
    """
    import drjit as dr

    mi, lanes = task.mi, dr.width(first.t)
    lane = dr.arange(mi.UInt32, lanes)
    start = Path(first, mi.Float(1), first.t * task.stage.unit_m, mi.Float(1), mi.UInt32(0))
    draw = Draw(mi, mi.UInt32(0), lane_keys(mi, lane, seed), mi.UInt32(0))
    total = (sums, dr.zeros(mi.Float, lanes))
    return walk(task, lane, start, draw, (bounces, samples), total, deposit)


def lane_keys(mi: Any, lane: Jit, seed: int) -> Jit:  # noqa: ANN401 - the module mitsuba
    """Root of every lane's random numbers.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    lane : UInt32
        Lanes.
    seed : int
        Seed of the whole pass.

    Returns
    -------
    UInt32
        Hashes.
    """
    import drjit as dr

    # Opaque: another seed must not mean another kernel.
    return hashed(mi, lane ^ hashed(mi, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)))


def walk(
    task: Task,
    lane: Jit,
    start: Path,
    draw: Draw,
    counts: tuple[int, int],
    total: tuple[Jit, Jit],
    deposit: Deposit,
) -> tuple[Jit, Jit]:
    """Follow paths from where they stand.

    Parameters
    ----------
    task : Task
        Scene and sources.
    lane : UInt32
        Number of each lane, for `deposit`.
    start : Path
        Where every path of a lane begins.
    draw : Draw
        Number of the first path, and of its first step.
    counts : tuple of int
        Last bounce, and paths per lane.
    total : tuple of pytree and Float
        What has been collected, and the unmodulated radiance.
    deposit : callable
        Takes up one contribution of modulated light.

    Returns
    -------
    pytree, Float
        Both with the paths' light added.
    """
    import drjit as dr

    mi = task.mi
    limit, paths = (dr.opaque(mi.UInt32, count) for count in counts)
    last = draw.number + paths
    # Lamps shine on the last surface as well, and holes in it lead on without a bounce.
    more = int(task.chance_direct)

    def body(active: Jit, number: Jit, step: Jit, path: Path, total: Jit) -> tuple[Jit, ...]:
        now = Draw(mi, number, draw.key, step)
        path, alive, total = _bounce(task, (lane, number), active, path, now, limit, total, deposit)
        alive &= path.bounce < limit + more
        alive &= step < 2 * limit + MAX_PASSED  # rays that pass holes do not bounce
        number = dr.select(alive, number, number + 1)
        step = dr.select(alive, step + 1, draw.step)
        return active & (number < last), number, step, dr.select(alive, path, start), total

    begin = start.si.is_valid() & (start.bounce < limit + more)
    state = (begin, draw.number, draw.step, start, total)
    return dr.while_loop(state, lambda active, *_: active, body)[-1]


def _bounce(
    task: Task,
    who: tuple[Jit, Jit],
    active: Jit,
    path: Path,
    draw: Draw,
    limit: Jit,
    total: tuple[Jit, Jit],
    deposit: Deposit,
) -> tuple[Path, Jit, tuple[Jit, Jit]]:
    """One step: lamps at this surface, a new direction, the next surface and the sources there."""
    import drjit as dr

    mi, stage, (sums, ambient), si = task.mi, task.stage, total, path.si
    if task.lamps:
        light = lamps_at(mi, stage, si, *draw.lamp(), path.ior, active)
        length_m = path.length_m + light.far_m
        sums = deposit(sums, *who, path.bounce, path.throughput * light.modulated, length_m)
        ambient = ambient + path.throughput * light.ambient
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, draw.lobe(), draw.direction(), active)
    throughput = path.throughput * weight[0]
    ior = path.ior * sample.eta
    active = active & (throughput > 0)
    nearby = next_hit(task, si, si.to_world(sample.wo), active)
    hit = active & nearby.is_valid()
    if task.lamps:
        light = lamps_hit(mi, stage, si, nearby, sample, ior, active)
        length_m = path.length_m + light.far_m
        sums = deposit(sums, *who, path.bounce, throughput * light.modulated, length_m)
        ambient = ambient + throughput * light.ambient
    passed = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    new = Path(
        nearby,
        throughput,
        path.length_m + dr.select(hit, ior * nearby.t * stage.unit_m, 0.0),
        ior,
        path.bounce + dr.select(passed, mi.UInt32(0), mi.UInt32(1)),
    )
    for flash in task.flashes:
        lit = hit & (new.bounce <= limit)
        value, far_m = flash_light(mi, stage, flash, nearby, lit, ior=ior)
        if flash.modulated:
            sums = deposit(sums, *who, new.bounce, throughput * value, new.length_m + far_m)
        else:
            ambient = ambient + throughput * value
    return new, hit, (sums, ambient)
