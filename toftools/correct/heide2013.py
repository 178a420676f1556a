"""Transient imaging: a whole transient per pixel from a sweep of frequencies, and its first peak.

The phasors are samples of the transient's Fourier transform, ``z_f = sum_i x_i exp(j k_f d_i)``.
Ten to a hundred MHz leave it under-determined, so the paper minimises ``1/2 |C x - z|^2 +
lambda_t |grad_t x| + lambda_s |grad_xy x|`` (Huber norms, a primal-dual solver: the i-step), and
explains each peak by a Gaussian and an exponential decay (the u-step). Reference: Heide et al.,
SIGGRAPH 2013 (below; objective, solver and peaks as in the code released with it, read; the
alternation of both steps recalled). Input: eight or more frequencies, with or without sigma.

Built here: the i-step with ``x >= 0`` (ours) by ADMM, on phasors instead of raw correlations, then
one u-step, fitted to the phasors themselves: sharp returns at the peaks (the Gaussian, without
width), and an exponential behind the nearest one where chi-squared demands it (theirs: behind every
peak). Left out: the spatial term, since images of transients do not fit the memory; smoothing the
phasors beforehand (the filter `smooth`) stands in for it. `range_m` is the first sharp return: off
the grid, and not biased by the regularisation.

Memory: 0.5 kB per pixel for the answers, and 16 kB (192 cells, 221 frequencies) for each of the
1024 pixels at work. A frame of 160x120 with 221 frequencies takes 3 s (one return) to 4 s (two) of
one core, two thirds of it for the 60 iterations; the thesis of Marco reports 90 s for the paper.

When it fails; figures for the preset `heide2013` (10..120 MHz) unless others are given:

- Two returns must be two peaks of the transient: 0.85 m apart (amplitudes 1 and 0.5), 0.8 m with
  ``weight = 3e-4``, more with larger weights. Closer ones are one, 5 to 25 cm too far, and its
  decay is meaningless; sigma grows by the misfit, which is not enough.
- Diffuse light is no exponential. Corner of 90 degrees at 1 m, three bounces: median error 12 mm
  (mean phase of all frequencies: 47 mm). One bounce, 16 frequencies of 10..160 MHz: 15 of 30 mm.
  Both fit within the noise, so that sigma (0.7 mm) knows nothing of it.
- Light from beyond `max_range_m` has no place on the grid and becomes a false decay or return.
- Noise makes false returns: of lone ones at an amplitude of 5, 3.3 sigma per frequency, 0.4 and
  18 % have one nearer or farther than `first_share` ignores; with 16 frequencies none at 20, half
  of them at 10.
- Amplitudes that depend on frequency (contrast that falls with frequency, uncalibrated) look like
  a decay: calibrate first.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toftools.correct import _heide_fit as parametric
from toftools.correct import refuse_emitter_offset, warm_up
from toftools.correct._heide_peaks import MOST
from toftools.correct._heide_solver import Problem, problem, transients
from toftools.correct._returns import GUARD_M, answer, sorted_returns
from toftools.correct._wraps import longest_m
from toftools.types import F64, Bool, DepthMap, Phasors, Sensor
from toftools.units import ambiguity_m, joint_ambiguity_m

LEAST_FREQS = 8
BLOCK = 1024
"""Pixels at a time."""


def heide2013(
    sensor: Sensor,
    *,
    iterations: int = 60,
    weight: float = 0.001,
    first_share: float = 0.05,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """First return of a transient reconstructed from many frequencies.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, eight or more different ones.
    iterations : int
        Iterations of the reconstruction.
    weight : float
        Weight of the temporal differences, 1e-4..0.1, for phasors of unit strength.
    first_share : float
        Returns weaker than this share of the strongest are ignored, 0..1.
    max_range_m : float
        Length of the range grid, m; 0 stands for one turn of the lowest frequency.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the Cramer-Rao bound of the returns and the
        decay that were found, times ``sqrt(chi2 / d.o.f.)`` where chi-squared refuses them by five
        of its standard deviations. ``info``: as of all methods with several returns, and `chi2`
        (H, W), of ``2 F - 2 returns`` degrees of freedom, two less with a decay (mean squared
        residual where sigma is unknown, relative to the phasors); `decay_share` and `decay_m`
        (H, W), strength relative to the first return and length of the decay behind it, 0 if none.

    Raises
    ------
    ValueError
        If there are too few frequencies, a parameter is out of range, or the emitter is not at the
        camera.

    References
    ----------
    F. Heide, M. B. Hullin, J. Gregson, W. Heidrich, "Low-budget Transient Imaging using Photonic
    Mixer Devices", ACM Transactions on Graphics 32 (2013) 45.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("heide2013:width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.7 * np.exp(3.5j * turn)  # at 2 m and, weaker, at 3.5 m
    >>> depth = heide2013(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"][:2, 0, 0].round(3).tolist()
    [2.0, 3.5]
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    _check(freqs, iterations, weight, first_share)
    length_m = longest_m(freqs, max_range_m or float(ambiguity_m(freqs.min())))
    task = problem(freqs, length_m, weight, cyclic=_meets(freqs, length_m))

    def run(phasors: Phasors) -> DepthMap:
        if phasors.values.shape[0] != freqs.size:
            msg = f"phasors must have {freqs.size} frequencies, got {phasors.values.shape[0]}"
            raise ValueError(msg)
        shape = phasors.valid.shape
        usable = phasors.valid & (np.abs(phasors.values) > 0).any(axis=0)
        found = np.empty((usable.size, 3 * MOST + 3))
        for lo in range(0, usable.size, BLOCK):
            part = slice(lo, min(lo + BLOCK, usable.size))
            _block(phasors, part, usable, task, iterations, first_share, found[part])
        columns = found.T.reshape(-1, *shape)
        return _answer(columns, phasors, usable, task, length_m, first_share)

    warm_up(run, freqs.size)
    return run


def _check(freqs_hz: F64, iterations: int, weight: float, first_share: float) -> None:
    different = np.unique(freqs_hz).size
    if different < LEAST_FREQS:
        msg = (
            f"heide2013 needs {LEAST_FREQS} or more different frequencies, got {different}; use "
            "'crt', or a method of few frequencies"
        )
        raise ValueError(msg)
    if iterations < 1:
        msg = f"iterations must be 1 or more, got {iterations}"
        raise ValueError(msg)
    if not 1e-4 <= weight <= 0.1:
        msg = f"weight must lie in 1e-4..0.1, got {weight}"
        raise ValueError(msg)
    if not 0 < first_share < 1:
        msg = f"first_share must lie between 0 and 1, got {first_share}"
        raise ValueError(msg)


def _meets(freqs_hz: F64, length_m: float) -> bool:
    """Whether the grid ends where all phases repeat."""
    try:
        return bool(np.isclose(joint_ambiguity_m(freqs_hz), length_m, rtol=1e-9))
    except ValueError:  # they never repeat
        return False


def _block(
    phasors: Phasors,
    part: slice,
    usable: Bool,
    task: Problem,
    iterations: int,
    first_share: float,
    out: F64,
) -> None:
    """Fill ``out`` (P, 3 MOST + 3) for some pixels, as `_heide_fit.returns` says."""
    n_freqs = task.wavenumbers.size
    use = usable.reshape(-1)[part].copy()
    z = np.zeros((use.size, n_freqs), np.complex128)
    z[use] = phasors.values.reshape(n_freqs, -1)[:, part].T[use]
    scale = np.ones(use.size)
    scale[use] = np.sqrt((np.abs(z[use]) ** 2).mean(axis=1))
    z /= scale[:, None]
    weights = np.ones(z.shape)
    known = phasors.sigma is not None
    if phasors.sigma is not None:
        noise = phasors.sigma.reshape(n_freqs, -1)[:, part].T / scale[:, None]
        # A signal to noise ratio of 1e5 is as good as it gets; unknown noise is no information.
        noise = np.where(np.isnan(noise), np.inf, np.maximum(noise, 1e-5))
        weights = np.ascontiguousarray(1 / noise**2, np.float64)
    parts = (np.concatenate([z.real, z.imag], axis=1).T / np.sqrt(n_freqs)).astype(np.float32)
    cell_m = float(task.ranges_m[1])
    period_m = cell_m * task.ranges_m.size if task.cyclic else 0.0
    parametric.returns(
        transients(parts, task, iterations), z, weights, task.wavenumbers, use, known, cell_m,
        task.cyclic, period_m, GUARD_M, first_share, out,
    )  # fmt: skip
    out[:, MOST : 2 * MOST] *= scale[:, None]


def _misfit(found: F64, task: Problem) -> F64:
    """Factor of sigma where chi-squared says that the model does not hold, else 1."""
    returns = (found[MOST : 2 * MOST] != 0).sum(axis=0)
    freedom = np.maximum(2 * task.wavenumbers.size - 2 * returns - 2 * (found[-1] > 0), 1)
    ratio = np.nan_to_num(found[3 * MOST]) / freedom
    return np.where(ratio > 1 + 5 * np.sqrt(2 / freedom), np.sqrt(ratio), 1.0)


def _answer(
    found: F64,
    phasors: Phasors,
    usable: Bool,
    task: Problem,
    length_m: float,
    first_share: float,
) -> DepthMap:
    ranges_m, amplitudes, sigmas_m = (found[i * MOST : (i + 1) * MOST] for i in range(3))
    cell_m = float(task.ranges_m[1])
    # The fit is free to leave the grid; what lies outside is no return.
    with np.errstate(invalid="ignore"):
        inside = (ranges_m > -cell_m) & (ranges_m < length_m + cell_m)
    period_m = length_m if task.cyclic else 0.0
    placed_m, strengths = sorted_returns(
        np.minimum(ranges_m, length_m), np.where(inside, amplitudes, 0.0),
        first_share=first_share, period_m=period_m,
    )  # fmt: skip
    sigma_m = None
    if phasors.sigma is not None:
        away = np.where(inside, np.abs(ranges_m - placed_m[:1]), np.inf)
        first = np.argmin(np.where(np.isnan(away), np.inf, away), axis=0)
        sigma_m = np.take_along_axis(sigmas_m, first[None], axis=0)[0] * _misfit(found, task)
    depth = answer(placed_m, strengths, usable, sigma_m=sigma_m)
    cost, share, decay_m = (np.nan_to_num(found[3 * MOST + i]) for i in range(3))
    n_data = 1 if phasors.sigma is not None else 2 * task.wavenumbers.size
    more: dict[str, NDArray[np.float32]] = {
        "chi2": (cost / n_data).astype(np.float32),
        "decay_share": share.astype(np.float32),
        "decay_m": decay_m.astype(np.float32),
    }
    return DepthMap(
        range_m=depth.range_m,
        sigma_m=depth.sigma_m,
        confidence=depth.confidence,
        info={**depth.info, **more},
    )
