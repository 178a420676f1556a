"""Scene files: Mitsuba XML old and new, meshes, the public scenes; hostile ones in a sentence."""

import os
import subprocess
import sys
from pathlib import Path

import hostile_scenes
import numpy as np
import pytest
from stage_rays import cast

from toftools._native import import_mitsuba, two_threads_at_least
from toftools.camera import pinhole, rays
from toftools.registry import parse_entry
from toftools.sim.mesh import MESHES, read_mesh
from toftools.sim.scenes import from_dict, world_of
from toftools.sim.stage import load
from toftools.sim.world import world_at
from toftools.types import Scene

RAYS = rays(pinhole(40, 30, hfov_deg=70)).reshape(-1, 3)
AHEAD = np.array([[0, 0, 1.0]])
PUBLIC = Path(os.environ.get("TOFTOOLS_DATA", "/nonexistent")).parent / "scenes"


def public(name):
    path = PUBLIC / name
    if not path.is_file():
        pytest.skip(f"no scene {name} beside TOFTOOLS_DATA")
    return path


def world(path, text=""):
    return world_of(Scene(str(path), parse_entry(f"x:{text}")[1]))


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


# Old scene files

OLD = """<?xml version="1.0" encoding="utf-8"?>
<scene version="0.6.0">
    <default name="method" value="sppm"/><default name="far" value="4"/>
    <path value="elsewhere"/>
    <integrator type="$method"><integer name="maxDepth" value="65"/></integrator>
    <sensor type="perspective">
        <float name="nearClip" value="1"/>
        <transform name="toWorld">
            <lookAt origin="0, 1, 0" target="0, 1, 1" up="0, 1, 0"/></transform>
        <sampler type="ldsampler"/>
        <film type="ldrfilm"><float name="gamma" value="2.2"/></film>
    </sensor>
    <sensor type="spherical"/>
    <bsdf type="roughdiffuse" id="Rough"><rgb name="reflectance" value="0.2"/>
        <float name="alpha" value="1"/></bsdf>
    <bsdf type="phong" id="Shiny"><spectrum name="diffuseReflectance" value="0.4"/>
        <float name="exponent" value="30"/></bsdf>
    <bsdf type="coating" id="Coated"><string name="intIOR" value="amber"/>
        <bsdf type="coating"><bsdf type="roughconductor" id="inner">
            <float name="extEta" value="1"/><string name="material" value="Cu"/>
        </bsdf></bsdf>
    </bsdf>
    <bsdf type="twosided" id="Triple"><bsdf type="diffuse">
        <spectrum name="reflectance" value="0.6, 0.6,0.6"/></bsdf></bsdf>
    <bsdf type="diffuse" id="Picture"><texture name="reflectance" type="bitmap">
        <string name="filename" value="tex/p.png"/>
        <string name="filterType" value="trilinear"/></texture></bsdf>
    <shape type="sphere" id="a"><point name="center" value="-2,1,$far"/><ref id="Rough"/></shape>
    <shape type="sphere" id="b"><point name="center" value="2,1,$far"/><ref id="Shiny"/></shape>
    <shape type="sphere" id="c"><point name="center" value="0,3,$far"/><ref id="Coated"/></shape>
    <shape type="sphere" id="d"><point name="center" value="0,-1,$far"/><ref id="Triple"/></shape>
    <shape type="obj" id="e"><string name="filename" value="wall.obj"/>
        <float name="maxSmoothAngle" value="30"/><ref id="Picture"/></shape>
    <emitter type="sunsky"/>
    <emitter type="point" id="bulb"><spectrum name="intensity" value="1"/></emitter>
</scene>
"""
WALL = (
    "v -9 -9 8\nv 9 -9 8\nv 9 9 8\nv -9 9 8\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 3/3 2/2\nf 1/1 4/1 3/3\n"
)


@pytest.fixture
def old(tmp_path):
    from PIL import Image

    (tmp_path / "tex").mkdir()
    Image.new("L", (4, 4), 128).save(tmp_path / "tex" / "p.png")
    written(tmp_path / "wall.obj", WALL)
    return written(tmp_path / "old.xml", OLD)


