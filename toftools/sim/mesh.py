"""Mesh files as scenes: one object of one material before the camera, read by Open3D.

Formats are PLY, OBJ, STL, OFF, GLB and GLTF (Q.-Y. Zhou et al., "Open3D", 2018). Colours and
materials of the files are not read: they say nothing about the near infrared. Faces stay flat, so
that the truth is that of the triangles.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from toftools._native import import_open3d
from toftools.sim import solids
from toftools.sim.planes import STILL, moving
from toftools.sim.shapes import check_positive
from toftools.sim.world import World
from toftools.types import F64

MESHES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
LARGEST_BYTES = 1 << 30
MATERIALS = tuple(name for name in solids.SOLID if name != "checker")  # meshes bring no coordinates
AXES = {
    "y": np.diag([1.0, -1.0, -1.0]),  # x right, y up, z towards the camera
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),  # x right, y away, z up
}
"""Frames of mesh files by their upward axis, in the frame of the camera."""


def mesh_world(
    path: Path,
    *,
    range: float = 1.0,
    size: float = 0.5,
    albedo: float = 0.5,
    up: str = "y",
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
    wall: float = 0.0,
    material: str = "diffuse",
    velocity: tuple[float, float, float] = STILL,
) -> World:
    """World of a mesh file: the object centred on the optical axis.

    Parameters
    ----------
    path : Path
        The file.
    range : float
        Distance of the nearest vertex along the optical axis, m.
    size : float
        Largest side of the bounding box of the file, m; 0 takes its numbers for metres.
    albedo : float
        Diffuse albedo of the object, 0..1; the wall has 0.5.
    up : {"y", "z"}
        Upward axis of the file, as in graphics or in CAD.
    yaw, pitch, roll : float
        Turns about the vertical (down), right and forward axis of the camera, degrees,
        right-handed; roll comes first and yaw last.
    wall : float
        Distance of a wall behind, m; 0 for none.
    material : str
        Name out of `MATERIALS`; glass needs a closed mesh.
    velocity : tuple of 3 floats
        Velocity of the object in the camera frame, m/s.

    Returns
    -------
    World
        The shape ``mesh``, and the ``wall``.

    Raises
    ------
    ValueError
        If the file holds no mesh, or a parameter is impossible.
    """
    check_positive(range=range)
    if up not in AXES or not size >= 0:
        msg = f"got up={up!r} and size={size}; wanted up y or z and a size of 0 or more m"
        raise ValueError(msg)
    bsdf = solids.material(material, albedo, allowed=MATERIALS)
    vertices, faces = read_mesh(path)
    extent = float(np.ptp(vertices, axis=0).max())
    scale = size / extent if size > 0 else 1.0
    at = scale * (vertices - _middle(vertices)) @ (_turn(yaw, pitch, roll) @ AXES[up]).T
    at -= [*_middle(at)[:2], at[:, 2].min() - range]
    behind = solids.backdrop(wall, float(at[:, 2].max()), 0.5)
    shape = {"type": "arrays", "vertices": at, "faces": faces, "bsdf": bsdf}
    return World({"mesh": shape, **behind}, velocity_mps=moving("mesh", velocity))


def _middle(vertices: F64) -> F64:
    return np.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2)


def _turn(yaw: float, pitch: float, roll: float) -> F64:
    """Rotation about the camera's z, then x, then y, degrees."""
    about = [np.roll(np.arange(3), -i) for i in (1, 0, 2)]  # the axis, then those it turns
    turn: F64 = np.eye(3)
    for axis, angle in zip(about, np.radians([yaw, pitch, roll]), strict=True):
        step = np.eye(3)
        step[np.ix_(axis[1:], axis[1:])] = [
            [np.cos(angle), -np.sin(angle)],
            [np.sin(angle), np.cos(angle)],
        ]
        turn = turn @ step
    return turn


def read_mesh(path: Path) -> tuple[F64, F64]:
    """Vertices and triangles of a mesh file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    tuple of ndarray, (N, 3) and (M, 3)
        Vertices as in the file, and indices of the corners of the triangles.

    Raises
    ------
    ValueError
        If there is no such file, or no mesh in it.
    """
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no file"
        raise ValueError(f"got {what} at {path}, wanted a mesh file")
    size = path.stat().st_size
    if not 0 < size <= LARGEST_BYTES or _claims(path) > size:
        raise ValueError(
            f"{path.name} has {size} bytes, too few or too many for the mesh it claims"
        )
    open3d = import_open3d()
    level = open3d.utility.VerbosityLevel.Error
    with open3d.utility.VerbosityContextManager(level), _hushed():
        mesh = open3d.io.read_triangle_mesh(str(path))
    vertices, faces = np.array(mesh.vertices), np.array(mesh.triangles)
    if not len(faces):
        raise ValueError(f"found no triangles in {path.name}; wanted a mesh as {', '.join(MESHES)}")
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError(f"{path.name} has faces without vertices, or vertices that are not finite")
    if not np.ptp(vertices, axis=0).max() > 0:
        raise ValueError(f"all vertices of {path.name} lie in one point")
    return vertices, faces


@contextmanager
def _hushed() -> Iterator[None]:
    """Keep the libraries inside Open3D from writing to the error stream past us."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _claims(path: Path) -> int:
    """Most elements that the header of a PLY or OFF file claims; each takes a byte or more."""
    with path.open("rb") as file:
        head = file.read(4096)
    off = re.match(rb"\s*[A-Z]*OFF\s+(?:#.*\s+)*(\d+)\s+(\d+)", head)
    ply = re.findall(rb"element\s+\w+\s+(\d+)", head) if head.startswith(b"ply") else []
    return max(map(int, off.groups() if off else ply), default=0)
