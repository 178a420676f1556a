"""The engine radiosity against closed forms, the engine path, and what it says of itself.

Pixels of one seed share their virtual lights, so that errors are those of the spread over seeds.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from path_proof import ideal

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.phasor import wrapped_range_m
from toftools.sensors import sensor
from toftools.sim import shapes
from toftools.sim.path import path
from toftools.sim.radiosity import radiosity
from toftools.sim.scenes import from_dict, world_of
from toftools.sim.solids import box, material, plane, quad, sphere
from toftools.sim.world import World
from toftools.types import Emitter, Scene, Shot
from toftools.units import phase_to_range

EYE = ideal(16, 12, (20e6,), more=",hfov_deg=39.3077")
SMALL = ideal(12, 9, (20e6,), more=",hfov_deg=39.3077")
SEEDS, PATH_SEEDS, SIGMAS = 5, 8, 6.62
"""The limit is Student's t with 4 degrees of freedom at two-sided 0.27 %."""


def captures(engine, scene, device, seeds, **fields):
    scene = Scene(scene) if isinstance(scene, str) else scene
    run = engine(scene)
    return [run(Shot(device, seed=seed, noisy=False, **fields)) for seed in seeds]


def parts(capture, where=...):
    """Means over a region: one bounce, the rest, real and imaginary; charge, unmodulated too."""
    light = [np.asarray(getattr(capture.truth, name), np.complex128)[..., where].mean(axis=-1)
             for name in ("one_bounce", "rest")]  # fmt: skip
    charge = capture.taps.values.astype(np.float64)[..., where].mean(axis=(1, 2))
    return np.array([x for part in light for x in (part.real, part.imag)] + [charge])


def gap(ours, theirs):
    """Difference of means of two sets of rows over seeds, and its standard error."""
    off = np.mean(ours, axis=0) - np.mean(theirs, axis=0)
    error = np.hypot(*(np.std(x, axis=0, ddof=1) / np.sqrt(len(x)) for x in (ours, theirs)))
    return off, error


def agree(scene, device=SMALL, where=None, *, antialias=1, samples=512, paths=256, within=0.03,
          bounces=None):  # fmt: skip
    """Assert that indirect light is that of path, within standard errors that are small."""
    where = np.ones(device.camera.shape, bool) if where is None else where
    first, second = (partial(engine, antialias=antialias) for engine in (radiosity, path))
    made = captures(first, scene, device, range(SEEDS), samples=samples, max_bounces=bounces)
    theirs = captures(second, scene, device, range(100, 100 + PATH_SEEDS), samples=paths,
                      max_bounces=24 if bounces is None else bounces)  # fmt: skip
    ours, theirs = (np.array([parts(c, where) for c in some]) for some in (made, theirs))
    off, error = gap(ours, theirs)
    size = np.abs(np.mean(theirs, axis=0)[:4]).max()
    assert size > 0
    assert (np.abs(off) <= SIGMAS * error + 1e-5 * size).all(), (off / error, off / size)
    assert error[:4].max() < within * size, error / size
    return made


def rms_mm(capture, expected_m):
    """Error of measured range, wrapped, root mean square over the image."""
    freqs_hz = capture.sensor.modulation.freqs_hz
    found = wrapped_range_m(capture.phasors.values, freqs_hz)
    period_m = phase_to_range(2 * np.pi, freqs_hz)[:, None, None]
    off = (found - expected_m + period_m / 2) % period_m - period_m / 2
    return 1e3 * np.sqrt(np.mean(off**2, axis=(1, 2)))


def ranges_of(values, freqs_hz):
    return wrapped_range_m(np.asarray(values, np.complex64), freqs_hz)


# Closed forms


@pytest.mark.parametrize(("albedo", "tol_m"), [(0.3, 1e-3), (0.6, 2e-3), (0.9, 3e-3)])
def test_all_bounces_of_the_cavity_within_the_tolerance_asked_for(albedo, tol_m):
    device = ideal(12, 9, (20e6, 50e6))
    freqs_hz = device.modulation.freqs_hz
    (capture,) = captures(radiosity, Scene("cavity", {"albedo": albedo}), device, [1], tol_m=tol_m)
    exact = shapes.cavity(device.camera, albedo=albedo)
    expected = ranges_of([exact.phasor(f, None) for f in freqs_hz], freqs_hz)
    assert (rms_mm(capture, expected) <= 1e3 * tol_m).all()
    assert capture.provenance["tolerance_met"]
    assert capture.provenance["standard_error_mm"] <= 1e3 * tol_m


