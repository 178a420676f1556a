"""Sparse gather with an error bound, on scenes in closed form: planes, a box, a sphere, a pole."""

from dataclasses import dataclass

import numpy as np
import pytest

from toftools.sim._sparse import Surface, place, spread
from toftools.sim._sparse_cells import Cells, bilinear
from toftools.units import path_to_phase

FREQ_HZ = 50e6
LAMPS_M = np.array([[-1.2, -0.8, 1.0], [1.0, 0.6, 0.4], [0.3, -0.9, 2.2]])
"""Virtual lights, in metres, camera frame."""


@dataclass
class View:
    """A surface with the number of the object in every pixel."""

    surface: Surface
    object: np.ndarray


def rays_of(width, height):
    x = (np.arange(width) - (width - 1) / 2) / (0.8 * width)
    y = (np.arange(height) - (height - 1) / 2) / (0.8 * width)
    ray = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def plane(ray, normal, offset):
    """Range to the plane ``normal . p = offset``."""
    cosine = ray @ np.asarray(normal, float)
    far = np.divide(offset, cosine, out=np.full(cosine.shape, np.inf), where=cosine != 0)
    return np.where(far > 0, far, np.inf), np.broadcast_to(normal, ray.shape).astype(float)


def sphere(ray, centre, radius):
    centre = np.asarray(centre, float)
    along = ray @ centre
    inside = along**2 - centre @ centre + radius**2
    far = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
    normal = (ray * np.where(np.isfinite(far), far, 0.0)[..., None] - centre) / radius
    return far, normal


def within(hit, ray, low, high):
    """A hit kept where its point lies between two corners."""
    far, normal = hit
    point = ray * np.where(np.isfinite(far), far, 0.0)[..., None]
    inside = ((point >= np.asarray(low) - 1e-9) & (point <= np.asarray(high) + 1e-9)).all(axis=-1)
    return np.where(inside, far, np.inf), normal


def view_of(width, height, *objects):
    """First hits; an object is a function from rays to (range, normal)."""
    ray = rays_of(width, height)
    hits = [thing(ray) for thing in objects]
    fars = np.stack([far for far, _ in hits])
    first = fars.argmin(axis=0)
    far = fars.min(axis=0)
    valid = np.isfinite(far)
    normal = np.take_along_axis(np.stack([n for _, n in hits]), first[None, ..., None], 0)[0]
    away = (normal * ray).sum(axis=-1, keepdims=True) > 0
    normal = np.where(away, -normal, normal)
    position = np.where(valid[..., None], ray * far[..., None], np.nan)
    normal = np.where(valid[..., None], normal, np.nan)
    return View(Surface(position, normal, valid), np.where(valid, first, -1))


def floor(ray):
    return plane(ray, (0, 1, 0), 1.0)


def wall(ray):
    return plane(ray, (0, 0, 1), 3.0)


def left(ray):
    return plane(ray, (-1, 0, 0), 1.5)


def ball(ray):
    return sphere(ray, (0.5, 0.5, 2.2), 0.5)


def front(ray):
    return within(plane(ray, (0, 0, 1), 2.0), ray, (-0.9, 0.3, 0), (-0.3, 1.0, 9))


def top(ray):
    return within(plane(ray, (0, 1, 0), 0.3), ray, (-0.9, 0, 2.0), (-0.3, 9, 2.6))


def pole(ray):
    """One column of pixels before the wall, and parallel to it."""
    far, normal = plane(ray, (0, 0, 1), 2.9)
    across = np.abs(np.arange(ray.shape[1]) - int(0.6 * ray.shape[1]))[None, :]
    return np.where(across < 0.5, far, np.inf), normal


ROOM = (floor, wall, left, ball, front, top)
CORNER = (floor, wall)


def light(position, normal, shade=None):
    """Irradiance phasors (2, n) of three virtual lights, one of them maybe in shade."""
    total = np.zeros((2, len(position)), complex)
    for number, lamp in enumerate(LAMPS_M):
        away = lamp - position
        far = np.linalg.norm(away, axis=1)
        value = np.maximum((away * normal).sum(axis=1), 0) / (far * (far**2 + 0.05))
        if shade is not None and number == 0:
            value = value * shade(position)
        total[0] += value * np.exp(1j * path_to_phase(far + 1 + 0.5 * number, FREQ_HZ))
        total[1] += value * np.exp(1j * path_to_phase(far + 1 + 0.5 * number, 2 * FREQ_HZ))
    return total


def soft(position):
    """A penumbra some 20 cm wide across floor and wall."""
    return 0.5 + 0.5 * np.tanh((position[:, 0] + 0.3 * position[:, 2] - 0.5) / 0.1)


def hard(position):
    return (position[:, 0] + 0.3 * position[:, 2] > 0.5).astype(float)


