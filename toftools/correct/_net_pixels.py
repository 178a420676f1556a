"""The compiled part of a network's input: phases, candidates and channels of every pixel.

Phases are taken once and serve both the search over wraps (`_wraps`, with the weights of phasors of
amplitude 1: cameras tell amplitudes per frequency or not, and the search must not differ) and the
description of what it found. Pixels go in blocks, and the loop over a block's pixels is the
innermost, so that compilers vectorise it. Input: phasors. Fails as the search does.
"""

import numpy as np
from numba import njit, prange

from toftools._turns import FAST, turns
from toftools.correct import kernel_input
from toftools.correct._net_coarse import MOST, RANGE_M, SHIFT_M
from toftools.correct._wraps import BLOCK, Plan, sink, walk_step
from toftools.types import C64, F32, Bool


def propose(values: C64, usable: Bool, walk: Plan, top: int) -> tuple[F32, F32, Bool, F32]:
    """Phases of every pixel, and the ranges that explain them best.

    Parameters
    ----------
    values : ndarray, (F, H, W)
        Phasors, complex64.
    usable : ndarray, (H, W), bool
        Pixels to look at.
    walk : Plan
        Search over wraps.
    top : int
        Ranges wanted of every pixel.

    Returns
    -------
    cycles : ndarray, (F, H, W)
        Phases, turns; 0 without a signal.
    bright : ndarray, (H, W)
        Mean amplitude of the frequencies.
    lit : ndarray, (H, W), bool
        Usable pixels with a signal at all frequencies.
    range_m : ndarray, (top, H, W)
        Ranges, m, likeliest first; where there are fewer, the first again.
    """
    n_freqs, *shape = values.shape
    pixels = values[0].size
    cycles = np.empty((n_freqs, pixels), np.float32)
    range_m = np.empty((top, pixels), np.float32)
    bright, lit = np.empty(pixels, np.float32), np.empty(pixels, np.bool_)
    _propose(
        kernel_input(values).view(np.float32).reshape(n_freqs, -1, 2),
        kernel_input(usable).reshape(-1), walk.ambiguity_m.astype(np.float32),
        walk.information.astype(np.float32), walk.anchor, walk.first, walk.last,
        np.float32(walk.max_range_m), cycles, bright, lit, range_m,
    )  # fmt: skip
    return (
        cycles.reshape(n_freqs, *shape), bright.reshape(shape), lit.reshape(shape),
        range_m.reshape(top, *shape),
    )  # fmt: skip