def reflectance(loaded, direction):
    """Diffuse reflectance where a camera ray ends."""
    mi = import_mitsuba()
    away = loaded.to_world[:3, :3] @ (np.array(direction) / np.linalg.norm(direction))
    ray = mi.Ray3f(mi.Point3f(*map(float, loaded.to_world[:3, 3])), mi.Vector3f(*map(float, away)))
    hit = loaded.scene.ray_intersect(ray)
    return float(hit.bsdf().eval_diffuse_reflectance(hit)[0][0])


def test_old_scene_becomes_what_its_rules_say(old):
    made = world(old)
    assert set(made.notes) == {
        "removed the integrator (1)", "removed the path (1)", "lookAt -> lookat (1)",
        "kept only the pose of the sensor (1)",
        "removed a further sensor (1)", "removed the emitter sunsky (1)", "removed extEta (1)",
        "removed maxSmoothAngle (1)", "coating -> its inner coating (1)",
        "coating -> its inner roughconductor (1)", "roughdiffuse -> diffuse (1)",
        "phong -> diffuse (1)", "trilinear -> bilinear (1)", "spectrum of three numbers -> rgb (1)",
        "version 0.6.0 -> 0.5.0 (1)",
    }  # fmt: skip
    loaded = load(made, merge=False)
    aims = np.array([[2, 0, 4.0], [-2, 0, 4], [0, -2, 4], [0, 2, 4], [0, 0, 4]])
    aims /= np.linalg.norm(aims, axis=1, keepdims=True)
    range_m, _, names = cast(loaded, aims)
    # Mitsuba's camera looks along +z with x to the left: -x of the scene is on the right.
    assert names.tolist() == ["a", "b", "c", "d", "e"]
    assert np.allclose(range_m, [20**0.5 - 1] * 4 + [8], atol=1e-5)
    assert [reflectance(loaded, aim) for aim in aims[[0, 1, 3]]] == pytest.approx([0.2, 0.4, 0.6])
    assert [lamp.id() for lamp in loaded.scene.emitters()] == ["bulb"]


def test_file_needs_no_folder_to_stand_in(old, monkeypatch, tmp_path_factory):
    made = world(old)
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert cast(load(made), AHEAD)[0][0] == pytest.approx(8, abs=1e-5)
    assert str(old.parent) not in made.description, "the description keeps relative names"


def test_parameters_of_a_file_do_what_they_say(old):
    ours = load(world(old, "camera=0+1+6,target=0+1+8,unit_m=0.5,ambient_e=70,lamps=0.25"))
    assert cast(ours, AHEAD)[0][0] == pytest.approx(1.0, abs=1e-6)
    assert (ours.ambient_e, ours.lamp_gain, ours.unit_m) == (70, 0.25, 0.5)
    upside_down = load(world(old, "camera=0+1+0,target=0+1+4,up=0+-1+0"), merge=False)
    assert cast(upside_down, np.array([[0, -2, 4]]) / 20**0.5)[2].tolist() == ["d"]
    lit = load(world(old, "modulated=bulb,delay_ns=3"))
    assert lit.lamp_modulated.tolist() == [True] and lit.lamp_delay_s == pytest.approx([3e-9])
    moving = world(old, "camera=0+1+0,target=0+1+4,velocity=0+0+2")
    assert cast(load(world_at(moving, 0.5)), AHEAD)[0][0] == pytest.approx(7, abs=1e-5)


def test_albedos_are_chosen_by_material_or_for_all(old):
    near, right = [0, 2, 4], [2, 0, 4]
    chosen = load(world(old, "albedo=0.55"))
    assert [reflectance(chosen, a) for a in (near, right, [0, 0, 1])] == pytest.approx([0.55] * 3)
    table = written(old.parent / "nir.toml", "Triple = 0.9\nCoated = 0.5\n")
    mixed = world(old, f"albedo=0.3,albedos={table}")
    loaded = load(mixed)
    assert [reflectance(loaded, a) for a in (near, right)] == pytest.approx([0.9, 0.3])
    assert "albedo of Triple: 0.9 (1)" in mixed.notes and "albedo 0.3 (4)" in mixed.notes
    metal = [v for k, v in import_mitsuba().traverse(loaded.scene) if "specular_refl" in k]
    assert np.allclose(metal, 0.5)


