"""When to stop: how many bounces and how many paths an image needs, both out of a tolerance in m.

Bounces: a small pilot finds the energy of every bounce. What is left out after n bounces cannot
turn a phasor z by more than ``asin(R_n / |z|)``, R_n being its energy at 0 Hz, so the range by at
most ``c / (4 pi f)`` times that. Paths: passes with independent sequences scatter by their standard
error, which is pooled over tiles; tiles that are good enough are left alone.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._phasors import C128, direct_light, indirect_light
from toftools.sim._task import Jit, Task, first_hits
from toftools.sim._tracer import trace
from toftools.types import F64
from toftools.units import phase_to_range

PILOT_PIXELS, PILOT_PATHS, PILOT_BOUNCES = 1024, 64, 32
MOST_BOUNCES = 512
SHARE = 0.95
"""Pixels for which the bound on left-out bounces must hold: the rest is the pilot's own noise."""


@dataclass(frozen=True)
class Depth:
    """How many indirect bounces are modelled, and why.

    Parameters
    ----------
    bounces : int
        Indirect bounces.
    left_m : float
        Bound on what all further ones could move range by, m; NaN where nobody looked.
    why : str
        The same as a sentence.
    """

    bounces: int
    left_m: float
    why: str


def range_weights(phasors: C128, freqs_hz: F64) -> F64:
    """Weight of each frequency in the range that unwrapping gives.

    Parameters
    ----------
    phasors : ndarray, (F, ...)
        Phasors.
    freqs_hz : ndarray, (F,)
        Modulation frequencies, Hz.

    Returns
    -------
    ndarray, (F, ...)
        Weights that sum to 1 over the frequencies: by the square of frequency and amplitude, which
        is best under noise that is alike at all of them; 0 without light.
    """
    freqs = freqs_hz.reshape(-1, *(1,) * (phasors.ndim - 1))
    weights = (freqs * np.abs(phasors)) ** 2
    total = weights.sum(axis=0)
    return np.asarray(np.divide(weights, total, out=np.zeros(weights.shape), where=total > 0))


def needed_bounces(task: Task, directions: F64, freqs_hz: F64, tol_m: float, seed: int) -> Depth:
    """Fewest bounces whose rest cannot move range by more than a tolerance.

    Parameters
    ----------
    task : Task
        Scene and sources.
    directions : ndarray, (N, 3)
        Viewing directions, of which the pilot takes a part.
    freqs_hz : ndarray, (F,)
        Modulation frequencies, Hz.
    tol_m : float
        Tolerance, m.
    seed : int
        Of the pilot.

    Returns
    -------
    Depth
        At most `MOST_BOUNCES`; beyond those of the pilot the energy is taken to fall as it fell
        over its last ones.
    """
    some = directions[:: max(1, len(directions) // PILOT_PIXELS)]
    first = first_hits(task, some)
    direct = direct_light(task, first, freqs_hz)
    settings: dict[str, Any] = {"bounces": PILOT_BOUNCES, "samples": PILOT_PATHS, "seed": seed}
    indirect = indirect_light(task, first, freqs_hz, **settings)
    energy = _energies(task, first, **settings)  # (bounces + 1, pixels)
    seen = np.abs(direct.total + indirect.total).min(axis=0) > 0
    if not seen.any() or not energy[1:].any():
        return Depth(0, 0.0, "no light bounces: the direct light is all there is")
    total = (direct.total + indirect.total)[:, seen]
    mean = energy[:, seen].mean(axis=1)
    fall = _fall(mean)
    beyond = energy[-1, seen] * fall / (1 - fall)
    for bounces in range(MOST_BOUNCES + 1):
        if bounces < PILOT_BOUNCES:
            left = energy[bounces + 1 :, seen].sum(axis=0) + beyond
        else:
            left = mean[-1] * fall ** (bounces - PILOT_BOUNCES + 1) / (1 - fall)
        moved_m = float(np.quantile(_moved_m(left, total, freqs_hz), SHARE))
        if moved_m <= tol_m:
            break
    return Depth(bounces, moved_m, _sentence(bounces, moved_m, tol_m))


def _sentence(bounces: int, moved_m: float, tol_m: float) -> str:
    light = f"light after {bounces} bounces moves range by at most {moved_m * 1e3:.2f} mm"
    if moved_m <= tol_m:
        return f"{light} in {SHARE:.0%} of the pixels"
    return f"{light}: more than the {tol_m * 1e3:g} mm asked for, at the most bounces there are"


def _energies(task: Task, first: Jit, *, bounces: int, samples: int, seed: int) -> F64:
    """Mean modulated radiance per bounce and lane."""
    import drjit as dr

    mi, lanes = task.mi, dr.width(first.t)
    table = dr.zeros(mi.Float, lanes * (bounces + 1))

    def deposit(sums: Jit, lane: Jit, _number: Jit, bounce: Jit, light: Jit, _path: Jit) -> Jit:
        dr.scatter_add(sums, light, lane * (bounces_jit + 1) + bounce, light > 0)
        return sums

    bounces_jit = mi.UInt32(bounces)
    sums, _ = trace(
        task, first, bounces=bounces, samples=samples, seed=seed, sums=table, deposit=deposit
    )
    found = np.asarray(sums.numpy(), np.float64).reshape(lanes, bounces + 1)
    return np.asarray(found.T / samples)


def _fall(mean: F64) -> float:
    """Share of energy that one bounce more keeps, from the last eight."""
    if not mean[-2:].any():
        return 0.0
    # Halves, not ends: between two plates every second bounce may be dark.
    early, late = mean[-8:-4].sum(), mean[-4:].sum()
    return float(np.clip((late / early) ** (1 / 4), 0, 0.999)) if early > 0 else 0.999


def _moved_m(left: Any, total: C128, freqs_hz: F64) -> F64:  # noqa: ANN401
    """Bound on the range error from phasors of modulus `left` missing in `total`."""
    angle = np.arcsin(np.minimum(1, left / np.abs(total)))  # (F, N)
    moved = phase_to_range(angle, freqs_hz[:, None])
    return np.asarray((range_weights(total, freqs_hz) * moved).sum(axis=0))


def range_errors_m(errors: C128, total: C128, freqs_hz: F64) -> F64:
    """Range errors to first order from errors of phasors.

    Parameters
    ----------
    errors : ndarray, (..., F, N)
        Errors of the phasors at the modulation frequencies.
    total : ndarray, (F, N)
        The phasors.
    freqs_hz : ndarray, (F,)
        Modulation frequencies, Hz.

    Returns
    -------
    ndarray, (..., N)
        Error of the range that all frequencies together give, m; 0 without light.
    """
    power = np.abs(total) ** 2
    angle = np.divide(
        (errors * np.conj(total)).imag, power, out=np.zeros(errors.shape), where=power > 0
    )
    moved = phase_to_range(angle, freqs_hz[:, None])
    return np.asarray((range_weights(total, freqs_hz) * moved).sum(axis=-2))
