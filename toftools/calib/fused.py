"""A whole chain on phasors in one pass, for streams of frames.

Every phase stage is ``z exp(-j error)``. Their errors are sampled once: wiggling as a table over
measured phase, the amplitude error as a table over phase and amplitude, constants per frequency as
one number, patterns as one map. The pass then reads each phasor once, looks up, adds, turns and
writes it. Tables are linear in between: with `PHASES` nodes that errs below a millionth of a radian
for wiggling of 4 degrees, with `PER_OCTAVE` x `SLICES` nodes below 0.1 mrad for smooth amplitude
errors, but for the last eighth of an octave before the ends of their span; tests/test_fused.py
compares with `toftools.calib.chain.applied`. Amplitudes are looked up
by the bits of their float32, which rise evenly within each octave: a logarithm for nothing.
Stages that only mark pixels (response) or change optics (lens, extrinsics) cost a mask or nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange

from toftools._arrays import kernel_input
from toftools._transfer import sincos
from toftools._turns import FAST, turns
from toftools.calib.chain import Chain
from toftools.calib.stage import SLOTS, PhaseStage
from toftools.types import F32, F64, Bool, Phasors
from toftools.units import TWO_PI

PHASES = 2048
SLICES = 256
PER_OCTAVE = 8
"""Amplitudes of the table per octave, which start with it: slopes jump from octave to octave."""
OCTAVE = 1 << 23
"""Steps of the bits of a float32 per octave."""
SPAN = (1e-6, 1e9)
"""Amplitudes of the table where a stage has no ``amplitude_span``; beyond it the ends hold."""
KERNEL = ("wiggling", "slope", "constant", "last", "pattern", "amplitude")


@dataclass(frozen=True, eq=False)
class Tables:
    """What the pass looks up; all errors in turns.

    Parameters
    ----------
    wiggling, slope : ndarray, (F, PHASES + 1)
        Error over measured phase, and its slope, turns per turn.
    constant, last : ndarray, (F,)
        Errors that are the same for all pixels: of stages before and after the amplitude stage.
    pattern : ndarray, (F, H, W) or (F, 1, 1)
        Error per pixel.
    amplitude : ndarray, (F, SLICES + 1, L) or (F, 1, 1)
        Error over corrected phase and amplitude.
    low : int
        Bits of the first amplitude of that table.
    per_bit : float
        Steps of it per unit of the bits.
    good : ndarray, (H, W), bool
        Pixels that no stage calls invalid.
    """

    wiggling: F32
    slope: F32
    constant: F32
    last: F32
    pattern: F32
    amplitude: F32
    low: int
    per_bit: float
    good: Bool


def fused(chain: Chain) -> Callable[[Phasors], Phasors]:
    """Make the correction of phasors by all stages of a chain.

    Parameters
    ----------
    chain : Chain
        Calibration; its temperature stage, if any, must be set to the temperatures of the frames
        (`toftools.calib.chain.at_conditions`).

    Returns
    -------
    callable
        ``run(phasors) -> phasors``, pure. Taps are the business of the response stage, which
        comes before.

    Raises
    ------
    ValueError
        If the temperature stage has no temperatures.
    """
    tables = _tables(chain)
    arrays = [kernel_input(getattr(tables, name)) for name in KERNEL]
    low, per_bit = np.int32(tables.low), np.float32(tables.per_bit)
    shape = (chain.freqs_hz.size, chain.height, chain.width)

    def run(phasors: Phasors) -> Phasors:
        if phasors.values.shape != shape:
            msg = f"the calibration is of phasors {shape}, got {phasors.values.shape}"
            raise ValueError(msg)
        values = kernel_input(phasors.values).view(np.float32)
        sigma = np.zeros((1, 1, 1), np.float32) if phasors.sigma is None else phasors.sigma
        out, scaled = np.empty(values.shape, np.float32), np.empty(sigma.shape, np.float32)
        _correct(values, kernel_input(sigma), *arrays, low, per_bit, out, scaled)
        known = None if phasors.sigma is None else scaled
        return Phasors(out.view(np.complex64), known, valid=phasors.valid & tables.good)

    for sigma in (None, np.ones(shape, np.float32)):
        run(Phasors(np.ones(shape, np.complex64), sigma))  # compiling belongs to making
    return run


def _tables(chain: Chain) -> Tables:
    """Sample every stage."""
    n, shape = chain.freqs_hz.size, (chain.height, chain.width)
    parts: dict[str, F64] = {
        **dict.fromkeys(("wiggling", "slope"), np.zeros((n, PHASES + 1))),
        **dict.fromkeys(("constant", "last"), np.zeros(n)),
        **dict.fromkeys(("pattern", "amplitude"), np.zeros((n, 1, 1))),
    }
    low, per_bit, good = 0, 0.0, np.ones(shape, bool)
    for stage in chain.stages:
        good &= stage(Phasors(np.ones((n, *shape), np.complex64))).valid
        if not isinstance(stage, PhaseStage):
            continue
        if stage.slot == "wiggling":
            nodes = np.linspace(0, TWO_PI, PHASES + 1)
            phase = np.tile(nodes, (n, 1))
            parts["wiggling"] = np.asarray(stage.error_rad(phase, np.ones_like(phase)))
            parts["slope"] = TWO_PI * _slope(stage, phase, parts["wiggling"])
        elif stage.slot == "amplitude":
            parts["amplitude"], low, per_bit = _surface(stage, n)
        else:
            error = np.asarray(stage.error_rad(np.zeros((n, 1, 1)), np.ones((n, 1, 1))))
            late = SLOTS.index(stage.slot) > SLOTS.index("amplitude")
            where = "pattern" if error.shape[-2:] == shape else "last" if late else "constant"
            flat = error if where == "pattern" else error[:, 0, 0]
            parts[where] = parts[where] + np.nan_to_num(flat, nan=0.0)
    single = {name: np.asarray(part / TWO_PI, np.float32) for name, part in parts.items()}
    return Tables(**single, low=low, per_bit=per_bit, good=good)


def _slope(stage: PhaseStage, phase: F64, error: F64) -> F64:
    """Derivative of a wiggling by phase: its own where it tells one, else by differences."""
    told = getattr(stage, "slope", None)
    if told is not None:
        return np.asarray(told(phase))
    return np.asarray(np.gradient(error, phase[0], axis=1, edge_order=2))


def _surface(stage: PhaseStage, n: int) -> tuple[F64, int, float]:
    """Amplitude error over phase and amplitude, with the bits of the first and their scale."""
    low_level, high_level = np.log2(getattr(stage, "amplitude_span", SPAN))
    octaves = 2.0 ** np.arange(np.floor(low_level), np.ceil(high_level) + 1)
    first, last = (int(bits) for bits in octaves[[0, -1]].astype(np.float32).view(np.int32))
    bits = np.arange(first, last + 1, OCTAVE // PER_OCTAVE, dtype=np.int32)
    levels = bits.view(np.float32).astype(np.float64)
    phase, amplitude = np.meshgrid(np.linspace(0, TWO_PI, SLICES + 1), levels, indexing="ij")
    grid = (n, *phase.shape)
    error = stage.error_rad(np.broadcast_to(phase, grid), np.broadcast_to(amplitude, grid))
    return np.broadcast_to(error, grid), first, PER_OCTAVE / OCTAVE


# Whole rows in short loops over buffers of one row: each loop is simple enough to be vectorised.
@njit(inline="always", fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _look_up(table: F32, turn: F32, out: F32) -> None:
    """Linear interpolation of a table over 0..1 turns."""
    nodes, most = np.float32(table.size - 1), np.int32(table.size - 2)
    for x in range(turn.size):
        place = turn[x] * nodes
        i = max(min(np.int32(place), most), np.int32(0))  # NaN may become any number
        start = table[i]
        out[x] = start + (place - np.float32(i)) * (table[i + 1] - start)


@njit(inline="always", fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _bend(
    table: F32, levels: int, row: F32, turn: F32, low: np.int32, per_bit: np.float32, error: F32
) -> None:  # fmt: skip
    """Add the amplitude error: bilinear in corrected phase and in the bits of the amplitude."""
    wide = np.int32(levels)
    slices, most = np.float32(table.size // levels - 1), np.int32(table.size // levels - 2)
    top, last = np.float32(levels - 1), np.int32(levels - 2)
    level, up, across = np.empty_like(turn), np.empty_like(turn), np.empty_like(turn)
    cell = np.empty(turn.size, np.int32)
    for x in range(turn.size):
        level[x] = np.sqrt(row[2 * x] * row[2 * x] + row[2 * x + 1] * row[2 * x + 1])
    bits = level.view(np.int32)
    for x in range(turn.size):
        phase = turn[x] - error[x]
        phase = (phase - np.floor(phase)) * slices
        i = max(min(np.int32(phase), most), np.int32(0))
        place = min(max(np.float32(bits[x] - low) * per_bit, np.float32(0)), top)
        j = max(min(np.int32(place), last), np.int32(0))
        cell[x] = i * wide + j
        across[x] = phase - np.float32(i)
        up[x] = place - np.float32(j)
    one = np.int32(1)
    for x in range(turn.size):
        k, v = cell[x], up[x]
        near = table[k] + v * (table[k + one] - table[k])
        far = table[k + wide] + v * (table[k + wide + one] - table[k + wide])
        error[x] += near + across[x] * (far - near)


@njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]  # numba has no types
def _correct(
    values: F32, sigma: F32, wiggling: F32, slope: F32, constant: F32, last: F32, pattern: F32,
    surface: F32, low: np.int32, per_bit: np.float32, out: F32, scaled: F32,
) -> None:  # fmt: skip
    """Turn every phasor; values and out are (F, H, 2 W), real and imaginary parts in turn."""
    n, height, width = values.shape[0], values.shape[1], values.shape[2] // 2
    bends, patterned, noisy = surface.size > n, pattern.size > n, sigma.size > 1
    for line in prange(n * height):
        f, y = line // height, line % height
        row, new = values[f, y], out[f, y]
        turn, error = np.empty(width, np.float32), np.empty(width, np.float32)
        for x in range(width):
            turn[x] = turns(row[2 * x], row[2 * x + 1])
        _look_up(wiggling[f], turn, error)
        before, after = constant[f], last[f]
        for x in range(width):
            error[x] += before
        if patterned:
            offset = pattern[f, y]
            for x in range(width):
                error[x] += offset[x]
        if bends:
            _bend(surface[f].ravel(), surface.shape[2], row, turn, low, per_bit, error)
        for x in range(width):
            s, c = sincos(error[x] + after)
            new[2 * x] = row[2 * x] * c + row[2 * x + 1] * s
            new[2 * x + 1] = row[2 * x + 1] * c - row[2 * x] * s
        if noisy:
            _look_up(slope[f], turn, error)
            old, fresh = sigma[f, y], scaled[f, y]
            for x in range(width):
                fresh[x] = old[x] * abs(1 - error[x])


def at_temperatures(chain: Chain, **temperatures: float) -> Chain:
    """The chain with its temperature stage set.

    Parameters
    ----------
    chain : Chain
        Calibration.
    **temperatures : float
        ``sensor_c`` and ``light_c``, degrees Celsius.

    Returns
    -------
    Chain
        The chain itself if it has no temperature stage.
    """
    stages = [
        stage.at(**temperatures) if stage.slot == "temperature" else stage  # type: ignore[attr-defined]
        for stage in chain.stages
    ]
    return replace(chain, stages=tuple(stages))
