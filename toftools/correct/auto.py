"""The cheapest model of the light that explains the phasors, pixel by pixel.

Models, cheapest first: one return; light that bounced between the surfaces in view; two returns;
a learned method, the package's own or one that is named. Every answer starts as one return,
unwrapped by `semi_global`, and a richer model must earn its place:

- *bounced light* (`fuchs2010`) when phasors freed from it agree across frequencies better than
  before. The share of the excess residual that it explains decides for the whole frame, since a
  frame has one light; windows that contradict stay with one return. With one frequency nothing can
  disagree, and the energy decides: albedos must be those of surfaces.
- *two returns* (`two_returns`) where much is left unexplained in the neighbourhood, they explain
  nearly all of it, the nearer one is no brighter than white, and its own uncertainty is smaller
  than what it changes.
- *learned* (`network`, if the package has one for these frequencies and the frame is no smaller
  than those it knows) where its own sigma is smaller than what it changes, or clearly than what has
  been decided till then can promise: light from out of view need not disagree with itself, so that
  the models above cannot see it in the phases, and what has learned how rooms go on can. To change
  the count of turns its sigma must be a tenth of the change: between two turns it hedges. (That the
  phases fit no worse there is no good test: it cost 30 %, since multipath bends them.) A learned
  method without a sigma is asked only where the frame still disagrees with itself, which takes
  several frequencies.

Where the evidence is weak the single return stays, and sigma grows by what the rejected model would
have changed; unexplained residuals widen it too. Reference: model selection by chi-squared and the
Cramer-Rao bound is textbook; order, tests and thresholds are ours, measured in docs/correction.
Input: any frequencies. Fails with its models: light from surfaces out of view stays in the answer.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from toftools.correct import INVALID, OK, refuse_emitter_offset, warm_up
from toftools.correct._choice import BOUNCED, LEARNED, MODELS, ONE, TWO, Choice, merged, spread_of
from toftools.correct._evidence import Explained, explained, explains_more, noise_of, pooled
from toftools.correct._net_file import LEAST_PIXELS, shipped
from toftools.correct._scene import optics
from toftools.registry import CORRECTIONS, find
from toftools.types import F32, F64, Bool, DepthMap, Phasors, Sensor
from toftools.units import TWO_PI, range_to_phase

UNEXPLAINED = 3.0
"""Mean residual per degree of freedom from which a neighbourhood needs a richer model."""
TWO_LEFT = 2.0
"""And the most that two returns may leave: they have to be the model, not merely a better one."""
TRANSPORT_ERROR = 0.3
"""Share of its correction that bounced light may be wrong by: surfaces out of view, normals."""
WHITE = 1.3
"""Largest albedo of a surface; above 1 for noise and slanted light."""
CLEARLY = 0.8
"""Sigma of a learned answer over that of the cheaper one, below which it is clearly smaller."""
SURE = 0.1
"""Sigma of a learned answer over its change, below which it may change the count of turns."""
LEAST_ALBEDO = 0.02
"""Median albedo below which amplitudes cannot be in the sensor's unit: the strength of bounced
light is then fitted to the agreement of the frequencies."""


@dataclass(frozen=True, eq=False)
class _Rivals:
    """The methods behind the models; None where the sensor does not suit one."""

    one: Callable[[Phasors], DepthMap]
    bounced: Callable[[Phasors], DepthMap]
    fitted: Callable[[Phasors], DepthMap] | None
    two: Callable[[Phasors], DepthMap] | None
    learned: Callable[[Phasors], DepthMap] | None
    least_pixels: int
    k: F64


def auto(
    sensor: Sensor, *, bounced: str = "", learned: str = "", max_range_m: float = 0.0
) -> Callable[[Phasors], DepthMap]:
    """Range by the cheapest model that explains the data.

    Parameters
    ----------
    sensor : Sensor
        Any; with one frequency only bounced light can be told, by its energy.
    bounced : str
        Correction for bounced light, as ``name[:key=val,...]`` or ``module:function``: one that
        gives ``info["indirect"]``; empty for `fuchs2010`.
    learned : str
        A learned correction, the same way; empty for the network of the package that suits the
        frequencies, if there is one and the frame is no smaller than those it was trained on;
        ``none`` for none.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. ``info``: `status`; `model` (H, W), index into `models`;
        `residual` (H, W), what the chosen model leaves per degree of freedom in the neighbourhood
        (1 is noise; of a learned answer, what the model before it leaves); `why`, one sentence per
        model that was tried; `shares`, pixels per model.

    Raises
    ------
    ValueError
        If a named method is unknown or a parameter wrong, a learned one without a sigma is named
        for one frequency, or the emitter is not at the camera.

    References
    ----------
    S. Fuchs, "Multipath interference compensation in time-of-flight camera images", ICPR 2010, and
    the references of `semi_global` and `two_returns`, for the models.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> camera = sensor("opt8241:width=4,height=3")
    >>> wall = np.exp(1j * range_to_phase(2.0, camera.modulation.freqs_hz))[:, None, None]
    >>> depth = auto(camera)(Phasors(np.broadcast_to(wall, (2, 3, 4))))
    >>> depth.info["models"][depth.info["model"][0, 0]], depth.range_m[0, 0].round(3)
    ('one return', np.float32(2.0))
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    name = "semi_global" if freqs.size > 1 else "crt"
    fuchs = CORRECTIONS["fuchs2010"]
    limit = {"max_range_m": max_range_m}
    fitted = freqs.size > 1 and not bounced
    rivals = _Rivals(
        CORRECTIONS[name].build(sensor, **limit),
        find(CORRECTIONS, bounced).build(sensor) if bounced else fuchs.build(sensor, **limit),
        fuchs.build(sensor, albedo_gain=0.0, **limit) if fitted else None,
        None if freqs.size < 3 else CORRECTIONS["two_returns"].build(sensor, **limit),
        _taught(sensor, learned, max_range_m),
        0 if learned else LEAST_PIXELS,
        range_to_phase(1.0, freqs),
    )
    flash = optics(sensor).flash.mean(axis=0)

    def run(phasors: Phasors) -> DepthMap:
        same = flash.shape == phasors.valid.shape
        lit = flash if same else optics(sensor, phasors.valid.shape).flash.mean(axis=0)
        return _decided(phasors, rivals, lit)

    warm_up(run, freqs.size)
    return run