def test_new_scene_keeps_its_names_and_includes_are_put_in_place(tmp_path):
    (tmp_path / "parts").mkdir()
    written(tmp_path / "parts" / "paint-dark.xml", '<scene version="3.0.0"><bsdf type="plastic" '
            'id="p"><rgb name="diffuse_reflectance" value="0.25"/></bsdf></scene>')  # fmt: skip
    body = """<scene version="3.0.0"><default name="tone" value="dark"/>
      <include filename="parts/paint-$tone.xml"/>
      <sensor type="thinlens"><float name="aperture_radius" value="0.1"/>
        <transform name="to_world"><scale value="3"/></transform></sensor>
      <shape type="sphere"><point name="center" value="0,0,4"/><ref id="p"/></shape></scene>"""
    made = world(written(tmp_path / "new.xml", body))
    loaded = load(made)
    assert cast(loaded, AHEAD)[0][0] == pytest.approx(3, abs=1e-6)
    assert np.allclose(loaded.to_world, np.diag([-1, -1, 1, 1])), "a scaled camera sees the same"
    assert reflectance(loaded, [0, 0, 1]) == pytest.approx(0.25)
    painted = load(world(tmp_path / "new.xml", "albedo=0.7"))
    assert reflectance(painted, [0, 0, 1]) == pytest.approx(0.7)
    assert made.notes == ("kept only the pose of the sensor (1)",)


@pytest.mark.parametrize(("scale", "sides"), [('value="3"', -1), ('x="-3" y="3" z="3"', 1)])
def test_scaled_and_mirrored_cameras_see_what_mitsuba_shows(tmp_path, scale, sides):
    """Mitsuba's unscaled camera has x on its left; a mirrored one shows the scene mirrored."""
    text = f"""<scene version="3.0.0"><sensor type="perspective"><transform name="to_world">
      <scale {scale}/></transform></sensor><shape type="sphere" id="ball">
      <point name="center" value="2, 1, 4"/></shape></scene>"""
    loaded = load(world(written(tmp_path / "m.xml", text)))
    _, _, names = cast(loaded, np.array([[2 * sides, -1, 4]]) / 21**0.5)
    assert names.tolist() == ["ball"]


