"""The path engine against closed forms, quadrature, a slow twin and another renderer.

Means over fixed seeds lie within three of their own standard errors; `benchmarks/proofs.py` runs
the same tests with more seeds and writes their figures down.
"""

from dataclasses import replace

import numpy as np
import pytest
import reference_transport as exact
from path_proof import (
    DARK,
    FREQS_HZ,
    THOROUGH,
    Mean,
    agree,
    averaged,
    ideal,
    offset,
    phasors,
    prove,
    shots,
    steady,
)

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sim import shapes
from toftools.sim.dihedral import Wall, one_bounce
from toftools.sim.scenes import world_of
from toftools.sim.solids import box, glass, plane, quad, sphere
from toftools.sim.world import World
from toftools.types import Emitter, Scene

NARROW = ",hfov_deg=0.01"  # all pixels look along the axis to 1e-4 rad
BLACK = {"type": "diffuse", "reflectance": 0.0}
GREY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def world(name, **params):
    return world_of(Scene(name, params))


# Closed forms with all bounces: sphere cavity, parallel plates

# Albedo, frequencies, paths, bounces, and how many more seeds (of 64 x 64 pixels) a relative error
# of 1e-3 takes; what the bounces leave out is below 1e-4 of the light.
CAVITIES = [
    (0.3, (20e6, 50e6, 100e6), 128, 8, 1),
    (0.8, (20e6,), 64, 32, 1),
    (0.8, (50e6, 100e6), 64, 12, 2),
    (0.95, (20e6,), 64, 72, 1),
    (0.95, (50e6,), 64, 16, 3),
    (0.95, (100e6,), 64, 6, 4),
]


@pytest.mark.parametrize(("albedo", "proved", "paths", "bounces", "more"), CAVITIES)
def test_sphere_cavity(albedo, proved, paths, bounces, more, record_property):
    side, seeds = (64, 16 * more) if THOROUGH else (16, 16)
    found = shots(
        Scene("cavity", {"albedo": albedo}), ideal(side, side), range(seeds),
        samples=paths, max_bounces=bounces,
    )  # fmt: skip
    mean = averaged(phasors(found).mean(axis=(2, 3)))
    for i, freq in enumerate(FREQS_HZ):
        one = Mean(mean.value[i], mean.error[i])
        name, what = f"sphere cavity, albedo {albedo}", f"{freq / 1e6:g} MHz"
        cut = exact.cavity(2.0, albedo, freq, bounces)
        prove(record_property, name, f"{what}, {bounces} bounces", one, cut)
        if freq in proved:
            whole = exact.cavity(2.0, albedo, freq)
            assert abs(cut - whole) < 1e-4 * abs(whole)
            prove(record_property, name, f"{what}, all bounces", one, whole,
                  within=1e-3, rounding=1e-4)  # fmt: skip


@pytest.mark.parametrize("bounces", [0, 1, 2, 5])
def test_truncation_is_that_of_the_series(bounces, record_property):
    found = shots("cavity", ideal(16, 16), range(16), samples=64, max_bounces=bounces)
    name = "sphere cavity, albedo 0.8"
    still = averaged(offset(found).mean(axis=(1, 2)))
    prove(record_property, name, f"0 Hz, {bounces} bounces", still,
          exact.cavity(2.0, 0.8, 0.0, bounces).real)  # fmt: skip
    sums = np.array([[exact.cavity(2.0, 0.8, freq, n) for freq in FREQS_HZ]
                     for n in (0, min(bounces, 1), bounces)])  # fmt: skip
    parts = {"direct": sums[0], "one_bounce": sums[1] - sums[0], "rest": sums[2] - sums[1]}
    for part, expected in parts.items():
        mean = averaged([getattr(c.truth, part).mean(axis=(1, 2)) for c in found])
        prove(record_property, name, f"{part} of {bounces} bounces, 3 frequencies", mean, expected)


def disc_lit(radius, bounces):
    """Light from a shining disc by way of the wall it faces; the camera in between, on the axis."""
    device = ideal(16, 16, more=NARROW, emitters=(DARK,))
    lit = world("disc", gap=2.0, range=1.0, radius=radius, radiance=1.0)
    found = shots(lit, device, range(200, 216), samples=64, max_bounces=bounces)
    light = np.column_stack([offset(found).mean(axis=(1, 2)), phasors(found).mean(axis=(2, 3))])
    return averaged(light)


