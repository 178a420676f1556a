"""Where indirect light is gathered: points chosen by one smooth estimate of it."""

from dataclasses import replace
from typing import Any

import numpy as np

from toftools.sim._field import arriving, light_field
from toftools.sim._phasors import C128
from toftools.sim._seen import points_at
from toftools.sim._sparse import Plan, Surface, place
from toftools.sim._stop import range_errors_m
from toftools.sim._wanted import FAINT, Wanted, shown
from toftools.types import F64

BETWEEN = 1.0
"""Share of the tolerance: a single estimate differs more between places than the mean of four."""
PLACING = 4096
"""Virtual lights of that estimate."""


def placed(scene: Wanted) -> Plan:
    """Points to gather at."""
    task, what, used = scene.task, scene.what, scene.order.used
    wave = scene.order.freqs_hz[used]
    known: dict[str, Any] = {}

    def evaluate(number: Any) -> C128:  # noqa: ANN401 - ints
        points = points_at(task, what, number)
        if not known:
            seed = scene.order.seed + 99
            field = light_field(
                task, scene.views, scene.channels, points, PLACING, scene.bounces, seed
            )
            # Nothing by chance that neighbours do not share: differences are those of the light.
            known["field"] = replace(field, near_m=0.0, sure=0.0)
        one, rest = arriving(task, known["field"], points)
        light = np.asarray((one + rest)[used])
        known.setdefault("total", _roughly(scene, number, light))
        return light

    def errors_m(delta: C128, number: Any) -> F64:  # noqa: ANN401 - ints
        total = known["total"]
        size = np.abs(total).min(axis=0)
        counts = size > FAINT * np.median(size[what.diffuse])
        error_m = range_errors_m(shown(what, delta, wave, number), total[:, number], wave)
        return np.where(counts[number], error_m, 0.0)

    shape = what.shape
    surface = Surface(
        what.position_m.reshape(*shape, 3),
        what.normal.reshape(*shape, 3),
        what.diffuse.reshape(shape),
    )
    return place(surface, evaluate, errors_m, BETWEEN * scene.order.tol_m)


def _roughly(scene: Wanted, number: Any, light: C128) -> C128:  # noqa: ANN401 - ints
    """All modulated light of all points, the indirect part that of the nearest of some points."""
    from scipy.spatial import cKDTree

    what = scene.what
    place = np.where(what.met[:, None], what.position_m, 0.0)
    rows = np.concatenate([place, what.normal], axis=1)
    _, nearest = cKDTree(rows[number]).query(rows, workers=-1)
    wave = scene.order.freqs_hz[scene.order.used]
    every = np.arange(len(place))
    indirect = shown(what, light[:, nearest], wave, every)
    return np.asarray(scene.direct[scene.order.used] + indirect)
