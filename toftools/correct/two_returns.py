"""Two returns per pixel by maximum likelihood, where one does not explain the phasors.

``z_f = a1 exp(j k_f d1) + a2 exp(j k_f d2)`` with positive amplitudes that do not depend on
frequency; the pair of least ``chi^2 = sum_f |z_f - model|^2 / sigma_f^2`` is found by trying all
pairs of a coarse grid over the whole range and taking Gauss-Newton steps from the best few. A
pixel keeps its one return (`crt`) unless the second lowers chi^2 by more than `significance`.
Reference: the model is that of Godbaz et al. (SPIE 8296, 2012) and others; the estimator,
exhaustive and efficient instead of closed form, is ours: the yardstick of the closed forms and the
second model of `auto`. Input: three or more frequencies (six real data for four unknowns), the
same contrast at all of them or the sensor's.

Fails where the returns are so close that one explains the data (then the mean phase is what is
left), where noise or more than two returns make another pair fit better, wraps apart, and where
amplitudes depend on frequency in a way that the sensor does not say.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._returns import answer, sorted_returns
from toftools.correct._sra_grid import usable_pixels
from toftools.correct._two_fit import fit_two
from toftools.correct._wraps import longest_m, plan, search
from toftools.types import F64, DepthMap, Phasors, Sensor
from toftools.units import ambiguity_m, range_to_phase

CELLS_PER_TURN = 10
"""Grid cells per turn of the highest frequency: the steps then start in the right valley."""
MAX_CELLS = 4096
WIDEST = 1e100


def two_returns(
    sensor: Sensor,
    *,
    max_range_m: float = 0.0,
    first_share: float = 0.05,
    significance: float = 14.0,
    model_share: float = 0.002,
) -> Callable[[Phasors], DepthMap]:
    """The nearer of the two most likely returns.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, three or more, and the contrast of each.
    max_range_m : float
        Both returns lie in [0, max_range_m]; 0 stands for the joint ambiguity.
    first_share : float
        A return weaker than this share of the stronger one is none.
    significance : float
        By how much chi^2 must fall for a second return; 14 is a chance of 0.1 % in pixels with one.
    model_share : float
        Error of the model itself (calibration) as a share of the amplitude, added to the noise;
        where the noise is unknown it is all there is.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``; `sigma_m` from the information matrix at the solution,
        ``info``: `status`, `returns`, `ranges_m`, `amplitudes`, `chi2` (H, W) of what was chosen.

    Raises
    ------
    ValueError
        If there are fewer than three frequencies, a parameter is out of range, or the emitter is
        not at the camera.

    References
    ----------
    J. P. Godbaz, M. J. Cree, A. A. Dorrington, "Closed-form inverses for the mixed pixel/multipath
    interference problem in AMCW lidar", Proc. SPIE 8296 (2012), for the model.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> camera = sensor("deeptof:freqs=20e6+50e6+70e6,width=1,height=1")
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.0j * turn)  # at 2 m and, weaker, at 3 m
    >>> depth = two_returns(camera)(Phasors(two[:, None, None]))
    >>> depth.info["ranges_m"][:, 0, 0].round(3).tolist()
    [2.0, 3.0]
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    if freqs.size < 3:
        msg = f"two_returns needs at least three frequencies, got {freqs.size}; use 'sra'"
        raise ValueError(msg)
    _check(first_share, significance, model_share)
    walk = plan(sensor, max_range_m, least_freqs=3, method="two_returns")
    span_m = longest_m(freqs, max_range_m)
    step_m = float(ambiguity_m(freqs.max())) / CELLS_PER_TURN
    n_cells = int(np.ceil(span_m / step_m)) + 1
    if n_cells > MAX_CELLS:
        msg = f"a range of {span_m:g} m makes {n_cells} cells, wanted {MAX_CELLS}; set max_range_m"
        raise ValueError(msg)
    k = range_to_phase(1.0, freqs)
    angle = k[:, None] * step_m * np.arange(n_cells)
    atoms = kernel_input(np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32))
    gain = 1 / np.broadcast_to(np.asarray(sensor.noise.contrast, dtype=np.float64), freqs.shape)
    period_m = span_m if max_range_m == 0 else 0.0

    def run(phasors: Phasors) -> DepthMap:
        usable = usable_pixels(phasors, freqs.size)
        alone = search(phasors, walk, top=1)
        z, sigma = _scaled(phasors, gain / gain.mean())
        one, one_cost = _one_return(z, sigma, alone.range_m[0].reshape(-1), k, model_share)
        two, two_cost = np.empty((5, z.shape[2])), np.empty(z.shape[2])
        wanted = usable.reshape(-1) & (one_cost > significance)
        fit_two(z, sigma, wanted, k, model_share, atoms, step_m, two, two_cost)
        both = wanted & (one_cost - two_cost > significance)
        ranges = np.where(both, two[:2], np.stack([alone.range_m[0].reshape(-1), np.nan * one]))
        amplitudes = np.where(both, two[2:4], np.stack([one, np.zeros_like(one)]))
        returns = sorted_returns(ranges, amplitudes, first_share=first_share, period_m=period_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            lone_m = 1 / np.sqrt(alone.information.reshape(-1))
            sigma_m = np.where(both, np.sqrt(two[4]), lone_m)
        depth = answer(
            returns[0].reshape(2, *usable.shape),
            returns[1].reshape(2, *usable.shape),
            usable,
            sigma_m=None if phasors.sigma is None else sigma_m.reshape(usable.shape),
        )
        chi2 = np.where(both, two_cost, one_cost).reshape(usable.shape)
        return DepthMap(
            depth.range_m, depth.sigma_m, depth.confidence, info={**depth.info, "chi2": chi2}
        )

    warm_up(run, freqs.size)
    return run


def _check(first_share: float, significance: float, model_share: float) -> None:
    if not (0 <= first_share <= 1 and 0 <= model_share <= 1):
        msg = f"first_share and model_share must lie in [0, 1], got {first_share}, {model_share}"
        raise ValueError(msg)
    if not significance >= 0:
        msg = f"significance must be 0 or more, got {significance}"
        raise ValueError(msg)


def _scaled(phasors: Phasors, gain: F64) -> tuple[F64, F64]:
    """Phasors as (2, F, P) and their sigma (F, P) at equal contrast; NaN set to zero."""
    usable = phasors.valid.reshape(-1)
    flat = np.where(usable, phasors.values.reshape(gain.size, -1), 0) * gain[:, None]
    z = np.stack([flat.real, flat.imag]).astype(np.float64)
    sigma = np.zeros(flat.shape)
    if phasors.sigma is not None:
        # Without NaN, and small enough to be squared: a weight of zero all the same.
        known = phasors.sigma.reshape(flat.shape).astype(np.float64) * gain[:, None]
        sigma = np.nan_to_num(known, posinf=WIDEST)
    return np.ascontiguousarray(z), np.ascontiguousarray(sigma)


def _one_return(z: F64, sigma: F64, range_m: F64, k: F64, share: float) -> tuple[F64, F64]:
    """Amplitude and chi^2 of one return at the given range, in every pixel."""
    power = z[0] ** 2 + z[1] ** 2
    noise = sigma**2 + share**2 * power
    floor = np.maximum(1e-10 * power.sum(axis=0), 1e-300)
    weight = 1 / np.maximum(noise, floor)
    angle = k[:, None] * range_m
    cos, sin = np.cos(angle), np.sin(angle)
    along, across = z[0] * cos + z[1] * sin, z[1] * cos - z[0] * sin
    amplitude = np.sum(weight * along, axis=0) / weight.sum(axis=0)
    return amplitude, np.sum(weight * ((along - amplitude) ** 2 + across**2), axis=0)
