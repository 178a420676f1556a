"""The search over wrap counts that unwrapping methods share: a walk along the range axis.

The maximum-likelihood range of a lone return minimises ``sum_i w_i (d_i + n_i U_i - d)^2`` over d
and the wraps n_i, with ``w_i = (4 pi f_i / c)^2 A_i^2 / sigma_i^2`` (the weights of the
Cramer-Rao bound). Trying all wrap vectors costs the product of the wrap counts. Along the range
axis only their sum exists, and of those only one per wrap of the highest frequency matters: fix
its wrap, and the wraps of all others follow by rounding. The right vector is among these
candidates as long as ``|e_i - e_max f_i / f_max| < 1/2`` turn for the phase errors e, which
includes every error below a quarter turn: no tolerance to choose, nothing to miss.

Ranges are confined to [0, max_range]: a candidate beyond an end is moved to that end and pays
for it in the likelihood. Fails when an error exceeds the bound above (no signal, or multipath).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from toftools._turns import FAST, turns
from toftools.correct import kernel_input
from toftools.types import F32, F64, Phasors, Sensor
from toftools.units import ambiguity_m, joint_ambiguity_m, range_to_phase

BLOCK = 512
"""Pixels per block: the block's arrays stay in the first-level caches."""
# Caps the signal to noise ratio at 1e5, so that noise-free input keeps finite weights.
LEAST_NOISE = 1e-10


@dataclass(frozen=True, eq=False)
class Plan:
    """What can be worked out before a frame arrives.

    Parameters
    ----------
    ambiguity_m : ndarray, (F,)
        Unambiguous range of each frequency, m.
    information : ndarray, (F,)
        ``(4 pi f / c)^2``, rad^2 / m^2: weight of a squared phase signal to noise ratio of one.
    anchor : int
        Index of the highest frequency.
    first, last : int
        First and last wrap of the anchor to try.
    max_range_m : float
        Longest range, m.
    """

    ambiguity_m: F64
    information: F64
    anchor: int
    first: int
    last: int
    max_range_m: float


@dataclass(frozen=True, eq=False)
class Candidates:
    """The best candidates of every pixel, most likely first.

    Parameters
    ----------
    range_m : ndarray, (T, H, W)
        Ranges, m.
    cost : ndarray, (T, H, W)
        Weighted squared residual: chi-squared with F - 1 degrees of freedom if the noise is
        known, else the amplitude-weighted mean squared phase residual, rad^2. Infinite if there
        is no further candidate.
    information : ndarray, (H, W)
        Sum of the weights, m^-2: the Fisher information of the range if the noise is known; zero
        where there is no signal.
    n_freqs : int
        Number of frequencies.
    """

    range_m: F32
    cost: F32
    information: F32
    n_freqs: int


def plan(sensor: Sensor, max_range_m: float, *, least_freqs: int, method: str) -> Plan:
    """Lay out the walk along the range axis.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity. An exact repetition caps it, since
        nothing tells ranges beyond that apart.
    least_freqs : int
        Number of frequencies the method needs.
    method : str
        Name for the error message.

    Returns
    -------
    Plan
        The walk.

    Raises
    ------
    ValueError
        If there are too few frequencies or `max_range_m` is negative or not finite.
    """
    freqs = sensor.modulation.freqs_hz
    if freqs.size < least_freqs:
        msg = (
            f"{method} needs at least {least_freqs} frequencies, got {freqs.size}; "
            "use 'single' or 'crt'"
        )
        raise ValueError(msg)
    longest = longest_m(freqs, max_range_m)
    anchor = int(np.argmax(freqs))
    ambiguity = ambiguity_m(freqs)
    # One wrap more at both ends: noise may carry a phase across either.
    last = int(np.ceil(longest / ambiguity[anchor]))
    return Plan(ambiguity, range_to_phase(1.0, freqs) ** 2, anchor, -1, last, longest)


def longest_m(freqs_hz: F64, max_range_m: float) -> float:
    """Longest range to consider.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Modulation frequencies, Hz.
    max_range_m : float
        Wanted limit, m; 0 stands for the joint ambiguity.

    Returns
    -------
    float
        The limit, m: at most the range where all phases repeat exactly. One where they repeat
        only nearly is no reason to cut what was asked for.

    Raises
    ------
    ValueError
        If the limit is negative or not finite.
    """
    if not (np.isfinite(max_range_m) and max_range_m >= 0):
        msg = f"max_range_m must be metres, or 0 for the joint ambiguity, got {max_range_m}"
        raise ValueError(msg)
    if max_range_m == 0:
        return joint_ambiguity_m(freqs_hz)
    try:
        return min(float(max_range_m), joint_ambiguity_m(freqs_hz, tol_cycles=0.0))
    except ValueError:  # these frequencies never repeat exactly: nothing to cap
        return float(max_range_m)