def test_a_room_of_single_walls_is_no_thing_whichever_way_they_face(tmp_path):
    """Mitsuba merges walls of one material into one mesh, which looks like a solid from inside."""
    walls = ""
    for i, side in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        across = np.roll(side, 1)
        up = np.cross(side, across)  # the triangles look outwards
        corners = [
            3 * (side + u * across + v * up) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        lines = ["v " + " ".join(map(str, c)) for c in corners] + ["f 1 2 3", "f 1 3 4"]
        written(tmp_path / f"{i}.obj", "\n".join(lines) + "\n")
        walls += f'<shape type="obj"><string name="filename" value="{i}.obj"/><ref id="w"/></shape>'
    paint = '<bsdf type="twosided" id="w"><bsdf type="diffuse"/></bsdf>'
    path = written(tmp_path / "r.xml", f'<scene version="3.0.0">{paint}{walls}</scene>')
    loaded = load(world(path, "camera=0+0+0,target=0+0+1"))
    range_m, normal, _ = cast(loaded, AHEAD)
    assert len(loaded.scene.shapes()) == 1 and range_m[0] == pytest.approx(3)
    assert normal[0, 2] > 0.99, "it is a back that the camera sees"


def test_shapes_without_material_take_the_albedo_too(tmp_path):
    ball = '<shape type="sphere"><point name="center" value="0,0,4"/></shape>'
    path = written(tmp_path / "bare.xml", f'<scene version="3.0.0">{ball}</scene>')
    loaded = load(world(path, "albedo=0.7,camera=0+0+0,target=0+0+1"))
    assert reflectance(loaded, [0, 0, 1]) == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera=0+0+0", "wanted both, as x.y.z, or neither"),
        ("target=0+0+0", "wanted both, as x.y.z, or neither"),
        ("camera=0+0,target=0+0+1", "camera must be three finite numbers"),
        ("camera=0+0+0,target=0+1+0", "line of sight must not lie on up"),
        ("unit_m=0", "unit_m must be a positive number"),
        ("lamps=-1", "lamp_gain must be 0 or more"),
        ("modulated=sun", "modulated=sun, which is no lamp of the scene; its lamps: bulb"),
        ("delay_ns=2", "wanted one each, or one"),
        ("modulated=bulb,delay_ns=1+2", "wanted one each, or one"),
        ("albedo=1.5", "albedo must lie in 0..1"),
        ("albedos=gone.toml", "albedos=gone.toml, which is no file"),
        ("colour=1", "has no parameter 'colour'"),
        ("camera=0+1+7.9995,target=0+1+9", "the camera touches the shape 'e'"),
        ("camera=2+1+4,target=2+1+9", "the camera stands inside the shape 'b'"),
        ("camera=0+1+10,target=0+1+11", "the camera sees nothing"),
        ("velocity=1+2", "camera must be three finite numbers"),
    ],
)
def test_impossible_parameters_of_a_file_are_refused(old, text, message):
    with pytest.raises(ValueError, match=message) as error:
        load(world(old, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("lamp", ['type="constant"', 'type="directional"'])
def test_a_lamp_without_a_distance_cannot_be_modulated(tmp_path, lamp):
    ball = '<shape type="sphere"><point name="center" value="0,0,4"/></shape>'
    sky = f'<emitter id="sky" {lamp}/>'
    path = written(tmp_path / "sky.xml", f'<scene version="3.0.0">{ball}{sky}</scene>')
    at = "camera=0+0+0,target=0+0+1"
    assert not load(world(path, at)).lamp_modulated.any()
    with pytest.raises(ValueError, match="modulated=sky, a lamp without a distance"):
        load(world(path, f"{at},modulated=sky"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("Nope = 0.5", "got an albedo for 'Nope'; materials with an id are: Rough, Shiny, Coated"),
        ("Rough = 1.5", "got Rough = 1.5"),
        ("Rough = nan", "got Rough = nan"),
        ("Rough = true", "got Rough = True"),
        ("Rough = [1]", "got Rough = "),
        ("Rough", "is no TOML"),
    ],
)
def test_impossible_albedos_are_refused(old, content, message):
    table = written(old.parent / "t.toml", content)
    with pytest.raises(ValueError, match=message):
        world(old, f"albedos={table}")


# Hostile files


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    for name, (content, _) in {**hostile_scenes.XML, **hostile_scenes.MESHES}.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("name", [*hostile_scenes.XML, *hostile_scenes.MESHES])
def test_hostile_files_are_refused_in_a_sentence(hostile, name):
    message = {**hostile_scenes.XML, **hostile_scenes.MESHES}[name][1]
    with pytest.raises(ValueError, match=message) as error:
        load(world(hostile / name))
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_what_is_no_file_is_refused(tmp_path):
    folder = tmp_path / "scene.xml"
    folder.mkdir()
    for name, message in (
        (folder, "got the folder"), (tmp_path / "gone.xml", "nothing there at"),
        (tmp_path / "gone.ply", "got no file at"), (tmp_path / "scene.blend", "kind is not known"),
        (tmp_path, "got the folder"), ("a/b", "got the file 'a/b', whose kind is not known"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            world(name)


def test_huge_files_are_refused_unread(tmp_path):
    path = tmp_path / "huge.xml"
    with path.open("wb") as file:
        file.truncate(40 << 20)
    with pytest.raises(ValueError, match="has 41943040 bytes, wanted a scene file of up to 32 MiB"):
        world(path)


# Meshes

CORNERS = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1.0]])  # no symmetry at all
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def saved(path, corners=CORNERS):
    from toftools._native import import_open3d

    if path.suffix == ".glb":  # Open3D cannot read the ones it writes
        path.write_bytes(hostile_scenes.glb(corners.tolist(), FACES.tolist()))
        return path
    open3d = import_open3d()
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(corners), open3d.utility.Vector3iVector(FACES)
    )
    mesh.compute_triangle_normals()  # STL is written with them
    assert open3d.io.write_triangle_mesh(str(path), mesh)
    return path


