"""Unwrapping by smoothness along paths through the image, with what multipath does to wraps.

Per pixel the most likely wrap hypotheses (`_wraps`) compete. Each costs half of

    chi^2 / (1 + m^2 snr^2) + (max(albedo - 1.1, 0) / 0.15)^2

and neighbours of different range cost ``jump min(|d - d'| / 1 m, 1)``; the hypothesis of least cost
summed over eight straight paths is the answer (dynamic programming along each path). Two facts
about indirect light enter. It makes lower frequencies read longer than higher ones, so the model
error m is 1 rad for hypotheses whose residuals lean that way and 0.15 rad for the others (more
where the frame's calibration is worse than that): plain unwrapping instead prefers whatever
residual is smallest, and jumps by metres in dark corners. And no surface is brighter than white:
the albedo that a hypothesis needs, ``|z| range^2 / flash``, rules out those too far away.

Reference: the summation over paths is H. Hirschmüller, "Stereo processing by semi-global matching
and mutual information", IEEE TPAMI 30 (2008) 328-341, equation 13; hypotheses, costs and the
one-sided model error are ours. Input: two or more frequencies; amplitudes in the unit of the
sensor's radiometry (`Noise.signal_e`, contrast) or much weaker, which leaves the albedo out, as
does a frame whose clear pixels are brighter than white. Fails where a region borders no surface of
the same range (then chi^2 alone decides), and on bright mirrors and retroreflectors.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from toftools._turns import turns
from toftools.correct import INVALID, OK, kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._paths import DEAREST, aggregate
from toftools.correct._scene import optics
from toftools.correct._wraps import BLOCK, Candidates, plan, search
from toftools.types import C64, F32, Bool, DepthMap, Phasors, Sensor
from toftools.units import TWO_PI, range_to_phase

HYPOTHESES = 5
WHITE, WHITE_SPREAD = np.float32(1.1), np.float32(0.15)
"""Albedo from which a hypothesis becomes dearer, and by how much more it costs half a chi^2."""
LONE_CHI2, LONE_RAD2 = (6.0, 30.0), (4e-4, 1e-2)
"""A range is undisputed if its residual is below the first figure and the next one's above the
second: chi^2, or rad^2 where the noise is unknown."""
LEAST_ERROR_RAD = np.float32(0.15)
"""Model error where the residuals are not those of multipath: calibration, mixed pixels."""
MOST_SAMPLES = 4096
"""Pixels for a statistic of the frame."""
MOST_AGAINST = 0.65
"""Share of pixels that may lean against multipath; noise alone makes it one half."""


def semi_global(
    sensor: Sensor,
    *,
    jump: float = 16.0,
    multipath_rad: float = 1.0,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """Range whose wraps are smooth over the image and plausible as light.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more, and the radiometry.
    jump : float
        Cost of a step of 1 m or more between neighbours; 0 leaves every pixel to itself.
    multipath_rad : float
        Phase error that multipath may cause, rad.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the Cramer-Rao bound, right where the wraps are;
        `confidence` the cost between the winner and the runner-up; ``info``: `status`, `changed`
        (H, W), True where it is not the least residual that won, and `residual` (H, W) as in `crt`.

    Raises
    ------
    ValueError
        If there is one frequency only, a parameter is negative, or the emitter is not at the
        camera.

    References
    ----------
    H. Hirschmüller, "Stereo processing by semi-global matching and mutual information", IEEE TPAMI
    30 (2008) 328-341.
    """
    refuse_emitter_offset(sensor)
    if not (jump >= 0 and multipath_rad >= 0):
        msg = f"jump and multipath_rad must be 0 or more, got {jump} and {multipath_rad}"
        raise ValueError(msg)
    walk = plan(sensor, max_range_m, least_freqs=2, method="semi_global")
    k = range_to_phase(1.0, sensor.modulation.freqs_hz).astype(np.float32)
    view = optics(sensor)

    def run(phasors: Phasors) -> DepthMap:
        found = search(phasors, walk, top=HYPOTHESES)
        valid = phasors.valid & (found.information > 0)
        known = phasors.sigma is not None
        snr2 = found.information * np.float32(1 / walk.information.sum())
        cost = np.empty_like(found.cost)
        values = kernel_input(phasors.values).reshape(k.size, -1)
        flat = found.range_m.reshape(HYPOTHESES, -1), found.cost.reshape(HYPOTHESES, -1)
        same = view.flash.shape[1:] == valid.shape
        flash = view.flash if same else optics(sensor, valid.shape).flash
        white = _whiteness(phasors, flash.mean(axis=0), found, valid)
        _price(
            values, *flat, kernel_input(snr2).reshape(-1), kernel_input(white).reshape(-1), k,
            _model_errors(values, found, valid, k, multipath_rad), known,
            cost.reshape(HYPOTHESES, -1),
        )  # fmt: skip
        total = aggregate(found.range_m, cost, kernel_input(valid), jump)
        best = np.empty(valid.size, np.uint8)
        picked = np.empty((3, valid.size), np.float32)
        _take(total.reshape(HYPOTHESES, -1), *flat, best, *picked)
        chosen, residual, margin = picked.reshape(3, *valid.shape)
        sigma_m = None
        if known:
            with np.errstate(divide="ignore"):
                sigma_m = np.where(valid, 1 / np.sqrt(found.information), np.float32(np.nan))
        return DepthMap(
            range_m=np.where(valid, chosen, np.float32(np.nan)),
            sigma_m=sigma_m,
            confidence=np.where(valid, margin, np.float32(0)),
            info={
                "status": np.where(valid, np.uint8(OK), np.uint8(INVALID)),
                "changed": valid & (best.reshape(valid.shape) > 0),
                "residual": residual,
            },
        )

    warm_up(run, k.size)
    return run


def _whiteness(phasors: Phasors, flash: F32, found: Candidates, valid: Bool) -> F32:
    """Albedo of every pixel divided by its squared range; 0 if the radiometry cannot be right.

    It cannot if most pixels are brighter than white at the nearest of their hypotheses, or most of
    those with an undisputed range at that range.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        white = np.abs(phasors.values).mean(axis=0) / np.maximum(flash, np.float32(1e-30))
        white = np.where(valid, white, np.float32(0))
        clean, disputed = LONE_CHI2 if phasors.sigma is not None else LONE_RAD2
        lone = valid & (found.cost[0] < clean) & (found.cost[1] > disputed)
        nearest = np.fmin.reduce(found.range_m, axis=0)
        for pixels, range_m in ((valid, nearest), (lone, found.range_m[0])):
            albedo = (white * range_m**2)[pixels]
            if albedo.size and not np.median(albedo) <= WHITE:
                return np.zeros_like(white)
    return white


