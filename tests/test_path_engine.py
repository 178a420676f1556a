"""The path engine as a camera: sources, lens, motion, waveforms, and what it says of its errors."""

from dataclasses import replace

import numpy as np
import pytest
import reference_transport as exact
from path_proof import DARK, agree, averaged, fact, ideal, offset, phasors, prove, shots

from toftools._native import import_mitsuba
from toftools._overrides import spot
from toftools.camera import pinhole, rays, resized
from toftools.phasor import wrapped_range_m
from toftools.sensors import sensor
from toftools.sim._views import FINER, UNLIKE
from toftools.sim.analytic import analytic
from toftools.sim.path import path
from toftools.sim.scenes import world_of
from toftools.sim.solids import quad
from toftools.sim.world import World
from toftools.types import Camera, Emitter, Scene, Shot
from toftools.units import path_to_phase, phase_to_range

# Direct light is exact but for single precision: 24 bits of paths of metres, seen at 100 MHz.
FLOAT32 = 1e-5
BLACK = {"type": "diffuse", "reflectance": 0.0}
GREY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def world(name, **params):
    return world_of(Scene(name, params))


def range_errors_m(values, freqs_hz):
    """Errors (S, H, W) of the range that phasors (S, F, H, W) give together, about their mean."""
    mean = values.mean(axis=0)
    moved = phase_to_range(np.angle(values * np.conj(mean)), freqs_hz[:, None, None])
    # Least squares under noise that is alike at all frequencies.
    weights = (np.abs(mean) * freqs_hz[:, None, None]) ** 2
    return (moved * weights).sum(axis=1) / weights.sum(axis=0)


# Scene files: near plane, lamps, orientation

WALL = """<scene version="3.0.0">
<sensor type="perspective"><float name="near_clip" value="{near}"/><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="1,2,3" target="1,2,5" up="0,1,0"/></transform></sensor>
<shape type="rectangle" id="wall"><transform name="to_world"><scale value="20"/>
<rotate y="1" angle="180"/><translate x="1" y="2" z="5"/></transform>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></shape>
{lamp}</scene>"""
AMBIENT = {
    "none": "",
    "constant": '<emitter type="constant"><spectrum name="radiance" value="0.5"/></emitter>',
    "directional": '<emitter type="directional"><vector name="direction" x="0.2" y="-0.3" z="1"/>'
    '<spectrum name="irradiance" value="0.5"/></emitter>',
    "area": '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/>'
    '<translate x="1" y="4" z="4"/></transform><bsdf type="diffuse"><spectrum name="reflectance" '
    'value="0"/></bsdf><emitter type="area"><spectrum name="radiance" value="3"/></emitter>'
    "</shape>",
}  # fmt: skip


@pytest.mark.parametrize("lamp", AMBIENT)
@pytest.mark.parametrize("near", [1e-4, 0.01, 0.1])
def test_a_wall_at_two_metres_reads_two_metres(tmp_path, near, lamp, record_property):
    file = tmp_path / "wall.xml"
    file.write_text(WALL.format(near=near, lamp=AMBIENT[lamp]), encoding="utf-8")
    device = ideal(9, 7, (20e6,), more=",hfov_deg=40")
    capture = path(Scene(str(file), {"lamps": 1.0}))(Shot(device, samples=64, noisy=False))
    read_m = wrapped_range_m(capture.phasors.values, device.modulation.freqs_hz)[0]
    true_m = 2 / rays(device.camera)[..., 2]
    most_mm = 1e3 * np.abs(read_m - true_m).max()
    fact(record_property, "wall at 2 m", f"ambient lamp: {lamp}; near_clip {near:g} m",
         "2.0000 m, every pixel within 0.05 mm",
         f"{read_m[3, 4]:.5f} m, off by at most {most_mm:.4f} mm")  # fmt: skip
    assert np.abs(read_m - true_m).max() < 5e-5
    assert np.abs(capture.truth.range_m - true_m).max() < 1e-5
    flash = 0.5 * rays(device.camera)[..., 2] ** 3 / 4
    assert (offset([capture])[0] > flash * (1.02 if AMBIENT[lamp] else 0.99)).all()