class Gather:
    """A gather that counts what it is asked for."""

    def __init__(self, view, field):
        self.surface, self.field, self.calls, self.asked = view.surface, field, 0, []

    def __call__(self, pixels):
        assert pixels.ndim == 1
        assert self.surface.valid.ravel()[pixels].all()
        self.calls += 1
        self.asked.append(pixels)
        position = self.surface.position.reshape(-1, 3)[pixels]
        return self.field(position, self.surface.normal.reshape(-1, 3)[pixels])


def metres(view, scale=1.0):
    """Error of range: that of the phase of irradiance on top of direct light of 1/range^2."""
    far = np.linalg.norm(view.surface.position, axis=-1).ravel()

    def errors_m(delta, pixels):
        direct = 1.0 / far[pixels] ** 2
        return scale * 0.1 * delta[0].imag / direct

    return errors_m


def placed(view, field, tol_m):
    """A plan, the gather that made it, and its true errors by pixel."""
    gather, errors_m = Gather(view, field), metres(view)
    plan = place(view.surface, gather, errors_m, tol_m)
    valid = np.flatnonzero(view.surface.valid)
    answer = spread(plan, plan.values).reshape(2, -1)[:, valid]
    truth = gather(valid)
    return plan, gather, errors_m(answer - truth, valid)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def lit(shade=None):
    return lambda position, normal: light(position, normal, shade)


SCENES = {
    "corner": (CORNER, lit()),
    "ball": ((wall, ball), lit()),
    "pole": ((wall, pole), lit()),
    "soft shadow": (ROOM, lit(soft)),
    "hard shadow": (ROOM, lit(hard)),
    "hard shadow in a corner": (CORNER, lit(hard)),
}


@pytest.mark.parametrize("tol_m", [1e-3, 3e-4])
@pytest.mark.parametrize("name", SCENES)
def test_error_is_below_the_tolerance_and_known(name, tol_m):
    things, field = SCENES[name]
    view = view_of(160, 120, *things)
    plan, _, error = placed(view, field, tol_m)
    assert rms(error) < tol_m
    assert plan.error_m < tol_m
    assert 0.5 * plan.error_m < rms(error) < 2 * plan.error_m
    assert len(plan.pixels) < 0.6 * view.surface.valid.sum()


def blind(_delta, pixels):
    """No error is ever seen, so that geometry alone keeps surfaces apart."""
    return np.zeros(len(pixels))


def marbles(ray):
    """Many small spheres before the wall, each some pixels wide."""
    y, x = np.mgrid[-0.9:1.0:0.16, -1.2:1.3:0.16]
    hits = [
        sphere(ray, centre, 0.02 + 0.01 * (number % 5))
        for number, centre in enumerate(zip(x.ravel(), y.ravel(), 2.5 + 0 * x.ravel(), strict=True))
    ]
    far = np.stack([far for far, _ in hits])
    first = far.argmin(axis=0)[None]
    normal = np.take_along_axis(np.stack([n for _, n in hits]), first[..., None], 0)[0]
    return far.min(axis=0), normal


@pytest.mark.parametrize("things", [ROOM, (wall, pole), (*ROOM, pole), (wall, ball)])
def test_surfaces_do_not_mix(things):
    view = view_of(160, 120, *things)
    names = view.object.ravel()
    plan = place(view.surface, lambda p: np.exp(1j * names[p])[None], blind, 1e-3)
    answer = spread(plan, plan.values)[0].ravel()
    np.testing.assert_allclose(answer, np.exp(1j * names), atol=1e-12)
    assert len(plan.pixels) < 0.25 * len(names)


def test_every_pixel_of_small_things_is_answered():
    view = view_of(160, 120, wall, marbles)
    names = view.object.ravel()
    plan = place(view.surface, lambda p: np.exp(1j * names[p])[None], blind, 1e-3)
    answer = spread(plan, plan.values)[0].ravel()
    np.testing.assert_allclose(answer, np.exp(1j * names), atol=1e-12)


def test_an_edge_is_followed_from_cell_to_cell():
    """Cells that were not split take errors over from their neighbours: fewer samples serve."""
    plan, _, error = placed(view_of(320, 240, *ROOM), lit(hard), 1e-3)
    assert rms(error) < 1e-3
    assert len(plan.pixels) < 4800


def test_each_pixel_is_asked_once_and_few_calls_are_made():
    _, gather, _ = placed(view_of(160, 120, *ROOM), lit(soft), 1e-3)
    asked = np.concatenate(gather.asked[:-1])  # the last call is the test's own
    assert len(np.unique(asked)) == len(asked)
    assert gather.calls < 16


def test_rows_sum_to_one_and_samples_answer_for_themselves():
    view = view_of(96, 72, wall, ball, pole)
    hole = np.ones((72, 96), bool)
    hole[10:40, 20:50] = False
    view.surface.position[~hole], view.surface.normal[~hole] = np.nan, np.nan
    surface = Surface(view.surface.position, view.surface.normal, hole)
    gather = Gather(View(surface, view.object), lit())
    plan = place(surface, gather, metres(view), 1e-3)
    total = np.asarray(plan.matrix.sum(axis=1)).reshape(72, 96)
    np.testing.assert_allclose(total, hole, atol=1e-9)
    answer = spread(plan, plan.values)
    assert np.isfinite(answer).all()
    assert (answer[:, ~hole] == 0).all()
    np.testing.assert_allclose(answer.reshape(2, -1)[:, plan.pixels], plan.values, atol=1e-15)
    np.testing.assert_allclose(plan.values, gather(plan.pixels), atol=1e-15)


