"""Parts of the engine radiosity against slow readable twins."""

import numpy as np
import pytest
from path_proof import ideal

from toftools._native import import_mitsuba, import_open3d
from toftools.camera import rays
from toftools.sim._cache import RAYS, lookups, nearest, ranks, solved
from toftools.sim._fan import along_curve, box_of, own_fan, shared_fan, turned_fan
from toftools.sim._field import arriving, light_field
from toftools.sim._flash import flashes_of
from toftools.sim._gather import gather
from toftools.sim._hemisphere import _thinned, hemisphere
from toftools.sim._hits import Hits
from toftools.sim._light_map import light_map, lit_by, row_of
from toftools.sim._lookup import looked_up, sharpened
from toftools.sim._second import up_of
from toftools.sim._segments import CLEAR
from toftools.sim._sweep import Against
from toftools.sim._task import Task, first_hits
from toftools.sim._tracer import lane_keys
from toftools.sim._viewpoints import Viewpoint, _chart, density, viewpoints
from toftools.sim._virtual import Channels, Virtual, albedo_of, virtual_lights
from toftools.sim.scenes import world_of
from toftools.sim.solids import box, material, plane
from toftools.sim.stage import load
from toftools.sim.world import World
from toftools.types import Scene
from toftools.units import path_to_phase

EYE = ideal(6, 4, (20e6,), more=",hfov_deg=50")
CHANNELS = Channels(np.array([0.0, 20e6]), (True, True))
GREY = material("diffuse", 0.5)
CENTRE, HALF = np.array([0.1, 0.3, 2.2]), np.array([0.3, 0.3, 0.2])
"""A box in the air before a wall and above a floor, which cannot hide one another."""
PLACES = World({
    "back": plane([0, 0, 3], [9, 0, 0], [0, -9, 0], GREY),
    "floor": plane([0, 1, 0], [9, 0, 0], [0, 0, 9], GREY),
    "box": box(CENTRE, HALF, 0, GREY),
})  # fmt: skip


def task_of(world):
    mi = import_mitsuba()
    stage = load(world)
    return Task(mi, stage, flashes_of(mi, stage, EYE))


def points_of(task):
    return first_hits(task, rays(EYE.camera).reshape(-1, 3))


def arrays(p):
    return np.asarray(p.numpy(), np.float64).reshape(3, -1).T


def hidden(start, end):
    """Whether the box lies between two places, by the slabs of its sides."""
    with np.errstate(divide="ignore"):
        sides = ((CENTRE + s * HALF - start) / (end - start) for s in (-1, 1))
        near, far = np.sort(list(sides), axis=0)
    return max(near.max(), 0.0) < min(far.min(), 1.0)


def lifted(p, n):
    return p + n * CLEAR * (1 + np.abs(p).max())


def coupling(x, n, y, m):
    """Cosines over pi and squared distance, and the distance."""
    way = y - x
    square = way @ way
    return max(n @ way, 0) * max(-(m @ way), 0) / (np.pi * square**2), np.sqrt(square)


@pytest.mark.parametrize("shared", [0, 32])
def test_gathered_light_is_that_of_a_double_loop(shared):
    task = task_of(PLACES)
    points = points_of(task)
    lights = virtual_lights(task, viewpoints(task), 60, CHANNELS, 5)
    later = lights.direct[:, ::-1] * (0.5 + 0.1j)
    one, rest, ones = gather(task, points, lights, later, CHANNELS, shared)
    slow = np.zeros((3, 2, len(ones)), complex)
    unseen = 0
    places = list(zip(arrays(lights.p), arrays(lights.n), lights.area_m2, strict=True))
    for i, (x, n) in enumerate(zip(arrays(points.p), arrays(up_of(points)), strict=True)):
        for j, (y, m, area) in enumerate(places):
            term, far_m = coupling(x, n, y, m)
            if hidden(lifted(x, n), lifted(y, m)):
                unseen += term > 0
                continue
            share = term * area / (1 + shared * term * area)
            turn = np.exp(1j * path_to_phase(far_m, CHANNELS.freqs_hz))
            for part, light in zip(slow, (lights.direct, later, np.ones_like(later)), strict=True):
                part[:, i] += share * light[:, j] * turn
    assert unseen > 20
    for mine, twin in ((one, slow[0]), (rest, slow[1]), (ones, slow[2, 0].real)):
        assert np.abs(mine - twin).max() < 1e-4 * np.abs(twin).max()


