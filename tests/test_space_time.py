"""Transient instant radiosity against closed forms, the engine path, and a slow twin.

Means over fixed seeds lie within so many standard errors as three are of a normal variable: 4.1
for the spread of ten seeds. Pixels of one seed share their virtual lights.
"""

from dataclasses import replace

import numpy as np
import pytest
from path_proof import ideal

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sim import _space_time
from toftools.sim._bins import Order, depositor
from toftools.sim._flash import flashes_of
from toftools.sim._task import Task, first_hits
from toftools.sim._walks import emissions, virtual_lights
from toftools.sim.scenes import world_of
from toftools.sim.shapes import cavity
from toftools.sim.solids import box, glass, material, plane, quad, sphere
from toftools.sim.space_time import space_time
from toftools.sim.stage import load
from toftools.sim.transients import histogram, transient
from toftools.sim.world import World
from toftools.transient import phasors
from toftools.types import Emitter, Scene, Shot
from toftools.units import time_to_path

EYE = ideal(16, 12, more=",hfov_deg=39.3077")
AXIS = {"bin_m": 0.05, "n_bins": 512}
FREQS_HZ = [0.0, 20e6]
SEEDS, SIGMAS = 10, 4.1
"""The limit is Student's t with 9 degrees of freedom at two-sided 0.27 %."""
PATH_SEEDS = 4
BLACK = {"type": "diffuse", "reflectance": 0.0}
GREY = material("diffuse", 0.5)


def looked_at(**things):
    """Two walls, a floor, and what stands before them."""
    walls = {
        "back": plane([0, 0, 3], [9, 0, 0], [0, -9, 0], GREY),
        "side": plane([0.8, 0, 0], [0, 0, 9], [0, -9, 0], GREY),
    }
    return World({**walls, **things})


def energy(made):
    return made.values.sum(axis=0, dtype=np.float64) + made.missed


def rows(made, regions):
    """Light and phasor of regions: (R, 3), complex parts apart."""
    light, turned = phasors(made, FREQS_HZ)
    parts = light.real + made.missed, turned.real, turned.imag
    return np.array([[part[region].mean() for part in parts] for region in regions])


def agree(scene, device=EYE, regions=(...,), *, bounces=2):
    """Assert that means of both engines over regions are the same within their standard errors."""
    # One emitter at a time: light adds up, and `transient` records one source per step.
    alone = [replace(device, emitters=(one,)) for one in device.emitters] or [device]
    ours, theirs = [], []
    for seed in range(SEEDS):
        shot = Shot(device, seed=seed, samples=1024, max_bounces=bounces)
        made = space_time(scene, shot, **AXIS)
        ours.append(rows(made, regions))
    for seed in range(100, 100 + PATH_SEEDS):
        each = [Shot(eye, max_bounces=bounces, seed=seed, samples=512) for eye in alone]
        paths = [transient(scene, shot, method=histogram, **AXIS) for shot in each]
        theirs.append(sum(rows(one, regions) for one in paths))
    off = np.mean(ours, axis=0) - np.mean(theirs, axis=0)
    error = np.hypot(*(np.std(x, axis=0, ddof=1) / np.sqrt(len(x)) for x in (ours, theirs)))
    room = 2e-6 * np.abs(np.mean(theirs, axis=0))
    assert (np.abs(off) <= SIGMAS * error + room).all(), off / error
    return made


# closed forms


@pytest.mark.parametrize("albedo", [0.3, 0.6, 0.9])
def test_all_bounces_of_the_cavity_are_the_geometric_series(albedo):
    scene, device = Scene("cavity", {"radius": 2.0, "albedo": albedo}), ideal(16, 12)
    made = [
        space_time(scene, Shot(device, seed=seed, samples=4096), bin_m=0.05, n_bins=2048)
        for seed in range(SEEDS)
    ]
    exact = cavity(device.camera, radius=2.0, albedo=albedo)
    for freq_hz in FREQS_HZ:
        wanted = exact.phasor(freq_hz, None)[0, 0]
        found = np.array([phasors(one, [freq_hz])[0].mean() for one in made])
        if freq_hz == 0:
            assert wanted == pytest.approx(albedo / (1 - albedo) / 4, rel=1e-6)
            found = found + [one.missed.mean() for one in made]
        error = np.sqrt((found.real.var(ddof=1) + found.imag.var(ddof=1)) / len(made))
        # Path lengths pooled over 5 cm move a lone return by up to 2.5 cm of path at 20 MHz.
        bins = 0.0 if freq_hz == 0 else abs(exact.phasor(0.0, 0)[0, 0]) * 0.025 * 0.42
        assert abs(found.mean() - wanted) <= SIGMAS * error + bins
        assert error < 0.02 * abs(wanted)


