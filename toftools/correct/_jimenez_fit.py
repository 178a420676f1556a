"""Ranges whose simulated phasors are the measured ones: objective, gradient, minimisation.

With the way to the camera at the starting range d0 taken off, a node at range d = d0 + x shows

    m(u) = a(u) [ L(u) exp(2jkx) + G(u) exp(jk(x - d0)) ],   k = 2 pi f / c,
    G(u) = sum_v K(u, v) b(v) exp(jk |u - v|),   b(v) = m(v) exp(jk(d0 - x)),

L the flash, K the form factor of `_transfer`, G the light of all other nodes: m(v) is what was
measured there, so that all bounces are in it (ours; a simulation would need a series). The least
squares albedo a is put in as a function of the ranges, and

    J(x) = 1/2 sum_u,f |m - measured|^2 / s^2  +  1/2 sum_pairs (x_u - x_v)^2 / t^2

is minimised by L-BFGS with its exact gradient: all that depends on a range, directly or through
places, distances, areas and the phase of what is sent on. Normals stay (the caller renews them).
References: D. Jimenez et al. (2014), see `jimenez2014`, for the idea; R. H. Byrd et al., "A
limited memory algorithm for bound constrained optimization", SIAM J. Scientific Computing 16
(1995) 1190-1208. Inputs: nodes. Fails where the misfit has other minima: wrong wraps stay wrong.
"""

from dataclasses import dataclass, replace

import numpy as np

from toftools._transfer import Patches, gather
from toftools.correct._albedo_gain import fitted_gain
from toftools.correct._jimenez_gradient import through_transfer
from toftools.correct._jimenez_nodes import Nodes
from toftools.types import C64, F64
from toftools.units import path_to_phase

MODEL_NOISE = 0.01
"""Error of the model itself, as a share of the phasor."""
FURTHEST_M = 0.5
"""No range moves by more than this: beyond, patches would meet the camera or each other."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Nodes and the weights of the objective.

    Parameters
    ----------
    nodes : Nodes
        Patches, phasors, flash.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    weight : ndarray, (F, N)
        ``1 / s^2``.
    bond : ndarray, (E,)
        ``1 / t^2`` of each pair, m^-2.
    """

    nodes: Nodes
    freqs_hz: F64
    weight: F64
    bond: F64


@dataclass(frozen=True, eq=False)
class Misfit:
    """The objective at one set of ranges.

    Parameters
    ----------
    value : float
        J.
    gradient : ndarray, (N,)
        Its derivative, 1/m.
    albedo : ndarray, (N,)
        The albedo that fits best.
    data : float
        The part of J that compares phasors.
    """

    value: float
    gradient: F64
    albedo: F64
    data: float


def problem(here: Nodes, freqs_hz: F64, *, slope: float, albedo_gain: float) -> Problem:
    """Weights of the objective, and the gain of the albedo where it is not known.

    Parameters
    ----------
    here : Nodes
        Nodes.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    slope : float
        By how much the error of the range may differ between two neighbours, as a share of their
        distance.
    albedo_gain : float
        The flash is weaker by this factor than the sensor says; 0 fits it.

    Returns
    -------
    Problem
        Ready to be minimised.
    """
    size = np.abs(here.light)
    weight = 1 / np.maximum(here.noise**2 + (MODEL_NOISE * size) ** 2, 1e-30)
    at = here.patches.position[:, here.pairs]  # (3, 2, E)
    apart = np.sqrt(np.sum((at[:, 0] - at[:, 1]) ** 2, axis=0, dtype=np.float64))
    bond = 1 / np.maximum(slope * apart, 1e-6) ** 2
    gain = albedo_gain or _gain_of(here, freqs_hz)
    return Problem(replace(here, flash=here.flash / gain), freqs_hz, weight, bond)


def _gain_of(here: Nodes, freqs_hz: F64) -> float:
    """The gain that `fuchs2010` would fit to the nodes."""
    start = Problem(here, freqs_hz, np.zeros(0), np.zeros(0))
    sent = sent_light(start, np.zeros_like(here.range_m))
    arrived = gather(here.patches, here.patches, sent, freqs_hz)
    turn = np.exp(-1j * path_to_phase(here.range_m, freqs_hz[:, None]))
    ratio = (arrived * turn / np.maximum(here.flash, 1e-9)).astype(np.complex64)
    shown = (sent / turn).astype(np.complex64)  # as the camera sees them
    flash = here.flash[:, None].astype(np.float32)
    range_m = here.range_m[None].astype(np.float32)
    return fitted_gain(shown[:, None], ratio[:, None], flash, range_m, freqs_hz)


