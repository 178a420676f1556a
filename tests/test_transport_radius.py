"""Spectral radius of transport: closed forms, and the eigenvalues of a dense matrix."""

import numpy as np
import pytest

from toftools._transfer import Patches
from toftools.camera import rays
from toftools.correct._scene import optics, surface
from toftools.correct._transport_radius import radius_of, spectral_radius
from toftools.correct.fuchs2010 import fuchs2010
from toftools.registry import SIMULATORS
from toftools.sensors import sensor
from toftools.types import DepthMap, Phasors, Scene, Shot


def cavity(count, radius_m=2.0):
    """A sphere seen from inside, in patches of one area along a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * (np.arange(count) + 0.5)
    out = np.sqrt(1 - z * z)
    outward = np.stack([out * np.cos(turn), out * np.sin(turn), z]).astype(np.float32)
    area = np.full(count, 4 * np.pi * radius_m**2 / count, np.float32)
    return Patches(radius_m * outward, -outward, area)


def dense(patches, albedo, freq_hz=0.0):
    """Transport as a matrix, entry by entry."""
    at, n, a = (np.asarray(x, np.float64) for x in
                (patches.position, patches.normal, patches.area_m2))  # fmt: skip
    found = np.zeros((a.size, a.size), np.complex128)
    for u in range(a.size):
        way = at - at[:, u : u + 1]
        r2 = np.sum(way * way, axis=0)
        here, there = np.maximum(n[:, u] @ way, 0), np.maximum(-np.sum(n * way, axis=0), 0)
        factor = here * there * a / (np.maximum(r2, 1e-30) * (np.pi * r2 + a))
        found[u] = albedo[u] * factor * np.exp(2j * np.pi * freq_hz * np.sqrt(r2) / 299_792_458.0)
    return found


def eigen_radius(matrix):
    return np.abs(np.linalg.eigvals(matrix)).max()


def corner(angle=90, size="opt8241:width=24,height=18", edge_m=2.0):
    """Two half planes with an upright edge on the axis that open towards the camera."""
    device, half = sensor(size), np.radians(angle) / 2
    way = rays(device.camera)
    walls = [way @ [side * np.cos(half), 0, np.sin(half)] for side in (-1, 1)]
    return device, (edge_m * np.sin(half) / np.maximum(*walls)).astype(np.float32)


def answer(range_m, albedo):
    return DepthMap(range_m, info={"albedo": np.full(range_m.shape, albedo, np.float32)})


@pytest.mark.parametrize("albedo", [0.2, 0.9])
def test_a_closed_sphere_keeps_the_share_of_its_albedo(albedo):
    # Every place of a sphere sees every other with one form factor. The area that `_transfer` adds
    # in its denominator takes off the mean of A / (pi r^2 + A); r^2 is uniform up to 4 R^2, which
    # makes ln(1 + n) / n of n patches.
    found = radius_of(cavity(1000), np.full(1000, albedo, np.float32))
    assert found == pytest.approx(albedo * (1 - np.log(1001) / 1000), rel=1e-3)


def test_light_that_only_goes_to_and_fro_has_a_radius_too():
    # Two squares of unlike size face each other: eigenvalues r and -r, between which single
    # bounces would swing.
    side = (np.arange(6) - 2.5) / 6
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    small, large = (
        np.stack([scale * x, scale * y, np.full_like(x, z)]) for scale, z in ((1, 0), (3, 0.5))
    )
    at = np.concatenate([small, large], axis=1).astype(np.float32)
    normal = np.repeat(np.array([[0, 0], [0, 0], [1, -1.0]]), 36, axis=1).astype(np.float32)
    plates = Patches(at, normal, np.repeat(np.array([1, 9], np.float32) / 36, 36))
    albedo = np.repeat(np.array([0.9, 0.3], np.float32), 36)
    wanted = np.linalg.eigvals(dense(plates, albedo))
    assert wanted.real.min() == pytest.approx(-np.abs(wanted).max(), rel=1e-6)
    assert radius_of(plates, albedo) == pytest.approx(np.abs(wanted).max(), rel=1e-3)


def test_it_is_the_largest_eigenvalue_of_the_transport_of_a_frame():
    device, range_m = corner(60)
    albedo = np.random.default_rng(1).uniform(0.2, 0.9, range_m.shape).astype(np.float32)
    seen = surface(optics(device), range_m)
    which = seen.flat
    pixels = Patches(seen.position[:, which], seen.normal[:, which], seen.area_m2[which])
    still = eigen_radius(dense(pixels, albedo[which]))
    found = spectral_radius(device, DepthMap(range_m, info={"albedo": albedo}))
    assert 0.05 < found == pytest.approx(still, rel=1e-3)
    assert eigen_radius(dense(pixels, albedo[which], 70e6)) < still, "phases make it smaller"


def test_a_wedge_stays_below_its_form_factor():
    # A point on one half plane sees the other, at an angle a, with (1 + cos a) / 2.
    for angle in (60, 110):
        device, range_m = corner(angle, "opt8241:width=40,height=30")
        limit = (1 + np.cos(np.radians(angle))) / 2
        found = spectral_radius(device, answer(range_m, 0.8))
        assert 0.2 * limit < found / 0.8 < limit
        half = spectral_radius(device, answer(range_m, 0.4))
        assert half == pytest.approx(found / 2, rel=1e-3)


def test_merged_blocks_change_little():
    small, large = (
        spectral_radius(*with_albedo(corner(90, f"opt8241:width={w},height={h}")))
        for w, h in ((40, 30), (80, 60))
    )
    assert small == pytest.approx(large, rel=0.1)


def with_albedo(pair):
    return pair[0], answer(pair[1], 0.8)


def test_what_reflects_nothing_and_what_is_not_believed():
    device, range_m = corner()
    assert spectral_radius(device, answer(range_m, np.nan)) == 0
    assert spectral_radius(device, answer(range_m, 0.0)) == 0
    most = spectral_radius(device, answer(range_m, 1.5))
    assert spectral_radius(device, answer(range_m, np.inf)) == pytest.approx(most, rel=1e-6)
    assert np.isnan(spectral_radius(device, answer(np.full_like(range_m, np.nan), 0.5)))
    with pytest.raises(ValueError, match=r"wanted info\['albedo'\] \(18, 24\) of numbers"):
        spectral_radius(device, DepthMap(range_m))
    with pytest.raises(ValueError, match="take a method that models the transport"):
        spectral_radius(device, DepthMap(range_m, info={"albedo": np.ones(3, np.float32)}))


def test_the_answer_of_a_method_has_the_radius_of_the_truth():
    # Where a crease drowns in noise, normals next to it are not trusted, and the strongest light
    # there is not counted; so sigma is as small here as the noise, which is none.
    device = sensor("opt8241:width=24,height=18")
    scene = Scene("corner", {"angle": 90, "range": 2, "albedo": 0.6})
    capture = SIMULATORS["analytic"].build(scene)(Shot(device, noisy=False))
    phasors = Phasors(capture.phasors.values, 1e-3 * capture.phasors.sigma)
    found = spectral_radius(device, fuchs2010(device)(phasors))
    wanted = spectral_radius(device, answer(capture.truth.range_m, 0.6))
    assert found == pytest.approx(wanted, rel=0.15)
