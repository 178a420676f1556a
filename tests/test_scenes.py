"""Procedural scenes: rays meet what the closed form says; what cannot be is refused."""

from itertools import combinations

import numpy as np
import pytest
from stage_rays import cast

from toftools._native import import_mitsuba
from toftools.camera import pinhole, rays
from toftools.registry import parameters_of, parse_entry
from toftools.sim.analytic import SCENES
from toftools.sim.rooms import CLEAR_M
from toftools.sim.scenes import WORLDS, from_dict, world_of
from toftools.sim.solids import MATERIALS, OPAQUE
from toftools.sim.stage import load
from toftools.sim.world import look_at, world_at
from toftools.types import Scene

CAMERA = pinhole(40, 30, hfov_deg=70)
RAYS = rays(CAMERA).reshape(-1, 3)
# Mitsuba traces in single precision: 24 bits of ranges and places of a few metres.
FLOAT32_M = 3e-6
GREY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def world(text):
    return world_of(Scene(*parse_entry(text)))


def stage(text):
    return load(world(text), merge=False)  # merged meshes lose their names


# Geometry against closed forms


@pytest.mark.parametrize(
    "text",
    [
        "wall", "wall:range=0.3", "wall:range=40,material=checker", "tilted", "tilted:tilt=-50",
        "cavity", "cavity:radius=0.5", "corner", "corner:angle=60,range=1.5,size=0.7,height=0.5",
        "corner:angle=140,material=plastic",
    ],
)  # fmt: skip
def test_ranges_are_those_of_the_closed_form(text):
    name, params = parse_entry(text)
    params = {k: v for k, v in params.items() if k != "material"}
    expected = SCENES[name](CAMERA, **params).range_m.ravel()
    range_m, normal, _ = cast(stage(text), RAYS)
    assert (np.isnan(range_m) == np.isnan(expected)).mean() > 0.999  # a ray may graze an edge
    both = np.isfinite(range_m) & np.isfinite(expected)
    error = np.abs(range_m - expected)[both]
    # At grazing incidence a rounding of the direction moves the hit along the surface.
    grazing = np.abs((normal * RAYS).sum(axis=1))[both]
    assert (error * grazing < FLOAT32_M * np.fmax(1, expected[both])).all()


def test_a_wall_fills_a_fisheye_without_losing_digits():
    """Points on the wall, not only ranges, matter: shadow rays start there."""
    mi = import_mitsuba()
    wide = pinhole(64, 48, hfov_deg=170)
    directions = rays(wide).reshape(-1, 3)
    loaded = stage("wall:range=2")
    range_m, _, _ = cast(loaded, directions)
    assert np.isfinite(range_m).all()
    away = mi.Vector3f(np.ascontiguousarray(directions.T, dtype=np.float32))
    hit = loaded.scene.ray_intersect(mi.Ray3f(mi.Point3f(0), away))
    places = directions * (2 / directions[:, 2:])
    error = np.linalg.norm(np.array(hit.p).T - places, axis=1)
    # Single precision of the direction, amplified by 1 / cos where it grazes.
    assert (error <= 4e-7 * np.linalg.norm(places, axis=1) / directions[:, 2]).all()


@pytest.mark.parametrize("name", sorted(set(SCENES) & set(WORLDS)))
def test_builders_take_what_the_closed_forms_take(name):
    theirs, ours = parameters_of(SCENES[name]), parameters_of(WORLDS[name])
    assert theirs.items() <= ours.items()


def test_plates_stand_on_both_sides_and_end():
    loaded = stage("plates:gap=2,range=0.5,size=30")
    for sign, z in ((1, 0.5), (-1, 1.5)):
        directions = RAYS * [1, 1, sign]
        range_m, normal, names = cast(loaded, directions)
        assert np.abs(range_m * RAYS[:, 2] - z).max() < FLOAT32_M
        assert np.allclose(normal, [0, 0, -sign]), "both face the camera"
        assert set(names) == {"front" if sign > 0 else "back"}
    edge = np.array([[14.99, 0, 0.5], [15.01, 0, 0.5], [0, -14.99, 0.5], [0, -15.01, 0.5]])
    range_m, _, _ = cast(loaded, edge / np.linalg.norm(edge, axis=1, keepdims=True))
    assert np.isfinite(range_m).tolist() == [True, False, True, False]