def test_weights_of_rays_and_lights_sum_to_one_for_every_pair():
    task, count, total = task_of(PLACES), 32, 500
    mi, points, views = task.mi, points_of(task), viewpoints(task)
    lanes = mi.UInt32(np.arange(len(arrays(points.p)), dtype=np.uint32))
    fan = own_fan(mi, count, lane_keys(mi, lanes, 3))
    hits = hemisphere(task, points, fan, CHANNELS, Against(views, total)).hits
    x, n = arrays(points.p), arrays(up_of(points))
    chosen = np.flatnonzero(hits.weight * count > 1e-3)[::40]
    shares = hits.weight * count
    assert shares.max() <= 1 + 1e-5 and len(chosen) > 5
    for i in chosen:
        y, m = mi.Point3f(*map(float, hits.p[:, i])), mi.Normal3f(*map(float, hits.n[:, i]))
        dense = float(density(task, views, total, y, m, mi.Bool(True)).numpy()[0])
        if dense == 0:
            assert shares[i] == pytest.approx(1)
            continue
        none = np.ones((2, 1), complex)
        light = Virtual([], y, m, np.array([1 / dense]), np.ones(1), none, total)
        lane = hits.lane[i]
        _, _, ones = gather(task, points, light, none, CHANNELS, count)
        term, _ = coupling(x[lane], n[lane], hits.p[:, i], hits.n[:, i])
        assert ones[lane] * dense / term + shares[i] == pytest.approx(1, abs=2e-3)


def test_density_integrates_to_the_number_of_points():
    """Over a sphere, from a viewpoint off its centre."""
    task, total, radius_m = task_of(world_of(Scene("cavity", {"radius": 2.0}))), 1000, 2.0
    mi, place = task.mi, np.array([0.7, -0.4, 0.5])
    views = (Viewpoint(place, _chart(task, place), 1.0),)
    out = np.random.default_rng(0).normal(size=(3, 1 << 14))
    out /= np.linalg.norm(out, axis=0)
    p, n = (kind(np.float32(v)) for kind, v in ((mi.Point3f, radius_m * out), (mi.Normal3f, -out)))
    dense = density(task, views, total, p, n, mi.Bool(True)).numpy().astype(np.float64)
    integral = dense * 4 * np.pi * radius_m**2
    error = integral.std() / np.sqrt(integral.size)
    assert abs(integral.mean() - total) < 4 * error
    assert error < 0.01 * total


def test_the_cache_solves_its_equations():
    task = task_of(world_of(Scene("cornell")))
    mi, seed = task.mi, 11
    at = virtual_lights(task, viewpoints(task), 200, CHANNELS, 2).at
    cache = solved(task, at, 0.3, CHANNELS, None, seed)
    once, rows, start, rank = [], [], 0, ranks(at)
    for some in at:
        count = len(arrays(some.p))
        fan = turned_fan(mi, RAYS, rank[start : start + count], seed)
        arrived = hemisphere(task, some, fan, CHANNELS)
        once.append(arrived.one_bounce + arrived.rest)
        near = nearest(cache, arrived.hits)
        matrices = list(lookups(cache, arrived.hits, near, count, CHANNELS))
        whole = np.bincount(arrived.hits.lane, arrived.hits.weight, count)
        assert matrices[0].sum(axis=1) == pytest.approx(whole)
        rows.append([matrix.toarray() for matrix in matrices])
        start += count
    albedo = np.concatenate([albedo_of(some) for some in at])
    once = np.concatenate(once, axis=1)
    for i in range(2):
        system = np.concatenate([matrices[i] for matrices in rows]) * albedo
        exact = np.linalg.solve(np.eye(len(albedo)) - system, once[i])
        assert np.abs(cache.later[i] - exact).max() < 1e-4 * np.abs(exact).max()
        alone = solved(task, at, 0.3, CHANNELS, 2, seed).later[i]
        assert alone == pytest.approx(once[i] + system @ once[i], rel=1e-4, abs=1e-9)


