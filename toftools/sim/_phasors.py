"""Phasors out of traced paths: one pass of the tracer as sums over frequencies, split by bounce."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.sim._flash import flash_light
from toftools.sim._lamps import lamps_seen
from toftools.sim._task import Jit, Task
from toftools.sim._tracer import Deposit, trace
from toftools.types import F64
from toftools.units import path_to_phase

C128 = NDArray[np.complex128]


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
            phasors += turned(_numpy(value), range_m + _numpy(far_m), freqs_hz)
        else:
            ambient += _numpy(value)
    if task.lamps:
        light = lamps_seen(mi, stage, first, mi.Bool(True))
        phasors += turned(_numpy(light.modulated), _numpy(light.far_m), freqs_hz)
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

    lanes = dr.width(first.t)
    sums, ambient = trace(
        task,
        first,
        bounces=bounces,
        samples=samples,
        seed=seed,
        sums=empty_sums(task, lanes, freqs_hz),
        deposit=depositor(task, freqs_hz),
    )
    return light_of(sums, ambient, samples)


def empty_sums(task: Task, lanes: int, freqs_hz: F64) -> Jit:
    """Sums of phasors that `depositor` adds to: by bounce, frequency, and real and imaginary part.

    Parameters
    ----------
    task : Task
        Scene; direct light is summed only where it is met by chance.
    lanes : int
        Number of lanes.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz; 0 Hz has no imaginary part.

    Returns
    -------
    list of list of tuple of Float
        Zeros.
    """
    import drjit as dr

    mi, parts = task.mi, 3 if task.chance_direct else 2
    return [
        [tuple(dr.zeros(mi.Float, lanes) for _ in range(2 if freq else 1)) for freq in freqs_hz]
        for _ in range(parts)
    ]


def depositor(task: Task, freqs_hz: F64) -> Deposit:
    """How a contribution goes into the sums.

    Parameters
    ----------
    task : Task
        Scene.
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.

    Returns
    -------
    callable
        A `Deposit` for `trace` and `walk`.
    """
    import drjit as dr

    cycles = cycles_per_m(freqs_hz)

    def deposit(sums: Jit, _lane: Jit, _number: Jit, bounce: Jit, light: Jit, path_m: Jit) -> Jit:
        kinds = [bounce == 0] * (len(sums) - 2) + [bounce == 1, bounce > 1]
        turns = [turn(task.mi, cycle, path_m) for cycle in cycles]
        return [
            added(part, dr.select(kind, light, 0.0), turns)
            for part, kind in zip(sums, kinds, strict=True)
        ]

    return deposit


def added(part: Jit, light: Jit, turns: Jit) -> Jit:
    """One sum of phasors with one contribution more.

    Parameters
    ----------
    part : list of tuple of Float
        Sum by frequency.
    light : Float
        Radiance.
    turns : list of tuple of Float
        Phase factor, or another phasor, by frequency.

    Returns
    -------
    list of tuple of Float
        New sum.
    """
    return [
        tuple(a + light * b for a, b in zip(old, turn, strict=True))
        for old, turn in zip(part, turns, strict=True)
    ]


def light_of(sums: Jit, ambient: Jit, samples: int) -> Light:
    """Mean light of finished sums.

    Parameters
    ----------
    sums, ambient : pytree and Float
        What was collected.
    samples : int
        Over how many paths per lane.

    Returns
    -------
    Light
        In numpy.
    """
    import drjit as dr

    dr.eval(sums, ambient)
    parts = [np.stack([_complex(pair) for pair in part]) / samples for part in sums]
    direct = parts[0] if len(parts) == 3 else np.zeros_like(parts[0])
    return Light(direct, parts[-2], parts[-1], _numpy(ambient) / samples)


def cycles_per_m(freqs_hz: F64) -> list[float]:
    """Turns of the phase per metre of path.

    Parameters
    ----------
    freqs_hz : ndarray, (Q,)
        Frequencies, Hz.

    Returns
    -------
    list of float
        ``f / c``, 1/m.
    """
    return [float(path_to_phase(1.0, freq) / (2 * np.pi)) for freq in freqs_hz]


def turn(mi: Any, cycles: float, path_m: Jit) -> tuple[Jit, ...]:  # noqa: ANN401
    """Phase factor ``exp(+j 2 pi f path / c)`` in parts, at 0 Hz the real one alone.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    cycles : float
        Turns per metre.
    path_m : Float
        Optical path, m.

    Returns
    -------
    tuple of Float
        Cosine and sine.
    """
    import drjit as dr

    if cycles == 0:
        return (mi.Float(1),)
    turns = path_m * dr.opaque(mi.Float, cycles)  # other frequencies, the same kernel
    # Whole turns go first, while single precision holds them.
    sine, cosine = dr.sincos((turns - dr.floor(turns)) * dr.two_pi)
    return cosine, sine


def turned(value: F64, path_m: F64, freqs_hz: F64) -> C128:
    return np.asarray([value * np.exp(1j * path_to_phase(path_m, f)) for f in freqs_hz])


def _complex(parts: tuple[Jit, ...]) -> C128:
    imaginary = _numpy(parts[1]) if len(parts) == 2 else 0.0
    return np.asarray(_numpy(parts[0]) + 1j * imaginary)


def _numpy(values: Jit) -> F64:
    return np.asarray(values.numpy(), dtype=np.float64)