def test_disc_lights_the_point_on_the_axis_as_its_form_factor_says():
    mi = import_mitsuba()
    loaded = stage("disc:range=1,gap=2,radius=0.8,radiance=3")
    back, _, names = cast(loaded, np.array([[0, 0, -1.0], [0.7, 0, -1], [0.9, 0, -1]]))
    assert names.tolist() == ["disc", "disc", ""]
    assert back[0] == pytest.approx(1, abs=FLOAT32_M)
    assert loaded.lamp_modulated.tolist() == [True] and loaded.lamp_gain == 1
    n = 1 << 14
    hit = loaded.scene.ray_intersect(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)))
    rng = np.random.default_rng(0)
    sample = mi.Point2f(rng.random((2, n)).astype(np.float32))
    light, weight = loaded.scene.sample_emitter_direction(hit, sample, True)
    irradiance = np.array(weight)[0] * np.array(mi.Frame3f.cos_theta(hit.to_local(light.d)))
    exact = np.pi * 3 * 0.8**2 / (0.8**2 + 2**2)  # radiance times the form factor of a disc
    standard_error = irradiance.std() / np.sqrt(n)
    assert abs(irradiance.mean() - exact) < 4 * standard_error + 1e-6


def test_slab_is_glass_of_the_given_thickness_and_index():
    mi = import_mitsuba()
    loaded = stage("slab:range=2,thickness=0.25,gap=0.5,index=1.7")
    at, found = 0.0, []
    for _ in range(3):
        ray = mi.Ray3f(mi.Point3f(0.01, 0.02, at + 1e-4), mi.Vector3f(0, 0, 1))
        hit = loaded.scene.ray_intersect(ray)
        at = float(hit.p.z[0])
        found.append((hit.shape[0].id(), round(at, 5), float(hit.n.z[0])))
    assert found == [("near", 1.25, -1.0), ("far", 1.5, 1.0), ("wall", 2.0, -1.0)]
    eta = [np.array(v) for k, v in mi.traverse(loaded.scene) if k.endswith("bsdf.eta")]
    assert np.allclose(eta, 1.7, rtol=1e-6), "against vacuum, not air"


def test_cornell_box_fills_its_field_of_view_with_the_right_sides():
    loaded = stage("cornell:size=2")
    view = pinhole(60, 60, hfov_deg=39.3)
    directions = rays(view).reshape(-1, 3)
    range_m, _, names = cast(loaded, directions)
    near = 1 / np.tan(np.radians(39.3077) / 2)
    with np.errstate(divide="ignore"):
        shell = np.min([1 / np.abs(directions[:, :2]).max(axis=1), (near + 2) / directions[:, 2]],
                       axis=0)  # fmt: skip
    on_box = np.isin(names, ["small", "large"])
    assert np.abs(range_m - shell)[~on_box].max() < 1e-5  # 5 m away in single precision
    assert (range_m < shell)[on_box].all() and 0.1 < on_box.mean() < 0.5
    picture = names.reshape(60, 60)
    assert picture[30, 1] == "left" and picture[30, 58] == "right"
    assert picture[1, 30] == "ceiling" and picture[58, 30] == "floor"
    assert picture[45, 40] == "small" and picture[30, 20] == "large"
    albedo = {n: e["bsdf"]["bsdf"]["reflectance"] for n, e in world("cornell").description.items()}
    assert albedo["left"] != albedo["right"]


def test_v_of_panels_is_the_corner_of_its_size_beside_a_panel():
    text = "range=1.5,angle=90,size=0.6,height=0.8"
    range_m, _, names = cast(stage(f"vshape:{text}"), RAYS)
    name, params = parse_entry(f"corner:{text}")
    expected = SCENES[name](CAMERA, **params).range_m.ravel()
    in_v = np.isin(names, ["left", "right"])
    assert in_v.mean() > 0.1 and np.nanmax(np.abs(range_m - expected)[in_v]) < FLOAT32_M
    flat = names == "flat"
    assert np.abs(range_m * RAYS[:, 2] - 1.38)[flat].max() < FLOAT32_M
    assert (RAYS[flat, 0] > 0).all() and flat.any()
    rest = ~in_v & ~flat
    assert np.abs(range_m * RAYS[:, 2] - 2.5)[rest].max() < FLOAT32_M


