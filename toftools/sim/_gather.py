"""Light of virtual lights at points, with exact visibility: all pairs, a ray each.

Eq. (6) and (7) of the seed "Transient instant radiosity" (2019) with the geometry term weighted
against rays (`_hemisphere`) instead of clamped. Lanes are points, and all look at the same virtual
light at a time, so that their shadow rays run side by side: two cores trace 60 to 170 million a
second, which is why nothing approximates visibility.
"""

import numpy as np

from toftools.sim._phasors import C128, cycles_per_m, turn
from toftools.sim._second import scatters_alike, up_of
from toftools.sim._segments import above, segment
from toftools.sim._task import Jit, Task
from toftools.sim._virtual import Channels, Virtual
from toftools.types import F64


def gather(
    task: Task, points: Jit, lights: Virtual, later: C128, channels: Channels, rays: int
) -> tuple[C128, C128, F64]:
    """Mean radiance over the hemisphere of points, as far as it is left to virtual lights.

    Parameters
    ----------
    task : Task
        Scene.
    points : SurfaceInteraction3f, (W,)
        Diffuse points; others get nothing.
    lights : Virtual
        Virtual lights with their direct light.
    later : ndarray, (C, M), complex128
        Their radiance by indirect light.
    channels : Channels
        What is summed up.
    rays : int
        Rays per point that share the light (`_hemisphere`); 0 leaves all to virtual lights.

    Returns
    -------
    tuple of ndarray, (C, W), (C, W) and (W,)
        Light with one bounce, with more, and what radiance 1 everywhere would give.
    """
    import drjit as dr

    mi, width, count = task.mi, dr.width(points.t), len(lights.area_m2)
    kinds = len(channels.freqs_hz)
    if count == 0 or width == 0:
        blank = np.zeros((kinds, width), np.complex128)
        return blank, blank, np.zeros(width)
    tables = _tables(task, lights, later)
    mine = (points.p, up_of(points), scatters_alike(mi, points))
    dr.eval(mine)
    cycles, unit, each = (
        cycles_per_m(channels.freqs_hz),
        task.stage.unit_m,
        dr.opaque(mi.Float, rays),
    )

    def body(j: Jit, sums: Jit, ones: Jit) -> tuple[Jit, ...]:
        place, normal, area = (
            dr.gather(kind, table, j)
            for kind, table in zip((mi.Point3f, mi.Normal3f, mi.Float), tables[:3], strict=True)
        )
        start, up, active = mine
        way = place - start
        square = dr.squared_norm(way)
        geometry = dr.maximum(dr.dot(up, way), 0.0) * dr.maximum(-dr.dot(normal, way), 0.0)
        geometry *= dr.inv_pi / (dr.square(square) * unit**2)
        share = geometry * area / (1 + each * geometry * area)
        active = active & (share > 0)
        clear = segment(mi, above(start, up), above(place, normal))
        active &= ~task.stage.scene.ray_test(clear, active)
        share = dr.select(active, share, 0.0)
        far_m, new = dr.sqrt(square) * unit, []
        for cycle, rows, row in zip(cycles, tables[3], sums, strict=True):
            turns = (*turn(mi, cycle, far_m), mi.Float(0))
            a, b, c, d = (dr.gather(mi.Float, part, j) for part in rows)
            light = (a * turns[0] - b * turns[1], a * turns[1] + b * turns[0],
                     c * turns[0] - d * turns[1], c * turns[1] + d * turns[0])  # fmt: skip
            new.append(tuple(s + share * x for s, x in zip(row, light, strict=True)))
        return j + 1, new, ones + share

    zero = dr.zeros(mi.Float, width)
    limit = dr.opaque(mi.UInt32, count)
    state = (mi.UInt32(0), [(zero,) * 4 for _ in range(kinds)], zero)
    _, sums, ones = dr.while_loop(state, lambda j, *_: j < limit, body)
    dr.eval(sums, ones)
    found = np.array([[np.asarray(x.numpy(), np.float64) for x in row] for row in sums])
    return found[:, 0] + 1j * found[:, 1], found[:, 2] + 1j * found[:, 3], _f64(ones)


def _tables(task: Task, lights: Virtual, later: C128) -> tuple[Jit, ...]:
    """Virtual lights on the device: place, normal, area, light."""
    import drjit as dr

    mi = task.mi

    def sent(values: F64) -> Jit:
        return mi.Float(np.ascontiguousarray(values, np.float32))

    rows = [
        tuple(sent(x) for x in (one.real, one.imag, two.real, two.imag))
        for one, two in zip(lights.direct, later, strict=True)
    ]
    tables = (lights.p, lights.n, sent(lights.area_m2), rows)
    dr.eval(tables)
    return tables


def _f64(values: Jit) -> F64:
    return np.asarray(values.numpy(), np.float64)
