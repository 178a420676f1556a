"""Sparse reflections analysis, the readable reference: one linear program per pixel.

The phasors of a pixel are a sum of few returns on a range grid, ``z_f = sum_i x_i exp(j k_f d_i)``
with ``x >= 0`` and amplitudes that do not depend on frequency. SRA takes the smallest total
amplitude that explains them, ``min sum_i x_i`` subject to a bounded residual, and answers with
the first return. Reference: Freedman et al., ECCV 2014 (below; formulation recalled). Input:
phasors of two or more frequencies, with or without sigma. What comes back is not that first
return itself but the least-squares fit that starts from all of them: _sra_fit.py, ours.

The residual bound here is ``sum_f w_f |r_f| <= epsilon sum_f w_f |z_f|``, r_f the complex residual
of frequency f, w_f = 1 / sigma_f where the noise is known (the paper's C, diagonal) and 1
elsewhere. The modulus is the gauge of a 16-sided polygon inscribed in the circle with a corner at
the measured phase: so it stays a linear program, within 2 % of the circle, and the same problem
at every phase. The paper bounds a quadratic form (recalled); the MATLAB re-implementation
published with Su et al. bounds the sum of moduli of all real and imaginary parts (read). That sum
depends on where the phases happen to lie: of noise-free lone returns at 40/70 MHz it puts 12 %
more than 0.5 m off when the grid spans the joint ambiguity. (The re-implementation cuts its grid
to 0.5..1.5 times the true ranges of the frame, which a camera cannot.) Its 1 cm grid and
its 5 % for the residual are our defaults; its threshold for the first return, 1 % of the strongest,
is not: ours is 5 %, because of noise (below).

The optimum need not be unique: where the other phasors are weaker than the first one, all returns
lie whole turns of the first frequency apart, and four of them can trade amplitude. So a unit of
return costs ``1 - 0.001 s^2``, s in [-1, 1] its agreement with the measured phases; that decides
such ties in favour of a strong main return, and changes the optimum by 0.1 % at most. For the
same reason the grid starts, pixel by pixel, at the range that the first frequency reads.

When it fails; figures for two returns 0.3..2 m apart, ratios 0.05..0.8, phasor noise 1 % that is
not known (with `crt` in brackets), 20,000 pixels of the fast form:

- Two frequencies over their whole joint ambiguity do not identify two returns: other returns,
  several wraps apart, explain them with a smaller total amplitude. At 40/70 MHz the median error
  is 15 cm (12), and 15 % (26 %) are more than 0.5 m off, when the first return lies within 4 m.
  With ``max_range_m = 4`` it is 0.5 cm (9.5), and 7.5 cm (23) at the 90th percentile. Three
  frequencies without a limit: 20/50/70 MHz 0.5 cm (10) and 4.6 cm (836); 80/16/120 MHz 0.2 cm
  (2.2) and 3.9 cm (13). Three that are badly spaced are no better than two: at 198/189/54 MHz
  the median is 2.5 cm (2.7), but 27 % (13 %) are more than 0.5 m off.
- What is left at the 90th percentile is weak or close second returns that `epsilon` swallows:
  ``epsilon = 0.02`` halves it, but must still cover the noise.
- The limit must hold: light from beyond it comes back as a wrong range, not as a missing one. And
  it helps only near one turn of the lower frequency: at 5 m the median is 1.9 cm, and 4 % are more
  than 0.5 m off.
- Noise makes small false returns, and the nearest wins. Of lone returns at an amplitude of 20
  sigma 11 % are more than 0.5 m off at 40/70 MHz if sigma is not known; if it is, 0.03 %.
- sigma is honest where the number of returns is right. It does not know of a second return that
  was swallowed: errors of the two returns above spread by 1.1 to 1.3 sigma between quartiles, and
  by several sigma in the tails.
- Amplitudes that do depend on frequency (unit phasors, uncalibrated contrast) break the model;
  what remains is a robust unwrapping.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toftools.correct import refuse_emitter_offset, warm_up
from toftools.correct._returns import sorted_returns
from toftools.correct._sra_fit import Bounds, fitted
from toftools.correct._sra_grid import (
    SIDES,
    TIE,
    check_parameters,
    group_returns,
    range_grid,
    usable_pixels,
)
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import phase_to_range, range_to_phase, wrap_phase


def sra_lp(
    sensor: Sensor,
    *,
    grid_m: float = 0.01,
    epsilon: float = 0.05,
    first_share: float = 0.05,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """First of the fewest returns that explain each pixel, by linear programming.

    Takes about 5 ms per pixel: `sra` is the fast form.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more.
    grid_m : float
        Range grid, m; a return between two cells comes back as their weighted mean.
    epsilon : float
        Residual allowed, as a share of the summed amplitudes, 0..1.
    first_share : float
        Returns weaker than this share of the strongest are ignored.
    max_range_m : float
        The grid spans [0, max_range_m]; 0 stands for the joint ambiguity, where it is cyclic and
        a return up to 5 cm below zero counts as one at zero.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `confidence` is the first return's share of the total
        amplitude. ``info["returns"]`` (H, W) is the number of returns that are strong enough,
        ``info["ranges_m"]`` and ``info["amplitudes"]`` (L, H, W) are all of them, nearest first.
        `sigma_m` is that of the fit: right where the number of returns is.

    Raises
    ------
    ValueError
        If there is one frequency only, a parameter is out of range, or the emitter is not at the
        camera.

    References
    ----------
    D. Freedman, Y. Smolin, E. Krupka, I. Leichter, M. Schmidt, "SRA: Fast Removal of General
    Multipath for ToF Sensors", ECCV 2014, arXiv 1403.5919; grid and epsilon: ``scripts/SRA.m`` in
    the release of S. Su et al., "Deep End-to-End Time-of-Flight Imaging", CVPR 2018.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> camera = sensor("deeptof:freqs=20e6+50e6+70e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.0j * turn)  # at 2 m and, weaker, at 3 m
    >>> depth = sra_lp(camera, epsilon=0.01)(Phasors(two[:, None, None]))
    >>> round(float(depth.range_m[0, 0]), 2), int(depth.info["returns"][0, 0])
    (2.0, 2)
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    if freqs.size < 2:
        msg = f"sra_lp needs at least two frequencies, got {freqs.size}; use 'single'"
        raise ValueError(msg)
    check_parameters(grid_m, epsilon, first_share)
    ranges_m, period_m = range_grid(freqs, grid_m, max_range_m)
    step_m = float(ranges_m[1] - ranges_m[0])
    atoms = np.exp(1j * range_to_phase(ranges_m, freqs[:, None]))  # (F, N)
    bounds = Bounds(epsilon, period_m, np.inf if period_m > 0 else max_range_m)

    def returns(z: NDArray[np.complex128], weights: F64) -> tuple[F64, F64]:
        moved_m = float(phase_to_range(wrap_phase(np.angle(z[0])), freqs[0]))
        use = slice(None)
        if period_m == 0:
            use = slice(*np.searchsorted(ranges_m, [-moved_m, max_range_m - moved_m + 1e-9]))
        turned = z * np.exp(-1j * range_to_phase(moved_m, freqs))
        amounts = smallest_sum(turned, weights, atoms[:, use], epsilon)
        if amounts is None:
            return np.full(1, np.nan), np.zeros(1)
        found_m, strengths = group_returns(amounts, step_m, cyclic=period_m > 0)
        found_m += ranges_m[use][0] + moved_m
        return sorted_returns(found_m, strengths, first_share=first_share, period_m=period_m)

    def run(phasors: Phasors) -> DepthMap:
        usable = usable_pixels(phasors, freqs.size)
        weights = noise_weights(phasors)
        shape = (2 * freqs.size, *usable.shape)
        found_m, found = np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32)
        for i, j in zip(*np.nonzero(usable), strict=True):
            z = phasors.values[:, i, j].astype(np.complex128)
            at, strengths = returns(z, weights[:, i, j])
            found_m[: at.size, i, j], found[: at.size, i, j] = at, strengths
        flat = found_m.reshape(shape[0], -1), found.reshape(shape[0], -1)
        return fitted(phasors, usable, freqs, bounds, *flat)

    warm_up(run, freqs.size)
    return run