@pytest.mark.parametrize("albedo", [0.5, 0.9])
def test_energy_of_all_bounces_in_the_cavity(albedo):
    device = ideal(12, 9, (20e6,))
    made = captures(radiosity, Scene("cavity", {"albedo": albedo}), device, range(4), samples=1024)
    found = np.array([c.taps.values.mean(axis=(0, 1), dtype=np.float64).mean() for c in made])
    wanted = shapes.cavity(device.camera, albedo=albedo).phasor(20e6, None)
    phasors = np.array([c.phasors.values.mean(dtype=np.complex128) for c in made])
    error = np.sqrt(phasors.real.var(ddof=1) + phasors.imag.var(ddof=1)) / 2
    assert abs(phasors.mean() - wanted.mean()) < 9.2 * error + 1e-6  # t, 3 degrees of freedom
    assert error < 5e-3 * abs(wanted.mean())
    still = shapes.cavity(device.camera, albedo=albedo).phasor(0.0, None).real.mean()
    assert found.mean() == pytest.approx(still, rel=1e-2)


def test_the_corner_within_the_tolerance_asked_for():
    device = ideal(24, 18, (20e6, 50e6), more=",hfov_deg=50")
    (capture,) = captures(radiosity, "corner", device, [2], tol_m=1e-3, max_bounces=1)
    freqs_hz = device.modulation.freqs_hz
    exact = shapes.corner(device.camera)
    expected = ranges_of([exact.phasor(f, 1) for f in freqs_hz], freqs_hz)
    assert (rms_mm(capture, expected) <= 1.0).all()
    assert not capture.truth.rest.any()


def test_pixels_in_the_corner_are_not_darkened():
    """A clamped geometry term would lose the light of near pairs."""
    device = ideal(16, 6, (20e6,), more=",hfov_deg=4")
    made = captures(radiosity, "corner", device, range(2), samples=1024, max_bounces=1)
    found = np.mean([np.abs(c.truth.one_bounce[0]) for c in made], axis=0)
    exact = shapes.corner(device.camera)
    wanted = np.abs(exact.phasor(20e6, 1) - exact.phasor(20e6, 0))
    assert found[:, 7:9].mean() == pytest.approx(wanted[:, 7:9].mean(), rel=0.02)
    assert found == pytest.approx(wanted, rel=0.05)


def test_a_wall_has_no_indirect_light():
    device = ideal(8, 6)
    (capture,) = captures(radiosity, "wall", device, [0], tol_m=1e-3)
    exact = shapes.wall(device.camera)
    expected = np.array([exact.phasor(f, None) for f in device.modulation.freqs_hz])
    assert np.abs(capture.phasors.values - expected).max() < 2e-6 * np.abs(expected).max()
    assert not capture.truth.one_bounce.any() and not capture.truth.rest.any()
    assert capture.provenance["tolerance_met"]


# Against path


@pytest.mark.parametrize("bounces", [2, None])
def test_energy_of_the_cornell_box_is_that_of_path(bounces):
    made = agree("cornell", EYE, bounces=bounces)
    assert all(c.provenance["left_to_path"] == 0 for c in made)


def test_a_thin_gap_between_boxes():
    """What looks into a gap of 4 cm has light from walls nearer than virtual lights are apart."""
    white = material("diffuse", 0.8)
    between = World({
        "left": box([-0.33, 0, 2.3], [0.31, 0.5, 0.3], 0, white),
        "right": box([0.33, 0, 2.3], [0.31, 0.5, 0.3], 0, white),
        "back": plane([0, 0, 2.7], [9, 0, 0], [0, -9, 0], white),
    })  # fmt: skip
    agree(between, ideal(12, 3, (20e6,), more=",hfov_deg=2"), paths=512, within=0.1)


