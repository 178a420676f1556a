"""Paths from the camera that share the light with virtual lights.

R paths per pixel walk from the first surface and connect with a source at every further one, as
in `_tracer`, but with Russian roulette; of light that virtual lights bring too they keep the share
1 - w of `_walks`, which is where the two are near. That replaces the clamping of the seed
"Transient instant radiosity" (2019).
"""

from dataclasses import dataclass

from toftools.sim._flash import flash_light
from toftools.sim._holes import MAX_PASSED
from toftools.sim._second import scatters_alike
from toftools.sim._sobol import hashed, single
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._tracer import Deposit, Draw, lane_keys
from toftools.sim._walks import BLACK, LAST, Emission, place_of


@dataclass
class Trail:
    """Where a path from the camera stands.

    Parameters
    ----------
    si : SurfaceInteraction3f
        Its surface.
    throughput, length_m, ior : Float
        Radiance at the pixel per radiance here, optical path to the pixel, and medium.
    bounce : UInt32
        Indirect bounces so far.
    geometry, albedo : Float
        G of the first leg over pi, and q_k.
    alike : Bool
        Whether all surfaces so far were diffuse, so that a light subpath could be the same.
    """

    si: Jit
    throughput: Jit
    length_m: Jit
    ior: Jit
    bounce: Jit
    geometry: Jit
    albedo: Jit
    alike: Jit


def camera_walks(
    task: Task,
    first: Jit,
    pixel: Jit,
    source: Emission,
    counts: tuple[int, int, int],
    sums: Jit,
    deposit: Deposit,
) -> Jit:
    """Light of paths from the camera, as far as it is not left to virtual lights.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surfaces; only the diffuse ones are walked from.
    pixel : UInt32
        Number of each lane's pixel, root of its random numbers.
    source : Emission
        Source with its light subpaths.
    counts : tuple of int
        Most bounces, paths per pixel, and seed.
    sums : pytree
        What `deposit` adds to.
    deposit : callable
        Takes up a contribution, of which there are R times as many as of light: R paths.

    Returns
    -------
    pytree
        The sums.
    """
    import drjit as dr

    mi, (bounces, rays, seed), lanes = task.mi, counts, dr.width(first.t)
    limit, paths = dr.opaque(mi.UInt32, min(bounces, LAST)), dr.opaque(mi.UInt32, rays)
    key, lane = lane_keys(mi, pixel, seed), dr.arange(mi.UInt32, lanes)
    one, none = dr.ones(mi.Float, lanes), dr.zeros(mi.UInt32, lanes)
    range_m = first.t * task.stage.unit_m
    start = Trail(first, one, range_m, one, none, one, one, dr.full(mi.Bool, True, lanes))

    def body(active: Jit, number: Jit, step: Jit, trail: Trail, sums: Jit) -> tuple[Jit, ...]:
        draw = Draw(mi, number, key, step)
        trail, alive = _stride(task, active, trail, draw)
        lit = alive & (trail.bounce <= limit)
        value, far_m = flash_light(mi, task.stage, source.flash, trail.si, lit, ior=trail.ior)
        value *= trail.throughput * _share(task, source, trail, lit, rays)
        sums = deposit(sums, lane, number, trail.bounce, value, trail.length_m + far_m)
        alive &= (trail.bounce < limit) & (step < 2 * limit + MAX_PASSED)
        number = dr.select(alive, number, number + 1)
        trail = dr.select(alive, trail, start)
        return active & (number < paths), number, dr.select(alive, step + 1, 0), trail, sums

    begin = scatters_alike(mi, first) & (limit > 0)
    state = (begin, none, none, start, sums)
    return dr.while_loop(state, lambda active, *_: active, body)[-1]


def _stride(task: Task, active: Jit, trail: Trail, draw: Draw) -> tuple[Trail, Jit]:
    """One step, and whether it ends on a surface; roulette from the second on."""
    import drjit as dr

    mi, si = task.mi, trail.si
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, draw.lobe(), draw.direction(), active)
    begins = draw.step == 0
    goes_on = dr.select(begins, 1.0, dr.minimum(weight[0], 1.0))
    # The fourth use of a step's numbers; `Draw` has three.
    chance = single(mi, draw.number, hashed(mi, draw.key + hashed(mi, 4 * draw.step)))
    active = active & (weight[0] > 0) & (chance < goes_on)
    away = si.to_world(sample.wo)
    nearby = next_hit(task, si, away, active)
    hit = active & nearby.is_valid()
    far_m = nearby.t * task.stage.unit_m
    leg = dr.abs(sample.wo.z * dr.dot(nearby.n, away)) * dr.inv_pi / dr.square(far_m)
    albedo = nearby.bsdf().eval_diffuse_reflectance(nearby, hit)[0]
    ior = trail.ior * sample.eta
    passed = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    return Trail(
        si=nearby,
        throughput=trail.throughput * weight[0] / dr.maximum(goes_on, BLACK),
        length_m=trail.length_m + dr.select(hit, ior * far_m, 0.0),
        ior=ior,
        bounce=trail.bounce + dr.select(passed, mi.UInt32(0), mi.UInt32(1)),
        geometry=dr.select(begins, leg, trail.geometry),
        albedo=dr.select(begins, albedo, trail.albedo),
        alike=trail.alike & scatters_alike(mi, nearby),
    ), hit


def _share(task: Task, source: Emission, trail: Trail, active: Jit, rays: int) -> Jit:
    """Share of the light of a whole path that camera paths keep: 1 - w."""
    import drjit as dr

    mi, si = task.mi, trail.si
    place = place_of(mi, source.flash)
    away = si.p - place
    far_m = dr.norm(away) * task.stage.unit_m
    away = dr.normalize(away)
    rival = trail.alike & active
    if task.holes:
        rival &= ~task.stage.scene.ray_test(si.spawn_ray_to(place), rival)
    density = source.paths * source.density(mi, away) * dr.abs(dr.dot(si.n, away))
    q1 = dr.maximum(si.bsdf().eval_diffuse_reflectance(si, rival)[0], BLACK)
    density = density / dr.square(far_m) * q1 / dr.maximum(trail.albedo, BLACK)
    return dr.select(rival, 1 / (1 + density / dr.maximum(rays * trail.geometry, 1e-30)), 1.0)