@pytest.mark.parametrize("suffix", MESHES)
def test_every_format_gives_the_same_surface(tmp_path, suffix):
    """Through a slow twin: every ray against every triangle (Moeller and Trumbore)."""
    loaded = load(
        world(saved(tmp_path / f"m{suffix}"), "size=1,range=0.8,yaw=20,pitch=-30,roll=10")
    )
    range_m, _, _ = cast(loaded, RAYS)
    c, s = np.cos(np.radians([20, -30, 10])), np.sin(np.radians([20, -30, 10]))
    about_y = np.array([[c[0], 0, s[0]], [0, 1, 0], [-s[0], 0, c[0]]])
    about_x = np.array([[1, 0, 0], [0, c[1], -s[1]], [0, s[1], c[1]]])
    about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    at = (CORNERS / 4 * [1, -1, -1]) @ (about_y @ about_x @ about_z).T
    at -= (at.min(axis=0) + at.max(axis=0)) / 2
    # The file was centred before it was turned; a tetrahedron's bounding box is turned with it,
    # so only its own extent along the axis, and that across, place it.
    at[:, 2] += 0.8 - at[:, 2].min()
    expected = np.array([_first_hit(ray, at) for ray in RAYS])
    both = np.isfinite(range_m) & np.isfinite(expected)
    assert both.sum() > 30 and (np.isfinite(range_m) == np.isfinite(expected)).mean() > 0.995
    assert np.abs(range_m - expected)[both].max() < 1e-5  # single precision, at slanted faces


def _first_hit(ray, corners):
    ranges = [np.nan]
    for a, b, c in corners[FACES]:
        system = np.stack([b - a, c - a, -ray], axis=1)
        u, v, t = np.linalg.solve(system, -a) if abs(np.linalg.det(system)) > 1e-12 else (-1, 0, 0)
        if u >= 0 and v >= 0 and u + v <= 1 and t > 0:
            ranges.append(t)
    return np.nanmin(ranges) if len(ranges) > 1 else np.nan


def test_upward_axes_and_metres(tmp_path):
    path = saved(tmp_path / "m.ply")
    for up, sides in (("y", (4, 2, 1)), ("z", (4, 1, 2))):
        made = world(path, f"size=0,up={up},range=7")
        corners = made.description["mesh"]["vertices"]
        assert np.ptp(corners, axis=0) == pytest.approx(sides)
        assert corners[:, 2].min() == pytest.approx(7)
        assert corners[:, :2].min(axis=0) + corners[:, :2].max(axis=0) == pytest.approx(0)
    upright = world(path, "size=0").description["mesh"]["vertices"]
    assert upright[2, 1] < upright[0, 1], "what is up in the file is up in the picture"
    assert upright[3, 2] < upright[0, 2], "its front looks at the camera"
    stood = world(path, "size=0,up=z").description["mesh"]["vertices"]
    assert stood[3, 1] < stood[0, 1] and stood[2, 2] > stood[0, 2]