def _decided(phasors: Phasors, rivals: _Rivals, flash: F32) -> DepthMap:
    """All models in turn."""
    start = rivals.one(phasors)
    usable = np.isfinite(start.range_m)
    values = np.where(usable, phasors.values, np.complex64(0))
    phasors = Phasors(values, phasors.sigma, phasors.valid & usable)
    noise = noise_of(phasors, start.range_m, rivals.k)
    plain = explained(phasors.values, noise, start.range_m, rivals.k, usable)
    nothing = np.zeros(usable.shape, np.float32)
    first = Choice(
        plain.range_m, plain.sigma_m, plain.chi2, np.full(usable.shape, ONE, np.uint8), nothing
    )
    why: dict[str, str] = {}
    choice, left = _bounced(phasors, rivals, noise, usable, first, flash, why)
    if rivals.k.size > 2:
        choice = _two(left, rivals, usable, choice, flash, why)
    dof = max(rivals.k.size - 1, 1)
    if rivals.learned is not None and usable.size >= rivals.least_pixels:
        choice = _learned(phasors, rivals, usable, choice, dof, why)
    return _answer(start, phasors, usable, choice, dof, why)


def _bounced(
    phasors: Phasors, rivals: _Rivals, noise: F32, usable: Bool, choice: Choice, flash: F32,
    why: dict[str, str],
) -> tuple[Choice, Phasors]:  # fmt: skip
    """Bounced light taken out where that explains more; and the phasors that remain."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        albedos = (np.abs(phasors.values).mean(axis=0) * choice.range_m**2 / flash)[usable]
    albedo = float(np.median(albedos)) if albedos.size else 0.0
    lit = LEAST_ALBEDO < albedo < WHITE
    method = rivals.bounced if lit or rivals.fitted is None else rivals.fitted
    tried = method(phasors)
    removed = np.asarray(tried.info["indirect"])
    direct = np.where(usable, phasors.values - removed, phasors.values)
    freed = explained(direct, noise, choice.range_m, rivals.k, usable)
    touched = usable & (removed != 0).any(axis=0)
    if rivals.k.size > 1:
        believed, reason = explains_more(choice.chi2, freed.chi2, usable, rivals.k.size - 1)
        why[MODELS[BOUNCED]] = reason + (", its strength fitted" if method is rivals.fitted else "")
    else:
        believed = np.full(usable.shape, lit)
        why[MODELS[BOUNCED]] = f"one frequency; the median albedo {albedo:.2f} is " + (
            "that of a surface" if lit else "not that of a surface, so amplitudes say nothing"
        )
    taken = touched & believed
    change = np.where(touched, np.abs(freed.range_m - choice.range_m), 0)
    doubt = np.where(taken, np.float32(TRANSPORT_ERROR), 1) * change
    answer = merged(choice, freed, taken, BOUNCED, doubt.astype(np.float32))
    left = np.where(taken, direct, phasors.values).astype(np.complex64)
    return answer, Phasors(left, phasors.sigma, usable)


def _two(
    left: Phasors, rivals: _Rivals, usable: Bool, choice: Choice, flash: F32, why: dict[str, str]
) -> Choice:
    """Two returns where the neighbourhood needs them and they explain it."""
    assert rivals.two is not None
    dof = rivals.k.size - 1
    need, _ = pooled(choice.chi2, usable, dof)
    asked = usable & (need > UNEXPLAINED)
    if not asked.any():
        why[MODELS[TWO]] = f"no neighbourhood leaves more than {UNEXPLAINED:g} times its noise"
        return choice
    tried = rivals.two(Phasors(left.values, left.sigma, asked))
    own_dof = 2 * rivals.k.size - 4
    misfit, _ = pooled(np.asarray(tried.info["chi2"]), asked, own_dof)
    two = asked & (np.asarray(tried.info["returns"]) > 1) & (misfit < TWO_LEFT)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        amplitude = np.asarray(tried.info["amplitudes"])[0]
        two &= amplitude * tried.range_m**2 / flash < WHITE
        change = np.abs(tried.range_m - choice.range_m)
        sigma_m = choice.sigma_m if tried.sigma_m is None else tried.sigma_m
        two &= sigma_m < change
    share = float(two.sum() / asked.sum())
    why[MODELS[TWO]] = f"taken in {share:.0%} of the pixels whose neighbourhood needs more"
    chi2 = np.asarray(tried.info["chi2"] * dof / own_dof, np.float32)
    other = Explained(tried.range_m, chi2, sigma_m)
    return merged(choice, other, two, TWO, np.where(two, 0, choice.doubt_m).astype(np.float32))


def _taught(
    sensor: Sensor, learned: str, max_range_m: float
) -> Callable[[Phasors], DepthMap] | None:
    """The learned method, whose answers beyond the limit are none; None where there is none."""
    if learned == "none" or (not learned and shipped(sensor.modulation.freqs_hz) is None):
        return None
    run = find(CORRECTIONS, learned or "network").build(sensor)
    n_freqs = sensor.modulation.n_freqs
    pixel = np.ones((n_freqs, 1, 1), np.complex64)
    if n_freqs == 1 and run(Phasors(pixel)).sigma_m is None:
        msg = (
            f"auto cannot tell where learned={learned!r} is needed, got one frequency and no sigma "
            "from it; use it alone"
        )
        raise ValueError(msg)

    def within(phasors: Phasors) -> DepthMap:
        depth: DepthMap = run(phasors)
        if not max_range_m:
            return depth
        return replace(depth, range_m=np.where(depth.range_m <= max_range_m, depth.range_m, np.nan))

    return within


def _learned(
    phasors: Phasors, rivals: _Rivals, usable: Bool, choice: Choice, dof: int, why: dict[str, str]
) -> Choice:
    """The learned answer where it is sure enough, or where the frame disagrees with itself."""
    assert rivals.learned is not None
    tried = rivals.learned(phasors)
    given = usable & np.isfinite(tried.range_m)
    spread, need = spread_of(choice, usable, dof)
    if tried.sigma_m is None:
        taken, sigma_m = given & (need > UNEXPLAINED) & (choice.model != TWO), spread
        said = "unexplained till then"
    else:
        sigma_m = tried.sigma_m
        change = np.abs(tried.range_m - choice.range_m)
        turned = change * rivals.k.max() > TWO_PI / 2  # by more than half of the shortest ambiguity
        taken = given & ((sigma_m < CLEARLY * spread) | (sigma_m < change))
        taken &= ~turned | (sigma_m < SURE * change)
        said = "where its sigma is below what it changes, or clearly the smallest"
    share = float(taken.sum() / max(int(usable.sum()), 1))
    why[MODELS[LEARNED]] = f"taken in {share:.0%} of the frame, {said}"
    other = Explained(tried.range_m, choice.chi2, sigma_m)
    return merged(choice, other, taken, LEARNED, np.where(taken, 0, choice.doubt_m))


def _answer(
    start: DepthMap, phasors: Phasors, usable: Bool, choice: Choice, dof: int,
    why: Mapping[str, str],
) -> DepthMap:  # fmt: skip
    """The choice as an answer; residuals and doubts widen sigma."""
    spread, left = spread_of(choice, usable, dof)
    counts = np.bincount(choice.model[usable].astype(np.int64), minlength=len(MODELS))
    return DepthMap(
        range_m=np.where(usable, choice.range_m, np.nan),
        sigma_m=None if phasors.sigma is None else np.where(usable, spread, np.nan),
        confidence=np.where(usable, 1 / np.maximum(left, 1e-3), 0),
        amplitude=start.amplitude,
        info={
            "status": np.where(usable, np.uint8(OK), np.uint8(INVALID)),
            "model": choice.model,
            "models": MODELS,
            "residual": left,
            "why": dict(why),
            "shares": {
                m: int(n) / max(int(usable.sum()), 1) for m, n in zip(MODELS, counts, strict=True)
            },
        },
    )
