"""A `World` loaded into Mitsuba: the scene, the pose, and what every lamp does.

Built on Mitsuba 3 (W. Jakob et al., mitsuba-renderer.org). A Mitsuba camera looks along z with x to
the left and y up; ours has x to the right and y down, so a pose of a file turns by half a turn
about z. Whatever Mitsuba says in many lines about a broken scene comes out as one sentence.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftools._arrays import F64, Bool, expect_shape
from toftools._native import import_mitsuba, two_threads_at_least
from toftools.sim._stage_checks import bounds_hold, check_values, check_view
from toftools.sim.mesh import read_mesh
from toftools.sim.scene_xml import with_files
from toftools.sim.world import World

TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Our camera frame in Mitsuba's."""


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene that an engine can trace.

    Parameters
    ----------
    scene : mitsuba.Scene
        Geometry, materials and lamps; sensors and integrator of the description do not count.
    to_world : ndarray, (4, 4)
        Camera frame (x right, y down, z forward) to scene, both in scene units.
    unit_m : float
        Length of one scene unit, m.
    lamp_modulated : ndarray, (L,), bool
        Whether each lamp carries the modulation, in the order of ``scene.emitters()``.
    lamp_delay_s : ndarray, (L,)
        Delay of each lamp's modulation, s.
    lamp_gain : float
        Radiance 1 of a lamp counts as ``lamp_gain * Noise.signal_e`` electrons per tap.
    ambient_e : float
        Unmodulated charge per tap on every pixel, electrons.
    """

    scene: Any
    to_world: F64
    unit_m: float
    lamp_modulated: Bool
    lamp_delay_s: F64
    lamp_gain: float
    ambient_e: float


def load(world: World, *, variant: str = "llvm_ad_mono", merge: bool = True) -> Stage:
    """Load a world into Mitsuba.

    Parameters
    ----------
    world : World
        Scene as plain data.
    variant : str
        Mitsuba variant; a ``mono`` one, in which colours become their luminance.
    merge : bool
        Whether meshes of the same material may become one, which traces up to twice as fast;
        they lose their ids, lamps keep them.

    Returns
    -------
    Stage
        The loaded scene.

    Raises
    ------
    ValueError
        If the description is broken, names what does not exist, or cannot be seen from its camera.
    """
    mi = import_mitsuba(variant)
    with _one_sentence(mi), two_threads_at_least():
        scene = _scene(mi, world, merge=merge)
        if merge and not bounds_hold(scene):
            scene = _scene(mi, world, merge=False)
    check_values(mi, scene)
    to_world = _pose(scene) if world.to_world is None else world.to_world
    try:
        check_view(mi, scene, to_world, world.unit_m)
    except ValueError:  # merged walls look like one thing: ask the single ones, which have names
        with _one_sentence(mi), two_threads_at_least():
            single = _scene(mi, world, merge=False)
        check_view(mi, single, to_world, world.unit_m)
    modulated, delay_s = _lamps(mi, scene, world.modulated_s)
    return Stage(
        scene=scene,
        to_world=to_world,
        unit_m=world.unit_m,
        lamp_modulated=modulated,
        lamp_delay_s=delay_s,
        lamp_gain=world.lamp_gain,
        ambient_e=world.ambient_e,
    )


def _scene(mi: Any, world: World, *, merge: bool) -> Any:  # noqa: ANN401 - a module
    """The Mitsuba scene of a description."""
    if not isinstance(world.description, str):
        plain = {"type": "scene", **world.description}
        return mi.load_dict(_ready(mi, plain, world.folder), optimize=merge)
    text, files = with_files(world.description, world.folder or Path())
    for file in files:
        if file.suffix.lower() == ".ply":
            read_mesh(file)  # Mitsuba trusts the indices of its faces and may crash
    scene = mi.load_string(text, optimize=merge)
    if not isinstance(scene, mi.Scene):
        msg = f"the root of the scene file makes a {type(scene).__name__}, wanted a <scene>"
        raise ValueError(msg)
    return scene


@contextmanager
def _one_sentence(mi: Any) -> Iterator[None]:  # noqa: ANN401 - a module
    """Quiet Mitsuba, whose errors become one sentence."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    except (RuntimeError, TypeError, AttributeError) as error:
        text = re.sub(r"\[[^\]]*\.(cpp|h):\d+\]|\[[A-Za-z0-9]+\]", "", str(error))
        msg = f"Mitsuba cannot load the scene: {' '.join(text.split())}"
        raise ValueError(msg) from error
    finally:
        mi.set_log_level(level)