@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_bounces_are_counted(bounces):
    scene, device = Scene("cavity", {"radius": 2.0, "albedo": 0.8}), ideal(16, 12)
    made = [
        energy(space_time(scene, Shot(device, seed=seed, samples=4096, max_bounces=bounces)))
        for seed in range(SEEDS)
    ]
    wanted = cavity(device.camera, radius=2.0, albedo=0.8).phasor(0.0, bounces)[0, 0].real
    means = np.array([one.mean() for one in made])
    assert abs(means.mean() - wanted) <= SIGMAS * means.std(ddof=1) / np.sqrt(SEEDS) + 2e-6 * wanted


# the engine path


def corner_pixels():
    """Pixels of the Cornell box within 5 cm of where two faces meet."""
    mi = import_mitsuba()
    stage = load(world_of(Scene("cornell", {})))
    first = first_hits(Task(mi, stage, ()), rays(EYE.camera).reshape(-1, 3))
    to = stage.scene.bbox()
    p = np.asarray(first.p.numpy()) * stage.unit_m
    low, high = (np.asarray(x)[:, None] * stage.unit_m for x in (to.min, to.max))
    near = np.minimum(p - low, high - p) < 0.05
    return (near.sum(axis=0) >= 2).reshape(EYE.camera.shape)


def test_the_cornell_box_has_the_light_of_path_also_in_its_corners():
    near = corner_pixels()
    assert near.sum() >= 6
    made = agree(Scene("cornell", {}), regions=(..., near), bounces=6)
    assert made.info["left_to_path"] == 0
    assert made.info["virtual_lights"] > made.info["paths"]


def spot(angle_deg):
    return np.array([[0, 1.0], [angle_deg, 0.6], [angle_deg + 8, 0.0]])


def test_sources_are_those_of_path():
    post = box([0.1, 0.2, 2.2], [0.2, 0.3, 0.2], 30, material("diffuse", 0.8))
    emitters = (Emitter((-0.3, 0.1, 0.1), beam=spot(15.0), delay_s=3e-9), Emitter(strength=0.5))
    made = agree(looked_at(post=post), replace(EYE, emitters=emitters))
    assert made.info["paths"] == 1024


def test_light_without_modulation_has_no_place_on_the_axis():
    lamp = Emitter((0.3, 0, 0), modulated=False)
    shot = Shot(EYE, samples=256)
    with_lamp = replace(shot, sensor=replace(EYE, emitters=(Emitter(), lamp)))
    one, two = (space_time(looked_at(), s, **AXIS) for s in (shot, with_lamp))
    assert one.values.tobytes() == two.values.tobytes()