def test_prisms_stand_in_their_box():
    loaded = stage("prism:range=0.8,wall=0")
    view = rays(pinhole(200, 200, hfov_deg=40)).reshape(-1, 3)
    range_m, _, names = cast(loaded, view)
    at = (view * range_m[:, None])[np.isfinite(range_m)]
    assert (np.abs(at) <= [0.3 + 1e-5, 0.25 + 1e-5, np.inf]).all()
    assert at[:, 2].min() > 0.8 - 1e-5 and at[:, 2].max() == pytest.approx(0.8 + 0.64, abs=1e-5)
    assert {"prism_3", "prism_4", "prism_6", "e_0", "e_1", "e_2", "e_3"} <= set(names)
    for name, entry in world("prism:range=0.8").description.items():
        if name.startswith("prism"):
            assert entry["vertices"][:, 1].max() == pytest.approx(0.25 - 1e-4)
            _check_closed_outwards(entry)


def _check_closed_outwards(entry):
    """Every edge has two faces that run along it in opposite ways, and the volume is positive."""
    faces, corners = entry["faces"], entry["vertices"]
    edges = [(f[i], f[(i + 1) % 3]) for f in faces for i in range(3)]
    assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
    a, b, c = (corners[faces[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


# Rooms


def _solids(description):
    """Boxes as (centre, axes (3, 3) of half lengths in rows) and spheres as (centre, radius)."""
    boxes, spheres = {}, {}
    for name, entry in description.items():
        if entry["type"] == "cube":
            boxes[name] = entry["to_world"][:3, 3], entry["to_world"][:3, :3].T
        elif entry["type"] == "sphere":
            spheres[name] = np.array(entry["center"]), entry["radius"]
    return boxes, spheres


def _boxes_overlap(one, other):
    """Separating axes of two upright boxes: y, and the two horizontal axes of each."""
    axes = [np.array([0.0, 1.0, 0.0]), *one[1][[0, 2]], *other[1][[0, 2]]]
    for axis in axes:
        reach = np.abs(one[1] @ axis).sum() + np.abs(other[1] @ axis).sum()
        if abs((one[0] - other[0]) @ axis) >= reach:
            return False
    return True


def _ball_in_box(ball, box):
    local = box[1] / np.linalg.norm(box[1], axis=1, keepdims=True) @ (ball[0] - box[0])
    outside = np.maximum(np.abs(local) - np.linalg.norm(box[1], axis=1), 0)
    return np.linalg.norm(outside) < ball[1]


@pytest.mark.parametrize("seed", range(30))
def test_room_stands_and_nothing_overlaps(seed):
    made = world(f"room:seed={seed},boxes=8,balls=5")
    boxes, balls = _solids(made.description)
    assert len([n for n in boxes if n.startswith("box_")]) == 8 and len(balls) == 5
    for one, other in combinations(boxes, 2):
        assert not _boxes_overlap(boxes[one], boxes[other]), (one, other)
    for name, ball in balls.items():
        assert not any(_ball_in_box(ball, box) for box in boxes.values()), name
    for (a, r), (b, s) in combinations(balls.values(), 2):
        assert np.linalg.norm(a - b) > r + s
    shell = made.description
    half = np.array([shell["floor"]["to_world"][0, 0], 0, shell["floor"]["to_world"][2, 1]])
    table_top = boxes["table"][0][1] - boxes["table"][1][1, 1]
    grounds = np.array([0.0, table_top])
    for name, (centre, axes) in boxes.items():
        corners = (
            centre + np.array([[u, v, w] for u in (-1, 1) for v in (-1, 1) for w in (-1, 1)]) @ axes
        )
        assert (np.abs(corners[:, [0, 2]]) < half[[0, 2]]).all(), name
        if name != "table":
            assert np.abs(corners[:, 1].max() + CLEAR_M - grounds).min() < 1e-9, f"{name} floats"
    for name, (centre, radius) in balls.items():
        assert (np.abs(centre[[0, 2]]) + radius < half[[0, 2]]).all(), name
        assert np.abs(centre[1] + radius + CLEAR_M - grounds).min() < 1e-9, f"{name} floats"


@pytest.mark.parametrize("seed", range(12))
def test_room_shows_clutter_at_useful_ranges(seed):
    range_m, _, names = cast(stage(f"room:seed={seed}"), RAYS)
    assert np.isfinite(range_m).all(), "a room is closed"
    assert range_m.min() > 0.4 and range_m.max() < 9
    clutter = ~np.isin(names, ["floor", "ceiling", "wall_1", "wall_2", "wall_3", "wall_4"])
    assert 0.04 < clutter.mean() < 0.8 and len(set(names)) >= 8


def _same(one, other):
    assert one.keys() == other.keys()
    for key, value in one.items():
        if isinstance(value, dict):
            _same(value, other[key])
        else:
            assert np.array_equal(value, other[key]), key


def test_rooms_are_their_seed():
    _same(dict(world("room:seed=3").description), dict(world("room:seed=3").description))
    assert np.array_equal(world("room:seed=3").to_world, world("room:seed=3").to_world)
    other = world("room:seed=4")
    assert not np.array_equal(world("room:seed=3").to_world, other.to_world)
    more, fewer = world("room:seed=3,boxes=9"), world("room:seed=3,boxes=0,balls=0")
    for name, entry in fewer.description.items():
        _same(entry, more.description[name])
    shiny = world("room:seed=3,material=mirror").description
    for name, entry in world("room:seed=3").description.items():
        assert np.array_equal(entry.get("to_world"), shiny[name].get("to_world"))


def test_albedos_of_rooms_are_those_of_the_published_data_sets():
    values = []
    for seed in range(20):
        for entry in world(f"room:seed={seed}").description.values():
            values.append(entry["bsdf"]["bsdf"]["reflectance"])
    assert min(values) >= 0.3 and max(values) <= 0.8
    assert np.std(values) > 0.1, "they vary"


def test_no_sky_shines_through_the_walls_of_a_closed_room():
    """Mitsuba's own merging of rectangles loses their bounds, and shadow rays end too early."""
    mi = import_mitsuba()
    made = world("room:seed=3,boxes=0,balls=0")
    shapes = {n: {**e, "bsdf": GREY} for n, e in made.description.items()}
    sky = {"sky": {"type": "constant", "radiance": 1.0}}
    loaded = load(from_dict(shapes | sky, to_world=made.to_world))
    walls = np.array([[-2.42671, -2.62721, -2.87447], [2.42671, 0, 2.87447]])
    box = loaded.scene.bbox()
    assert np.array([box.min, box.max]) == pytest.approx(walls, abs=1e-4)
    hit = loaded.scene.ray_intersect(
        mi.Ray3f(mi.Point3f(*map(float, made.to_world[:3, 3])), mi.Vector3f(0, 1, 0))
    )
    sample = mi.Point2f(np.random.default_rng(0).random((2, 4096)).astype(np.float32))
    way, light = loaded.scene.sample_emitter_direction(hit, sample, True)
    up = np.array(way.d)[1] < -1e-3  # from the floor into the room
    assert up.any() and not np.array(light)[0][up].any()


def test_merging_meshes_moves_nothing():
    made = world("room:seed=3,boxes=20,balls=2")
    shapes = {n: {**e, "bsdf": GREY} for n, e in made.description.items() if e["type"] == "cube"}
    made = from_dict(shapes, to_world=made.to_world)
    merged, single = load(made), load(made, merge=False)
    assert len(merged.scene.shapes()) < len(single.scene.shapes())
    (range_m, normal, _), (expected, way, _) = cast(merged, RAYS), cast(single, RAYS)
    seen = np.isfinite(expected)
    assert np.array_equal(seen, np.isfinite(range_m)) and seen.any()
    assert np.abs(range_m - expected)[seen].max() < 5 * FLOAT32_M  # up to 5 m away
    assert np.allclose(normal[seen], way[seen], atol=1e-5)


# Materials


@pytest.mark.parametrize("name", OPAQUE)
def test_every_material_is_a_wall(name):
    mi = import_mitsuba()
    loaded = stage(f"wall:material={name},albedo=0.6")
    hit = loaded.scene.ray_intersect(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0.1, 0.13, 1)))
    flags = loaded.scene.shapes()[0].bsdf().flags()
    assert mi.has_flag(flags, mi.BSDFFlags.BackSide), "both sides are the same"
    rng = np.random.default_rng(1)
    context, n = mi.BSDFContext(), 4096
    two = mi.Point2f(rng.random((2, n)).astype(np.float32))
    one = mi.Float(rng.random(n).astype(np.float32))
    _, weight = hit.bsdf().sample(context, hit, one, two)
    reflected = np.array(weight)[0].mean()
    assert 0 < reflected <= 1.01, "no more light than came"
    if name in ("diffuse", "mirror", "checker"):
        assert reflected == pytest.approx(0.6, abs=1e-5) or name == "checker"


@pytest.mark.parametrize("name", MATERIALS)
def test_every_material_is_a_ball_in_a_room(name):
    assert len(stage(f"room:material={name}").scene.shapes()) == 6 + 6 + 5 + 3


def test_a_checker_board_has_two_albedos():
    mi = import_mitsuba()
    loaded = stage("wall:material=checker,albedo=0.8")
    # Squares are a tenth of a metre: the rays meet the middles of neighbours at 2 m.
    seen = []
    for x in (0.05, 0.15, 0.25):
        hit = loaded.scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.05, 0), mi.Vector3f(0, 0, 1)))
        seen.append(float(hit.bsdf().eval_diffuse_reflectance(hit)[0][0]))
    assert seen[0] == pytest.approx(seen[2]) and sorted(seen[:2]) == pytest.approx([0.2, 0.8])


