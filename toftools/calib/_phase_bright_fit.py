"""Data, choice of size and gauge of the amplitude error, all frequencies together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib._choice import smallest
from toftools.calib._phase_apply import rad_per_mm
from toftools.calib._phase_bright import Samples, held_out, robust, solved
from toftools.calib._phase_errors import around_centre, error_and_sigma
from toftools.calib._phase_surface import design
from toftools.conditions import conditions_of, expected_range_m, name_of
from toftools.phasor import phasors_of
from toftools.types import F64, Capture
from toftools.units import TWO_PI, range_to_phase

SHAPES = ((2, 1), (3, 1), (4, 1), (6, 1), (2, 4), (3, 4), (4, 4), (4, 6), (6, 6), (6, 8))
"""Numbers of functions over log amplitude and over phase, from small to large."""
MOST_PIXELS, MOST_SAMPLES, LEAST_PIXELS = 3000, 60_000, 400
LEAST_CAPTURES = 3
LEAST_CONTRAST = 1.5
"""Ratio of the brightest to the darkest capture below which there is nothing to fit."""
WHOLE_TURN = 0.8
"""Share of the turn that phases must cover for functions of phase."""
ENDS = (0.5, 99.5)
"""Percentiles of the amplitudes that end the span."""
OFF_MM = 0.5


@dataclass(frozen=True, eq=False)
class Data:
    """Pixels of captures of several brightnesses.

    Parameters
    ----------
    names, kinds : tuple of str, K
        Files and kinds of the captures.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    samples : tuple of Samples, F
        Per frequency.
    sigma_rad : ndarray, (K, F, P)
        Noise, rad.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    freqs_hz: F64
    samples: tuple[Samples, ...]
    sigma_rad: F64


@dataclass(frozen=True, eq=False)
class Fit:
    """Surfaces of all frequencies.

    Parameters
    ----------
    knot_rad : ndarray, (F, A, P)
        Coefficients, rad.
    covariance_rad2 : ndarray, (F, A P, A P)
        Their covariance.
    reference_amplitude : ndarray, (F,)
        Where the surface is 0 on average.
    before_rad, after_rad, held_out_rad : ndarray, (K, F, P)
        Errors without, with, and with the stage fitted to other captures; outliers NaN.
    notes : tuple of str
        Sentences.
    """

    knot_rad: F64
    covariance_rad2: F64
    reference_amplitude: F64
    before_rad: F64
    after_rad: F64
    held_out_rad: F64
    notes: tuple[str, ...]