LOPSIDED = """<scene version="3.0.0">
<sensor type="perspective"><float name="near_clip" value="0.5"/><float name="fov" value="50"/>
<transform name="to_world"><lookat origin="3,1,-2" target="0.5,0.3,1" up="0.2,1,0.1"/></transform>
<film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="18"/>
<rfilter type="box"/></film></sensor>
<shape type="sphere"><point name="center" x="0" y="0" z="1"/><float name="radius" value="0.7"/>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.9"/></bsdf></shape>
<shape type="cube"><transform name="to_world"><scale value="0.4"/>
<translate x="1.2" y="1" z="0.5"/></transform>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.2"/></bsdf></shape>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
<translate y="-0.7"/></transform>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></shape>
<emitter type="directional"><vector name="direction" x="-0.5" y="-1" z="0.7"/>
<spectrum name="irradiance" value="2"/></emitter></scene>"""


def test_the_picture_stands_as_mitsuba_renders_it(tmp_path):
    mi = import_mitsuba()
    file = tmp_path / "lopsided.xml"
    file.write_text(LOPSIDED, encoding="utf-8")
    scene = mi.load_file(str(file))
    theirs = np.asarray(mi.render(scene, spp=1024, integrator=mi.load_dict({"type": "direct"})))
    device = ideal(24, 18, (20e6,), more=",hfov_deg=50", emitters=(DARK,))
    run = path(Scene(str(file), {"lamps": 1.0}), antialias=8)
    ours = offset([run(Shot(device, samples=64, max_bounces=0, noisy=False))])[0]
    theirs = theirs[..., 0].astype(np.float64)
    # Edges of things and shadows differ: 64 points a pixel against 1024 random ones.
    assert np.abs(ours - theirs).mean() < 0.01 * theirs.mean()
    assert (np.abs(ours - theirs) < 1e-4 * theirs.mean()).mean() > 0.7
    for wrong in (ours[::-1], ours[:, ::-1], ours[::-1, ::-1]):
        assert np.abs(wrong - theirs).mean() > 0.2 * theirs.mean()


# Sources off the camera


def lit_by(source, at, normal, albedo):
    """Light of one source by way of points, seen from the origin: strength (H, W) and path, m."""
    to = np.asarray(source.offset_m) - at
    far = np.linalg.norm(to, axis=-1)
    strength = albedo * source.strength * (to @ normal) / far**3
    if source.beam is not None:
        angle = np.degrees(np.arccos(-to[..., 2] / far))
        strength = strength * np.interp(angle, source.beam[:, 0], source.beam[:, 1], right=0.0)
    return strength, far + np.linalg.norm(at, axis=-1)


SIDE = (0.3, -0.1, 0.05)
SOURCES = {
    "aside": (Emitter(SIDE),),
    "spot": (Emitter(SIDE, beam=spot(50.0)),),
    "profile": (Emitter((0.0, 0.0, 0.0), beam=np.array([[0, 1.0], [10, 0.7], [30, 0.1]])),),
    "late": (Emitter(SIDE, delay_s=2e-9),),
    "two": (Emitter(SIDE, strength=0.4, delay_s=-1e-9), Emitter((-0.2, 0.1, 0.0), spot(70.0))),
    "steady": (Emitter(), Emitter(SIDE, strength=2.0, modulated=False)),
}