@pytest.mark.parametrize("albedo", [0.5, 0.9])
@pytest.mark.parametrize(("bounces", "terms"), [(1, 1), (3, 3), (None, 1000)])
def test_places_that_look_around_once_more_count_one_more_bounce(albedo, bounces, terms):
    """In a sphere lit from its centre every bounce is the one before times the albedo."""
    task = task_of(world_of(Scene("cavity", {"radius": 2.0, "albedo": albedo})))
    views = viewpoints(task)
    lights = virtual_lights(task, views, 256, CHANNELS, 4)
    before = None if bounces is None else bounces - 1
    cache = solved(task, lights.at, 0.2, CHANNELS, before, 5)
    sharp = sharpened(task, lights.at, cache, CHANNELS, 6)
    # What leaves a place of albedo 1 is what arrives: direct light of the sphere, and so on.
    series = np.mean(lights.direct[0].real) * np.sum(albedo ** np.arange(terms))
    assert np.mean(sharp.later[0].real) == pytest.approx(series, rel=0.01)


def test_places_that_look_around_once_more_scatter_less():
    task = task_of(world_of(Scene("cornell")))
    at = virtual_lights(task, viewpoints(task), 256, CHANNELS, 4).at
    rough = [solved(task, at, 0.3, CHANNELS, None, seed) for seed in (1, 2)]
    sharp = [sharpened(task, at, cache, CHANNELS, seed) for seed, cache in enumerate(rough, 3)]
    apart = [np.linalg.norm(one.later - two.later) for one, two in (rough, sharp)]
    assert apart[1] < 0.5 * apart[0]


def test_thinned_hits_stand_for_all():
    rng = np.random.default_rng(3)
    shares = rng.random((5, 64)).astype(np.float32) ** 4
    shares[rng.random((5, 64)) < 0.2] = 0.0
    shares[1, 7] = shares[4, 60] = -1.0
    values = rng.normal(size=(5, 64))
    sums, counts = [], []
    for offset in (np.arange(4000) + 0.5) / 4000:
        lane, ray, weight = _thinned(shares, offset, 10)
        assert {(1, 7), (4, 60)} <= set(zip(lane.tolist(), ray.tolist(), strict=True))
        diffuse = shares[lane, ray] > 0
        counts.append(np.bincount(lane[diffuse], minlength=5))
        assert (weight[~diffuse] == 1).all()
        weighted = (weight * values[lane, ray])[diffuse]
        sums.append(np.bincount(lane[diffuse], weighted, 5))
    assert np.ptp(counts, axis=0).max() <= 1
    assert np.max(counts) <= 11
    exact = (np.clip(shares, 0, None) * values).sum(axis=1)
    assert np.mean(sums, axis=0) == pytest.approx(exact, abs=0.005)
    lane, ray, weight = _thinned(shares, 0.3, None)
    assert len(lane) == np.count_nonzero(shares)
    assert weight == pytest.approx(np.abs(shares[lane, ray]))
    assert not len(_thinned(shares, 0.3, 0)[0])


def test_a_guess_and_what_corrects_it_are_the_light_of_the_cache():
    task = task_of(world_of(Scene("cornell")))
    points, views = points_of(task), viewpoints(task)
    at = virtual_lights(task, views, 300, CHANNELS, 2).at
    cache = solved(task, at, 0.3, CHANNELS, None, 3)
    fan, count = shared_fan(task.mi, 32, 9), len(arrays(points.p))
    plain, guessed = (
        hemisphere(task, points, fan, CHANNELS, Against(views, 300), None, guess)
        for guess in (None, cache.guess)
    )
    assert not plain.guessed.any()
    assert guessed.guessed.any()
    one, two = (
        part.guessed + looked_up(task, cache, part.hits, count, CHANNELS, 1, 0)
        for part in (plain, guessed)
    )
    assert np.abs(one - two).max() < 1e-5 * np.abs(one).max()
    few = hemisphere(task, points, fan, CHANNELS, Against(views, 300), 4, cache.guess)
    assert len(few.hits.weight) < 0.3 * len(plain.hits.weight)
    rough = few.guessed + looked_up(task, cache, few.hits, count, CHANNELS, 1, 0)
    alone = hemisphere(task, points, fan, CHANNELS, Against(views, 300), 4).hits
    blind = looked_up(task, cache, alone, count, CHANNELS, 1, 0)
    assert np.linalg.norm(rough - one) < 0.5 * np.linalg.norm(blind - one)