# Poses


def test_our_rays_are_those_of_mitsubas_own_camera():
    """Through every pixel centre, with an upright picture: left is left and up is up."""
    mi = import_mitsuba()
    at, to, top = [1.0, 2.0, 3.0], [4.0, 1.0, -2.0], [0.1, 1.0, 0.2]
    pose = mi.ScalarTransform4f().look_at(at, to, top)
    film = {"type": "hdrfilm", "width": 40, "height": 30, "pixel_format": "luminance"}
    sensor = {"type": "perspective", "fov": 70, "fov_axis": "x", "to_world": pose,
              "near_clip": 0.7, "film": film}  # fmt: skip
    ball = {"type": "sphere", "center": to, "bsdf": GREY}
    loaded = load(from_dict({"type": "scene", "sensor": sensor, "ball": ball}))
    v, u = np.mgrid[0:30, 0:40]
    place = mi.Point2f((u.ravel() + 0.5) / 40, (v.ravel() + 0.5) / 30)
    theirs, _ = mi.load_dict(sensor).sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    ours = RAYS @ loaded.to_world[:3, :3].T
    assert np.abs(np.array(theirs.d).T - ours).max() < 1e-6
    assert np.allclose(loaded.to_world[:3, 3], at)
    assert np.allclose(loaded.to_world, look_at(at, to, top), atol=1e-6)