def _model_errors(values: C64, found: Candidates, valid: Bool, k: F32, widest: float) -> F32:
    """Phase errors (2,) to expect, rad: of calibration, and of multipath.

    Residuals that lean as multipath never does are calibration errors (or wrong turns, the fewer
    part): where they are larger than `LEAST_ERROR_RAD`, so is the error to expect. Where most of a
    frame leans that way, its calibration hides what multipath does, and both errors are one.
    """
    some = valid.reshape(-1) & np.isfinite(found.range_m[0]).reshape(-1)
    pixels = np.flatnonzero(some)[:: max(int(some.sum()) // MOST_SAMPLES, 1)]
    off = _residuals(values, found.range_m[0].reshape(-1), pixels, k / np.float32(TWO_PI))
    against = ((k - k.mean()) / k) @ off > 0
    error = LEAST_ERROR_RAD
    if against.any():
        typical = TWO_PI * np.percentile(np.abs(off[:, against]), 80)
        error = max(error, np.float32(typical))
    wide = widest if pixels.size and against.mean() < MOST_AGAINST else 0.0
    return np.array([error, max(wide, error)], np.float32)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _residuals(values: C64, range_m: F32, pixels: NDArray[np.int64], per_m: F32) -> F32:
    """Phases less those of the ranges, (F, pixels), turns."""
    off = np.empty((per_m.size, pixels.size), np.float32)
    for f in range(per_m.size):
        for i in range(pixels.size):
            z = values[f, pixels[i]]
            away = turns(z.real, z.imag) - per_m[f] * range_m[pixels[i]]
            off[f, i] = away - np.rint(away)
    return off


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _take(
    total: F32, range_m: F32, cost: F32, best: NDArray[np.uint8], chosen: F32, residual: F32,
    margin: F32,
) -> None:  # fmt: skip
    """The cheapest hypothesis of every pixel, and how much dearer the next one is."""
    for p in prange(best.size):
        first, least, second = 0, total[0, p], np.float32(np.inf)
        for t in range(1, total.shape[0]):
            if total[t, p] < least:
                first, least, second = t, total[t, p], least
            elif total[t, p] < second:
                second = total[t, p]
        best[p], chosen[p], residual[p] = first, range_m[first, p], cost[first, p]
        margin[p] = second - least


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _price(
    values: C64, range_m: F32, chi2: F32, snr2: F32, white: F32, k: F32, error: F32,
    known: bool, cost: F32,
) -> None:  # fmt: skip
    """Cost of every hypothesis above that of the pixel's best."""
    noise = np.float32(1.0) if known else np.float32(0.0)
    # Turns per metre, and the weight of a residual in turns for how residuals lean.
    per_m = k / np.float32(TWO_PI)
    lever = (k - k.mean()) / k
    for block in prange((values.shape[1] + BLOCK - 1) // BLOCK):
        cycles = np.empty(k.size, np.float32)
        for p in range(block * BLOCK, min((block + 1) * BLOCK, values.shape[1])):
            least = np.float32(np.inf)
            for f in range(k.size):
                cycles[f] = turns(values[f, p].real, values[f, p].imag)
            for t in range(range_m.shape[0]):
                if not chi2[t, p] < np.inf:
                    cost[t, p] = np.inf
                    continue
                lean = np.float32(0.0)  # negative: the lower the frequency, the longer its range
                for f in range(k.size):
                    off = cycles[f] - per_m[f] * range_m[t, p]
                    lean += (off - np.rint(off)) * lever[f]
                wide = error[1] if lean < 0 else error[0]
                misfit = chi2[t, p] / max(noise + wide * wide * snr2[p], np.float32(1e-30))
                bright = white[p] * range_m[t, p] * range_m[t, p] - WHITE
                bright = max(bright, np.float32(0.0)) / WHITE_SPREAD
                cost[t, p] = np.float32(0.5) * (misfit + bright * bright)
                least = min(least, cost[t, p])
            for t in range(range_m.shape[0]):
                cost[t, p] = min(cost[t, p] - least, DEAREST)
