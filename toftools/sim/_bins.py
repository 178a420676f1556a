"""Bins of path length that many contributions go into: in kernels, and one by one.

The histogram of the seed "Transient instant radiosity" (2019), section "Generating the space-time
volumes": a contribution goes into the bin of its optical path. Every pixel has a row of bins, with
one more on either side for what is outside the axis.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._task import Jit
from toftools.sim._tracer import Deposit
from toftools.transient import Samples
from toftools.types import F32, Bool


@dataclass(frozen=True, eq=False)
class Order:
    """What to fill.

    Parameters
    ----------
    start_m, bin_m : float
        Begin of the axis and width of a bin, m of whole optical path.
    n_bins : int
        Number of bins.
    bounces : int
        Most indirect bounces.
    seed : int
        Of all sequences.
    room : int
        Working memory, bytes.
    """

    start_m: float
    bin_m: float
    n_bins: int
    bounces: int
    seed: int
    room: int


@dataclass(frozen=True, eq=False)
class Volume:
    """Light by pixel and bin, filled in place.

    Parameters
    ----------
    values : ndarray, (P, T)
        Light in the bins.
    missed : ndarray, (P,)
        Light outside the axis.
    counts : ndarray, (3,), int
        Contributions: all, before and beyond the axis.
    left : ndarray, (P,), bool
        Pixels whose first surface is not diffuse; they hold direct light alone.
    seen : ndarray, (P,), bool
        Pixels that look at something.
    lights : list of int
        Number of virtual lights, once it is known.
    """

    values: F32
    missed: F32
    counts: Any
    left: Bool
    seen: Bool
    lights: list[int]


def depositor(mi: Any, rows: Jit, order: Order, scale: float) -> Deposit:  # noqa: ANN401
    """How a contribution of a kernel goes into its bin, one per lane and step.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    rows : Float
        Rows of bins, lane by lane, each with one more bin on either side.
    order : Order
        Axis.
    scale : float
        Factor on all light.

    Returns
    -------
    callable
        A `Deposit` whose sums count contributions: all, before and beyond the axis.
    """
    import drjit as dr

    # Opaque: another axis must not mean another kernel.
    first, width, part = (dr.opaque(mi.Float, x) for x in (order.start_m, order.bin_m, scale))
    last = dr.opaque(mi.UInt32, order.n_bins + 1)

    def deposit(counts: Jit, lane: Jit, _n: Jit, _bounce: Jit, light: Jit, path_m: Jit) -> Jit:
        lit = light > 0
        position = dr.clip((path_m - first) / width + 1, 0.0, mi.Float(last))
        column = mi.UInt32(position)
        # A lane has its row to itself: no other writes there.
        dr.scatter_reduce(dr.ReduceOp.Add, rows, light * part, lane * (last + 1) + column, lit,
                          mode=dr.ReduceMode.NoConflicts)  # fmt: skip
        kinds = (lit, lit & (column == 0), lit & (column == last))
        return tuple(
            count + dr.select(kind, mi.UInt32(1), 0)
            for count, kind in zip(counts, kinds, strict=True)
        )

    return deposit


def add(volume: Volume, samples: Samples, order: Order) -> None:
    """Further samples, each in its bin.

    Parameters
    ----------
    volume : Volume
        Filled in place.
    samples : Samples
        Contributions.
    order : Order
        Axis.
    """
    bins = np.floor((samples.path_m - order.start_m) / order.bin_m)
    before, beyond = bins < 0, bins >= order.n_bins
    inside = ~(before | beyond)
    weight = samples.weight.astype(np.float32)
    place = (samples.pixel[inside], bins[inside].astype(np.int64))
    np.add.at(volume.values, place, weight[inside])
    np.add.at(volume.missed, samples.pixel[~inside], weight[~inside])
    volume.counts[:] += [bins.size, np.count_nonzero(before), np.count_nonzero(beyond)]