def test_near_clip_never_matters():
    ball = {"type": "sphere", "center": [0, 0, 2], "radius": 0.5, "bsdf": GREY}
    for near in (1e-4, 0.1, 1.9):
        sensor = {"type": "perspective", "near_clip": near}
        range_m, _, _ = cast(load(from_dict({"s": sensor, "b": ball})), np.array([[0, 0, 1.0]]))
        assert range_m[0] == pytest.approx(1.5, abs=FLOAT32_M)


def test_an_asymmetrical_scene_lands_where_it_should():
    """Through a pose: three balls right, below and ahead of a camera that looks along -x."""
    pose = look_at((10, 20, 30), (0, 20, 30), (0, 0, 1))  # z up: right is +y
    places = {"right": (8, 21, 30), "below": (8, 20, 29), "ahead": (7, 20, 30)}
    balls = {n: {"type": "sphere", "center": p, "radius": 0.2, "bsdf": GREY}
             for n, p in places.items()}  # fmt: skip
    loaded = load(from_dict(balls, to_world=pose, unit_m=0.01))
    aims = np.array([[1, 0, 2], [0, 1, 2], [0, 0, 1.0]])
    range_m, normal, names = cast(loaded, aims / np.linalg.norm(aims, axis=1, keepdims=True))
    assert names.tolist() == ["right", "below", "ahead"]
    assert np.allclose(range_m, 0.01 * (np.array([5**0.5, 5**0.5, 3]) - 0.2), atol=1e-7)
    assert np.allclose(normal, -aims / np.linalg.norm(aims, axis=1, keepdims=True), atol=1e-4)