def _ready(mi: Any, entry: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:  # noqa: ANN401
    """A plain description with its poses and meshes as Mitsuba objects, its files absolute."""
    done: dict[str, Any] = {}
    for key, value in entry.items():
        if isinstance(value, Mapping):
            is_mesh = value.get("type") == "arrays"
            done[key] = _mesh(mi, key, value, folder) if is_mesh else _ready(mi, value, folder)
        elif isinstance(value, np.ndarray) and value.shape == (4, 4):
            done[key] = mi.ScalarTransform4f(np.asarray(value, dtype=np.float64))
        elif key == "filename" and folder is not None:
            done[key] = str((folder / value).absolute())
        else:
            done[key] = value
    return done


def _mesh(mi: Any, name: str, entry: Mapping[str, Any], folder: Path | None) -> Any:  # noqa: ANN401
    """A Mitsuba mesh out of an ``arrays`` entry; without normals its faces stay flat."""
    arrays = _mesh_arrays(name, entry)
    props = mi.Properties()
    props["face_normals"] = "vertex_normals" not in arrays
    props["mesh_bsdf"] = mi.load_dict(_ready(mi, entry["bsdf"], folder))
    mesh = mi.Mesh(
        name,
        len(arrays["vertex_positions"]),
        len(arrays["faces"]),
        has_vertex_normals="vertex_normals" in arrays,
        has_vertex_texcoords="vertex_texcoords" in arrays,
        props=props,
    )
    params = mi.traverse(mesh)
    for key, values in arrays.items():
        params[key] = values.ravel()
    params.update()
    return mesh


def _mesh_arrays(name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays of an ``arrays`` entry under Mitsuba's names, checked."""
    vertices = np.asarray(entry.get("vertices", ()), np.float32)
    faces = np.asarray(entry.get("faces", ()))
    flat = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3
    if not (flat and len(faces) and faces.min() >= 0 and faces.max() < len(vertices)):
        msg = (
            f"the mesh {name!r} has vertices {vertices.shape} and faces {faces.shape}; wanted "
            "(N, 3) and at least one face of three vertices out of those N"
        )
        raise ValueError(msg)
    if not isinstance(entry.get("bsdf"), Mapping):
        msg = f"the mesh {name!r} has no material; wanted an entry bsdf"
        raise ValueError(msg)
    arrays = {"vertex_positions": vertices, "faces": faces.astype(np.uint32)}
    for ours, theirs, width in (("normals", "vertex_normals", 3), ("uv", "vertex_texcoords", 2)):
        if ours in entry:
            arrays[theirs] = np.asarray(entry[ours], np.float32)
            expect_shape(f"{ours} of the mesh {name!r}", arrays[theirs], (len(vertices), width))
    return arrays


def _pose(scene: Any) -> F64:  # noqa: ANN401
    """Pose of the description's first sensor, in our frame."""
    if not scene.sensors():
        msg = "the scene has no sensor to take the pose from; give camera=x+y+z and target=x+y+z"
        raise ValueError(msg)
    pose = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        msg = "the pose of the scene's sensor is not finite; give camera=x+y+z and target=x+y+z"
        raise ValueError(msg)
    left, _, right = np.linalg.svd(pose[:3, :3])  # a scaled camera sees the same as a plain one
    pose[:3, :3] = left @ right
    return np.asarray(pose @ TURN)


def _lamps(mi: Any, scene: Any, modulated_s: Mapping[str, float]) -> tuple[Bool, F64]:  # noqa: ANN401
    """Which lamps are modulated, and the delay of each; a lamp goes by its shape's id as well."""
    names = [_names(lamp) for lamp in scene.emitters()]
    unknown = set(modulated_s) - set().union(*names)
    if unknown:
        known = ", ".join(sorted(set().union(*names))) or "none"
        msg = f"got modulated={min(unknown)}, which is no lamp of the scene; its lamps: {known}"
        raise ValueError(msg)
    delays = [[modulated_s[n] for n in sorted(own) if n in modulated_s] for own in names]
    modulated = np.array([bool(d) for d in delays], dtype=bool)
    for lamp, own, lit in zip(scene.emitters(), names, modulated, strict=True):
        if lit and mi.has_flag(lamp.flags(), mi.EmitterFlags.Infinite):
            msg = f"got modulated={min(own)}, a lamp without a distance, so its light has no phase"
            raise ValueError(f"{msg}; wanted a point, a spot or a shape that shines")
    return modulated, np.array([d[0] if d else 0.0 for d in delays], dtype=np.float64)


def _names(lamp: Any) -> set[str]:  # noqa: ANN401
    shape = lamp.get_shape()
    return {lamp.id(), "" if shape is None else shape.id()} - {""}