@pytest.mark.parametrize("name", SOURCES)
def test_sources_by_geometry(name):
    device = ideal(16, 12, more=",hfov_deg=60", emitters=SOURCES[name])
    captures = shots("tilted", device, [0], max_bounces=0)
    normal = np.array([-np.sin(np.radians(30)), 0.0, -np.cos(np.radians(30))])
    views = rays(device.camera)
    at = views * ((2 * normal[2]) / (views @ normal))[..., None]
    expected, mean = np.zeros((3, 12, 16), complex), np.zeros((12, 16))
    for source in SOURCES[name]:
        strength, path_m = lit_by(source, at, normal, 0.5)
        mean += strength
        for i, freq in enumerate(device.modulation.freqs_hz if source.modulated else ()):
            phase = path_to_phase(path_m, freq) + 2 * np.pi * freq * source.delay_s
            expected[i] += strength * np.exp(1j * phase)
    # A beam is looked up in 2048 steps: kinks of its table are cut by 0.1 degrees.
    loose = 3e-3 if name in ("spot", "profile", "two") else FLOAT32
    assert np.abs(phasors(captures)[0] - expected).max() < loose * np.abs(expected).max()
    assert np.abs(offset(captures)[0] - mean).max() < loose * mean.max()
    assert (mean[:, :2] < 1e-9).any() == (name in ("spot", "profile")), (
        "beams end within the picture"
    )


def test_an_offset_source_throws_shadows():
    device = ideal(48, 36, (20e6,), more=",hfov_deg=60", emitters=(Emitter((0.4, 0.0, 0.0)),))
    scene = world("wall", albedo=0.5)
    thing = quad([0, 0, 1.2], [0.1, 0, 0], [0, -0.1, 0], GREY)
    scene = replace(scene, description={**scene.description, "thing": thing})
    light = np.abs(phasors(shots(scene, device, [0], max_bounces=0))[0, 0])
    views = rays(device.camera)
    on_thing = np.abs(views[..., :2] * (1.2 / views[..., 2:])).max(axis=-1) < 0.1
    wall = views * (2 / views[..., 2:])
    crossing = [0.4, 0, 0] + (wall - [0.4, 0, 0]) * (1.2 / 2)
    dark = (np.abs(crossing[..., :2]).max(axis=-1) < 0.1) & ~on_thing
    assert dark.sum() > 10 and np.array_equal(light == 0, dark)


# Pixels have an area


def test_antialiasing_averages_the_light_over_a_pixel():
    device = ideal(40, 30, more=",hfov_deg=37")
    shot = {"noisy": False, "max_bounces": 0}
    whole = path(Scene("cornell"), antialias=3)(Shot(device, **shot)).truth.direct
    means = []
    for side in (3, 3 * FINER):
        fine = replace(device, camera=resized(device.camera, 40 * side, 30 * side))
        parts = path(Scene("cornell"))(Shot(fine, **shot)).truth.direct.astype(np.complex128)
        parts = parts.reshape(3, 30, side, 40, side)
        means.append((parts, parts.mean(axis=(2, 4))))
    (points, coarse), (_, finer) = means
    spread = np.abs(points - coarse[:, :, None, :, None]).max(axis=(2, 4))
    edge = (spread > UNLIKE * np.abs(coarse)).any(axis=0)
    assert 0.1 < edge.mean() < 0.9, "pixels of both kinds"
    mean = np.where(edge, finer, coarse)
    assert np.abs(whole - mean).max() < 1e-6 * np.abs(mean).max()