def test_look_at_needs_a_line_of_sight():
    with pytest.raises(ValueError, match="line of sight must not lie on up"):
        look_at((0, 0, 0), (0, 2, 0))
    with pytest.raises(ValueError, match="line of sight"):
        look_at((0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="camera must be three finite numbers"):
        look_at((0, 0), (0, 0, 1))


# Motion


def test_things_and_camera_move_by_velocity_times_time():
    base = world("wall:range=2,velocity=0+0+1.5")
    assert world_at(base, 0.0) is not None
    ahead = np.array([[0, 0, 1.0]])
    for time_s, expected in ((0.0, 2.0), (0.1, 2.15), (-0.2, 1.7)):
        assert cast(load(world_at(base, time_s)), ahead)[0][0] == pytest.approx(expected, abs=1e-6)
    pose = look_at((1, 2, 3), (1, 2, 8))
    ball = {"ball": {"type": "sphere", "center": [1, 2, 7], "radius": 1, "bsdf": GREY}}
    still = {"to_world": pose, "unit_m": 0.5}
    towards = from_dict(ball, velocity_mps={"camera": (0, 0, 1)}, **still)
    away = from_dict(ball, velocity_mps={"ball": (0, 0, 1)}, **still)
    both = from_dict(ball, velocity_mps={"camera": (3, 2, 1), "ball": (3, 2, 1)}, **still)
    for moving, expected in ((towards, 1.25), (away, 1.75), (both, 1.5)):
        assert cast(load(world_at(moving, 0.25)), ahead)[0][0] == pytest.approx(expected, abs=1e-6)
    first = world("room:seed=3,velocity=0+1+0")
    here, there = (world_at(first, t).description["box_1"]["to_world"][:3, 3] for t in (0.0, 0.1))
    assert (there - here) @ first.to_world[:3, 1] == pytest.approx(0.1)


def test_motion_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="a velocity for 'nothing', which moves nothing"):
        world_at(from_dict({"b": {"type": "sphere"}}, to_world=np.eye(4),
                           velocity_mps={"nothing": (0, 0, 1)}), 1.0)  # fmt: skip
    with pytest.raises(ValueError, match="motion needs the pose"):
        world_at(from_dict({}, velocity_mps={"camera": (0, 0, 1)}), 1.0)
    with pytest.raises(ValueError, match="wall must be three finite numbers"):
        world("wall:velocity=1+2")