def smallest_sum(
    z: NDArray[np.complex128], weights: F64, atoms: NDArray[np.complex128], epsilon: float
) -> F64 | None:
    """Amplitudes of smallest sum whose phasors stay within the residual bound.

    Parameters
    ----------
    z : ndarray, (F,)
        Measured phasors.
    weights : ndarray, (F,)
        Weight of each frequency in the residual bound.
    atoms : ndarray, (F, N)
        Phasors of a unit return in each grid cell.
    epsilon : float
        Bound of the weighted residual, relative to the weighted amplitudes.

    Returns
    -------
    ndarray, (N,), or None
        Non-negative amplitudes; None if none satisfy the bound.
    """
    from scipy.optimize import linprog

    n_freqs, n_atoms = atoms.shape
    # Turn every frequency until its measured phasor is real: the polygon has a corner there.
    columns = np.zeros((n_freqs, n_atoms + n_freqs * SIDES), dtype=np.complex128)
    columns[:, :n_atoms] = atoms * np.exp(-1j * np.angle(z))[:, None]
    gauge = np.zeros(columns.shape[1])
    for f in range(n_freqs):
        own = slice(n_atoms + f * SIDES, n_atoms + (f + 1) * SIDES)
        columns[f, own] = np.exp(2j * np.pi * np.arange(SIDES) / SIDES)
        gauge[own] = weights[f]
    unit = np.abs(z) / np.abs(z).max()  # the solver's tolerances are absolute
    agreement = unit @ columns[:, :n_atoms].real / unit.sum()
    cost = np.zeros(columns.shape[1])
    cost[:n_atoms] = 1 - TIE * agreement**2
    solution = linprog(
        cost,
        A_ub=gauge[None],
        b_ub=[epsilon * float(weights @ unit)],
        A_eq=np.concatenate([columns.real, columns.imag]),
        b_eq=np.concatenate([unit, np.zeros(n_freqs)]),
        method="highs",
    )
    if not solution.success:
        return None
    return np.asarray(solution.x[:n_atoms] * np.abs(z).max())


def noise_weights(phasors: Phasors) -> F64:
    """Weight of each frequency in the residual: 1 / sigma, or 1 where sigma is unknown.

    Parameters
    ----------
    phasors : Phasors
        Measurement.

    Returns
    -------
    ndarray, (F, H, W)
        Weights of mean 1.
    """
    weights = np.ones(phasors.values.shape)
    if phasors.sigma is None:
        return weights
    known = (np.isfinite(phasors.sigma) & (phasors.sigma > 0)).all(axis=0)
    weights[:, known] = 1 / phasors.sigma[:, known].astype(np.float64)
    return np.asarray(weights / weights.mean(axis=0))