def test_a_pixel_across_an_edge_sums_both_walls():
    device = ideal(5, 3, more=",hfov_deg=40")
    camera = device.camera
    # The near wall ends 3/8 into the middle pixel.
    edge = (2 - 0.5 + 3 / 8 - camera.K[0, 2]) / camera.K[0, 0]
    near = quad([edge - 2, 0, 1], [2, 0, 0], [0, -2, 0], GREY)
    scene = World({**world("wall", range=2.0, albedo=0.9).description, "near": near})
    seen = path(scene, antialias=8)(Shot(device, noisy=False, max_bounces=0))
    across = seen.truth.direct[:, 1, 2]
    side = 8 * FINER  # the grid of a pixel whose points differ
    views = rays(resized(camera, 5 * side, 3 * side))[side : 2 * side, 2 * side : 3 * side]
    parts = {}
    for depth, albedo, columns in (
        (1.0, 0.5, slice(0, 3 * side // 8)),
        (2.0, 0.9, slice(3 * side // 8, side)),
    ):
        at = views[:, columns] * (depth / views[:, columns, 2:])
        strength, path_m = lit_by(Emitter(), at, np.array([0, 0, -1.0]), albedo)
        turn = np.exp(1j * path_to_phase(path_m, device.modulation.freqs_hz[:, None, None]))
        parts[depth] = (strength * turn).mean(axis=(1, 2))
    expected = 3 / 8 * parts[1.0] + 5 / 8 * parts[2.0]
    assert np.abs(across - expected).max() < FLOAT32 * np.abs(expected).max()


def test_indirect_light_is_averaged_over_a_pixel_too(record_property):
    device, few = ideal(8, 6, more=",hfov_deg=37"), {"noisy": False, "max_bounces": 2}
    fine = replace(device, camera=resized(device.camera, 24, 18))
    whole, parts = path(Scene("cornell"), antialias=3), path(Scene("cornell"))
    seeds = range(1000, 1008)
    whole = [whole(Shot(device, seed=seed, samples=144, **few)).truth for seed in seeds]
    parts = [parts(Shot(fine, seed=seed, samples=16, **few)).truth for seed in seeds]
    for part in ("one_bounce", "rest"):
        one, other = (
            np.array([getattr(t, part) for t in truths], np.complex128) for truths in (whole, parts)
        )
        split = other.reshape(8, 3, 6, 3, 8, 3).mean(axis=(3, 5))
        name = "Cornell box, 3 x 3 points a pixel"
        agree(record_property, name, f"{part}, as from a finer picture", one, split)


# What it says of its own errors


@pytest.fixture(scope="module")
def repeated():
    """One tile of the Cornell box with 64 paths a pixel under many seeds."""
    device = ideal(16, 16, (20e6, 50e6), more=",hfov_deg=37")
    return device, shots("cornell", device, range(100, 132), samples=64, max_bounces=4)


def test_the_standard_error_is_the_real_scatter(repeated, record_property):
    device, captures = repeated
    errors = range_errors_m(phasors(captures), device.modulation.freqs_hz)
    count = len(captures)
    real = (errors**2).mean(axis=(1, 2)) * count / (count - 1)
    told = np.array([1e-3 * c.provenance["standard_error_mm"] for c in captures]) ** 2
    gap = averaged((real - told)[:, None])
    fact(record_property, "Cornell box, 64 paths", "standard error told, scatter over 32 seeds",
         "equal within 3 standard errors",
         f"{1e3 * np.sqrt(told.mean()):.2f} mm told, {1e3 * np.sqrt(real.mean()):.2f} mm real, "
         f"{gap.value[0] / gap.error[0]:+.1f} standard errors apart")  # fmt: skip
    assert abs(gap.value[0]) < 3 * gap.error[0]
    assert gap.error[0] < 0.1 * told.mean(), "the test can tell"


def test_seeds_are_independent_and_repeat(repeated):
    device, captures = repeated
    again = shots("cornell", device, [105], samples=64, max_bounces=4)[0]
    assert np.array_equal(again.taps.values, captures[5].taps.values)
    light = np.array([c.truth.one_bounce[0] + c.truth.rest[0] for c in captures])
    rest = (light - light.mean(axis=0)).reshape(len(captures), -1)
    rest /= np.sqrt((np.abs(rest) ** 2).mean(axis=0))
    together = np.real(rest @ rest.conj().T) / rest.shape[1]
    others = together[np.triu_indices(len(captures), 1)]
    # Taking out the mean of n makes pairs correlate by -1 / (n - 1).
    scatter = others.std() / np.sqrt(others.size)
    assert abs(others.mean() + 1 / (len(captures) - 1)) < 3 * scatter
    assert np.abs(others).max() < 6 * others.std()


@pytest.mark.parametrize("tol_m", [9e-3, 5e-3])
def test_a_tolerance_that_is_met_is_met(tol_m, record_property):
    device = ideal(32, 16, (50e6,), more=",hfov_deg=37")
    captures = shots("cornell", device, range(100, 108), tol_m=tol_m, max_bounces=3)
    told = [c.provenance for c in captures]
    assert all(p["tolerance_met"] and p["standard_error_mm"] <= 1e3 * tol_m for p in told)
    errors = range_errors_m(phasors(captures), device.modulation.freqs_hz)
    tiles = (errors**2).reshape(8, 16, 2, 16).mean(axis=(1, 3)) * 8 / 7  # (S, tile)
    real, doubt = averaged(tiles)
    fact(record_property, "Cornell box", f"tolerance {1e3 * tol_m:g} mm, scatter over 8 seeds",
         f"at most {1e3 * tol_m:g} mm rms per tile",
         " and ".join(f"{1e3 * np.sqrt(x):.2f}" for x in real) + " mm")  # fmt: skip
    assert (real - 3 * doubt < tol_m**2).all()


def test_a_tolerance_out_of_reach_is_said_to_be():
    device = ideal(16, 16, (50e6,), more=",hfov_deg=37")
    run = path(Scene("cornell"), max_samples=32)
    told = run(Shot(device, noisy=False, tol_m=1e-5, max_bounces=3)).provenance
    assert told["tolerance_met"] is False and told["standard_error_mm"] > 0.01
    assert 32 <= told["samples"] <= 64


@pytest.mark.parametrize(
    ("name", "params"), [("cornell", {}), ("corner", {}), ("cavity", {"albedo": 0.95})]
)
def test_bounces_left_out_move_range_by_less_than_the_tolerance(name, params, record_property):
    device, scene, tol_m = (
        ideal(16, 12, (20e6, 50e6), more=",hfov_deg=37"),
        Scene(name, params),
        2e-3,
    )
    short = shots(scene, device, [1], samples=64, tol_m=tol_m)[0]
    bounces, bound_m = (short.provenance[k] for k in ("max_bounces", "left_out_mm"))
    # The same seed draws the same paths, so that nothing but the bounces differs.
    deep = shots(scene, device, [1], samples=64, max_bounces=3 * bounces + 20)[0]
    both = phasors([short, deep])
    freqs = device.modulation.freqs_hz[:, None, None]
    weights = (np.abs(both[1]) * freqs) ** 2
    moved = phase_to_range(np.angle(both[0] * np.conj(both[1])), freqs)
    moved = np.abs((moved * weights).sum(axis=0) / weights.sum(axis=0))
    fact(record_property, name, f"bounces of auto: {bounces}; left out, 95 % of the pixels",
         f"below the bound of {bound_m:.2f} mm, tolerance {1e3 * tol_m:g} mm",
         f"{1e3 * np.quantile(moved, 0.95):.3f} mm")  # fmt: skip
    assert bound_m <= 1e3 * tol_m
    assert np.quantile(moved, 0.95) <= 1e-3 * bound_m, "an upper bound"
    assert 0 < bounces < 200


def test_a_scene_without_bounces_needs_none():
    told = shots("wall", ideal(4, 3), [0])[0].provenance
    assert told["max_bounces"] == 0 and told["left_out_mm"] == 0


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (33, 2), (17, 13)])
def test_pictures_of_any_size(shape, monkeypatch, record_property):
    """Groups, tiles and parts of the work that the picture does not fill."""
    monkeypatch.setattr("toftools.sim._views.MAX_LANES", 100)
    device = ideal(*shape)
    found = shots("cavity", device, range(1000, 1016), samples=32, max_bounces=2)
    mean = averaged(phasors(found).mean(axis=(2, 3)))
    expected = [exact.cavity(2.0, 0.8, freq, 2) for freq in device.modulation.freqs_hz]
    what = f"{shape[0]} x {shape[1]} pixels, 2 bounces, 3 frequencies"
    prove(record_property, "sphere cavity, albedo 0.8", what, mean, expected)


@pytest.mark.parametrize("samples", [1, 2, 3, 7])
def test_few_paths_are_unbiased_too(samples, record_property):
    device = ideal(16, 16)
    found = shots("cavity", device, range(1000, 1032), samples=samples, max_bounces=2)
    mean = averaged(phasors(found).mean(axis=(2, 3)))
    expected = [exact.cavity(2.0, 0.8, freq, 2) for freq in device.modulation.freqs_hz]
    what = f"{samples} paths, 2 bounces, 3 frequencies"
    prove(record_property, "sphere cavity, albedo 0.8", what, mean, expected)
    told = found[0].provenance
    assert 1 <= told["samples"] <= 8
    assert (told["standard_error_mm"] is None) == (samples == 1)


def test_stopping_at_a_tolerance_does_not_pull_the_mean(record_property):
    device = ideal(8, 8)
    found = shots("cavity", device, range(1000, 1032), tol_m=4e-3, max_bounces=3)
    mean = averaged(phasors(found).mean(axis=(2, 3)))
    expected = [exact.cavity(2.0, 0.8, freq, 3) for freq in device.modulation.freqs_hz]
    prove(record_property, "sphere cavity, albedo 0.8", "tolerance 4 mm, 3 frequencies", mean,
          expected)  # fmt: skip
    assert len({c.provenance["samples"] for c in found}) > 1, "some stop earlier than others"


# Waveforms, motion, lens


def test_square_waves_wiggle_as_in_the_closed_form(record_property):
    device = sensor("deeptof:width=16,height=16,freqs=20e6,waveform=square,signal_e=1,contrast=0.7")
    scene, few = Scene("cavity", {"albedo": 0.7}), {"max_bounces": 12}
    closed = analytic(scene)(Shot(device, noisy=False, **few))
    found = shots(scene, device, range(100, 116), samples=64, **few)
    taps = averaged([c.taps.values.astype(float).mean(axis=(2, 3)) for c in found])
    expected = closed.taps.values.astype(float).mean(axis=(2, 3))
    prove(record_property, "sphere cavity, square waves", "4 taps", taps, expected)
    sine = replace(device, modulation=replace(device.modulation, harmonics=None))
    plain = analytic(scene)(Shot(sine, noisy=False, **few)).taps.values.mean(axis=(2, 3))
    assert np.abs(plain - expected).max() > 100 * taps.error.max(), "the harmonics are seen"


@pytest.mark.parametrize("mover", ["wall", "camera"])
def test_motion_between_taps(mover):
    device = ideal(8, 6, (20e6, 60e6), more=",tap_interval_s=2e-3")
    scene = world("wall", range=2.0)
    if mover == "wall":  # comes nearer
        scene = replace(scene, velocity_mps={"wall": np.array([0, 0, -3.0])})
    else:
        scene = replace(scene, velocity_mps={"camera": np.array([0, 0, 3.0])})
    moving = shots(scene, device, [0])[0]
    closed = analytic(Scene("wall", {"velocity_mps": 3.0}))(Shot(device, noisy=False))
    assert (
        np.abs(moving.taps.values - closed.taps.values).max() < FLOAT32 * closed.taps.values.max()
    )
    assert np.allclose(moving.truth.range_m, closed.truth.range_m, rtol=1e-6)
    assert moving.provenance["frames"] == 8
    still = shots("wall", device, [0])[0]
    assert np.abs(moving.taps.values - still.taps.values).max() > 0.01


def test_things_move_across_the_picture_between_taps():
    device = ideal(24, 4, (20e6,), more=",hfov_deg=60,tap_interval_s=0.1")
    scene = world("wall", range=2.0, albedo=0.1)
    thing = quad([-0.5, 0, 1.0], [0.1, 0, 0], [0, -1, 0], GREY)
    scene = replace(scene, description={**scene.description, "thing": thing},
                    velocity_mps={"thing": np.array([1.0, 0, 0])})  # fmt: skip
    taps = shots(scene, device, [0], max_bounces=0)[0].taps.values[0, :, 1]
    across = rays(device.camera)[1]
    at = across[:, 0] / across[:, 2]
    for k in range(4):
        on = np.abs(at - (-0.5 + 0.1 * k)) < 0.1
        z = 1.0 if on.any() else 2.0
        strength = np.where(on, 0.5 * across[:, 2] ** 3, 0.1 * across[:, 2] ** 3 / 4)
        far = np.where(on, z, 2.0) / across[:, 2]
        turn = np.cos(path_to_phase(2 * far, 20e6) - device.modulation.steps_rad[0, k])
        assert np.abs(taps[k] - strength * (1 + turn)).max() < FLOAT32


def test_a_distorted_lens_and_pixels_without_a_ray():
    K = np.array([[6, 0, 7.5], [0, 6, 7.0], [0, 0, 1.0]])
    folding = Camera(16, 16, K, np.array([-0.3, 0.02, 0.01, -0.01]))
    device = replace(ideal(), camera=folding)
    views = rays(device.camera)
    blind = np.isnan(views).any(axis=-1)
    assert blind.any() and not blind.all()
    capture = shots(Scene("wall", {"range": 1.3}), device, [0])[0]
    closed = analytic(Scene("wall", {"range": 1.3}))(Shot(device, noisy=False))
    lit = ~blind
    assert np.abs(capture.phasors.values - closed.phasors.values)[:, lit].max() < FLOAT32
    assert np.array_equal(np.isnan(capture.truth.range_m), blind)
    assert np.allclose(capture.truth.range_m[lit], 1.3 / views[lit, 2], rtol=1e-5)
    assert (capture.taps.values[..., blind] == 0).all()
    several = path(Scene("cornell"), antialias=2)(Shot(device, noisy=False, samples=4))
    assert np.isfinite(several.taps.values).all()


def test_lens_axes_are_those_of_the_camera_matrix():
    """Principal point off the middle, unequal focal lengths: a plane reads its geometry."""
    camera = replace(
        pinhole(12, 9, hfov_deg=50), K=np.array([[9, 0, 2.5], [0, 14, 7.0], [0, 0, 1]])
    )
    device = replace(ideal(), camera=camera)
    ours, closed = (
        shots("tilted", device, [0])[0],
        analytic(Scene("tilted"))(Shot(device, noisy=False)),
    )
    seen = np.isfinite(closed.truth.range_m)
    assert np.allclose(ours.truth.range_m[seen], closed.truth.range_m[seen], rtol=1e-5)
    assert np.abs(ours.phasors.values - closed.phasors.values).max() < FLOAT32


# Textures and masks


def test_textures_are_seen_where_they_are():
    device = ideal(20, 15, (20e6,), more=",hfov_deg=20")
    capture = shots(Scene("wall", {"material": "checker", "albedo": 0.8}), device, [0])[0]
    views = rays(device.camera)
    at = views[..., :2] * (2 / views[..., 2:])
    squares = np.floor(at / 0.1)
    clear = (np.abs(at / 0.1 - np.round(at / 0.1)) > 0.02).all(axis=-1)
    first = (squares.sum(axis=-1) % 2 == 0)[clear]
    albedo = capture.truth.albedo[clear]
    assert len(np.unique(albedo.round(5))) == 2
    assert np.ptp(albedo[first]) < 1e-6 and np.ptp(albedo[~first]) < 1e-6
    light = np.abs(capture.truth.direct[0])[clear] / (views[..., 2] ** 3 / 4)[clear]
    assert np.allclose(light, albedo, rtol=1e-4)


def veil(opacity):
    """A sheet before the camera of which as much is there as `opacity` says."""
    mask = {"type": "mask", "opacity": opacity, "bsdf": GREY}
    return {"veil": quad([0, 0, 0.5], [3, 0, 0], [0, -3, 0], mask)}


VEILS = {  # before the camera, and in the way from wall to wall
    "before": veil(0.0),
    "between": {"veil": quad([0, 0, 1.6], [0, 0, 0.35], [0, -1.4, 0], veil(0.0)["veil"]["bsdf"])},
}


@pytest.mark.parametrize("where", VEILS)
@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_what_is_masked_out_is_not_there(where, bounces, record_property):
    device = ideal(8, 6, emitters=(Emitter((0.1, 0.0, 0.0)),))
    scene = world("corner")
    gone = replace(scene, description={**scene.description, **VEILS[where]})
    few = {"samples": 64, "max_bounces": bounces}
    bare, masked = (shots(w, device, range(500, 508), **few) for w in (scene, gone))
    for part in ("direct", "one_bounce", "rest")[: bounces + 1]:
        one, other = (
            averaged([getattr(c.truth, part).mean(axis=(1, 2)) for c in group])
            for group in (masked, bare)
        )
        both = type(one)(one.value, np.hypot(one.error, other.error))
        what = f"{part} of {bounces} bounces, open mask {where}"
        prove(record_property, "corner with an open mask", what, both, other.value)


THIN = 1 - 2 * 0.04 / 1.04  # a pane of index 1.5: two faces of 4 %, echoes between them included
SHEETS = {
    "veil of 0.3": (veil(0.3)["veil"]["bsdf"], 0.7, 0.5 * 0.3),
    "veil of 0.7": (veil(0.7)["veil"]["bsdf"], 0.3, 0.5 * 0.7),
    "thin pane": ({"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0}, THIN, 0.0),
}


@pytest.mark.parametrize("name", SHEETS)
@pytest.mark.parametrize("aside", [0.0, 1e-3])
def test_sheets_that_let_a_share_pass(name, aside, record_property):
    """Light crosses the sheet on its way there and back; what stays comes from the sheet itself."""
    bsdf, through, own = SHEETS[name]
    scene = world("wall", range=2.0, albedo=0.5)
    sheet = quad([0, 0, 1.0], [3, 0, 0], [0, -3, 0], bsdf)
    scene = replace(scene, description={**scene.description, "sheet": sheet})
    # Just beside the camera a source is connected by shadow rays.
    device = ideal(8, 8, more=",hfov_deg=0.01", emitters=(Emitter((aside, 0.0, 0.0)),))
    found = shots(scene, device, range(1000, 1016), samples=64, max_bounces=0)
    mean = averaged(phasors(found).mean(axis=(2, 3)))
    near, far = (exact.turn(2 * z, device.modulation.freqs_hz) for z in (1.0, 2.0))
    expected = own * near + through**2 * 0.5 / 4 * far
    prove(record_property, f"{name} before a wall", f"source {aside:g} m aside", mean, expected)


def test_a_closed_mask_is_a_wall():
    device, scene = ideal(8, 6), world("corner")
    solid = replace(scene, description={**scene.description, **veil(1.0)})
    near = shots(solid, device, [0], max_bounces=0)[0]
    assert np.allclose(near.truth.range_m * rays(device.camera)[..., 2], 0.5, rtol=1e-5)


def test_a_mask_is_seen_through_in_its_holes_alone():
    device = ideal(16, 12, (20e6,), more=",hfov_deg=50")
    board = {"type": "checkerboard", "color0": 0.0, "color1": 1.0,
             "to_uv": np.diag([4.0, 4.0, 1.0, 1.0])}  # fmt: skip
    scene = world("wall", range=2.0)
    scene = replace(scene, description={**scene.description, **veil(board)})
    capture = shots(scene, device, [0], max_bounces=1, samples=4)[0]
    z = capture.truth.range_m * rays(device.camera)[..., 2]
    near, far = np.isclose(z, 0.5, rtol=1e-5), np.isclose(z, 2.0, rtol=1e-5)
    assert near.any() and far.any() and (near | far).all()
    light = np.abs(capture.truth.direct[0]) / rays(device.camera)[..., 2] ** 3
    assert np.allclose(light[near], 0.5 / 0.25, rtol=1e-4)
    assert np.allclose(light[far], 0.5 / 4, rtol=1e-4)