def samples_of(captures: Sequence[Capture]) -> Data:
    """Errors, amplitudes and phases on a grid of pixels that all captures share.

    Parameters
    ----------
    captures : sequence of Capture
        Planes of several brightnesses.

    Returns
    -------
    Data
        At most `MOST_PIXELS` pixels each.

    Raises
    ------
    ValueError
        If there are too few, or all are of one brightness.
    """
    if len(captures) < LEAST_CAPTURES:
        msg = (
            f"amplitude needs {LEAST_CAPTURES} captures of several brightnesses or more, got "
            f"{len(captures)}"
        )
        raise ValueError(msg)
    size = captures[0].sensor.camera.width * captures[0].sensor.camera.height
    most = max(LEAST_PIXELS, min(MOST_PIXELS, MOST_SAMPLES // len(captures)))
    grid = np.unique(np.linspace(0, size - 1, min(size, most)).astype(np.intp))
    freqs = captures[0].sensor.modulation.freqs_hz
    parts = []
    for capture in captures:
        error, sigma = error_and_sigma(capture)
        level = np.abs(phasors_of(capture).values).astype(np.float64)
        expected = range_to_phase(expected_range_m(capture), freqs[:, None, None])
        layers = np.stack([error, sigma, level, expected])
        parts.append(layers.reshape(4, freqs.size, -1)[..., grid])
    layers = np.stack(parts, axis=2)  # (4, F, K, P)
    samples = tuple(_samples(*layers[:, f]) for f in range(freqs.size))
    _check_contrast(samples)
    return Data(
        tuple(name_of(capture) for capture in captures),
        tuple(conditions_of(capture).kind for capture in captures),
        freqs,
        samples,
        np.moveaxis(layers[1], 0, 1),
    )


def _samples(error: F64, sigma: F64, level: F64, expected: F64) -> Samples:
    error = around_centre(error)
    known = np.isfinite(error)
    weight = np.where(known, 1 / np.where(known, sigma, 1.0) ** 2, 0.0)
    low, high = np.percentile(level[known], ENDS)
    return Samples(
        np.where(known, error, 0.0),
        np.where(known, expected, 0.0),
        np.where(known, level, low),
        weight,
        np.array([low, max(high, low * (1 + 1e-6))]),
    )


def _check_contrast(samples: Sequence[Samples]) -> None:
    least = np.inf
    for part in samples:
        levels = np.array(
            [
                np.median(level[weight > 0])
                for level, weight in zip(part.amplitude, part.weight, strict=True)
            ]
        )
        least = min(least, float(levels.max() / levels.min()))
    if least < LEAST_CONTRAST:
        msg = (
            f"the captures for amplitude differ in brightness by a factor of {least:.2f} only, "
            f"wanted {LEAST_CONTRAST:g} or more: add darker targets"
        )
        raise ValueError(msg)


def fit_surface(data: Data) -> Fit:
    """Fit all frequencies with functions as few as held-out captures allow.

    Parameters
    ----------
    data : Data
        Pixels.

    Returns
    -------
    Fit
        The surfaces.
    """
    shapes, notes = _shapes(data)
    samples = [robust(part, shapes[-1]) for part in data.samples]
    tables = [np.zeros(len(data.names))] + [np.zeros(len(data.names)) for _ in shapes]
    shares = np.zeros(len(data.names))
    for part in samples:
        shares += (part.weight > 0).sum(axis=1)
        for table, shape in zip(tables, [None, *shapes], strict=True):
            table += held_out(part, shape)[0]
    best = smallest(np.array(tables), shares)
    shape = shapes[max(best - 1, 0)]
    fits = [solved(part, shape) for part in samples]
    parts = [_gauged(data, part, shape, fit) for part, fit in zip(samples, fits, strict=True)]
    knots, covariance, reference = (np.stack([part[i] for part in parts]) for i in range(3))
    if best == 0:
        knots = np.zeros_like(knots)
        notes.append("held-out captures show no amplitude error: the stage changes nothing")
    else:
        notes.append(
            f"{shape[0]} functions of log amplitude times {shape[1]} of phase, chosen by held-out "
            "captures; amplitudes outside those of the fit are taken as its ends"
        )
        notes += _offset(data, np.array([part[3] for part in parts]))
    errors = [_errors(part, shape, used=best > 0) for part in samples]
    before, after, held = (np.stack([e[i] for e in errors], axis=1) for i in range(3))
    return Fit(knots.reshape(-1, *shape), covariance, reference, before, after, held, tuple(notes))


def _shapes(data: Data) -> tuple[list[tuple[int, int]], list[str]]:
    """Candidates that the phases allow."""
    covered = 1.0
    for part in data.samples:
        phase = np.mod(part.expected_rad[part.weight > 0], TWO_PI)
        bins = np.unique((phase / TWO_PI * 24).astype(np.intp))
        covered = min(covered, bins.size / 24)
    if covered >= WHOLE_TURN:
        return list(SHAPES), []
    note = (
        f"phases cover {100 * covered:.0f} % of the turn only: the amplitude error is taken as "
        "the same at all phases"
    )
    return [shape for shape in SHAPES if shape[1] == 1], [note]


def _gauged(
    data: Data, samples: Samples, shape: tuple[int, int], fit: tuple[F64, F64, F64]
) -> tuple[F64, F64, float, float]:
    """Coefficients and covariance of the surface that is 0 over the walls; its place, the shift.

    Without a wall the surface stays as measured, since common phase has set the walls to 0.
    """
    theta, covariance, fitted = fit
    walls = np.array([kind == "wall" for kind in data.kinds])
    if not walls.any():
        levels = np.geomspace(float(samples.span[0]), float(samples.span[1]), 33)
        turn = np.arange(32) * (TWO_PI / 32)
        grid = np.meshgrid(levels, turn, indexing="ij")
        rows = design(grid[0].ravel(), grid[1].ravel(), samples.span, shape)
        mean = (rows @ theta).reshape(33, 32).mean(axis=1)
        return theta, covariance, float(levels[np.argmin(np.abs(mean))]), 0.0
    own = (samples.weight > 0) & walls[:, None]
    level = samples.amplitude[own]
    phase = (samples.expected_rad + fitted)[own]
    mean = design(level, phase, samples.span, shape).mean(axis=0)
    turn = np.eye(theta.size) - mean  # every function less the surface's mean: they add up to 1
    shift = float(mean @ theta)
    place = float(np.exp(np.log(level).mean()))
    return turn @ theta, turn @ covariance @ turn.T, place, shift


def _errors(samples: Samples, shape: tuple[int, int], *, used: bool) -> tuple[F64, F64, F64]:
    """Errors (K, P) before, after and held out, outliers NaN."""
    before = np.where(samples.weight > 0, samples.error_rad, np.nan)
    if not used:
        return before, before, before
    _, _, fitted = solved(samples, shape)
    held = held_out(samples, shape)[1]
    gap = before - held
    means = np.nanmean(gap, axis=1)
    # The constant of each fit is that of the other captures.
    others = (means.sum() - means) / (means.size - 1)
    return before, before - fitted, gap - others[:, None]


def _offset(data: Data, shift_rad: F64) -> list[str]:
    off = shift_rad / rad_per_mm(data.freqs_hz)
    if np.abs(off).max() < OFF_MM:
        return []
    words = " and ".join(f"{x:+.1f}" for x in off)
    return [f"the surface was shifted by {words} mm to be 0 over the walls: targets misplaced?"]
