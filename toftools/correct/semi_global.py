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

from toftools._turns import FAST, turns
from toftools.correct import INVALID, OK, kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._scene import optics
from toftools.correct._wraps import Candidates, plan, search
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
DEAREST = np.float32(20.0)
"""No hypothesis costs more: a whole neighbourhood can overrule any pixel."""
FAR_M = np.float32(1e6)
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
        order = np.sort(total, axis=0)
        best = total.argmin(axis=0)[None]
        chosen, residual = (
            np.take_along_axis(a, best, axis=0)[0] for a in (found.range_m, found.cost)
        )
        sigma_m = None
        if known:
            with np.errstate(divide="ignore"):
                sigma_m = np.where(valid, 1 / np.sqrt(found.information), np.float32(np.nan))
        return DepthMap(
            range_m=np.where(valid, chosen, np.float32(np.nan)),
            sigma_m=sigma_m,
            confidence=np.where(valid, order[1] - order[0], np.float32(0)),
            info={
                "status": np.where(valid, np.uint8(OK), np.uint8(INVALID)),
                "changed": valid & (best[0] > 0),
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
    phase = np.angle(values[:, pixels]) - k[:, None] * found.range_m[0].reshape(-1)[pixels]
    off = phase - TWO_PI * np.rint(phase / TWO_PI)
    against = (off / k[:, None] * (k - k.mean())[:, None]).sum(axis=0) > 0
    error = LEAST_ERROR_RAD
    if against.any():
        error = max(error, np.float32(np.sqrt(np.percentile(off[:, against] ** 2, 80))))
    wide = widest if pixels.size and against.mean() < MOST_AGAINST else 0.0
    return np.array([error, max(wide, error)], np.float32)


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _price(
    values: C64, range_m: F32, chi2: F32, snr2: F32, white: F32, k: F32, error: F32,
    known: bool, cost: F32,
) -> None:  # fmt: skip
    """Cost of every hypothesis above that of the pixel's best."""
    mean = k.mean()
    for p in prange(values.shape[1]):
        least = np.float32(np.inf)
        cycles = np.empty(k.size, np.float32)
        for f in range(k.size):
            cycles[f] = turns(values[f, p].real, values[f, p].imag)
        for t in range(range_m.shape[0]):
            if not chi2[t, p] < np.inf:
                cost[t, p] = np.inf
                continue
            lean = np.float32(0.0)  # negative: the lower the frequency, the longer its range
            for f in range(k.size):
                off = cycles[f] - k[f] / TWO_PI * range_m[t, p]
                lean += (off - np.rint(off)) / k[f] * (k[f] - mean)
            noise = np.float32(1.0) if known else np.float32(0.0)
            misfit = chi2[t, p] / max(noise + error[0] ** 2 * snr2[p], np.float32(1e-30))
            if lean < 0:
                misfit = chi2[t, p] / max(noise + error[1] ** 2 * snr2[p], np.float32(1e-30))
            bright = max(white[p] * range_m[t, p] ** 2 - WHITE, np.float32(0.0)) / WHITE_SPREAD
            cost[t, p] = np.float32(0.5) * (misfit + bright * bright)
            least = min(least, cost[t, p])
        for t in range(range_m.shape[0]):
            cost[t, p] = min(cost[t, p] - least, DEAREST)


def aggregate(range_m: F32, cost: F32, valid: Bool, jump: float) -> F32:
    """Costs summed over straight paths through the image.

    Parameters
    ----------
    range_m, cost : ndarray, (T, H, W)
        Hypotheses, m, and their own costs.
    valid : ndarray, (H, W), bool
        Other pixels take no part.
    jump : float
        Cost of a step of 1 m or more.

    Returns
    -------
    ndarray, (T, H, W)
        ``sum_r L_r``, L_r the least cost of a path that comes along r and ends in the hypothesis.
    """
    with np.errstate(invalid="ignore"):
        ranges = np.where(np.isfinite(range_m), range_m, FAR_M).astype(np.float32)
    own = np.where(valid, cost, np.float32(0))
    total = np.zeros_like(own)
    # Rows first, and pixels of a row together: columns are the rows of the transposed image.
    for axes, ways in (((1, 0, 2), ((1, 0), (1, 1), (1, -1))), ((2, 0, 1), ((1, 0),))):
        # Copies, always: a read-only view of one pixel would be another flavour to the compiler.
        rows, costs = (a.transpose(axes).copy(order="C") for a in (ranges, own))
        mask = (valid if axes[0] == 1 else valid.T).copy(order="C")
        summed = np.zeros_like(costs)
        for dy, dx in ways:
            for sign in (dy, -dy):
                _sweep(rows, costs, mask, summed, sign, dx, np.float32(jump))
        total += summed.transpose(np.argsort(axes))
    return total


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _extend(
    here: F32, own: F32, there: F32, before: F32, jump: np.float32, best: F32, out: F32
) -> None:
    """Equation 13 for a row: own costs plus the cheapest way from the row before."""
    n = own.shape[0]
    base = before[0].copy()
    for s in range(1, n):
        for x in range(base.size):
            base[x] = min(base[x], before[s, x])
    for t in range(n):
        best[:] = DEAREST * jump
        for s in range(n):
            for x in range(base.size):
                step = min(abs(here[t, x] - there[s, x]), np.float32(1.0))
                best[x] = min(best[x], before[s, x] - base[x] + jump * step)
        for x in range(base.size):
            out[t, x] = own[t, x] + best[x]


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _sweep(
    range_m: F32, own: F32, valid: Bool, total: F32, dy: int, dx: int, jump: np.float32
) -> None:
    """Add the costs along one direction, row by row; invalid pixels are stepped over."""
    height, n, width = own.shape
    # What the paths bring into a row: hypotheses and costs of the last valid pixel of each.
    there, before = np.zeros((n, width), np.float32), np.zeros((n, width), np.float32)
    began = np.zeros(width, np.bool_)
    out, best = np.empty((n, width), np.float32), np.empty(width, np.float32)
    for row in range(height):
        y = row if dy > 0 else height - 1 - row
        _extend(range_m[y], own[y], there, before, jump, best, out)
        for x in range(width):
            if valid[y, x]:
                for t in range(n):
                    before[t, x] = out[t, x] if began[x] else own[y, t, x]
                    there[t, x] = range_m[y, t, x]
                    total[y, t, x] += before[t, x]
                began[x] = True
        if dx != 0:
            _shift(there, before, began, dx)


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _shift(there: F32, before: F32, began: Bool, dx: int) -> None:
    """Move the paths sideways; new ones enter at the border."""
    width = began.size
    for i in range(width):
        x = width - 1 - i if dx > 0 else i
        inside = 0 <= x - dx < width
        began[x] = began[x - dx] if inside else False
        for t in range(there.shape[0]):
            there[t, x] = there[t, x - dx] if inside else np.float32(0)
            before[t, x] = before[t, x - dx] if inside else np.float32(0)
