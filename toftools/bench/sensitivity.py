"""Local sensitivity: how much an answer changes per unit by which its input is perturbed.

A method that was run on a capture is run three times more, on phasors ``z`` of frequency ``f``
and noise ``s`` (`Phasors.sigma`) that are perturbed in a known way; d is its answer before, d'
after, r the true range (where nobody knows it, d), J half of the shortest ambiguity range, and a
pixel counts if it has both answers. A pixel *jumps* if it is off by more than J: a wrong turn, no
slope, and one such would hide thousands of others in a mean.

noise
    ``z + s (n1 + j n2)``, n1 and n2 normal. `noise` is the median of ``|d' - d| / bound`` over
    0.6745, the median of a normal error of one, over pixels that do not jump: 1 passes noise on as
    an efficient estimator of a lone return does, more amplifies it, less smoothes. The bound is
    `crlb_multi_range_m` of z and s. The median, since a ratio to millimetres has no largest value:
    a few pixels in doubt would make any mean. `jumps` is the share with ``|d' - d| > J``.
scale
    ``z exp(+j 4 pi f p r / c)``, p = 1 %: all light of a pixel comes from 1 % of its range
    farther. `scale` is the mean of ``|d' - d - p r| / (p r)`` over pixels that do not jump: 0
    follows faithfully, 1 stays where it was.
shift
    every pixel one column to the right, the first column invalid. `shift_m` is the mean of
    ``|d'(u + 1) - d(u)|`` over pixels that do not jump, m: 0 for methods that look at single
    pixels, more where the answer depends on how pixels fall on blocks, borders or the lens.

The draws are the same in every run. Needs phasors with sigma for the first.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from toftools.bench.bound import bound_of
from toftools.bench.measure import plain_answer, sentence
from toftools.bench.perturb import DEEPER, aside, deeper, noisier
from toftools.correct._transport_radius import spectral_radius
from toftools.phasor import phasors_of
from toftools.types import F64, Bool, Capture, DepthMap, Phasors
from toftools.units import ambiguity_m

NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a normal error of one."""
CALLS = 3
"""Runs that all this takes."""


def local_measures(
    run: Callable[[Phasors], object],
    capture: Capture,
    depth: DepthMap,
    *,
    call_s: float = 0.0,
    left_s: float = float("inf"),
) -> dict[str, Any]:
    """Sensitivities of a method at one capture, and the spectral radius of its transport.

    Parameters
    ----------
    run : callable
        The method as it was built and run.
    capture : Capture
        What it was run on.
    depth : DepthMap
        Its answer.
    call_s : float
        Time that a call takes, s.
    left_s : float
        Time that is left for this, s.

    Returns
    -------
    dict
        ``sensitivity``, None if a perturbed run raised or there is no time for three;
        ``sensitivity_error``, why, None if all is well; ``spectral_radius``, None where the
        answer's ``info`` has no albedo.
    """
    phasors = phasors_of(capture)
    # Before any other run: a method may hand out the same arrays every time.
    radius, no_radius = _tried(lambda: _radius(capture, depth))
    before = depth.range_m.astype(np.float64)
    if 2 * CALLS * call_s > left_s:
        why = f"left out: {CALLS} more calls of {call_s:.3g} s might pass the limit of time"
        return {"sensitivity": None, "sensitivity_error": why, "spectral_radius": radius}

    def again(perturbed: Phasors) -> F64:
        return plain_answer(run(perturbed), before.shape).range_m.astype(np.float64)

    found, error = _tried(lambda: sensitivity(again, capture, phasors, before))
    return {
        "sensitivity": found,
        "sensitivity_error": error or no_radius,
        "spectral_radius": radius,
    }


def _tried(work: Callable[[], Any]) -> tuple[Any, str | None]:
    """What a method's own code gives, or why it gives nothing."""
    try:
        return work(), None
    except BaseException as error:  # a method may raise anything; its point has succeeded
        return None, sentence(error)


def _radius(capture: Capture, depth: DepthMap) -> float | None:
    if "albedo" not in depth.info:
        return None
    radius = spectral_radius(capture.sensor, depth)
    return radius if np.isfinite(radius) else None


def sensitivity(
    again: Callable[[Phasors], F64], capture: Capture, phasors: Phasors, before: F64
) -> dict[str, float | None]:
    """The three sensitivities of a method at one capture; one run each.

    Parameters
    ----------
    again : callable
        Phasors to ranges (H, W), m; NaN for no answer.
    capture : Capture
        Sensor and truth.
    phasors : Phasors
        What the method was run on.
    before : ndarray, (H, W)
        What it answered, m.

    Returns
    -------
    dict of str to float or None
        ``noise``, ``jumps``, ``scale``, ``shift_m``; None where no pixel tells.
    """
    freqs_hz = capture.sensor.modulation.freqs_hz
    jump_m = float(ambiguity_m(freqs_hz).min()) / 2
    true_m = before
    if capture.truth is not None:
        known = np.isfinite(capture.truth.range_m)
        true_m = np.where(known, capture.truth.range_m.astype(np.float64), before)
    noise, jumps = _noise(again, phasors, before, freqs_hz, jump_m)
    return {
        "noise": noise,
        "jumps": jumps,
        "scale": _scale(again, phasors, before, true_m, freqs_hz, jump_m),
        "shift_m": _shift(again, phasors, before, jump_m),
    }


def _noise(
    again: Callable[[Phasors], F64], phasors: Phasors, before: F64, freqs_hz: F64, jump_m: float
) -> tuple[float | None, float | None]:
    """Median change over the bound, and share of jumps."""
    if phasors.sigma is None:
        return None, None
    change = np.abs(again(noisier(phasors)) - before)
    bound_m = bound_of(phasors, freqs_hz)
    both = phasors.valid & np.isfinite(change)
    told = both & (change <= jump_m) & np.isfinite(bound_m) & (bound_m > 0)
    jumps = float((change[both] > jump_m).mean()) if both.any() else None
    if not told.any():
        return None, jumps
    return float(np.median(change[told] / bound_m[told])) / NORMAL_MEDIAN, jumps


def _scale(
    again: Callable[[Phasors], F64], phasors: Phasors, before: F64, true_m: F64, freqs_hz: F64,
    jump_m: float,
) -> float | None:  # fmt: skip
    """Mean deviation from the way that the scene moved, in units of that way."""
    after = again(deeper(phasors, true_m, freqs_hz))
    way_m = DEEPER * true_m
    off = np.abs(after - before - way_m)
    return _mean(off / np.where(way_m > 0, way_m, np.nan), phasors.valid & (off <= jump_m))


def _shift(
    again: Callable[[Phasors], F64], phasors: Phasors, before: F64, jump_m: float
) -> float | None:
    """Mean change of what every pixel's neighbour now answers in its place, m."""
    off = np.abs(again(aside(phasors))[:, 1:] - before[:, :-1])
    return _mean(off, phasors.valid[:, :-1] & (off <= jump_m))


def _mean(values: F64, where: Bool) -> float | None:
    told = values[where & np.isfinite(values)]
    return float(told.mean()) if told.size else None