def search(phasors: Phasors, walk: Plan, *, top: int) -> Candidates:
    """The most likely ranges of every pixel.

    Parameters
    ----------
    phasors : Phasors
        Values (F, H, W), with or without sigma.
    walk : Plan
        The walk along the range axis.
    top : int
        How many candidates to keep.

    Returns
    -------
    Candidates
        Ranges and costs, (top, H, W).

    Raises
    ------
    ValueError
        If the number of frequencies is not the one planned for.
    """
    n_freqs, height, width = phasors.values.shape
    if n_freqs != walk.ambiguity_m.size:
        msg = f"phasors must have {walk.ambiguity_m.size} frequencies, got {n_freqs}"
        raise ValueError(msg)
    values = kernel_input(phasors.values).view(np.float32).reshape(n_freqs, -1, 2)
    known = phasors.sigma is not None
    sigma = phasors.sigma if phasors.sigma is not None else np.zeros((n_freqs, 1), np.float32)
    range_m = np.empty((top, height * width), np.float32)
    cost = np.empty_like(range_m)
    information = np.empty(height * width, np.float32)
    _search(
        values,
        kernel_input(sigma).reshape(n_freqs, -1),
        known,
        walk.ambiguity_m.astype(np.float32),
        walk.information.astype(np.float32),
        walk.anchor,
        walk.first,
        walk.last,
        np.float32(walk.max_range_m),
        range_m,
        cost,
        information,
    )
    shape = (top, height, width)
    return Candidates(
        range_m.reshape(shape), cost.reshape(shape), information.reshape(shape[1:]), n_freqs
    )


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _weigh(
    values: F32, sigma: F32, known: bool, k2: F32, lo: int, n: int,
    cycles: F32, weight: F32, total: F32,
) -> None:  # fmt: skip
    """Phase in turns, weight in 1/m^2 and sum of weights of one block."""
    n_freqs = values.shape[0]
    mean = np.zeros(n, np.float32)  # mean squared amplitude: stands in for an unknown sigma^2
    for i in range(n_freqs):
        for j in range(n):
            re, im = values[i, lo + j, 0], values[i, lo + j, 1]
            cycles[i, j] = turns(re, im)
            power = re * re + im * im
            weight[i, j] = power
            mean[j] += power / np.float32(n_freqs)
    total[:n] = 0
    for i in range(n_freqs):
        for j in range(n):
            power = weight[i, j]
            noise = sigma[i, lo + j] * sigma[i, lo + j] if known else mean[j]
            floor = max(np.float32(LEAST_NOISE) * power, np.float32(1e-30))
            weight[i, j] = k2[i] * power / max(noise, floor)
            total[j] += weight[i, j]


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def walk_step(
    cycles: F32, weight: F32, total: F32, U: F32, anchor: int, wrap: np.float32,
    longest: np.float32, n: int, s1: F32, s2: F32, range_m: F32, cost: F32,
) -> None:  # fmt: skip
    """Range and cost of the candidate with one wrap of the anchor, for one block."""
    s1[:n] = 0
    s2[:n] = 0
    for i in range(U.size):
        ratio = U[anchor] / U[i]
        for j in range(n):
            off = (cycles[anchor, j] + wrap) * ratio - cycles[i, j]
            e = (np.rint(off) - off) * U[i]  # d_i minus the anchor's range
            s1[j] += weight[i, j] * e
            s2[j] += weight[i, j] * e * e
    for j in range(n):
        shift = s1[j] / max(total[j], np.float32(1e-30))
        free = (cycles[anchor, j] + wrap) * U[anchor] + shift
        kept = min(max(free, np.float32(0)), longest)
        out = kept - free
        range_m[j] = kept
        cost[j] = max(s2[j] - shift * s1[j], np.float32(0)) + total[j] * out * out


@njit(parallel=True, cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _search(
    values: F32, sigma: F32, known: bool, U: F32, k2: F32, anchor: int, first: int, last: int,
    longest: np.float32, range_m: F32, cost: F32, information: F32,
) -> None:  # fmt: skip
    """Fill range_m, cost (T, P) and information (P,), block by block."""
    n_freqs, n_pixels = values.shape[:2]
    top = cost.shape[0]
    for block in prange((n_pixels + BLOCK - 1) // BLOCK):
        lo = block * BLOCK
        n = min(BLOCK, n_pixels - lo)
        cycles = np.empty((n_freqs, BLOCK), np.float32)
        weight = np.empty((n_freqs, BLOCK), np.float32)
        s1, s2 = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        new_range, new_cost = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        total = information[lo : lo + n]
        _weigh(values, sigma, known, k2, lo, n, cycles, weight, total)
        range_m[:, lo : lo + n] = np.nan
        cost[:, lo : lo + n] = np.inf
        for wrap in range(first, last + 1):
            step = np.float32(wrap)
            walk_step(
                cycles, weight, total, U, anchor, step, longest, n, s1, s2, new_range, new_cost
            )
            for t in range(top):
                sink(new_range, new_cost, range_m[t, lo : lo + n], cost[t, lo : lo + n])


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def sink(new_range: F32, new_cost: F32, range_m: F32, cost: F32) -> None:
    """Keep the cheaper of a new and an old candidate, hand the dearer one down."""
    for j in range(cost.size):
        better = new_cost[j] < cost[j]
        old_range, old_cost = range_m[j], cost[j]
        range_m[j] = new_range[j] if better else old_range
        cost[j] = new_cost[j] if better else old_cost
        new_range[j] = old_range if better else new_range[j]
        new_cost[j] = old_cost if better else new_cost[j]