def smooth_ball():
    """An octahedron whose normals pretend that it is round."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = [[a, b, c] for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    faces = [f if corners[f].sum() in (3, -1) else f[::-1] for f in faces]
    return {"type": "arrays", "vertices": corners * 0.3 + [0.1, 0.1, 2.4], "normals": corners,
            "faces": np.array(faces), "bsdf": material("diffuse", 0.8)}  # fmt: skip


GLOSS = {"plate": quad([-0.4, 0.3, 2.5], [0.3, 0, 0.2], [0, -0.3, 0], material("plastic", 0.5))}
VEIL = {"type": "mask", "opacity": 0.5, "bsdf": GREY}
MIRROR = material("mirror", 0.9)


def test_what_is_not_diffuse_is_that_of_path_and_counted():
    made = agree(looked_at(
        **GLOSS,
        glass=sphere([0.4, 0.3, 2.2], 0.2, glass(1.5)),
        veil=quad([0.3, -0.3, 2.2], [0.2, 0, 0.1], [0, -0.2, 0], VEIL),
        mirror=quad([-0.4, -0.3, 2.5], [0.2, 0, 0.2], [0, -0.2, 0], MIRROR),
    ))  # fmt: skip
    assert made.info["left_to_path"] > 0
    assert 0 < made.info["left_share"] < 1


def test_what_is_not_diffuse_out_of_sight_and_bent_normals_are_those_of_path():
    made = agree(looked_at(
        mirror=quad([0.79, 0, 1.6], [0, 0, 0.4], [0, -0.7, 0], MIRROR),
        veil=quad([-0.65, 0, 1.2], [0.1, 0, 0.1], [0, -0.4, 0], VEIL),
        ball=smooth_ball(),
    ))  # fmt: skip
    assert made.info["left_to_path"] == 0


# the slow twin


def slow_gather(first, lights, order, hides):
    """Every pixel with every virtual light, in plain loops and double precision."""
    bins = np.zeros((len(first["p"]), order.n_bins + 2))
    for i, x in enumerate(first["p"]):
        for y, n, light, path_m, density in lights:
            away = y - x
            far = np.linalg.norm(away)
            cosines = (first["n"][i] @ away / far) * (-n @ away / far)
            if first["n"][i] @ away <= 0 or n @ away >= 0 or hides(x, y):
                continue
            leg = cosines / far**2
            share = 1 / (1 + _space_time.RAYS * leg / np.pi / density)
            length = np.linalg.norm(x) + far + path_m
            column = int(np.clip((length - order.start_m) / order.bin_m + 1, 0, order.n_bins + 1))
            bins[i, column] += 0.5 / np.pi * leg * light * share
    return bins


def in_the_way(low, high):
    """Whether a box stands between two points, by its slabs."""

    def hides(x, y):
        with np.errstate(divide="ignore"):
            ends = np.sort([(low - x) / (y - x), (high - x) / (y - x)], axis=0)
        return max(ends[0].max(), 1e-4) < min(ends[1].min(), 1 - 1e-4)

    return hides


def test_the_gather_is_its_slow_twin():
    import drjit as dr

    low, high = np.array([0.3, -0.4, 2.0]), np.array([0.5, 0.6, 2.5])
    post = box((low + high) / 2, (high - low) / 2, 0, material("diffuse", 0.5))
    mi = import_mitsuba()
    stage, device = load(looked_at(post=post)), ideal(9, 7, more=",hfov_deg=39.3077")
    task = Task(mi, stage, flashes_of(mi, stage, device))
    [source] = emissions(task, 40)
    lights = virtual_lights(task, source, (0, 40), 4, 3)
    order = Order(7.0, 0.1, 20, 4, 0, 1 << 30)
    first = first_hits(task, rays(device.camera).reshape(-1, 3))
    bins, none = dr.zeros(mi.Float, 63 * 22), dr.zeros(mi.UInt32, 63)
    deposit = depositor(mi, bins, order, 1.0)
    counts = _space_time.gather(task, first, lights, (none, none, none), deposit)
    dr.eval(bins, counts)
    towards = -first.p.numpy().T
    normals = first.n.numpy().T
    normals = normals * np.sign((normals * towards).sum(axis=1, keepdims=True))
    listed = [
        np.asarray(getattr(lights, name).numpy(), np.float64).T
        for name in ("p", "n", "light", "path_m", "density")
    ]
    seen = {"p": first.p.numpy().T.astype(np.float64), "n": normals}
    hides = in_the_way(low, high)
    slow = slow_gather(seen, list(zip(*listed, strict=True)), order, hides)
    free = slow_gather(seen, list(zip(*listed, strict=True)), order, lambda *_: False)
    assert slow.sum() < 0.95 * free.sum()  # the post hides something
    assert slow[:, 0].sum() > 0 < slow[:, -1].sum()  # and something lies on either side of the axis
    fast = bins.numpy().reshape(63, 22)
    # A path within rounding of the edge of a bin may lie on its other side.
    np.testing.assert_allclose(fast.sum(axis=1), slow.sum(axis=1), rtol=1e-4)
    np.testing.assert_allclose(
        np.cumsum(fast, axis=1)[:, ::5], np.cumsum(slow, axis=1)[:, ::5], rtol=2e-3, atol=1e-6
    )
    wrong = np.abs(fast - slow) > 1e-4 * slow.max()
    assert wrong.sum() <= 4
    assert [int(c.numpy().sum()) for c in counts][1:] == [
        pytest.approx(k, abs=2) for k in _counted(slow_counts(seen, listed, order, hides))
    ]


def slow_counts(seen, listed, order, hides):
    """Numbers of contributions by column."""
    found = np.zeros(order.n_bins + 2, int)
    for x, up in zip(seen["p"], seen["n"], strict=True):
        for y, n, _, path_m, _ in zip(*listed, strict=True):
            if up @ (y - x) > 0 > n @ (y - x) and not hides(x, y):
                length = np.linalg.norm(x) + np.linalg.norm(y - x) + path_m
                at = (length - order.start_m) / order.bin_m + 1
                found[int(np.clip(at, 0, order.n_bins + 1))] += 1
    return found


def _counted(found):
    return found[0], found[-1]


# batches, axis, seeds


def test_batches_change_rounding_alone():
    scene = looked_at(**GLOSS)
    shot = Shot(EYE, samples=600, max_bounces=2)
    wide, narrow = (space_time(scene, shot, **AXIS, memory_mb=m) for m in (1024, 1))
    assert wide.info == narrow.info
    # A megabyte holds 61 subpaths and their lights: single precision adds up in another order.
    np.testing.assert_allclose(narrow.values, wide.values, rtol=2e-5, atol=1e-9)
    again = space_time(scene, shot, **AXIS, memory_mb=1024)
    assert again.values.tobytes() == wide.values.tobytes()


def test_batches_of_pixels_change_nothing():
    shot = Shot(EYE, samples=64, max_bounces=2)
    wide, narrow = (space_time(looked_at(), shot, **AXIS, memory_mb=m) for m in (1024, 1.1))
    assert narrow.values.tobytes() == wide.values.tobytes()


def test_light_outside_the_axis_is_kept_apart():
    shot = Shot(EYE, samples=256)
    whole = space_time(looked_at(), shot, **AXIS)
    part = space_time(looked_at(), shot, bin_m=0.05, n_bins=40, start_m=7.0)
    np.testing.assert_allclose(energy(part), energy(whole), rtol=1e-5)
    np.testing.assert_allclose(part.values[1:-1], whole.values[141:179], rtol=1e-3, atol=1e-5)
    assert part.info["samples"] == whole.info["samples"]
    assert part.info["before"] > 0 < part.info["beyond"]
    assert part.missed.sum() > 0


def test_direct_light_is_in_its_bin():
    made = space_time(Scene("wall", {"range": 2.0}), Shot(EYE, max_bounces=0), **AXIS)
    range_m = 2.0 / rays(EYE.camera)[..., 2]
    np.testing.assert_array_equal(made.values.argmax(axis=0), np.floor(2 * range_m / 0.05))
    assert (np.count_nonzero(made.values, axis=0) == 1).all()
    assert made.info["virtual_lights"] == 0


def test_a_delay_moves_the_axis():
    late = replace(EYE, emitters=(Emitter(delay_s=4e-9),))
    shift = float(time_to_path(4e-9))
    one = space_time(looked_at(), Shot(EYE, samples=256), **AXIS)
    two = space_time(looked_at(), Shot(late, samples=256), **AXIS, start_m=shift)
    np.testing.assert_allclose(energy(two), energy(one), rtol=1e-5)
    assert np.abs(two.values - one.values).sum() < 2e-3 * one.values.sum()


def test_nothing_in_sight_is_dark():
    aside = World({"wall": quad([4, 0, 2.0], [0.1, 0, 0], [0, 0.1, 0], GREY)})
    made = space_time(aside, Shot(EYE, samples=64), **AXIS)
    assert not made.values.any()
    assert made.info["left_share"] == 0


def test_black_walls_send_nothing_on():
    black = World({"wall": quad([0, 0, 2.0], [3, 0, 0], [0, -3, 0], BLACK)})
    assert energy(space_time(black, Shot(EYE, samples=64), **AXIS)).sum() < 1e-9


LIT = World(
    {"lamp": {**quad([0, 0, 2.0], [1, 0, 0], [0, -1, 0], GREY),
              "light": {"type": "area", "radiance": 1.0}, "id": "lamp"}},
    lamp_gain=1.0, modulated_s={"lamp": 0.0},
)  # fmt: skip


@pytest.mark.parametrize(
    ("scene", "fields", "match"),
    [
        (looked_at(), {"bin_m": 0.0}, "bin_m must be positive"),
        (looked_at(), {"n_bins": 0}, "bins for 16 x 12 px"),
        (looked_at(), {"n_bins": 1 << 25}, "take wider bins"),
        (looked_at(), {"start_m": np.nan}, "start_m finite"),
        (looked_at(), {"memory_mb": 0}, "memory_mb must be a positive"),
        (looked_at(), {"memory_mb": np.inf}, "memory_mb must be a positive"),
        ("cornell", {}, "wanted a Scene or a World"),
        (LIT, {}, "lamps that are modulated"),
    ],
)
def test_bad_requests_get_one_sentence(scene, fields, match):
    with pytest.raises(ValueError, match=match) as caught:
        space_time(scene, Shot(EYE), **fields)
    assert "\n" not in str(caught.value)
