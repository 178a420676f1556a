"""Virtual lights by light subpaths, and what they share with paths from the camera.

A light subpath x_0 y_1 y_2 ... starts at a source, with a density over directions that leaves out
what hits nothing, and goes on from diffuse surfaces with cosine-distributed directions as often as
the albedo q says (Russian roulette on energy), so that its flux stays what it was. At every vertex
it leaves a virtual light with the time of eq. (12) of the seed "Transient instant radiosity" (2019)
as an optical path, and the impulse of eq. (15): albedo / pi times flux over N subpaths. Eq. (16)
there ends at one bounce and one source; here both are free.

A vertex x that the camera sees gets from a virtual light y_k (eq. 6, 7) ``rho / pi G V`` times its
light, and G = cos cos / r^2 has no bound. The paper clamps it. Instead R paths per pixel walk the
other way, x y_k ... y_1, and connect with the source, and both share the light by the balance
heuristic. With q_i the albedos, p the density of y_1 per area, cosine sampling and the roulette,

    p_light  = p(y_1) q_1 .. q_{k-1} prod G / pi,
    p_camera = G(x, y_k) / pi q_k .. q_2 prod G / pi,       (the x to y_k leg has no roulette)

and all legs but the last cancel: virtual lights keep the share

    w = 1 / (1 + R G / (pi D)),    D = N p(y_1) q_1 / q_k,

so w G < pi D / R, and no corner is darkened. Light subpaths end at what is not diffuse; camera
paths with such a vertex beyond x have no rival and keep weight 1: mirrors and gloss seen second
hand are right, and caustics are, as in `path`, not modelled. The same holds where light first
passes a surface with holes. Shading normals enter as in `path` (cosines of the surface for areas,
of the shading for reflection). A subpath is cut after `LAST` bounces.

References
----------
I. Garcia and others, "Transient instant radiosity for efficient time-resolved global illumination",
2019, the seed; E. Veach 1997, chapter 9 (balance heuristic).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._flash import Flash, beam_at, opaque
from toftools.sim._second import facing, scatters_alike, up_of
from toftools.sim._sobol import MAX_POINTS, hashed, pair
from toftools.sim._task import Jit, Task, next_hit
from toftools.sim._tracer import Draw, lane_keys

LAST = 512
"""Bounces after which a subpath ends even where nothing absorbs."""
ROWS, FINER = 256, 2
"""Rows of the map of directions, and rays along each side of its cells."""
LEAST_HIT, LEAST = 1e-3, 1e-4
"""Of directions that hit nothing, and of those without light: what is thin is not left out."""
BLACK = 1e-6
"""Albedo below which nothing is told apart."""


@dataclass
class Lights:
    """Virtual lights, a structure that Dr.Jit can gather from.

    Parameters
    ----------
    p, n : Point3f, Normal3f
        Place, scene units, and normal on the lit side.
    light : Float
        Radiance times area, as it leaves, m^2 in units of `Noise.signal_e`.
    path_m : Float
        Optical path so far, the delay of the source included, m.
    density : Float
        D of the module's text, 1/m^2.
    bounce : UInt32
        Bounces of light that comes by way of it.
    """

    p: Jit
    n: Jit
    light: Jit
    path_m: Jit
    density: Jit
    bounce: Jit


@dataclass(frozen=True, eq=False)
class Emission:
    """A source, its density over directions and its share of the light subpaths.

    Parameters
    ----------
    flash : Flash
        Source.
    spread : Hierarchical2D0
        Density over the unit square that maps to the sphere.
    paths : int
        Light subpaths.
    """

    flash: Flash
    spread: Any
    paths: int

    def density(self, mi: Any, away: Jit) -> Jit:  # noqa: ANN401 - the module mitsuba
        """Density of a direction, per solid angle."""
        import drjit as dr

        turn = dr.atan2(away.y, away.x) * dr.inv_two_pi
        square = mi.Point2f(turn + dr.select(turn < 0, 1.0, 0.0), 0.5 * (1 - away.z))
        return self.spread.eval(square) * dr.inv_four_pi


def emissions(task: Task, paths: int) -> tuple[Emission, ...]:
    """All modulated sources of the camera, the light subpaths shared by strength.

    Parameters
    ----------
    task : Task
        Scene and sources.
    paths : int
        Light subpaths in all; every source gets one at least.

    Returns
    -------
    tuple of Emission
        One per modulated source.
    """
    flashes = [flash for flash in task.flashes if flash.modulated and flash.strength > 0]
    whole = sum(flash.strength for flash in flashes)
    return tuple(
        Emission(flash, _spread(task, flash), max(1, round(paths * flash.strength / whole)))
        for flash in flashes
    )


def _spread(task: Task, flash: Flash) -> Any:  # noqa: ANN401 - a Mitsuba distribution
    """Map of directions that hit something, times the beam."""
    import drjit as dr

    mi, shape = task.mi, (ROWS, FINER, 2 * ROWS, FINER)
    index = dr.arange(mi.UInt32, int(np.prod(shape)))
    across = dr.opaque(mi.UInt32, 2 * ROWS * FINER)
    square = mi.Point2f((index % across + 0.5) / (2 * ROWS * FINER), 0.0)
    square.y = (index // across + 0.5) / (ROWS * FINER)
    away = mi.warp.square_to_uniform_sphere(square)
    hit = task.stage.scene.ray_test(mi.Ray3f(place_of(mi, flash), away))
    bright = dr.select(hit, 1.0, LEAST_HIT) * _beam(mi, flash, away)
    cells = np.broadcast_to(bright.numpy(), index.numpy().shape).reshape(shape).max(axis=(1, 3))
    # Bilinear between the corners of cells: each is as bright as the brightest cell around it.
    cells = np.pad(cells, ((1, 1), (0, 0)), mode="edge")
    cells = np.pad(cells, ((0, 0), (1, 1)), mode="wrap")
    corners = np.maximum(np.maximum(cells[1:, 1:], cells[:-1, 1:]),
                         np.maximum(cells[1:, :-1], cells[:-1, :-1]))  # fmt: skip
    corners = np.maximum(corners, LEAST * max(float(corners.max()), LEAST))
    return mi.Hierarchical2D0(np.ascontiguousarray(corners, np.float32))


def place_of(mi: Any, flash: Flash) -> Jit:  # noqa: ANN401
    """Where a source sits, scene units."""
    return mi.Point3f(*opaque(mi, flash.position))


def _beam(mi: Any, flash: Flash, away: Jit) -> Jit:  # noqa: ANN401
    import drjit as dr

    if flash.beam is None:
        return mi.Float(1)
    axis = mi.Vector3f(*opaque(mi, flash.axis))
    return beam_at(mi, flash.beam, dr.safe_acos(dr.dot(away, axis)), mi.Bool(True))


def virtual_lights(
    task: Task, emission: Emission, part: tuple[int, int], bounces: int, seed: int
) -> Lights | None:
    """Virtual lights of some of a source's light subpaths.

    Parameters
    ----------
    task : Task
        Scene and sources.
    emission : Emission
        Source.
    part : tuple of int
        Number of the first subpath, and how many.
    bounces : int
        Most bounces of light that comes by way of a virtual light.
    seed : int
        Of the sequences.

    Returns
    -------
    Lights or None
        By bounce; None where the light meets nothing diffuse.
    """
    import drjit as dr

    mi, (start, count) = task.mi, part
    number = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
    # Sequences repeat after MAX_POINTS: later subpaths get others.
    key = lane_keys(mi, number // MAX_POINTS, seed)
    square, density = emission.spread.sample(pair(mi, number, hashed(mi, key), mi.UInt32(0)))
    density = density * dr.inv_four_pi
    away = mi.warp.square_to_uniform_sphere(square)
    si = task.stage.scene.ray_intersect(mi.Ray3f(place_of(mi, emission.flash), away))
    strength = np.pi * emission.flash.strength / emission.paths
    flux = strength * _beam(mi, emission.flash, away) / density
    length_m = si.t * task.stage.unit_m + emission.flash.delay_m
    found: list[Lights] = []
    first = mi.Float(0)
    for bounce in range(1, min(bounces, LAST) + 1):
        kept: Jit = dr.compress(si.is_valid() & scatters_alike(mi, si) & (flux > 0))
        if dr.width(kept) == 0:
            break
        si = dr.gather(mi.SurfaceInteraction3f, si, kept)
        number, key, flux, length_m, density = (
            dr.gather(type(x), x, kept) for x in (number, key, flux, length_m, density)
        )
        albedo = dr.maximum(si.bsdf().eval_diffuse_reflectance(si)[0], BLACK)
        arriving = dr.abs(dr.dot(si.n, si.to_world(si.wi)))
        if bounce == 1:  # D q_k, kept along the subpath
            far_m = length_m - emission.flash.delay_m
            first = emission.paths * density * arriving / dr.square(far_m) * albedo
        else:
            first = dr.gather(mi.Float, first, kept)
        flux *= dr.abs(si.wi.z) / arriving
        found.append(Lights(
            mi.Point3f(si.p), mi.Normal3f(facing(si.n, si.to_world(si.wi))),
            flux * albedo * dr.inv_pi, mi.Float(length_m), first / albedo,
            dr.full(mi.UInt32, bounce, dr.width(kept)),
        ))  # fmt: skip
        draw = Draw(mi, number, key, dr.opaque(mi.UInt32, bounce))
        way = mi.Frame3f(up_of(si)).to_world(mi.warp.square_to_cosine_hemisphere(draw.direction()))
        leaving = dr.dot(found[-1].n, way)
        goes = (draw.lobe() < albedo) & (leaving > 0)
        flux *= leaving / dr.dot(up_of(si), way)
        si = next_hit(task, si, way, goes)
        length_m = length_m + si.t * task.stage.unit_m
        dr.eval(found[-1], si, flux, length_m, first)
    return _joined(mi, found) if found else None


def _joined(mi: Any, parts: list[Lights]) -> Lights:  # noqa: ANN401
    """Virtual lights of all bounces in one."""

    def all_of(kind: Any, name: str) -> Jit:  # noqa: ANN401 - a Dr.Jit type
        arrays = [np.asarray(getattr(part, name).numpy()) for part in parts]
        return kind(np.ascontiguousarray(np.concatenate(arrays, axis=-1)))

    one = mi.Float
    kinds = {"p": mi.Point3f, "n": mi.Normal3f, "light": one, "path_m": one, "density": one,
             "bounce": mi.UInt32}  # fmt: skip
    return Lights(**{name: all_of(kind, name) for name, kind in kinds.items()})