def test_cells_hold_the_mean_of_their_hits():
    mi, rng, count = import_mitsuba(), np.random.default_rng(1), 500
    p, n = rng.random((3, count)) * [[2.0], [0.5], [0.0]], rng.normal(size=(3, count))
    blank = np.zeros(count)
    hits = Hits(np.arange(count), p, n, blank, blank, np.full(count, -1), np.ones(count, bool), [])
    places = rng.integers(0, 40, (count, 2))
    share = rng.random((count, 2))
    light = rng.normal(size=(2, 40)) + 1j * rng.normal(size=(2, 40))
    known = light_map(mi, hits, (share, places), light, 0.3)
    at, up = mi.Point3f(np.float32(p)), mi.Normal3f(np.float32(n))
    rows = row_of(mi, known, at, up, mi.Bool(True)).numpy()
    found = {}
    for i in range(count):
        axis = int(np.argmax(np.abs(n[:, i])))
        cell = (*((p[:, i] - p.min(axis=1)) // 0.3).astype(int), axis, n[axis, i] > 0)
        found.setdefault(cell, []).append(i)
    assert len(found) > 60
    for members in found.values():
        assert len(set(rows[members])) == 1
        mean = np.mean([(share[i] * light[:, places[i]]).sum(axis=1) for i in members], axis=0)
        assert known.light[:, rows[members[0]]] == pytest.approx(mean)
    outside = row_of(mi, known, mi.Point3f(9, 9, 9), mi.Normal3f(0, 0, 1), mi.Bool(True)).numpy()
    assert not known.light[:, outside].any()
    assert lit_by(known, 2 * light).light == pytest.approx(2 * known.light)


def test_a_far_place_makes_no_box_coarse():
    p = np.random.default_rng(2).random((3, 1000)) * [[4.0], [1.0], [0.0]]
    assert np.array_equal(box_of(p), [p.min(axis=1), p.max(axis=1)])
    low, high = box_of(np.append(p, [[2e5], [-1e6], [9e6]], axis=1))
    assert (low >= [-4, -4, -4]).all() and (high <= [8, 8, 8]).all()
    assert (low <= p.min(axis=1)).all() and (high >= p.max(axis=1)).all()


def test_areas_are_those_of_the_faces_where_normals_are_smooth(tmp_path):
    open3d = import_open3d()
    ball, file = open3d.geometry.TriangleMesh.create_icosahedron(2.0), str(tmp_path / "ball.ply")
    ball.compute_vertex_normals()
    open3d.io.write_triangle_mesh(file, ball)
    world = World({"ball": {"type": "ply", "filename": file, "flip_normals": True, "b": GREY}})
    task, total = task_of(world), 4000
    place = np.array([0.3, -0.2, 0.4])
    lights = virtual_lights(task, (Viewpoint(place, _chart(task, place), 1.0),), total, CHANNELS, 3)
    assert lights.area_m2.sum() == pytest.approx(ball.get_surface_area(), rel=0.02)
    assert np.linalg.norm(arrays(lights.n) * arrays(lights.p), axis=1).std() > 0.01


def test_only_light_that_came_straight_is_scaled():
    mirror = plane([-1, 0, 2], [0, 0, 9], [0, -9, 0], material("mirror", 0.9))
    left = []
    for world in (PLACES, World({**PLACES.description, "mirror": mirror})):
        task = task_of(world)
        points, views = points_of(task), viewpoints(task)
        field = light_field(task, views, CHANNELS, points, 512, None, 1)
        count = len(arrays(points.p))
        (one, rest), (same, some) = (
            arriving(task, field, points, met) for met in (None, np.zeros(count))
        )
        assert np.array_equal(one, same)
        left.append(np.linalg.norm(some) / np.linalg.norm(rest))
    assert left[0] == 0
    assert 0.02 < left[1] < 0.9


def test_rays_of_neighbours_complete_each_other():
    mi = import_mitsuba()
    fan = turned_fan(mi, 64, np.arange(4), 7)
    lane, number = (mi.UInt32(x.astype(np.uint32)) for x in np.divmod(np.arange(256), 64))
    square = np.asarray(fan.square(number, lane).numpy()).reshape(2, -1)
    cells = (16 * square).astype(int)
    assert len(set(zip(*cells, strict=True))) == 256
    own = (8 * square[:, :64]).astype(int)
    assert len(set(zip(*own, strict=True))) == 64
    shared = shared_fan(mi, 64, 7)
    rows = np.asarray(shared.square(mi.UInt32(np.arange(64, dtype=np.uint32)), None).numpy())
    rows = rows.reshape(2, -1)
    assert len(set(zip(*(8 * rows).astype(int), strict=True))) == 64
    assert (np.diff(along_curve(rows)) > 0).all()
    steps = np.linalg.norm(np.diff(rows, axis=1), axis=0)
    assert steps.mean() < 0.25  # 0.52 for random order