# What is refused


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nope", "unknown scene 'nope'; scenes: wall, tilted, .*files: .xml, .ply"),
        ("two_returns", "two_returns plants what follows the first and has no geometry"),
        ("wall:range=-1", "range must be a positive number, got -1"),
        ("wall:albedo=nan", "got albedo=nan, wanted a number"),
        ("wall:albedo=1.2", r"albedo must be in \(0, 1\], got 1.2"),
        ("wall:albedo=0", r"albedo must be in \(0, 1\], got 0"),
        ("wall:material=wood", "got material 'wood', wanted one of: diffuse, rough_conductor"),
        ("wall:material=dielectric", "got material 'dielectric', wanted one of: diffuse"),
        ("wall:colour=1", "has no parameter 'colour'"),
        ("wall:ambient_e=-1", "ambient_e must be 0 or more"),
        ("tilted:tilt=90", "tilt must lie within"),
        ("cavity:albedo=1", "a closed cavity needs albedo below 1"),
        ("corner:angle=180", "angle must lie in 10..180"),
        ("plates:range=3", "the camera stands between the plates"),
        ("disc:radiance=-1", "the camera stands between wall and disc"),
        ("slab:index=1", "wanted an index in"),
        ("slab:thickness=1.6", "wanted an index in .* glass in front of the camera"),
        ("vshape:size=9", "end in front of the camera"),
        ("vshape:wall=1", "wanted 0 for none or more than 1.5 m"),
        ("room:seed=-1", "got seed=-1"),
        ("room:boxes=101", "boxes=101"),
        ("room:boxes=100,balls=100", "no place for so many things"),
        ("room:boxes=0,velocity=0+0+1", "boxes=0"),
    ],
)
def test_impossible_scenes_are_refused_in_a_sentence(text, message):
    with pytest.raises(ValueError, match=message) as error:
        world(text)
    assert "\n" not in str(error.value)


BALL = {"type": "sphere", "center": [0, 0, 3], "bsdf": GREY}
NAN = float("nan")


def _mesh(vertices, faces, **more):
    return {"type": "arrays", "vertices": vertices, "faces": faces, "bsdf": GREY, **more}


TRIANGLE = [[0, 0, 2], [1, 0, 2], [0, 1, 2]]


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ({}, "the scene has no shapes"),
        ({"e": {"type": "constant"}}, "the scene has no shapes"),
        ({"a": {"type": "sphere", "bsdf": GREY}}, "the camera stands inside the shape 'a'"),
        ({"a": {"type": "cube"}, "b": {**BALL, "radius": 9}}, "stands inside the shape 'a'"),
        ({"a": {"type": "sphere"}}, "the camera stands inside"),
        ({"a": {**BALL, "radius": 2.9995}}, "the camera touches the shape 'a'"),
        ({"a": {**BALL, "radius": 3.0}}, "the camera touches the shape 'a'"),
        ({"a": {**BALL, "radius": 3.0005}}, "the camera touches the shape 'a'"),
        ({"a": {"type": "rectangle", "to_world": look_at((0, 0, 0), (1, 0, 0))}}, "camera touches"),
        ({"a": {**BALL, "center": [0, 0, -3]}}, "the camera sees nothing"),
        ({"a": {**BALL, "radius": NAN}}, "the shape 'a' of the scene has no finite place"),
        ({"a": {**BALL, "bsdf": {"type": "diffuse", "reflectance": NAN}}}, "holds nan, wanted"),
        ({"a": {**BALL, "bsdf": {"type": "diffuse", "reflectance": -0.1}}}, "holds -0.1, wanted"),
        ({"a": {**BALL, "bsdf": {"type": "diffuse", "reflectance": 1.1}}}, "holds 1.1, wanted"),
        ({"a": {**BALL, "bsdf": {"type": "roughconductor", "alpha": NAN}}}, "holds nan"),
        ({"a": {**BALL, "bsdf": {"type": "velvet"}}}, 'Plugin "velvet" not found'),
        ({"a": {**BALL, "bsdf": {"type": "conductor", "material": "Xx"}}}, "does not exist"),
        ({"a": {**BALL, "centre": 3.0}}, 'unreferenced property .*"centre"'),
        ({"a": {"type": "blob"}}, 'Plugin "blob" not found'),
        ({"a": {"type": "obj", "filename": "gone.obj"}}, "gone.obj.*file not found"),
        ({"a": {**BALL, "e": {"type": "area", "radiance": -1.0}}}, "holds -1, wanted"),
        ({"a": _mesh(TRIANGLE, [[0, 1, 3]])}, r"the mesh 'a' has vertices \(3, 3\)"),
        ({"a": _mesh(TRIANGLE, [[0, 1, -1]])}, "the mesh 'a'"),
        ({"a": _mesh(TRIANGLE, [])}, "the mesh 'a'"),
        ({"a": _mesh([[0, 0, NAN], *TRIANGLE[1:]], [[0, 1, 2]])}, "holds nan"),
        ({"a": _mesh(TRIANGLE, [[0, 1, 2]], uv=[[0, 0]])}, "uv of the mesh 'a' must have shape"),
        ({"a": {**_mesh(TRIANGLE, [[0, 1, 2]]), "bsdf": None}}, "no material"),
    ],
)
def test_what_mitsuba_takes_or_tells_at_length_is_refused_in_a_sentence(shapes, message, capfd):
    with pytest.raises(ValueError, match=message) as error:
        load(from_dict(shapes, to_world=np.eye(4)))
    assert "\n" not in str(error.value) and "[" not in str(error.value).split("wanted")[0][:20]
    assert not capfd.readouterr().err, "Mitsuba keeps quiet"


