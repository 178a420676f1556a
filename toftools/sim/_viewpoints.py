"""Points from which surfaces are sampled: the camera's centre, and others for what it cannot see.

Seen from a point c, directions drawn with density p(w) hit surfaces with ``p(w) cos / d^2`` points
per area (d the distance, cos that of the angle of incidence). With N_c directions from each of
several viewpoints the density of all points together is the sum over those that see a place, so
every point stands for the area that is its inverse: unbiased over all surfaces that any viewpoint
sees (the balance heuristic; E. Veach, "Robust Monte Carlo Methods for Light Transport Simulation",
1997, section 9.2.2). The camera's centre sees what its own flash lights; further viewpoints are
picked one by one where they see most of what light reaches from there, yet no viewpoint has seen.
What stays unseen has density 0 and is left to rays.

References
----------
The map of what a light sees as a source of virtual lights: reflective shadow maps, as in seed
"Transient instant radiosity" (2019), section 4, for one viewpoint.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._fan import away_of
from toftools.sim._flash import opaque
from toftools.sim._second import face_of, scatters_alike
from toftools.sim._segments import above, segment
from toftools.sim._sobol import hashed, pair
from toftools.sim._task import Jit, Task, next_hit
from toftools.types import F64

MOST = 8
"""Viewpoints at most."""
LEFT = 0.005
"""Share of light's next places that may stay unseen."""
PROBES, CANDIDATES, DEEP = 2048, 96, 3
CELLS, FINE = 32, 4
"""Rows of the map of directions that hit something, and rays along each side of its cells."""
FAINT = 0.02
"""Density of directions that hit nothing: what a coarse map missed is still met."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """One point, and how directions are drawn from it.

    Parameters
    ----------
    place : ndarray, (3,)
        Place, scene units.
    chart : mitsuba.Hierarchical2D0
        Density over the unit square, which is the sphere of directions at equal areas.
    share : float
        Its share of all points.
    """

    place: F64
    chart: Any
    share: float


def counts(views: tuple[Viewpoint, ...], total: int) -> list[int]:
    """Number of points of each viewpoint.

    Parameters
    ----------
    views : tuple of Viewpoint
        Viewpoints.
    total : int
        Points wanted.

    Returns
    -------
    list of int
        At least one each.
    """
    return [max(1, round(total * view.share)) for view in views]


def viewpoints(task: Task, seed: int = 0) -> tuple[Viewpoint, ...]:
    """Viewpoints that together see nearly all surfaces that light can reach.

    Parameters
    ----------
    task : Task
        Scene and sources.
    seed : int
        Of the probes.

    Returns
    -------
    tuple of Viewpoint
        The camera's centre first; offset sources follow, then what was picked.
    """
    centre = task.stage.to_world[:3, 3]
    places = [centre, *(f.position for f in task.flashes if not f.at_camera)]
    views = tuple(Viewpoint(p, _chart(task, p), 1 / len(places)) for p in places)
    unseen, normals, candidates, all_probes = _unseen(task, views, seed)
    picked = _picked(task, unseen, normals, candidates, LEFT * all_probes, MOST - len(places))
    if not picked:
        return views
    first = [Viewpoint(v.place, v.chart, 0.5 / len(views)) for v in views]
    rest = [Viewpoint(p, _chart(task, p), 0.5 / len(picked)) for p in picked]
    return (*first, *rest)


def _chart(task: Task, place: F64) -> Any:  # noqa: ANN401 - a class of Mitsuba's variant
    """Directions that hit something, with their neighbours, on a grid over the unit square."""
    mi = task.mi
    fine_rows, fine_columns = CELLS * FINE, 2 * CELLS * FINE
    row, column = (a.ravel() for a in np.mgrid[0:fine_rows, 0:fine_columns])
    u = (column + 0.5) / fine_columns, (row + 0.5) / fine_rows
    square = mi.Point2f(*(mi.Float(x.astype(np.float32)) for x in u))
    away = mi.warp.square_to_uniform_sphere(square)
    met = task.stage.scene.ray_test(mi.Ray3f(mi.Point3f(*opaque(mi, place)), away))
    cells = np.asarray(met.numpy(), bool).reshape(CELLS, FINE, 2 * CELLS, FINE).any(axis=(1, 3))
    grid = np.zeros((CELLS + 1, 2 * CELLS + 1), bool)
    for down in (0, 1):
        for right in (0, 1):
            grid[down : down + CELLS, right : right + 2 * CELLS] |= cells
    grid[:, 0] |= grid[:, -1]  # the square closes around the sphere
    grid[:, -1] = grid[:, 0]
    values = np.where(grid, 1.0, FAINT).astype(np.float32)
    return mi.Hierarchical2D0(values, normalize=True, enable_sampling=True)


def shoot(task: Task, view: Viewpoint, count: int, seed: int) -> tuple[Jit, Jit]:
    """Low-discrepancy points on diffuse surfaces, as a viewpoint sees them.

    Parameters
    ----------
    task : Task
        Scene.
    view : Viewpoint
        From where.
    count : int
        Directions; those that hit nothing diffuse give no point.
    seed : int
        Of the sequence.

    Returns
    -------
    SurfaceInteraction3f, Normal3f
        Points, and their normals on the side that is seen.
    """
    import drjit as dr

    mi = task.mi
    key = hashed(mi, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF))
    index = dr.arange(mi.UInt32, count)
    square, _ = view.chart.sample(pair(mi, index, key, mi.UInt32(0)))
    away = mi.warp.square_to_uniform_sphere(square)
    si = task.stage.scene.ray_intersect(mi.Ray3f(mi.Point3f(*opaque(mi, view.place)), away))
    dr.eval(si)  # else gathering evaluates every field by a kernel of its own
    found: Jit = dr.compress(scatters_alike(mi, si))
    si = dr.gather(mi.SurfaceInteraction3f, si, found)
    normal = face_of(si) if dr.width(found) else mi.Normal3f()
    dr.eval(si, normal)
    return si, normal


def density(
    task: Task, views: tuple[Viewpoint, ...], total: int, p: Jit, n: Jit, active: Jit
) -> Jit:
    """Points per area that viewpoints put on places.

    Parameters
    ----------
    task : Task
        Scene.
    views : tuple of Viewpoint
        Viewpoints.
    total : int
        Points of all together, as `counts` splits them.
    p, n : Point3f, Normal3f
        Places, scene units, and normals on the side that counts.
    active : Bool
        Which of them count.

    Returns
    -------
    Float
        Density, 1/m^2; 0 where no viewpoint sees the place.
    """
    import drjit as dr

    mi = task.mi
    lifted = above(p, n)
    found = mi.Float(0)
    for view, number in zip(views, counts(views, total), strict=True):
        place = mi.Point3f(*opaque(mi, view.place))
        way = p - place
        far = dr.norm(way)
        way /= far
        cosine = -dr.dot(n, way)
        lit = active & (cosine > 0)
        lit &= ~task.stage.scene.ray_test(segment(mi, place, lifted), lit)
        # Equal areas of the square are equal solid angles.
        turn = dr.atan2(way.y, way.x) * dr.inv_two_pi
        square = mi.Point2f(turn + dr.select(way.y < 0, 1.0, 0.0), 0.5 * (1 - way.z))
        chance = view.chart.eval(square) * (0.5 * dr.inv_two_pi) * dr.opaque(mi.Float, number)
        found += dr.select(lit, chance * cosine / dr.square(far * task.stage.unit_m), 0.0)
    return found


def _unseen(task: Task, views: tuple[Viewpoint, ...], seed: int) -> tuple[F64, F64, F64, int]:
    """Where light goes next and no viewpoint sees, places to see it from, and the probes."""
    import drjit as dr

    mi = task.mi
    each = [shoot(task, view, PROBES // len(views), seed + 1) for view in views]
    places: list[F64] = []
    normals: list[F64] = []
    candidates: list[F64] = []
    probes = 0
    for si, normal in each:
        for step in range(DEEP):
            if dr.width(si.t) == 0:
                break
            index = dr.arange(mi.UInt32, dr.width(si.t))
            number = pair(mi, index, hashed(mi, dr.opaque(mi.UInt32, 77 + step)), mi.UInt32(0))
            away = away_of(mi, normal, number)
            nearby = next_hit(task, si, away, mi.Bool(True))
            valid, facing = scatters_alike(mi, nearby), face_of(nearby)
            dr.eval(nearby, facing)
            probes += int(np.count_nonzero(valid.numpy())) if step == 0 else 0
            hidden = valid & (density(task, views, 1, nearby.p, facing, valid) <= 0)
            kept: Jit = dr.compress(hidden)
            middle = dr.gather(mi.Point3f, 0.5 * (si.p + nearby.p), kept)
            si = dr.gather(mi.SurfaceInteraction3f, nearby, kept)
            normal = dr.gather(mi.Normal3f, facing, kept)
            dr.eval(si, normal)
            for rows, values in ((places, si.p), (normals, normal), (candidates, middle)):
                rows.append(np.asarray(values.numpy(), np.float64).reshape(3, -1))
    none = [np.zeros((3, 0))]
    return (
        np.concatenate(places or none, 1), np.concatenate(normals or none, 1),
        np.concatenate(candidates or none, 1), probes,
    )  # fmt: skip


def _picked(
    task: Task, unseen: F64, normals: F64, candidates: F64, left: float, most: int
) -> list[F64]:
    """Candidates that see the most unseen places, one after the other."""
    total = unseen.shape[1]
    if total <= left or most < 1:
        return []
    number = np.linspace(0, candidates.shape[1] - 1, min(CANDIDATES, candidates.shape[1]))
    some = candidates[:, np.unique(number.astype(int))]
    seen = _sees(task, some, unseen, normals)
    rest = np.ones(total, bool)
    picked: list[F64] = []
    while len(picked) < most and rest.sum() > left:
        gain = (seen & rest).sum(axis=1)
        best = int(gain.argmax())
        if gain[best] < 2:
            break
        picked.append(some[:, best])
        rest &= ~seen[best]
    return picked


def _sees(task: Task, some: F64, unseen: F64, normals: F64) -> Any:  # noqa: ANN401 - bools
    """Which of some places see which others, (N, M)."""
    import drjit as dr

    mi, (n, m) = task.mi, (some.shape[1], unseen.shape[1])
    first, second = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    start = mi.Point3f(some[:, first].astype(np.float32))
    normal = mi.Normal3f(normals[:, second].astype(np.float32))
    end = mi.Point3f(unseen[:, second].astype(np.float32))
    front = dr.dot(normal, end - start) < 0
    clear = front & ~task.stage.scene.ray_test(segment(mi, start, above(end, normal)), front)
    return np.asarray(clear.numpy(), bool).reshape(n, m)