@pytest.mark.parametrize("step", [1, 2])
def test_samples_grow_slower_than_pixels(step):
    small, large = (view_of(160 * k, 120 * k, *ROOM) for k in (step, 2 * step))
    for field, tol_m in ((lit(soft), 1e-3), (lit(hard), 1e-3)):
        counts = [len(placed(view, field, tol_m)[0].pixels) for view in (small, large)]
        assert counts[1] < 2 * counts[0]


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (3, 5), (4, 4), (5, 7), (17, 33)])
def test_small_images(size):
    view = view_of(size[1], size[0], wall)
    plan, _, error = placed(view, lit(), 1e-4)
    assert rms(error) <= 1e-4
    if min(size) < 4:
        assert len(plan.pixels) == size[0] * size[1]
        assert plan.error_m == 0


def test_no_tolerance_samples_all():
    view = view_of(40, 30, *ROOM)
    plan, gather, error = placed(view, lit(hard), 0.0)
    assert len(plan.pixels) == 1200
    assert gather.calls == 2
    assert plan.error_m == 0
    np.testing.assert_allclose(error, 0, atol=1e-15)


def test_nothing_to_see():
    blank = np.full((20, 30, 3), np.nan)

    def never(_pixels):
        raise AssertionError

    plan = place(Surface(blank, blank, np.zeros((20, 30), bool)), never, never, 1e-3)
    assert len(plan.pixels) == 0
    assert plan.error_m == 0
    assert (spread(plan, np.zeros((2, 0), complex)) == np.zeros((2, 20, 30))).all()


def test_pixels_without_any_light():
    """No light is no number or an infinite error; neither stops the rest."""
    view = view_of(64, 48, wall)
    gather, errors_m = Gather(view, lit()), metres(view)

    def odd(delta, pixels):
        error = errors_m(delta, pixels)
        error[pixels % 64 < 20] = np.nan
        error[pixels % 64 > 60] = np.inf
        return error

    plan = place(view.surface, gather, odd, 1e-3)
    assert plan.error_m < 1e-3
    assert (np.bincount(plan.pixels % 64, minlength=64)[61:] == 48).all()


def test_a_plan_serves_other_replicates():
    """Linear: what was placed with one field interpolates another of the same scene."""
    view = view_of(160, 120, *CORNER)
    plan, _, own = placed(view, lit(soft), 1e-3)
    assert rms(own) < 0.65e-3  # what the budget leaves of the tolerance
    position = view.surface.position.reshape(-1, 3)
    linear = (position @ [1.0, 2.0, 3.0])[None] + 0j
    answer = spread(plan, linear[:, plan.pixels]).reshape(1, -1)
    assert rms(np.abs(answer - linear)) < 1e-3 * np.ptp(linear.real)


def slow_bilinear(corners, y, x):
    """Weights of the corners (y0, x0), (y0, x1), (y1, x0), (y1, x1) one by one."""
    (y0, x0), (y1, x1) = corners
    weights = []
    for cy in (y0, y1):
        for cx in (x0, x1):
            tall = 1.0 if y1 == y0 else 1 - abs(y - cy) / (y1 - y0)
            wide = 1.0 if x1 == x0 else 1 - abs(x - cx) / (x1 - x0)
            weights.append(tall * wide)
    return weights


def test_bilinear_weights_against_the_slow_twin():
    shape = (15, 30)
    none, home = np.zeros(2), np.zeros(450, int)
    cells = Cells(np.array([0, 8]), np.array([16, 24]), np.array([8, 8]), none, none, home)
    for which, (low, high) in enumerate((((0, 16), (8, 24)), ((8, 24), (14, 29)))):
        for y in range(low[0], high[0] + 1):
            for x in range(low[1], high[1] + 1):
                target = np.array([y * 30 + x])
                corners, weights = bilinear(cells, np.array([which]), target, shape)
                np.testing.assert_allclose(weights[0], slow_bilinear((low, high), y, x), atol=1e-15)
                assert corners[0].tolist() == [
                    cy * 30 + cx for cy in (low[0], high[0]) for cx in (low[1], high[1])
                ]


def test_a_plane_that_faces_the_camera_is_bilinear():
    """Irradiance linear in place on a facing wall is linear in pixels: exact from four corners."""
    view = view_of(160, 120, wall)
    plan, _, error = placed(view, lambda p, _n: (1j * p @ [0.3, 0.2, 0.1])[None].repeat(2, 0), 1e-3)
    assert np.abs(error).max() < 1e-12
    inner = np.diff(plan.matrix.indptr)
    assert inner.max() <= 4
