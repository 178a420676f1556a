"""Points in gaps narrower than a pixel: their light is no neighbour's, and nothing else tells."""

from typing import Any

import numpy as np

from toftools.sim._fan import away_of
from toftools.sim._second import scatters_alike, up_of
from toftools.sim._seen import Seen, points_at
from toftools.sim._sobol import hashed, pair
from toftools.sim._task import Task, next_hit
from toftools.sim._views import MAX_LANES

RAYS = 32
CROWDED = 0.6
"""Share of the hemisphere, by the cosine, that a crease of two walls cannot fill."""


def crowded(task: Task, what: Seen) -> Any:  # noqa: ANN401 - bools
    """Which points see hardly anything but what is nearer than the next pixel.

    Parameters
    ----------
    task : Task
        Scene.
    what : Seen
        Points.

    Returns
    -------
    ndarray of bool, (N,)
        True in gaps.
    """
    found = np.zeros(len(what.range_m), bool)
    able = np.flatnonzero(what.diffuse)
    rows = what.directions.reshape(*what.shape, 3)
    if what.shape[1] < 2 or not able.size:
        return found
    pixel = np.nanmedian(np.linalg.norm(np.diff(rows, axis=1), axis=-1))
    for start in range(0, able.size, MAX_LANES):
        number = able[start : start + MAX_LANES]
        found[number] = _share(task, what, number, pixel * what.range_m[number]) > CROWDED
    return found


def _share(task: Task, what: Seen, number: Any, reach_m: Any) -> Any:  # noqa: ANN401 - floats
    """Share of the hemisphere that is nearer than some reach."""
    import drjit as dr

    mi, points = task.mi, points_at(task, what, number)
    up, active = up_of(points), scatters_alike(mi, points)
    reach = mi.Float((reach_m / task.stage.unit_m).astype(np.float32))
    limit, key = dr.opaque(mi.UInt32, RAYS), hashed(mi, dr.opaque(mi.UInt32, RAYS))
    dr.eval(up, active, reach)

    def body(index: Any, near: Any) -> tuple[Any, Any]:  # noqa: ANN401
        away = away_of(mi, up, pair(mi, index, key, mi.UInt32(0)))
        nearby = next_hit(task, points, away, active)
        close = active & nearby.is_valid() & (nearby.t < reach)
        return index + 1, near + dr.select(close, mi.Float(1), 0.0)

    state = (mi.UInt32(0), dr.zeros(mi.Float, len(number)))
    _, near = dr.while_loop(state, lambda index, _: index < limit, body)
    return np.asarray(near.numpy()) / RAYS