def test_mesh_with_wall_material_and_motion(tmp_path):
    path = saved(tmp_path / "m.ply")
    made = world(path, "wall=3,material=mirror,albedo=0.9,velocity=0+0+1,size=0.4")
    range_m, _, names = cast(load(made, merge=False), RAYS)
    wall = names == "wall"
    assert np.isfinite(range_m).all() and 0.5 < wall.mean() < 1
    assert np.abs(range_m * RAYS[:, 2] - 3)[wall].max() < 3e-6
    moved = world_at(made, 0.1).description["mesh"]["vertices"]
    assert moved - made.description["mesh"]["vertices"] == pytest.approx(
        np.tile([0, 0, 0.1], (4, 1))
    )
    for text, message in (("wall=1.05", "wanted 0 for none or more than"), ("up=x", "got up='x'"),
                          ("material=checker", "got material 'checker'"), ("size=-1", "size=-1"),
                          ("range=0", "range must be a positive")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            world(path, text)


# Dictionaries of other programs


def test_mitsubas_own_cornell_box_is_taken_as_it_is():
    mi = import_mitsuba()
    loaded = load(from_dict(mi.cornell_box()))
    # Its camera stands at z = 3.9 before a box of 2 units around the origin.
    assert np.allclose(loaded.to_world[:3, 3], [0, 0, 3.9], atol=1e-6)
    corner = np.array([[0.9, -0.9, 4.9]])
    range_m = cast(loaded, corner / np.linalg.norm(corner))[0][0]
    assert range_m == pytest.approx(np.linalg.norm(corner), abs=1e-5)
    assert len(loaded.lamp_modulated) == 1 and not loaded.lamp_modulated.any()


ALONE = """
import sys
from toftools._native import limit_threads
limit_threads(1)
from toftools.sim.scenes import world_of
from toftools.sim.stage import load
from toftools.types import Scene
import drjit
load(world_of(Scene(sys.argv[1], {})))
print(drjit.thread_count())
"""


def test_a_worker_of_one_thread_reads_pictures(tmp_path):
    mi = import_mitsuba()
    with two_threads_at_least():  # this worker has one thread itself
        mi.Bitmap(np.ones((16, 32, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    path = written(
        tmp_path / "room.xml",
        """<scene version="3.0.0"><sensor type="perspective"/>
        <shape type="sphere"><point name="center" x="0" y="0" z="3"/></shape>
        <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>""",
    )
    code = [sys.executable, "-c", ALONE, str(path)]
    done = subprocess.run(code, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, "1"), done.stderr


# Public scenes


def test_public_living_room():
    path = public("living-room/scene.xml")
    loaded = load(world(path))
    view = rays(pinhole(160, 90, hfov_deg=90)).reshape(-1, 3)
    range_m, _, _ = cast(loaded, view)
    # Figures of the scene's manifest, measured with another program at this resolution.
    assert np.isnan(range_m).mean() == pytest.approx(0.058, abs=0.003)
    told = [np.nanmin(range_m), np.nanmedian(range_m), np.nanmax(range_m)]
    assert told == pytest.approx([1.73, 3.53, 6.11], abs=0.02)
    box = loaded.scene.bbox()
    assert np.array([*box.min, *box.max]) == pytest.approx(
        [-0.51, 0, -3.64, 5.12, 2.88, 0.59], abs=0.01
    )
    assert len(loaded.lamp_modulated) == 1, "the sky, ambient"


def test_public_living_room_with_random_materials():
    loaded = 0
    for i in range(5):
        path = public(f"living-room/living-room_rand_scene{i}.xml")
        try:
            load(world(path))
            loaded += 1
        except ValueError as error:
            assert "which is not in" in str(error), "only textures that the set lacks"
    assert loaded >= 3


@pytest.mark.parametrize("name", ["cbox/cbox.xml", "cbox/cbox-rgb.xml"])
def test_public_cornell_box_in_millimetres(name):
    loaded = load(world(public(name), "unit_m=0.001"), merge=False)
    aims = np.array([[0, -250, 1359.2], [278, 0, 1200], [-278, 0, 1200], [0, -274, 900]])
    range_m, _, _ = cast(loaded, aims / np.linalg.norm(aims, axis=1, keepdims=True))
    # The back wall lies 1359.2 behind the camera, which looks at the middle of the opening; the
    # sides are 555 apart, and lean a little.
    assert range_m == pytest.approx(np.linalg.norm(aims, axis=1) / 1000, rel=0.02)
    assert len(loaded.lamp_modulated) == 1
    # Seen from the opening, the red wall is on the left and the green one on the right.
    red, green = (reflectance(loaded, aim) for aim in aims[[2, 1]])
    if name == "cbox/cbox-rgb.xml":
        assert (red, green) == pytest.approx((0.155, 0.298), abs=0.01), "luminance of the colours"


def test_public_bunny_is_the_size_asked_for_where_asked_for():
    path = public("meshes/bunny.ply")
    corners, faces = read_mesh(path)
    assert (len(corners), len(faces)) == (35_947, 69_451)
    loaded = load(world(path, "size=0.3,range=1.2"))
    view = rays(pinhole(400, 400, hfov_deg=20)).reshape(-1, 3)
    range_m, _, _ = cast(loaded, view)
    at = (view * range_m[:, None])[np.isfinite(range_m)]
    size = np.ptp(corners, axis=0) * 0.3 / np.ptp(corners, axis=0).max()
    # Seen at a pixel's grain (0.35 degrees / 7: 1.5 mm) and from one point: edges hide a little.
    assert np.ptp(at, axis=0)[:2] == pytest.approx(size[:2], abs=0.006)
    assert 1.2 <= at[:, 2].min() < 1.205 and at[:, 2].max() < 1.2 + size[2]
    world_up = -at[:, 1]
    ears = at[world_up > np.quantile(world_up, 0.98)]
    assert ears[:, 0].mean() < -0.02, "it looks to the left, ears on the left"
    metres = world(path, "size=0").description["mesh"]["vertices"]
    assert np.ptp(metres, axis=0) == pytest.approx([0.156, 0.154, 0.121], abs=1e-3)