def test_light_from_outside_does_not_leak_into_gaps():
    """A pixel sees the floor 0.3 mm under a prism that hovers 0.1 mm above it: it is dark there."""
    scene = Scene("prism", {"range": 0.909, "albedo": 0.74})
    device, gap, beside = ideal(48, 36, (20e6,), more=",hfov_deg=45"), (29, 18), (29, 19)
    (ours,) = captures(radiosity, scene, device, [0], tol_m=4e-3)
    (theirs,) = captures(path, scene, device, [1], samples=128)
    mine, other = (np.abs(c.truth.one_bounce[0] + c.truth.rest[0]) for c in (ours, theirs))
    assert other[gap] < 0.25 * other[beside]
    assert abs(mine[gap] - other[gap]) < 0.1 * other[beside]


def test_textures_and_a_beam_from_aside_with_soft_pixels():
    beam = ideal(12, 9, (20e6,), more=",hfov_deg=39.3077,emitter=0.3+0+0,beam_deg=70")
    agree(Scene("cornell", {"material": "checker"}), beam, antialias=2)


SQUARE = sensor(
    "deeptof:width=12,height=9,freqs=20e6+60e6,hfov_deg=39.3077,waveform=square,contrast=0.7,signal_e=1"
)


def test_two_emitters_one_unmodulated_and_harmonics():
    lamps = (Emitter(), Emitter((0.2, 0.1, 0.0), strength=2.0, modulated=False))
    device = replace(SQUARE, emitters=lamps)
    agree("cornell", device)


# What is left to path

GREY = material("diffuse", 0.5)
BACK = plane([0, 0, 3], [9, 0, 0], [0, -9, 0], GREY)

BALL, RADIUS = np.array([0.2, -0.3, 2.5]), 0.35


@pytest.fixture
def mixed():
    """The Cornell box with a ball in the air, and the pixels that see it."""
    ball = sphere(BALL, RADIUS, material("plastic", 0.7))
    away = rays(SMALL.camera)
    near = away @ BALL
    sees = (near**2 - BALL @ BALL + RADIUS**2) > 0
    return World({**world_of(Scene("cornell")).description, "ball": ball}), sees


def test_pixels_that_see_no_diffuse_surface_are_left_to_path(mixed):
    world, sees = mixed
    assert 0.02 < sees.mean() < 0.5
    for capture in agree(world, where=~sees, samples=256, within=0.05):
        assert capture.provenance["left_to_path"] == pytest.approx(sees.mean())
        assert capture.provenance["left_why"] == "their surfaces are not diffuse"


def test_bounces_cannot_be_counted_past_a_mirror():
    world = World({**world_of(Scene("cornell")).description,
                   "ball": sphere(BALL, RADIUS, material("mirror", 0.7))})  # fmt: skip
    wholly_left(world, "not all surfaces are diffuse", max_bounces=1)


def test_bounces_cannot_be_counted_by_bent_normals():
    heights = np.random.default_rng(5).random((4, 4, 1), np.float32)
    bitmap = {"type": "bitmap", "bitmap": import_mitsuba().Bitmap(heights), "raw": True}
    bent = {"type": "bumpmap", "t": bitmap, "b": GREY}
    world = World({"back": BACK, "box": box([0.4, 0, 2], [0.3, 0.3, 0.3], 0, bent)})
    wholly_left(world, "not all surfaces are diffuse", max_bounces=1)


def wholly_left(world, why, **fields):
    (ours,), (theirs,) = (
        captures(engine, world, SMALL, [4], samples=16, **fields) for engine in (radiosity, path)
    )
    assert ours.provenance["left_to_path"] == 1
    assert why in ours.provenance["left_why"]
    size = np.abs(theirs.phasors.values).max()
    assert np.abs(ours.phasors.values - theirs.phasors.values).max() < 1e-5 * size


LEAVES = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "to_uv": np.diag([6.0, 6, 1, 1])}


@pytest.mark.parametrize("opacity", [LEAVES, 0.5])
def test_light_through_holes_and_veils(opacity):
    """A panel before the boxes: pixels beside it, and behind its holes, need no path."""
    paint = {"type": "mask", "opacity": opacity, "n": material("diffuse", 0.7)}
    boxes = world_of(Scene("cornell")).description
    panel = quad(
        [0, 0.1, boxes["small"]["to_world"][2, 3] - 0.3], [0.5, 0, 0.3], [0, -0.6, 0], paint
    )
    world = World({**boxes, "panel": panel})
    (first,) = captures(radiosity, world, SMALL, [0], samples=16)
    assert 0.05 < first.provenance["left_to_path"] < 0.4
    away = rays(SMALL.camera)
    agree(world, where=away[..., 1] > 0.2, paths=512)


