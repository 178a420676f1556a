"""Rays into a loaded scene, for tests: range in metres, normal in the camera frame, shape id."""

import numpy as np

from toftools._native import import_mitsuba


def cast(stage, directions):
    """Range (N,), unit normals (N, 3) and shape ids (N,) seen along unit camera rays (N, 3)."""
    mi = import_mitsuba()
    away = directions.reshape(-1, 3) @ stage.to_world[:3, :3].T
    ray = mi.Ray3f(
        mi.Point3f(*map(float, stage.to_world[:3, 3])),
        mi.Vector3f(np.ascontiguousarray(away.T, dtype=np.float32)),
    )
    hit = stage.scene.ray_intersect(ray)
    seen = np.array(hit.is_valid())
    range_m = np.where(seen, np.array(hit.t, np.float64) * stage.unit_m, np.nan)
    names = np.array([s.id() if s is not None else "" for s in hit.shape])
    return range_m, np.array(hit.n).T @ stage.to_world[:3, :3], names