ALL_HZ = (0.0, *FREQS_HZ)


def test_finite_disc_above_a_floor_point(record_property):
    for radius in (0.5, 3.0):
        expected = [0.8 * exact.turn(1.0, f) * exact.disc_leg(2.0, radius, f) for f in ALL_HZ]
        prove(record_property, f"disc of {radius} m radius, 2 m above a floor point",
              "0/20/50/100 MHz", disc_lit(radius, 0), expected)  # fmt: skip


@pytest.mark.parametrize("bounces", [0, 1, 4])
def test_endless_plates(bounces, record_property):
    # A disc of 1 km: what it lacks to a plane is (2 m / 1 km)^2 = 4e-6 of the light.
    expected = []
    for freq in ALL_HZ:
        leg = exact.plates_leg(2.0, freq)
        sums = exact.series((0.8 * leg) ** 2, bounces // 2)
        expected.append(0.8 * exact.turn(1.0, freq) * leg * sums)
    prove(record_property, "parallel plates, gap 2 m, albedo 0.8, one shines",
          f"0/20/50/100 MHz, {bounces} bounces", disc_lit(1000.0, bounces), expected,
          rounding=1e-5)  # fmt: skip


# Corner, one bounce


@pytest.mark.parametrize("angle", [90.0, 60.0])
def test_corner_one_bounce_against_quadrature(angle, record_property):
    device = ideal(12, 8, more=",hfov_deg=50")
    found = shots(
        Scene("corner", {"angle": angle}), device, range(300, 316), samples=256, max_bounces=1
    )
    form = shapes.corner(device.camera, angle=angle)
    expected = np.array([form.phasor(f, 1) - form.phasor(f, 0) for f in FREQS_HZ])
    light = np.array([c.truth.one_bounce for c in found], np.complex128)
    name = f"corner of {angle:g} degrees"
    # 288 complex numbers at once: 5 standard errors of 16 seeds each leave 1 in 1000.
    prove(record_property, name, "one bounce, every pixel", averaged(light), expected, sigmas=5)
    mean = averaged(light.mean(axis=(2, 3)))
    prove(record_property, name, "one bounce, mean over pixels", mean, expected.mean(axis=(1, 2)))


@pytest.mark.parametrize(("angle", "along", "up"), [(90.0, 0.02, 0.4), (60.0, 1.0, -1.2)])
def test_the_corner_quadrature_itself(angle, along, up):
    mine, other = (Wall.open(side, 2.0, angle, 2.0, 3.0) for side in (1, -1))
    at = mine.origin + along * mine.out + np.array([0.0, up, 0.0])
    adaptive = exact.corner_one_bounce(
        at, edge=2.0, angle=angle, albedo=0.7, size=2.0, height=3.0, freq_hz=50e6
    )
    assert abs(0.7 * one_bounce(at[None], mine, other, 0.7, 50e6)[0] / adaptive - 1) < 3e-6


# A slow readable twin


def test_cornell_box_bounce_by_bounce_against_a_slow_twin(record_property):
    device, bounces, paths = ideal(8, 5, FREQS_HZ[:2], more=",hfov_deg=37"), 3, 1000
    box_world = world("cornell")
    directions = np.repeat(rays(device.camera).reshape(-1, 3), paths, axis=0)
    slow = exact.slow_paths(*exact.quads_of(box_world), directions, FREQS_HZ[:2],
                            bounces=bounces, rng=np.random.default_rng(1))  # fmt: skip
    slow = slow.reshape(bounces + 1, 2, 40, paths)
    found = shots(box_world, device, range(8), samples=256, max_bounces=bounces)
    slow = {"direct": slow[0], "one_bounce": slow[1], "rest": slow[2:].sum(axis=0)}
    for part, values in slow.items():
        ours = averaged([getattr(c.truth, part).mean(axis=(1, 2)) for c in found])
        theirs = averaged(np.moveaxis(values.mean(axis=1), -1, 0))
        both = Mean(ours.value, np.hypot(ours.error, theirs.error))
        prove(record_property, "Cornell box", f"{part}, slow twin", both, theirs.value)


# 0 Hz is the steady picture: Mitsuba's own path tracer on the same rays


def furnished(**things):
    """An open box with things of several materials in it."""
    return World({**world("cornell").description, **things})


SHINY = furnished(
    ball=sphere([0.1, 0.6, 3.2], 0.3, {"type": "roughconductor", "material": "Au", "alpha": 0.2}),
    clear=sphere([0.55, -0.3, 3.0], 0.25, glass(1.5)),
    frosted=sphere(
        [-0.55, 0.3, 2.7], 0.25,
        {"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.5, "ext_ior": 1.0},
    ),
    plastic=box(
        [-0.5, -0.5, 3.4], [0.2, 0.2, 0.2], 30,
        {"type": "roughplastic", "diffuse_reflectance": 0.6, "alpha": 0.15},
    ),
)  # fmt: skip


def rough_sheets():
    """Sheets with bent normals: one by a map of normals, one by a map of heights."""
    mi, rng = import_mitsuba(), np.random.default_rng(0)
    bent = np.concatenate([rng.uniform(0.15, 0.85, (8, 8, 2)), np.full((8, 8, 1), 0.9)], axis=2)
    maps = {"normalmap": bent, "arbitrary": rng.random((8, 8, 1))}
    grey = {"type": "diffuse", "reflectance": 0.8}
    picture = {k: {"type": "bitmap", "bitmap": mi.Bitmap(v.astype(np.float32)), "raw": True}
               for k, v in maps.items()}  # fmt: skip
    bumps = {"type": "bumpmap", "arbitrary": picture["arbitrary"], "scale": 0.3, "bsdf": grey}
    bends = {"type": "normalmap", "normalmap": picture["normalmap"], "bsdf": grey}
    return {
        "bends": quad([-0.4, 0.2, 3.2], [0.3, 0, 0.1], [0, -0.6, 0], bends),
        "bumps": quad([0.4, 0.2, 3.2], [0.3, 0, -0.1], [0, -0.6, 0], bumps),
    }


def smooth_ball():
    """An octahedron whose normals pretend that it is round."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = [[a, b, c] if s > 0 else [a, c, b] for a in (0, 1) for b in (2, 3) for c in (4, 5)
             for s in [corners[[a, b, c]].prod(where=corners[[a, b, c]] != 0)]]  # fmt: skip
    return {"type": "arrays", "vertices": corners * 0.5 + [0.1, 0.2, 3.1], "normals": corners,
            "faces": faces, "bsdf": GREY}  # fmt: skip


ONE_SIDED = {"type": "diffuse", "reflectance": 0.8}
STEADY = {
    "Cornell box": lambda: {},
    "gold, glass, frosted glass and plastic": lambda: SHINY.description,
    "sheets with bent normals": rough_sheets,
    "octahedron with smooth normals": lambda: {"ball": smooth_ball()},
    "back of a one-sided sheet": lambda: {
        "back": quad([-0.2, 0.2, 2.6], [0.4, 0, 0.1], [0, 0.4, 0], ONE_SIDED)
    },
    "blend of two greys": lambda: {
        "mixed": quad(
            [0, 0.2, 3.2], [0.6, 0, 0.1], [0, -0.6, 0],
            {"type": "blendbsdf", "weight": 0.4, "a": ONE_SIDED, "b": GREY["bsdf"]},
        )
    },
}  # fmt: skip


@pytest.mark.parametrize("name", STEADY)
@pytest.mark.parametrize("bounces", [0, 2])
def test_no_frequency_is_the_steady_picture(name, bounces, record_property):
    # 11 lines: no ray of this camera meets an edge of the box at exactly 45 degrees.
    scene, device = furnished(**STEADY[name]()), ideal(12, 11, (20e6,), more=",hfov_deg=35")
    found = offset(shots(scene, device, range(400, 408), samples=64, max_bounces=bounces))
    flash = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": np.pi}
    lit = replace(scene, description={**scene.description, "flash": flash})
    theirs = steady(lit, device.camera, range(8), paths=256, depth=bounces + 2)
    agree(record_property, name, f"0 Hz, {bounces} bounces, Mitsuba's path", found, theirs)


# Light of the scene's lamps


def sky():
    """An environment map with a bright and a dark side."""
    mi = import_mitsuba()
    picture = np.ones((8, 16, 1), np.float32) * np.linspace(0.1, 2, 16, dtype=np.float32)[:, None]
    return {"type": "envmap", "bitmap": mi.Bitmap(picture)}


LAMPS = {
    "area, constant, directional, spot and point lamps": {
        "panel": quad([0.3, -0.95, 3.5], [0.3, 0, 0], [0, 0, 0.2], BLACK)
        | {"emitter": {"type": "area", "radiance": 4.0}},
        "air": {"type": "constant", "radiance": 0.2},
        "sun": {"type": "directional", "direction": [0.3, 0.4, 1.0], "irradiance": 0.5},
        "bulb": {"type": "point", "position": [-0.5, 0.0, 2.4], "intensity": 0.1},
        "torch": {
            "type": "spot", "intensity": 1.0, "cutoff_angle": 25.0, "beam_width": 10.0,
            "to_world": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1.0]]),
        },
    },
    "environment map and a glowing ball": {
        "sky": {},
        "moon": sphere([0.2, 0.5, 2.5], 0.2, GREY) | {"emitter": {"type": "area", "radiance": 1.0}},
    },
}  # fmt: skip


@pytest.mark.parametrize("name", LAMPS)
def test_lamps_give_the_steady_picture(name, record_property):
    lamps = {key: entry or sky() for key, entry in LAMPS[name].items()}
    scene = replace(furnished(**SHINY.description, **lamps), lamp_gain=1.0)
    device = ideal(12, 11, (20e6,), more=",hfov_deg=60", emitters=(DARK,))
    theirs = steady(scene, device.camera, range(8), paths=256, depth=4)
    ambient = shots(scene, device, range(500, 508), samples=64, max_bounces=2)
    agree(
        record_property, name, "0 Hz, 2 bounces, ambient, Mitsuba's path", offset(ambient), theirs
    )
    assert np.abs(phasors(ambient)).max() < 1e-6
    # Where one is modulated, all of them get as many paths as the camera's own light.
    endless = ("constant", "directional", "envmap")
    placed = [key for key, entry in lamps.items() if entry["type"] not in endless]
    scene = replace(scene, modulated_s=dict.fromkeys(placed, 0.0))
    found = shots(scene, device, range(500, 508), samples=64, max_bounces=2)
    agree(
        record_property, name, "0 Hz, 2 bounces, modulated, Mitsuba's path", offset(found), theirs
    )


def test_a_modulated_lamp_carries_its_delay(record_property):
    lit = world("disc", radius=0.5, radiance=1.0)
    late = replace(lit, modulated_s={"disc": 3e-9})
    device = ideal(4, 4, emitters=(DARK,))
    soon, later = (phasors(shots(w, device, [0], samples=64, max_bounces=2)) for w in (lit, late))
    turn = np.exp(2j * np.pi * device.modulation.freqs_hz * 3e-9)[:, None, None]
    assert np.allclose(later, soon * turn, rtol=1e-5, atol=1e-6 * np.abs(soon).max())
    off = shots(replace(lit, modulated_s={}), device, range(8), samples=64, max_bounces=2)
    assert np.abs(phasors(off)).max() < 1e-6, "ambient unless marked"
    on = shots(lit, device, range(8), samples=64, max_bounces=2)
    agree(record_property, "disc of 0.5 m radius", "0 Hz, not modulated", offset(off), offset(on))


# Glass


@pytest.mark.parametrize(("thickness", "index"), [(0.5, 1.5), (0.1, 2.0)])
def test_glass_adds_optical_length(thickness, index, record_property):
    """A shining wall 3 m away, seen through a pane: echoes inside it included."""
    shine = quad([0, 0, 3.0], [1, 0, 0], [0, -1, 0], BLACK)
    scene = World(
        {
            "lamp": shine | {"emitter": {"type": "area", "radiance": 1.0}},
            "near": plane([0, 0, 1.0], [2, 0, 0], [0, -2, 0], glass(index)),
            "far": plane([0, 0, 1.0 + thickness], [2, 0, 0], [0, 2, 0], glass(index)),
        },
        lamp_gain=1.0,
        modulated_s={"lamp": 0.0},
    )
    device = ideal(16, 16, more=NARROW, emitters=(DARK,))
    # Two bounces through, two more per echo; what the lamp's wall sends back is black.
    found = shots(scene, device, range(16), samples=64, max_bounces=6)
    mean = averaged(phasors(found).mean(axis=(2, 3)))
    expected = [exact.slab_leg(3.0, thickness, index, f, passes=2) for f in FREQS_HZ]
    prove(record_property, f"glass of {thickness} m, index {index}, before a shining wall",
          "3 frequencies, 2 echoes", mean, expected)  # fmt: skip


def test_frosted_glass_lets_lamps_shine_out_at_the_speed_of_air(record_property):
    """A small lamp behind a rough pane is mostly found on purpose, from inside the glass."""
    rough = {"type": "roughdielectric", "alpha": 0.1, "int_ior": 1.5, "ext_ior": 1.0}
    shine = quad([0, 0, 3.0], [0.1, 0, 0], [0, -0.1, 0], BLACK)
    scene = World(
        {
            "lamp": shine | {"emitter": {"type": "area", "radiance": 1.0}},
            "near": plane([0, 0, 1.0], [2, 0, 0], [0, -2, 0], rough),
            "far": plane([0, 0, 1.5], [2, 0, 0], [0, 2, 0], rough),
        },
        lamp_gain=1.0,
        modulated_s={"lamp": 0.0},
    )
    device = ideal(8, 8, more=NARROW, emitters=(DARK,))
    found = shots(scene, device, range(8), samples=256, max_bounces=3)
    path_m = np.angle(phasors(found).mean(axis=(0, 2, 3))) / exact.path_to_phase(1.0, FREQS_HZ)
    # Straight through it is 3.25 m; rays that leave the axis by alpha add some millimetres.
    assert 3.25 < path_m[0] < 3.29


# Energy


def test_white_furnace(record_property):
    """In a world of radiance 1 what absorbs nothing cannot be seen."""
    things = {
        "white": sphere([-1.2, 0, 4.0], 0.5, {"type": "diffuse", "reflectance": 1.0}),
        "glass": sphere([0.0, 0, 4.0], 0.5, glass(1.5)),
        "mirror": sphere([1.2, 0, 4.0], 0.5, {"type": "conductor", "material": "none"}),
    }
    air = {"air": {"type": "constant", "radiance": 1.0}}
    device = ideal(24, 8, (20e6,), more=",hfov_deg=50", emitters=(DARK,))
    found = shots(World({**things, **air}, lamp_gain=1.0), device, range(8), samples=64,
                  max_bounces=48)  # fmt: skip
    light = offset(found)
    # The white ball's neighbours are lossless, so all light comes back: 1 everywhere.
    prove(record_property, "white, glass and mirror balls in a white world", "0 Hz, every pixel",
          averaged(light), np.ones(light.shape[1:]), sigmas=9, rounding=1e-5)  # fmt: skip
    prove(record_property, "white, glass and mirror balls in a white world", "0 Hz, mean",
          averaged(light.mean(axis=(1, 2))), 1.0, rounding=1e-5)  # fmt: skip


@pytest.mark.parametrize("name", ["diffuse", "rough_conductor", "plastic", "checker"])
def test_no_material_makes_light(name):
    from toftools.sim.solids import material

    ball = sphere([0, 0, 3.0], 1.0, material(name, 1.0))
    scene = World({"ball": ball, "air": {"type": "constant", "radiance": 1.0}}, lamp_gain=1.0)
    device = ideal(12, 9, (20e6,), more=",hfov_deg=30", emitters=(DARK,))
    mean = averaged(offset(shots(scene, device, range(8), samples=64, max_bounces=4)).mean(axis=2))
    assert (mean.value <= 1 + 5 * mean.error + 1e-5).all()


# Symmetries


def test_size_and_frequency_scale_together():
    device, slow = ideal(8, 6, (40e6, 100e6)), ideal(8, 6, (10e6, 25e6))
    box_world = world("cornell")
    near = phasors(shots(box_world, device, [3], samples=16, max_bounces=3))
    far = phasors(shots(replace(box_world, unit_m=4.0), slow, [3], samples=16, max_bounces=3))
    assert np.array_equal(near, 16 * far), "powers of two change no digit"
    grown = phasors(shots(Scene("cornell", {"size": 8.0}), slow, [3], samples=16, max_bounces=3))
    # Single-precision coordinates round otherwise; a ray that grazes an edge may go astray.
    turned = np.abs(np.angle(grown * np.conj(near)))
    assert np.median(turned) < 1e-5 and np.quantile(turned, 0.9) < 1e-3


def test_a_lamp_is_as_bright_at_any_size():
    device, slow = (ideal(8, 6, f, emitters=(DARK,)) for f in ((40e6, 100e6), (10e6, 25e6)))
    lit = world("disc", radius=0.5, radiance=1.0)
    near, far = (
        phasors(shots(w, s, [3], samples=16, max_bounces=2))
        for w, s in ((lit, device), (replace(lit, unit_m=4.0), slow))
    )
    assert np.abs(near - far).max() < 1e-6 * np.abs(near).max()


def test_the_place_of_the_world_does_not_matter():
    """The same corner 100 m from the origin: rays must not lose length where they start."""
    device, here = ideal(8, 6), world("corner")
    away, pose = np.array([100.0, 50.0, 30.0]), np.eye(4)
    pose[:3, 3] = away
    shapes_there = {}
    for name, entry in here.description.items():
        placed = np.array(entry["to_world"])
        placed[:3, 3] += away
        shapes_there[name] = {**entry, "to_world": placed}
    there = replace(here, description=shapes_there, to_world=pose)
    near, far = (phasors(shots(w, device, [3], samples=64, max_bounces=3)) for w in (here, there))
    turned = np.abs(np.angle(far * np.conj(near)))
    # Single precision of 100 m is 4e-6 m of path, 1e-5 rad at 100 MHz. A start shifted sideways by
    # 1e-4 of the coordinates, as Mitsuba's own rays are, would be 2e-2 rad a bounce.
    assert turned.max() < 5e-5
    assert np.abs(np.abs(far / near) - 1).max() < 1e-4


def test_camera_and_source_may_change_places(record_property):
    """Light that a point gets from all around, of a source at another, and the other way round."""
    ends = np.array([[0.5, 0.3, -0.2], [-0.7, 0.2, 0.6]])
    seeds, flows = range(600, 608), []
    for here, there in (ends, ends[::-1]):
        flow = np.zeros((len(seeds), 2), np.complex128)
        for turn in cube_faces():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, here
            scene = replace(world("cavity", albedo=0.6), to_world=pose)
            device = ideal(
                16, 16, (20e6, 60e6), more=",hfov_deg=90",
                emitters=(Emitter(tuple(turn.T @ (there - here))),),
            )  # fmt: skip
            found = shots(scene, device, seeds, samples=64, max_bounces=3)
            share = rays(device.camera)[..., 2] ** 3 / device.camera.K[0, 0] ** 2
            flow += (phasors(found) * share).sum(axis=(2, 3))
        flows.append(averaged(flow))
    one, other = flows
    both = Mean(one.value, np.hypot(one.error, other.error))
    # 16 x 16 directions per face of the cube: the midpoint rule is good to 1e-4 here.
    prove(record_property, "sphere cavity, camera and source apart", "swapped, 20/60 MHz", both,
          other.value, rounding=2e-4)  # fmt: skip


def cube_faces():
    """Rotations of a camera to the six sides."""
    for axis in range(3):
        for side in (1.0, -1.0):
            ahead = np.eye(3)[axis] * side
            right = np.eye(3)[(axis + 1) % 3]
            yield np.stack([right, np.cross(ahead, right), ahead], axis=1)


def test_parts_sum_to_the_whole_and_none_exceeds_its_mean():
    device = ideal(16, 12, more=",hfov_deg=37")
    capture = shots(SHINY, device, [0], samples=64, max_bounces=6)[0]
    parts = capture.truth.direct + capture.truth.one_bounce + capture.truth.rest
    total = phasors([capture])[0]
    size = np.abs(total).max()
    assert np.allclose(parts, total, atol=1e-6 * size)
    mean = offset([capture])[0]
    assert (np.abs(total) <= mean * (1 + 1e-5)).all()
    assert (mean > 0).all()
