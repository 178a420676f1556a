"""Parts of the engine radiosity against slow readable twins."""

import numpy as np
import pytest
from path_proof import ideal

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sim._cache import RAYS, lookups, nearest, solved
from toftools.sim._fan import own_fan
from toftools.sim._flash import flashes_of
from toftools.sim._gather import gather
from toftools.sim._hemisphere import hemisphere
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
    once, rows, start = [], [], 0
    for number, some in enumerate(at):
        count = len(arrays(some.p))
        keys = lane_keys(mi, mi.UInt32(np.arange(start, start + count, dtype=np.uint32)),
                         seed + number)  # fmt: skip
        arrived = hemisphere(task, some, own_fan(mi, RAYS, keys), CHANNELS)
        once.append(arrived.one_bounce + arrived.rest)
        near = nearest(cache, arrived.hits)
        matrices = lookups(cache, arrived.hits, near, count, CHANNELS)
        whole = np.bincount(arrived.hits.lane, arrived.hits.weight, count)
        assert matrices[0].sum(axis=1) == pytest.approx(whole)
        rows.append([matrix.toarray() for matrix in matrices])
        start += count
    albedo = np.concatenate([albedo_of(task, some) for some in at])
    once = np.concatenate(once, axis=1)
    for i in range(2):
        system = np.concatenate([matrices[i] for matrices in rows]) * albedo
        exact = np.linalg.solve(np.eye(len(albedo)) - system, once[i])
        assert np.abs(cache.later[i] - exact).max() < 1e-4 * np.abs(exact).max()
        alone = solved(task, at, 0.3, CHANNELS, 2, seed).later[i]
        assert alone == pytest.approx(once[i] + system @ once[i], rel=1e-4, abs=1e-9)
