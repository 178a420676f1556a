"""The pairwise phasor transfer kernel and the surfaces it is fed with."""

import numpy as np
import pytest
from reference_fuchs import transfer

from toftools._transfer import Patches, gather, sincos
from toftools.camera import rays
from toftools.correct._scene import lit, optics, patches, radiosity, surface
from toftools.registry import SIMULATORS
from toftools.sensors import sensor as preset
from toftools.types import Scene, Shot
from toftools.units import path_to_phase

FREQS = np.array([20e6, 70e6, 120e6])


def random_patches(n, seed):
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal((3, n))
    normal /= np.linalg.norm(normal, axis=0)
    place = rng.uniform(-2, 2, (3, n))
    return Patches(
        place.astype(np.float32),
        normal.astype(np.float32),
        rng.uniform(1e-4, 1e-2, n).astype(np.float32),
    )


def test_kernel_agrees_with_its_twin():
    here, there = random_patches(37, 0), random_patches(1025, 1)
    rng = np.random.default_rng(2)
    light = rng.standard_normal((3, 1025)) + 1j * rng.standard_normal((3, 1025))
    got = gather(here, there, light, FREQS)
    for f, freq_hz in enumerate(FREQS):
        pairs = transfer(
            here.position.astype(float), here.normal, there.position.astype(float), there.normal,
            there.area_m2, freq_hz,
        )  # fmt: skip
        want = pairs @ light[f].astype(np.complex64)
        scale = np.abs(pairs) @ np.abs(light[f])  # sums of signed terms: errors relative to this
        assert (np.abs(got[f] - want) < 5e-6 * scale + 1e-12).all()


def test_polynomials_are_sine_and_cosine():
    turns = np.linspace(-3, 3, 20_001).astype(np.float32)
    table = np.array([sincos.py_func(t) for t in turns])
    angle = 2 * np.pi * turns.astype(float)
    assert np.abs(table[:, 0] - np.sin(angle)).max() < 2e-6
    assert np.abs(table[:, 1] - np.cos(angle)).max() < 2e-6


def test_patches_exchange_light_both_ways_alike():
    a, b = random_patches(1, 3), random_patches(1, 4)
    b = Patches(b.position, (a.position - b.position) / 3, b.area_m2)
    a = Patches(a.position, -b.normal, b.area_m2)
    one = np.ones((1, 1), np.complex64)
    assert gather(a, b, one, FREQS[:1]) == pytest.approx(gather(b, a, one, FREQS[:1]), rel=1e-5)


def test_a_disc_on_the_axis_is_exact_at_any_distance():
    up = np.array([[0.0], [0.0], [1.0]], np.float32)
    radius = 0.5
    for height in (0.01, 0.3, 4.0):
        disc = Patches(height * up, -up, np.full(1, np.pi * radius**2, np.float32))
        here = Patches(0 * up, up, np.ones(1, np.float32))
        got = gather(here, disc, np.ones((1, 1), np.complex64), np.zeros(1))[0, 0]
        assert got.real == pytest.approx(radius**2 / (radius**2 + height**2), rel=1e-5)


def test_absolute_scale_against_the_closed_form_of_a_corner():
    camera = preset("opt8241:width=80,height=60")
    scene = Scene(
        "corner", {"angle": 90.0, "range": 2.0, "albedo": 0.8, "size": 0.9, "height": 1.0}
    )
    capture = SIMULATORS["analytic"].build(scene)(Shot(camera, noisy=False))
    truth = capture.truth
    view = optics(camera)
    seen = surface(view, truth.range_m)
    flat = seen.flat
    albedo = np.abs(truth.direct) / lit(view, seen)
    assert np.abs(albedo[:, flat] - 0.8).max() < 1e-4
    light = radiosity(view, truth.direct[:, flat], truth.range_m[flat])
    some = patches(seen, flat)
    turn = np.exp(1j * path_to_phase(truth.range_m[flat], view.freqs_hz[:, None]))
    got = 0.8 * gather(some, some, light, view.freqs_hz) * turn
    want = (capture.phasors.values - truth.direct)[:, flat]
    columns = np.broadcast_to(np.arange(80), (60, 80))[flat]
    inner = np.abs(columns - camera.camera.K[0, 2]) > 2  # not the two columns at the crease
    ratio = (got / want)[:, inner]
    assert np.abs(np.abs(ratio) - 1).max() < 0.04
    assert np.abs(np.median(np.abs(ratio)) - 1) < 0.004
    assert np.abs(np.angle(ratio)).max() < 0.005


def test_planes_are_exact_up_to_their_edge():
    camera = preset("opt8241:width=40,height=30")
    way = rays(camera.camera)
    range_m = 2.0 / (way[..., 2] + np.abs(way[..., 0]))
    seen = surface(optics(camera), range_m.astype(np.float32))
    want = np.stack([-np.sign(way[..., 0]), 0 * way[..., 0], -np.ones((30, 40))]) / np.sqrt(2)
    off_edge = np.abs(way[..., 0]) > 1e-6
    assert np.abs(seen.normal - want)[:, off_edge].max() < 1e-3
    assert np.abs(seen.position - np.moveaxis(way * range_m[..., None], -1, 0)).max() < 1e-5
    assert seen.flat[off_edge].all()


def test_unknown_pixels_have_no_surface():
    camera = preset("opt8241:width=12,height=9")
    range_m = np.full((9, 12), 2.0, np.float32)
    range_m[4, 5] = np.nan
    seen = surface(optics(camera), range_m)
    assert not seen.known[4, 5]
    assert seen.known.sum() == 107
    assert not seen.flat[4, 5]
    assert np.isfinite(seen.position).all()
    assert np.isfinite(seen.area_m2).all()
