"""Phasors out of traced paths: one pass of the tracer as sums over frequencies, split by bounce."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.sim._flash import flash_light
from toftools.sim._lamps import lamps_seen
from toftools.sim._task import Jit, Task
from toftools.sim._tracer import trace
from toftools.types import F64
from toftools.units import path_to_phase

C128 = NDArray[np.complex128]
PARTS = ("direct", "one_bounce", "rest")


@dataclass(frozen=True, eq=False)
class Light:
    """Light per pixel, in units of `Noise.signal_e`.

    Parameters
    ----------
    direct, one_bounce, rest : ndarray, (Q, N), complex128
        Phasors of modulated light at every frequency, by number of indirect bounces.
    ambient : ndarray, (N,)
        Unmodulated radiance.
    """

    direct: C128
    one_bounce: C128
    rest: C128
    ambient: F64

    @property
    def total(self) -> C128:
        """All modulated light."""
        return self.direct + self.one_bounce + self.rest


def direct_light(task: Task, first: Jit, freqs_hz: F64) -> Light:
    """What needs no chance: the camera's sources at the first surface, and lamps looked into.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.

    Returns
    -------
    Light
        Direct light alone; phases in double precision.
    """
    mi, stage = task.mi, task.stage
    valid = first.is_valid()
    range_m = _numpy(first.t) * stage.unit_m
    range_m = np.where(np.isfinite(range_m), range_m, 0.0)
    phasors = np.zeros((len(freqs_hz), range_m.size), np.complex128)
    ambient = np.zeros(range_m.size)
    for flash in task.flashes:
        value, far_m = flash_light(mi, stage, flash, first, valid, lit=flash.at_camera)
        if flash.modulated:
            phasors += _turned(_numpy(value), range_m + _numpy(far_m), freqs_hz)
        else:
            ambient += _numpy(value)
    if task.lamps:
        light = lamps_seen(mi, stage, first, mi.Bool(True))
        phasors += _turned(_numpy(light.modulated), _numpy(light.far_m), freqs_hz)
        ambient += _numpy(light.ambient)
    none = np.zeros_like(phasors)
    return Light(phasors, none, none, ambient)


def indirect_light(
    task: Task, first: Jit, freqs_hz: F64, *, bounces: int, samples: int, seed: int
) -> Light:
    """One independent estimate of all that `direct_light` leaves out.

    Parameters
    ----------
    task : Task
        Scene and sources.
    first : SurfaceInteraction3f
        First surface of each lane.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.
    bounces, samples, seed : int
        As `trace` takes them.

    Returns
    -------
    Light
        Mean over the paths of every lane; `direct` is the direct light of the scene's lamps.
    """
    import drjit as dr

    mi, lanes = task.mi, dr.width(first.t)
    cycles = [float(path_to_phase(1.0, f) / (2 * np.pi)) for f in freqs_hz]
    sums = [[_zeros(mi, lanes, freq) for freq in freqs_hz] for _ in PARTS]

    def deposit(sums: Jit, _lane: Jit, _number: Jit, bounce: Jit, light: Jit, path_m: Jit) -> Jit:
        shares = [
            dr.select(bounce == 0, light, 0.0),
            dr.select(bounce == 1, light, 0.0),
            dr.select(bounce > 1, light, 0.0),
        ]
        turns = [_turn(mi, cycle, path_m) for cycle in cycles]
        return [
            [tuple(a + share * b for a, b in zip(old, turn, strict=True))
             for old, turn in zip(part, turns, strict=True)]
            for part, share in zip(sums, shares, strict=True)
        ]  # fmt: skip

    sums, ambient = trace(
        task, first, bounces=bounces, samples=samples, seed=seed, sums=sums, deposit=deposit
    )
    dr.eval(sums, ambient)
    direct, one_bounce, rest = (
        np.stack([_complex(pair) for pair in part]) / samples for part in sums
    )
    return Light(direct, one_bounce, rest, _numpy(ambient) / samples)


def _zeros(mi: Any, lanes: int, freq_hz: float) -> tuple[Jit, ...]:  # noqa: ANN401
    """Sum of one frequency: real and imaginary part, at 0 Hz the real one alone."""
    import drjit as dr

    return tuple(dr.zeros(mi.Float, lanes) for _ in range(2 if freq_hz else 1))


def _turn(mi: Any, cycles_per_m: float, path_m: Jit) -> tuple[Jit, ...]:  # noqa: ANN401
    """``exp(+j 2 pi f path / c)`` in parts; whole turns go first, while single precision holds."""
    import drjit as dr

    if cycles_per_m == 0:
        return (mi.Float(1),)
    turns = path_m * cycles_per_m
    sine, cosine = dr.sincos((turns - dr.floor(turns)) * dr.two_pi)
    return cosine, sine


def _turned(value: F64, path_m: F64, freqs_hz: F64) -> C128:
    return np.asarray([value * np.exp(1j * path_to_phase(path_m, f)) for f in freqs_hz])


def _complex(parts: tuple[Jit, ...]) -> C128:
    imaginary = _numpy(parts[1]) if len(parts) == 2 else 0.0
    return np.asarray(_numpy(parts[0]) + 1j * imaginary)


def _numpy(values: Jit) -> F64:
    return np.asarray(values.numpy(), dtype=np.float64)