def moved(here: Nodes, x_m: F64) -> Patches:
    """Patches with their ranges changed.

    Parameters
    ----------
    here : Nodes
        Nodes.
    x_m : ndarray, (N,)
        Change of range, m.

    Returns
    -------
    Patches
        Moved along the viewing rays; areas grow with the square of the range.
    """
    scale = (here.range_m + x_m) / here.range_m
    at = here.patches.position + here.ray * x_m
    return Patches(
        at.astype(np.float32), here.patches.normal, (here.patches.area_m2 * scale**2).astype("f4")
    )


def sent_light(task: Problem, x_m: F64) -> C64:
    """What the nodes send on: measured, delayed by the way from the camera that they now have.

    Parameters
    ----------
    task : Problem
        Nodes.
    x_m : ndarray, (N,)
        Change of range, m.

    Returns
    -------
    ndarray, (F, N)
        Radiosity phasors, in the unit of the measured ones.
    """
    way = path_to_phase(task.nodes.range_m - x_m, task.freqs_hz[:, None])
    return np.asarray(task.nodes.light * np.exp(1j * way), np.complex64)


def misfit(task: Problem, x_m: F64) -> Misfit:
    """Objective and gradient.

    Parameters
    ----------
    task : Problem
        Nodes and weights.
    x_m : ndarray, (N,)
        Change of range, m.

    Returns
    -------
    Misfit
        J, its gradient, the albedos.
    """
    here, k = task.nodes, path_to_phase(1.0, task.freqs_hz)[:, None]  # (F, 1) rad per metre
    d = here.range_m + x_m
    now = moved(here, x_m)
    sent = sent_light(task, x_m)
    arrived = gather(now, now, sent, task.freqs_hz)
    turn = np.exp(1j * k * (x_m - here.range_m))
    direct = here.flash * (here.range_m / d) ** 2 * np.exp(2j * k * x_m)
    indirect = arrived * turn
    total = direct + indirect
    power = np.sum(task.weight * np.abs(total) ** 2, axis=0)
    agree = np.sum(task.weight * (np.conj(total) * here.light).real, axis=0)
    albedo = np.clip(agree / np.maximum(power, 1e-30), 0, None)
    off = albedo * total - here.light
    data = 0.5 * float(np.sum(task.weight * np.abs(off) ** 2))
    pull = task.weight * albedo * np.conj(off)  # dJ = Re(pull d(total)), albedo at its optimum
    slopes = (2j * k - 2 / d) * direct + 1j * k * indirect
    gradient = np.sum((pull * slopes).real, axis=0)
    gradient += through_transfer(now, here.ray, d, k[:, 0], pull * turn, sent)
    a, b = here.pairs
    apart = x_m[a] - x_m[b]
    gradient += np.bincount(a, task.bond * apart, x_m.size)
    gradient -= np.bincount(b, task.bond * apart, x_m.size)
    return Misfit(data + 0.5 * float(np.sum(task.bond * apart**2)), gradient, albedo, data)


def minimise(task: Problem, *, iterations: int) -> F64:
    """Ranges of least misfit.

    Parameters
    ----------
    task : Problem
        Nodes and weights.
    iterations : int
        Most steps of L-BFGS.

    Returns
    -------
    ndarray, (N,)
        Change of range, m; all zero if no step lowers the objective.
    """
    from scipy.optimize import minimize

    count = task.nodes.range_m.size
    # Ranges in units of their own standard deviation: otherwise bright nodes hide dark ones.
    k = path_to_phase(1.0, task.freqs_hz)[:, None]
    stiff = np.sum(task.weight * (2 * k * np.abs(task.nodes.light)) ** 2, axis=0)
    stiff += np.bincount(task.nodes.pairs.ravel(), np.tile(task.bond, 2), count)
    unit = 1 / np.sqrt(np.maximum(stiff, 1e-12))

    def scaled(y: F64) -> tuple[float, F64]:
        at = misfit(task, y * unit)
        return at.value, at.gradient * unit

    reach = np.minimum(FURTHEST_M, task.nodes.range_m / 2) / unit
    found = minimize(
        scaled,
        np.zeros(count),
        jac=True,
        method="L-BFGS-B",
        bounds=np.stack([-reach, reach], axis=1),
        options={"maxiter": iterations, "maxcor": 10, "ftol": 1e-6},
    )
    return np.asarray(found.x * unit)