@njit(parallel=True, cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _propose(
    values: F32, usable: Bool, U: F32, k2: F32, anchor: int, first: int, last: int,
    longest: np.float32, cycles: F32, bright: F32, lit: Bool, range_m: F32,
) -> None:  # fmt: skip
    """Fill cycles, bright, lit and range_m, block by block."""
    n_freqs, n_pixels = values.shape[:2]
    top = range_m.shape[0]
    for block in prange((n_pixels + BLOCK - 1) // BLOCK):
        lo = block * BLOCK
        n = min(BLOCK, n_pixels - lo)
        phase, weight = (
            np.empty((n_freqs, BLOCK), np.float32),
            np.empty((n_freqs, BLOCK), np.float32),
        )
        total = np.full(BLOCK, k2.sum(), np.float32)
        s1, s2 = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        new_range, new_cost = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        cost = np.full((top, BLOCK), np.inf, np.float32)
        _phases(values, usable, lo, n, phase, bright, lit)
        for i in range(n_freqs):
            weight[i] = k2[i]
            cycles[i, lo : lo + n] = phase[i, :n]
        range_m[:, lo : lo + n] = 0
        for wrap in range(first, last + 1):
            step = np.float32(wrap)
            walk_step(
                phase, weight, total, U, anchor, step, longest, n, s1, s2, new_range, new_cost
            )
            for t in range(top):
                sink(new_range, new_cost, range_m[t, lo : lo + n], cost[t, :n])
        for t in range(1, top):
            for j in range(n):
                if not cost[t, j] < np.inf:
                    range_m[t, lo + j] = range_m[0, lo + j]


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _phases(values: F32, usable: Bool, lo: int, n: int, phase: F32, bright: F32, lit: Bool) -> None:
    """Phase, mean amplitude and whether there is a signal, of one block."""
    n_freqs = values.shape[0]
    bright[lo : lo + n] = 0
    for j in range(n):
        lit[lo + j] = usable[lo + j]
    for i in range(n_freqs):
        for j in range(n):
            re, im = values[i, lo + j, 0], values[i, lo + j, 1]
            wide, thin = max(abs(re), abs(im)), min(abs(re), abs(im))
            ratio = thin / max(wide, np.float32(1e-30))  # squares of small numbers would vanish
            bright[lo + j] += wide * np.sqrt(1 + ratio * ratio) / np.float32(n_freqs)
            lit[lo + j] &= wide > 0
            phase[i, j] = turns(re, im)
    for j in range(n):
        if not lit[lo + j]:
            bright[lo + j] = 1
            for i in range(n_freqs):
                phase[i, j] = 0


def describe(
    cycles: F32, bright: F32, lit: Bool, candidates_m: F32, turns_per_m: F32, way: F32, dim: F32,
    metre: float, out: F32,
) -> None:  # fmt: skip
    """Fill the channels at full resolution.

    Range, ray x and y, log reflectance, lit; then, of several frequencies, their residuals at the
    first candidate, how badly each candidate explains the phases, and how far the others lie.

    Parameters
    ----------
    cycles : ndarray, (F, H, W)
        Phases, turns.
    bright : ndarray, (H, W)
        Mean amplitude.
    lit : ndarray, (H, W), bool
        Pixels with a signal; all channels but the rays are zero elsewhere.
    candidates_m : ndarray, (K, H, W)
        Ranges, m.
    turns_per_m : ndarray, (F,)
        Phase per range, turns/m, float32.
    way : ndarray, (2, H, W)
        x and y of the unit viewing directions.
    dim : ndarray, (H, W)
        One over the amplitude of a white surface facing the camera at 1 m.
    metre : float
        Metres of the trained frequencies per metre.
    out : ndarray, (C, H, W)
        Channels.
    """
    n_freqs, n_cand = cycles.shape[0], candidates_m.shape[0]
    _describe(
        cycles.reshape(n_freqs, -1), bright.reshape(-1), lit.reshape(-1),
        candidates_m.reshape(n_cand, -1), turns_per_m, way.reshape(2, -1), dim.reshape(-1),
        np.float32(metre), out.reshape(out.shape[0], -1),
    )  # fmt: skip


@njit(parallel=True, cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _describe(
    cycles: F32, bright: F32, lit: Bool, candidates: F32, turns_per_m: F32, way: F32, dim: F32,
    metre: np.float32, out: F32,
) -> None:  # fmt: skip
    n_freqs, n_pixels = cycles.shape
    n_cand = candidates.shape[0]
    range_unit, shift_unit = metre / np.float32(RANGE_M), metre / np.float32(SHIFT_M)
    for block in prange((n_pixels + BLOCK - 1) // BLOCK):
        lo = block * BLOCK
        hi = min(lo + BLOCK, n_pixels)
        shine = np.empty(BLOCK, np.float32)
        for p in range(lo, hi):
            shine[p - lo] = np.float32(1) if lit[p] else np.float32(0)
            first = candidates[0, p]
            seen = bright[p] * max(first * first, np.float32(1e-4)) * dim[p]
            out[0, p] = shine[p - lo] * first * range_unit
            out[1, p], out[2, p] = way[0, p], way[1, p]
            out[3, p] = shine[p - lo] * np.log(max(seen, np.float32(1e-20)))
            out[4, p] = shine[p - lo]
        if n_freqs == 1:
            continue
        misfit = np.empty(BLOCK, np.float32)
        for c in range(n_cand):
            misfit[:] = 0
            for f in range(n_freqs):
                scale = shift_unit / turns_per_m[f]
                for p in range(lo, hi):
                    off = cycles[f, p] - turns_per_m[f] * candidates[c, p]
                    off -= np.rint(off)
                    misfit[p - lo] += off * off
                    if c == 0:
                        shift = min(max(off * scale, np.float32(-MOST)), np.float32(MOST))
                        out[5 + f, p] = shine[p - lo] * shift
            for p in range(lo, hi):
                root = np.sqrt(misfit[p - lo] / np.float32(n_freqs))
                out[5 + n_freqs + c, p] = shine[p - lo] * root * np.float32(8)
                if c > 0:
                    away = (candidates[c, p] - candidates[0, p]) * range_unit
                    out[5 + n_freqs + n_cand - 1 + c, p] = shine[p - lo] * away
