"""Single frames freed from diffuse interreflection: the loop that the methods of Fuchs share.

With diffuse surfaces the camera sees of every point the same radiosity as all other points do, so
the measured phasors m, which hold all bounces, are the emitters: ``m(u) = direct(u) + albedo(u)
E(u)``, E(u) the irradiance phasor from all v (one product, no recursion). The same albedo stands
in ``direct(u) = albedo(u) L(u)``, L the flash; so it cancels,

    direct = m / (1 + h),    h(u) = E(u) exp(-2j k range(u)) / |L(u)|    (E delayed to the camera),

and only geometry is iterated: range, normals, E, h, range. References: see `fuchs2010`. Inputs:
phasors in the unit of the sensor's electronics, since the flash must be known absolutely; a
`gain` stands for what is not known of it. Fails where light comes from surfaces out of view; a
pixel whose answer is not credible gets the plain one back (`FALLBACK`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from toftools.correct import INVALID, OK, kernel_input
from toftools.correct._albedo_gain import fitted_gain
from toftools.correct._bounced import bounced, ratio_of
from toftools.correct._evidence import explained
from toftools.correct._scene import Optics, Surface, lit, surface
from toftools.correct._wraps import Candidates, Plan, search
from toftools.types import C64, F32, Bool, DepthMap, Phasors

Irradiance = Callable[[Optics, Surface, C64], C64]
"""Phasors (F, H, W) to the irradiance phasors (F, H, W) on what every pixel sees."""

LEAST_SHARE, MOST_SHARE = 0.2, 2.0
"""Direct light below or above these shares of the measured amplitude is not credible: FALLBACK."""
MOST_ALBEDO = 1.5
"""Nor is a larger albedo; 0.5 above one for what the noise and the normals may do to it."""
SETTLED_M, SETTLED_SHARE = 0.02, 0.5
"""Nor is a range that the last iteration still moved by more: 2 cm and three standard deviations,
or half of all that was removed."""
NORMAL_NOISE = 0.01
"""Windows for planes grow until the noise turns normals by no more (rad, median)."""
NORMAL_SLOPE = 4.0
"""Relative change of what is removed per rad that a normal is off: light from walls comes in at
grazing angles, and the tangent of 76 degrees is 4."""
MOST_REACH_PX, FRAME_PER_REACH = 4, 20
"""But to no more than this, and this share of the frame: objects are small in small frames."""
LEAST_PREVIEW_PX = 100
"""Smaller frames have no pixels to spare."""


@dataclass(frozen=True, eq=False)
class Recipe:
    """What distinguishes the methods.

    Parameters
    ----------
    walk : Plan
        Of the search for the range.
    irradiance : callable
        The transport.
    iterations : int
        Times geometry is rebuilt.
    albedo_gain : float
        Factor of the radiometric albedo; 0 fits it.
    stride_px : int
        All iterations but the last see every so-many-th row and column; 1 sees all.
    start : callable or None
        Correction whose range starts the iteration and fixes the count of turns; None searches
        the most likely range at every step.
    bounces : int
        Bounces that are modelled; 0 for all. Needs a stride of 1.
    """

    walk: Plan
    irradiance: Irradiance
    iterations: int
    albedo_gain: float
    stride_px: int
    start: Callable[[Phasors], DepthMap] | None = None
    bounces: int = 0


@dataclass(frozen=True, eq=False)
class _State:
    """One iterate: range, ratio of indirect to direct light, gain."""

    found: Candidates
    ratio: C64
    flash: F32
    gain: float
    moved_m: F32


def freed(phasors: Phasors, view: Optics, recipe: Recipe) -> DepthMap:
    """Range without diffuse interreflection.

    Parameters
    ----------
    phasors : Phasors
        (F, H, W).
    view : Optics
        Of the camera, for frames of that shape.
    recipe : Recipe
        The method.

    Returns
    -------
    DepthMap
        See `toftools.correct.fuchs2010`.
    """
    plain = search(phasors, recipe.walk, top=1)
    if recipe.start is not None:
        plain = replace(plain, range_m=recipe.start(phasors).range_m[None])
    valid = phasors.valid & (plain.information > 0) & np.isfinite(plain.range_m[0])
    values = np.ascontiguousarray(np.where(valid, phasors.values, np.complex64(0)))
    known = Phasors(values, phasors.sigma, valid)
    state = _start(plain, values, recipe)
    reach = reach_px(view, plain, valid, known=phasors.sigma is not None)
    before = recipe.iterations - 1
    if before and recipe.stride_px > 1 and min(valid.shape) >= LEAST_PREVIEW_PX:
        state = _previewed(state, known, view, recipe, reach)
        before = 0
    for _ in range(before + 1):
        state = _iterate(state, known, view, recipe, reach)
    with np.errstate(divide="ignore", invalid="ignore"):
        tilt_rad = _tilt_rad(view, state.found, reach)
    return _answer(phasors, valid, plain, state, recipe, tilt_rad)


def _start(plain: Candidates, values: C64, recipe: Recipe) -> _State:
    none = np.zeros_like(values)
    return _State(plain, none, none.real, recipe.albedo_gain, plain.range_m[0])


def _previewed(state: _State, phasors: Phasors, view: Optics, recipe: Recipe, reach: int) -> _State:
    """All iterations but the last on fewer pixels: what they move is smooth over surfaces."""
    step = recipe.stride_px
    sparse = (slice(None), slice(None, None, step), slice(None, None, step))
    sigma = None if phasors.sigma is None else phasors.sigma[sparse]
    few = Phasors(phasors.values[sparse], sigma, phasors.valid[sparse[1:]])
    far_view = Optics(
        kernel_input(view.rays[sparse]),
        kernel_input(view.steps[sparse] / np.float32(step)),
        kernel_input(view.solid_angle_sr[sparse[1:]] * np.float32(step**2)),
        kernel_input(view.flash[sparse]),
        view.freqs_hz,
    )
    plain = replace(
        state.found,
        range_m=state.found.range_m[sparse],
        information=state.found.information[sparse[1:]],
    )
    far = _start(plain, few.values, recipe)
    for _ in range(recipe.iterations - 1):
        far = _iterate(far, few, far_view, recipe, reach)
    shift_m = far.found.range_m[0] - plain.range_m[0]
    # What changed its count of turns may not do so for its neighbours.
    shift_m = np.where(np.abs(shift_m) < recipe.walk.ambiguity_m.min() / 2, shift_m, 0)
    height, width = phasors.valid.shape
    moved_m = np.repeat(np.repeat(shift_m, step, axis=0), step, axis=1)[:height, :width]
    range_m = np.maximum(state.found.range_m + moved_m.astype(np.float32), np.float32(1e-3))
    return replace(state, found=replace(state.found, range_m=range_m))


def reach_px(view: Optics, plain: Candidates, valid: Bool, *, known: bool) -> int:
    """Windows that average enough."""
    if not (known and valid.any()):
        return 1
    most = int(max(1, min(MOST_REACH_PX, min(valid.shape) // FRAME_PER_REACH)))
    for reach in range(1, most):
        with np.errstate(divide="ignore", invalid="ignore"):
            tilt_rad = _tilt_rad(view, plain, reach)
        if np.median(tilt_rad[valid]) <= NORMAL_NOISE:
            return reach
    return most


def _tilt_rad(view: Optics, found: Candidates, reach: int) -> F32:
    """Noise of normals: that of range over the distance between pixels and sqrt S."""
    spread = (2 * reach + 1) ** 2 * reach * (reach + 1) / 3
    apart_m = found.range_m[0] * np.sqrt(view.solid_angle_sr)
    return np.asarray(1 / (np.sqrt(found.information * np.float32(spread)) * apart_m))


def _iterate(state: _State, phasors: Phasors, view: Optics, recipe: Recipe, reach: int) -> _State:
    values, before = phasors.values, state.found.range_m[0]
    noise_m: F32 | float = 0.0
    if phasors.sigma is not None:
        with np.errstate(divide="ignore"):
            noise_m = np.where(phasors.valid, 1 / np.sqrt(state.found.information), 0)
    range_m = np.where(phasors.valid, before, np.float32(np.nan))
    seen = surface(view, range_m, noise_m=noise_m, reach_px=reach)
    flash = lit(view, seen)

    def transport(light: C64) -> C64:
        return ratio_of(recipe.irradiance(view, seen, light), view, seen, flash)

    ratio = bounced(transport, values, state.ratio, state.gain, recipe.bounces)
    gain = recipe.albedo_gain or fitted_gain(values, ratio, flash, range_m, view.freqs_hz)
    direct, sigma = _direct(values, phasors.sigma, ratio, gain)
    freed_phasors = Phasors(direct, sigma, phasors.valid)
    found = (
        search(freed_phasors, recipe.walk, top=1)
        if recipe.start is None
        else _near(freed_phasors, before, recipe.walk)
    )
    return _State(found, ratio, flash, gain, np.abs(found.range_m[0] - before))


def _near(phasors: Phasors, range_m: F32, walk: Plan) -> Candidates:
    """The range next to a given one, as `search` would give it."""
    sigma = phasors.sigma
    if sigma is None:  # as in `search`: the mean power stands in
        power = np.mean(np.abs(phasors.values) ** 2, axis=0)
        sigma = np.broadcast_to(np.sqrt(power), phasors.values.shape)
    found = explained(phasors.values, sigma, range_m, np.sqrt(walk.information), phasors.valid)
    with np.errstate(divide="ignore"):
        information = np.asarray(1 / found.sigma_m**2, np.float32)
    return Candidates(found.range_m[None], found.chi2[None], information, walk.ambiguity_m.size)


def _direct(values: C64, sigma: F32 | None, ratio: C64, gain: float) -> tuple[C64, F32 | None]:
    """Direct light and its noise: both shrink alike."""
    divisor = 1 + np.float32(gain) * ratio
    with np.errstate(divide="ignore", invalid="ignore"):
        direct = values / divisor
    return direct, None if sigma is None else sigma / np.abs(divisor)


def _doubtful(
    phasors: Phasors, plain: Candidates, last: _State, recipe: Recipe, sigma_m: F32
) -> tuple[Bool, F32, F32]:
    """Where the corrected range is not credible; share of direct light; albedo."""
    size = np.abs(1 + np.float32(last.gain) * last.ratio)
    least, most = 1 / size.max(axis=0), 1 / size.min(axis=0)
    albedo = last.gain * (np.abs(phasors.values) / (size * last.flash)).max(axis=0)
    shift_m = last.found.range_m[0] - plain.range_m[0]
    limit_m = SETTLED_M + (3 * sigma_m if phasors.sigma is not None else 0)
    # A count of turns that the last iteration changed has not settled.
    turn_m = recipe.walk.ambiguity_m.min()
    limit_m = np.maximum(limit_m, np.minimum(SETTLED_SHARE * np.abs(shift_m), turn_m / 4))
    doubtful = (least < LEAST_SHARE) | (most > MOST_SHARE) | ~(albedo < MOST_ALBEDO)
    doubtful |= ~np.isfinite(shift_m)
    if recipe.iterations > 1:
        doubtful |= ~(last.moved_m < limit_m)
    touched = (np.abs(last.ratio) > 0).any(axis=0)
    return doubtful & touched, least, albedo


@np.errstate(all="ignore")  # pixels without an answer hold anything
def _answer(
    phasors: Phasors, valid: Bool, plain: Candidates, last: _State, recipe: Recipe, tilt_rad: F32
) -> DepthMap:
    """Corrected where that is credible, plain with a larger sigma elsewhere."""
    sigma_m = np.asarray(1 / np.sqrt(last.found.information), np.float32)
    plain_sigma_m = 1 / np.sqrt(plain.information)
    doubtful, share, albedo = _doubtful(phasors, plain, last, recipe, sigma_m)
    fallback = valid & doubtful
    nothing = np.float32(np.nan)
    spread = None
    if phasors.sigma is not None:
        shift_m = np.nan_to_num(last.found.range_m[0] - plain.range_m[0])
        own = np.hypot(sigma_m, NORMAL_SLOPE * shift_m * tilt_rad)
        spread = np.where(valid, np.where(fallback, np.hypot(plain_sigma_m, shift_m), own), nothing)
    range_m = np.where(fallback, plain.range_m[0], last.found.range_m[0])
    removed = phasors.values * (1 - 1 / (1 + np.float32(last.gain) * last.ratio))
    return DepthMap(
        range_m=np.where(valid, range_m, nothing),
        sigma_m=spread,
        confidence=np.where(valid, np.where(fallback, share * LEAST_SHARE, share), 0),
        amplitude=np.where(valid, np.abs(phasors.values).max(axis=0), 0),
        info={
            "status": np.where(valid, np.uint8(OK), np.uint8(INVALID)),
            "fallback": fallback,
            "indirect": np.where(valid & ~fallback, removed, 0).astype(np.complex64),
            "albedo": np.where(valid, albedo, nothing).astype(np.float32),
            "albedo_gain": last.gain,
            "iterations": recipe.iterations,
        },
    )
