"""What the camera sees first, point by point, as arrays: where indirect light is wanted."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._second import scatters_alike, up_of
from toftools.sim._task import Jit, Task, first_hits
from toftools.sim._views import MAX_LANES, views
from toftools.types import F64, Camera


@dataclass(frozen=True, eq=False)
class Seen:
    """First surfaces on a grid of points, ``side`` of them along each side of a pixel.

    Parameters
    ----------
    directions : ndarray, (N, 3)
        Viewing directions, row by row of the finer grid.
    shape : tuple of int
        Rows and columns of the grid.
    position_m : ndarray, (N, 3)
        Places in the scene frame, m.
    normal : ndarray, (N, 3)
        Unit normals towards the camera.
    range_m : ndarray, (N,)
        Range, m.
    albedo : ndarray, (N,)
        Diffuse albedo; 0 where the surface is not diffuse.
    met, diffuse : ndarray of bool, (N,)
        Whether there is a surface, and whether it scatters alike in all directions.
    """

    directions: F64
    shape: tuple[int, int]
    position_m: F64
    normal: F64
    range_m: F64
    albedo: F64
    met: Any
    diffuse: Any


def seen(task: Task, camera: Camera, side: int) -> Seen:
    """Look at the scene.

    Parameters
    ----------
    task : Task
        Scene.
    camera : Camera
        Camera.
    side : int
        Points along each side of a pixel.

    Returns
    -------
    Seen
        First surfaces.
    """
    height, width = camera.shape
    grid = views(camera, np.arange(height * width), side).reshape(height, width, side, side, 3)
    directions = grid.swapaxes(1, 2).reshape(-1, 3)
    parts = [
        _part(task, directions[start : start + MAX_LANES])
        for start in range(0, len(directions), MAX_LANES)
    ]
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Seen(directions, (height * side, width * side), *joined)


def _part(task: Task, directions: F64) -> tuple[Any, ...]:
    first = first_hits(task, directions)
    diffuse = np.asarray(scatters_alike(task.mi, first).numpy(), bool)
    met = np.asarray(first.is_valid().numpy(), bool)
    albedo = first.bsdf().eval_diffuse_reflectance(first, first.is_valid())[0].numpy()
    unit_m = task.stage.unit_m
    return (
        np.where(met[:, None], np.asarray(first.p.numpy(), np.float64).T * unit_m, np.nan),
        np.asarray(up_of(first).numpy(), np.float64).T,
        np.where(met, np.asarray(first.t.numpy(), np.float64) * unit_m, 0.0),
        np.where(diffuse, np.asarray(albedo, np.float64), 0.0),
        met,
        diffuse,
    )


def points_at(task: Task, what: Seen, number: Any) -> Jit:  # noqa: ANN401 - ints
    """First surfaces at some points of the grid.

    Parameters
    ----------
    task : Task
        Scene.
    what : Seen
        The grid.
    number : ndarray of int, (M,)
        Points.

    Returns
    -------
    SurfaceInteraction3f
        Their surfaces.
    """
    return first_hits(task, what.directions[number])
