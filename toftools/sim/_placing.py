"""Where indirect light is gathered: points chosen by one smooth estimate of it."""

from dataclasses import replace
from typing import Any

import numpy as np

from toftools._native import threads
from toftools.sim._crowded import crowded
from toftools.sim._field import arriving, light_field
from toftools.sim._phasors import C128
from toftools.sim._seen import points_at
from toftools.sim._sparse import Plan, Surface, place
from toftools.sim._wanted import Wanted, wrong_m
from toftools.types import F64

BETWEEN = 0.75
"""Share of the tolerance that interpolation may take."""
SMALL = 1024
"""Points of which so few are all gathered at."""
PLACING, ROUGH_M = 8192, 4e-3
"""Virtual lights of that estimate, and tolerance from which a quarter of them will do."""


def placed(scene: Wanted) -> Plan:
    """Points to gather at.

    Light with one bounce has the creases and shadows that all indirect light has, and is known
    without chance. Errors of its interpolation stand for those of the other light too, in
    proportion.

    Parameters
    ----------
    scene : Wanted
        Scene and image.

    Returns
    -------
    Plan
        Points, and how the others follow from them.
    """
    task, what, used = scene.task, scene.what, scene.order.used
    wave = scene.order.freqs_hz[used]
    known: dict[str, Any] = {}

    def evaluate(number: Any) -> C128:  # noqa: ANN401 - ints
        points = points_at(task, what, number)
        if not known:
            seed = scene.order.seed + 99
            total = PLACING if scene.order.tol_m < ROUGH_M else PLACING // 4
            field = light_field(
                task, scene.views, scene.channels, points, total, scene.bounces, seed
            )
            one, rest = (light[used] for light in arriving(task, field, points))
            known["one"], known["rest"] = _roughly(scene, number, one, rest)
            known["field"] = replace(field, cache=None, keep=0)
        one, _ = arriving(task, known["field"], points)
        return np.asarray(one[used])

    def errors_m(delta: C128, number: Any) -> F64:  # noqa: ANN401 - ints
        one, rest = known["one"][:, number], known["rest"][:, number]
        share = np.divide(delta, one, out=np.zeros_like(delta), where=one != 0)
        parts = (delta, share * rest)
        return np.hypot(*(wrong_m(scene, part, one + rest, number) for part in parts))

    def nothing(number: Any) -> C128:  # noqa: ANN401 - ints
        return np.zeros((len(wave), len(number)), np.complex128)

    shape = what.shape
    every, normal = what.diffuse.sum(), what.normal
    if every > SMALL:
        # Points in gaps are turned over: they serve none but each other, and none serves them.
        normal = np.where(crowded(task, what)[:, None], -normal, normal)
    surface = Surface(
        what.position_m.reshape(*shape, 3), normal.reshape(*shape, 3), what.diffuse.reshape(shape)
    )
    if every <= SMALL:
        return place(surface, nothing, errors_m, 0.0)
    # Points that do not count err by nothing: the mean over all must be that much smaller.
    share = (scene.counted.sum() or every) / every
    return place(surface, evaluate, errors_m, BETWEEN * scene.order.tol_m * np.sqrt(share))


def _roughly(scene: Wanted, number: Any, *lights: C128) -> list[C128]:  # noqa: ANN401 - ints
    """Light of all points as that of the nearest of some points."""
    from scipy.spatial import cKDTree

    what = scene.what
    where = np.where(what.met[:, None], what.position_m, 0.0)
    rows = np.concatenate([where, what.normal], axis=1)
    _, nearest = cKDTree(rows[number]).query(rows, workers=threads())
    return [light[:, nearest] for light in lights]