def test_where_little_is_diffuse_all_is_left_to_path():
    shiny = quad([0, 0, 2], [0.6, 0, 0], [0, -0.9, 0], material("plastic", 0.5))
    wholly_left(World({"back": BACK, "shiny": shiny}), "not diffuse", max_bounces=None)


def test_lamps_behind_holes_are_left_to_path():
    veil = quad([0, 0, 2], [0.4, 0, 0], [0, -0.4, 0], {"type": "mask", "opacity": 0.5, "n": GREY})
    lamp = {**sphere([0.5, -0.5, 2], 0.1, GREY), "emitter": {"type": "area", "radiance": 1.0}}
    world = from_dict({"back": BACK, "veil": veil, "lamp": lamp}, to_world=np.eye(4), lamp_gain=1)
    wholly_left(world, "lamps shine")


def test_modulated_lamps_are_left_to_path():
    lamp = {**sphere([0.5, -0.5, 2], 0.1, GREY), "emitter": {"type": "area", "radiance": 1.0}}
    lit = from_dict({"back": BACK, "lamp": lamp}, modulated_s={"lamp": 0.0}, to_world=np.eye(4))
    wholly_left(lit, "modulated", max_bounces=2)


# Requests at the edge


def test_lamps_where_no_pixel_sees_a_diffuse_surface():
    shiny = plane([0, 0, 3], [9, 0, 0], [0, -9, 0], material("plastic", 0.5))
    lamp = {**sphere([0, 0, -2], 0.1, GREY), "emitter": {"type": "area", "radiance": 1.0}}
    world = from_dict({"back": shiny, "lamp": lamp}, to_world=np.eye(4))
    ours, theirs = (
        captures(engine, world, ideal(4, 3), [4], samples=16)[0] for engine in (radiosity, path)
    )
    assert ours.provenance["left_to_path"] == 1
    assert np.array_equal(ours.truth.direct, theirs.truth.direct)


def test_a_shiny_thing_may_come_into_view_later():
    ball = sphere([-1.6, 0, 2], 0.3, material("plastic", 0.5))
    world = from_dict({"back": BACK, "ball": ball}, to_world=np.eye(4),
                      velocity_mps={"ball": (20.0, 0, 0)})  # fmt: skip
    device = ideal(6, 4, (20e6,), more=",hfov_deg=39.3077,tap_interval_s=0.02")
    (capture,) = captures(radiosity, world, device, [4], samples=16)
    assert np.isfinite(capture.taps.values).all()


def test_nothing_is_seen():
    aside = World({"box": box([900, 0, 2], [0.3, 0.3, 0.3], 0, GREY)})
    (capture,) = captures(radiosity, aside, ideal(4, 3), [0], tol_m=1e-3)
    assert not np.isfinite(capture.truth.range_m).any()
    assert not capture.taps.values.any()


@pytest.mark.parametrize("fields", [{"tol_m": 10.0}, {"samples": 1}, {"samples": 1, "tol_m": 1e-9}])
def test_a_single_pixel_and_odd_orders(fields):
    (capture,) = captures(radiosity, "cornell", ideal(1, 1, (20e6,)), [0], **fields)
    assert np.isfinite(capture.phasors.values).all()
    assert capture.truth.one_bounce.any()
    assert np.isfinite(capture.provenance["standard_error_mm"])


def test_same_seed_same_light_and_other_seed_other_light():
    first, again, other = captures(radiosity, "cornell", SMALL, [3, 3, 4], samples=256)
    size = np.abs(first.phasors.values).max()
    assert np.abs(first.phasors.values - again.phasors.values).max() < 1e-6 * size
    assert np.abs(first.phasors.values - other.phasors.values).max() > 1e-5 * size
    assert np.abs(first.truth.direct - other.truth.direct).max() == 0


@pytest.mark.parametrize("wrong", [{"antialias": 0}, {"max_samples": 0}])
def test_bad_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        radiosity(Scene("cornell"), **wrong)


def test_more_lights_than_there_are_directions_are_refused():
    with pytest.raises(ValueError, match=r"at most 65536 virtual lights .* got 65537"):
        captures(radiosity, "cornell", ideal(4, 3), [0], samples=65537)