def test_textures_are_checked_and_bytes_need_no_check():
    mi = import_mitsuba()
    for data, good in ((np.full((2, 2, 1), 1.5, np.float32), False), (np.ones((2, 2, 1)), True)):
        texture = {"type": "bitmap", "data": mi.TensorXf(data.astype(np.float32)), "raw": True}
        shapes = {"a": {**BALL, "bsdf": {"type": "diffuse", "reflectance": texture}}}
        if good:
            load(from_dict(shapes, to_world=np.eye(4)))
        else:
            with pytest.raises(ValueError, match=r"reflectance.data .* holds 1.5"):
                load(from_dict(shapes, to_world=np.eye(4)))


@pytest.mark.parametrize(
    "shapes",
    [
        {"a": {"type": "sphere", "flip_normals": True, "bsdf": GREY}},
        {"a": {"type": "sphere", "bsdf": {"type": "dielectric"}}},
        {"a": {"type": "cube", "flip_normals": True, "bsdf": GREY}},
        {"a": {"type": "sphere", "radius": 9, "bsdf": GREY}, "b": {**BALL, "radius": 2}},
        {"a": {**BALL, "radius": 2.99}},
        {"a": {**BALL, "center": [0, 0, 40], "radius": 0.01}},
    ],
)
def test_cameras_in_caves_rooms_and_glass_are_fine(shapes):
    load(from_dict(shapes, to_world=np.eye(4)))


def test_lamps_go_by_their_own_id_or_that_of_their_shape():
    shapes = {
        "ball": BALL,
        "bulb": {"type": "point", "position": [0, 0, 0], "intensity": 1.0},
        "panel": {"type": "rectangle", "to_world": look_at((0, 5, 3), (0, 0, 3), (0, 0, 1)),
                  "emitter": {"type": "area", "radiance": 2.0}},
        "sky": {"type": "constant", "radiance": 0.1},
    }  # fmt: skip
    made = from_dict(shapes, to_world=np.eye(4), modulated_s={"panel": 2e-9, "bulb": 0.0},
                     lamp_gain=0.3)  # fmt: skip
    loaded = load(made)
    ids = [lamp.id() for lamp in loaded.scene.emitters()]
    told = dict(zip(ids, zip(loaded.lamp_modulated, loaded.lamp_delay_s, strict=True), strict=True))
    assert told == {"bulb": (True, 0.0), "emitter": (True, 2e-9), "sky": (False, 0.0)}
    assert loaded.lamp_gain == 0.3
    with pytest.raises(
        ValueError, match=r"modulated=sun, which is no lamp .*: bulb, emitter, panel"
    ):
        load(from_dict(shapes, to_world=np.eye(4), modulated_s={"sun": 0.0}))


def test_names_of_scenes_need_no_engine():
    import subprocess
    import sys

    code = ("import sys; from toftools.sim.scenes import WORLDS, FILES, world_of; "
            "from toftools.types import Scene; [world_of(Scene(n)) for n in WORLDS]; "
            "print(*{'mitsuba', 'drjit', 'open3d'} & set(sys.modules))")  # fmt: skip
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""


@pytest.mark.parametrize("thing", ["cornell", None, [1, 2]])
def test_what_is_no_dictionary_is_refused_in_one_sentence(thing):
    with pytest.raises(ValueError, match="wanted a Mitsuba dictionary"):
        from_dict(thing)
