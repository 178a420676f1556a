"""Is a calibration good? Its answer on captures that no stage has seen, against the noise floor.

The range error e of every pixel of the held-out captures is compared with what its noise alone
would leave. What is more is the excess, ``mean e^2 - mean sigma^2``, and each cause is given the
part of it that it could explain on its own: one offset, a course with temperature, a bend of the
image that grows with distance (lens), a course with the measured phase, with amplitude, a pattern
that stands still on the pixels. The parts may overlap, since a handful of captures cannot tell all
causes apart; the simplest one that explains nearly as much as the largest names the verdict.

It fails where the held-out captures do not show an error that the scene will: distances, angles,
temperatures and brightnesses outside of theirs are not judged.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from toftools.calib._causes import CAUSES, Errors, causes_mm2, named_cause
from toftools.calib.chain import Chain, applied
from toftools.calib.residuals import range_error_m, range_noise_m, usable
from toftools.conditions import conditions_of, name_of
from toftools.phasor import phase, phasors_of
from toftools.types import F64, Capture
from toftools.units import range_to_phase

GOOD = 1.10
"""Up to this multiple of the noise floor, root mean square, a calibration is good."""
NO_DATA = "NO HELD-OUT DATA"
LARGEST_SIGMA_RAD = 0.5
"""Pixels of more phase noise carry no range worth judging; they are left out."""

WORDS: Mapping[str, str] = {
    "offset": "OFFSET LEFT",
    "pattern": "PATTERN LEFT",
    "lens": "LENS ERROR LEFT",
    "cyclic": "CYCLIC ERROR LEFT",
    "temperature": "DRIFT LEFT",
    "amplitude": "AMPLITUDE ERROR LEFT",
    "unexplained": "ERROR LEFT",
}
"""Largest cause of the excess to the word of the verdict."""

ADVICE: Mapping[str, str] = {
    "offset": (
        "All pixels read too far or too near by about as much: capture the wall again at a "
        "carefully measured distance, at the temperature of the check, and fit common_phase."
    ),
    "pattern": (
        "An error stands still on the pixels: capture more frames of a flat wall that fills the "
        "view, and fit fixed_pattern; their number bounds how well it is known."
    ),
    "lens": (
        "Planes bend in proportion to their distance, as wrong rays make them: capture the board "
        "in the corners of the image too, and fit lens and all stages after it."
    ),
    "cyclic": (
        "An error follows the measured phase: capture a rail or a delay sweep in steps of a tenth "
        "of the ambiguity range or less over a whole turn, and fit wiggling."
    ),
    "temperature": (
        "The error follows temperature: capture a warm-up with the temperatures of sensor and "
        "light, at least 5 K apart, and fit temperature."
    ),
    "amplitude": (
        "The error follows the amplitude: capture planes of several brightnesses at one distance "
        "(kind gray), and fit amplitude."
    ),
    "unexplained": (
        "None of the known causes explains it: check the distances in conditions.csv, and look "
        "for multipath from floor and walls in the maps of the report."
    ),
}
"""What to do about a cause."""


@dataclass(frozen=True)
class Score:
    """Range errors of one frequency, or of all together.

    Parameters
    ----------
    name : str
        ``40 MHz``, or ``together``: the mean weighted by the inverse of the variances, its wraps
        taken from the known range.
    rms_mm, bias_mm, spread_mm, p95_mm : float
        Root mean square, mean, robust spread (1.4826 x median absolute deviation) and 95th
        percentile of the absolute range error, mm.
    noise_mm : float
        Root mean square of its standard deviation by noise, mm.
    n : int
        Number of pixels of all captures.
    """

    name: str
    rms_mm: float
    bias_mm: float
    spread_mm: float
    p95_mm: float
    noise_mm: float
    n: int

    @property
    def ratio(self) -> float:
        """Root mean square in units of the noise floor."""
        return self.rms_mm / self.noise_mm if self.noise_mm > 0 else math.nan


@dataclass(frozen=True)
class Spot:
    """One held-out capture: where it was taken, and its error before and after the chain, mm."""

    name: str
    distance_m: float
    before_mm: float
    bias_mm: float
    rms_mm: float
    noise_mm: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer.

    Parameters
    ----------
    word : str
        ``GOOD``, one of `WORDS`, or `NO_DATA`.
    sentence : str
        One line that starts with the word.
    advice : tuple of str
        What to capture, or to check; empty if it is good.
    before, after : tuple of Score
        Errors without and with the chain, frequency by frequency, then together.
    causes_mm : mapping of str to float
        What each cause could explain of the excess on its own, root mean square, mm.
    spots : tuple of Spot
        The captures, by distance.
    """

    word: str
    sentence: str
    advice: tuple[str, ...] = ()
    before: tuple[Score, ...] = ()
    after: tuple[Score, ...] = ()
    causes_mm: Mapping[str, float] = field(default_factory=dict)
    spots: tuple[Spot, ...] = ()

    @property
    def good(self) -> bool:
        """Whether the error is that of the noise."""
        return self.word == "GOOD"


def verdict(chain: Chain, captures: Sequence[Capture]) -> Verdict:
    """Judge a calibration on captures that it has not seen.

    Parameters
    ----------
    chain : Chain
        Calibration.
    captures : sequence of Capture
        Raw captures of its camera with known distances.

    Returns
    -------
    Verdict
        Scores, causes and one sentence.

    Raises
    ------
    ValueError
        If a capture does not fit the chain, says no distance or no temperature, or has no pixel
        that measured anything.
    """
    if not captures:
        advice = "Keep captures for the check: flat walls at two or more known distances."
        return Verdict(NO_DATA, f"{NO_DATA}: nobody knows how good this calibration is", (advice,))
    raw = [_errors(capture) for capture in captures]
    corrected = [_errors(applied(chain, capture)) for capture in captures]
    freqs = chain.freqs_hz
    before, after = _scores(raw, freqs), _scores(corrected, freqs)
    last = after[-1]
    spots = _spots(captures, raw, corrected)
    parts = causes_mm2(corrected)
    if not round(last.ratio, 2) > GOOD:
        word, advice = "GOOD", ""
        if not last.noise_mm > 0:
            word = "UNKNOWN NOISE"
            advice = "The captures say no noise: take raw taps, or several frames of each."
    else:
        cause = named_cause(parts)
        word, advice = WORDS[cause], ADVICE[cause]
    sentence = _sentence(word, last, spots)
    causes = {name: math.sqrt(part) for name, part in parts.items()}
    advices = (advice,) if advice else ()
    return Verdict(word, sentence, advices, before, after, causes, spots)


def _sentence(word: str, last: Score, spots: Sequence[Spot]) -> str:
    worst = max(spots, key=lambda spot: spot.rms_mm)
    floor = (
        f", {last.ratio:.2f} x the noise floor ({last.noise_mm:.1f} mm)" if last.noise_mm else ""
    )
    where = "" if math.isnan(worst.distance_m) else f" at {worst.distance_m:.2f} m"
    count = "1 held-out capture" if len(spots) == 1 else f"{len(spots)} held-out captures"
    return f"{word}: {last.rms_mm:.1f} mm rms on {count}{floor}; worst {worst.rms_mm:.1f} mm{where}"


def _errors(capture: Capture) -> Errors:
    """Range errors, their noise, phases, amplitudes and temperatures of one capture, flat."""
    told, phasors = conditions_of(capture), phasors_of(capture)
    error = range_error_m(capture)
    noise = range_noise_m(capture)
    noise = _from_neighbours(error) if noise is None else noise
    freqs = capture.sensor.modulation.freqs_hz[:, None, None]
    clear = (range_to_phase(noise, freqs) < LARGEST_SIGMA_RAD) & np.isfinite(error)
    good = np.logical_and(usable(phasors), clear.all(axis=0))
    if not good.any():
        msg = (
            f"{name_of(capture)} has no pixel with a range to judge (all invalid, dark or without "
            "a known distance); leave it out or take it again"
        )
        raise ValueError(msg)
    return Errors(
        error_mm=np.where(good, 1e3 * error, np.nan).reshape(len(error), -1),
        noise_mm=np.where(good, 1e3 * noise, np.nan).reshape(len(error), -1),
        phase_rad=phase(phasors.values).reshape(len(error), -1),
        amplitude=np.abs(phasors.values).astype(np.float64).reshape(len(error), -1),
        place=_places(error.shape[1:]),
        distance_m=told.distance_m,
        sensor_c=told.sensor_c,
        light_c=told.light_c,
        freqs_hz=capture.sensor.modulation.freqs_hz,
    )


def _places(shape: tuple[int, ...]) -> F64:
    rows, columns = (np.linspace(-1, 1, n) for n in shape)
    return np.stack([np.tile(columns, shape[0]), np.repeat(rows, shape[1])])


def _from_neighbours(error_m: F64) -> F64:
    """Noise from the differences of neighbours, for phasors that say none; patterns count too."""
    step = np.diff(error_m, axis=2)
    layers = [row[np.isfinite(row)] for row in step.reshape(len(step), -1)]
    spread = [1.4826 * np.median(np.abs(row)) / math.sqrt(2) if row.size else 0 for row in layers]
    return np.broadcast_to(np.reshape(spread, (-1, 1, 1)), error_m.shape)


def _scores(errors: Sequence[Errors], freqs_hz: F64) -> tuple[Score, ...]:
    names = [f"{freq / 1e6:g} MHz" for freq in freqs_hz]
    alone = [
        _score(
            name,
            np.concatenate([one.error_mm[f] for one in errors]),
            np.concatenate([one.noise_mm[f] for one in errors]),
        )
        for f, name in enumerate(names)
    ]
    if len(names) == 1:
        return tuple(alone)
    joint = [one.together for one in errors]
    both = _score("together", np.concatenate([e for e, _ in joint]),
                  np.concatenate([s for _, s in joint]))  # fmt: skip
    return (*alone, both)


def _score(name: str, error_mm: F64, noise_mm: F64) -> Score:
    known = np.isfinite(error_mm)
    error, noise = error_mm[known], noise_mm[known]
    return Score(
        name=name,
        rms_mm=float(np.sqrt(np.mean(error**2))),
        bias_mm=float(error.mean()),
        spread_mm=float(1.4826 * np.median(np.abs(error - np.median(error)))),
        p95_mm=float(np.percentile(np.abs(error), 95)),
        noise_mm=float(np.sqrt(np.mean(noise**2))),
        n=int(error.size),
    )


def _spots(
    captures: Sequence[Capture], raw: Sequence[Errors], corrected: Sequence[Errors]
) -> tuple[Spot, ...]:
    spots = []
    for capture, first, last in zip(captures, raw, corrected, strict=True):
        before = _score("", *first.together)
        after = _score("", *last.together)
        distance_m = conditions_of(capture).distance_m
        name = name_of(capture)
        spots.append(Spot(name, distance_m, before.rms_mm, after.bias_mm, after.rms_mm,
                          after.noise_mm))  # fmt: skip
    return tuple(sorted(spots, key=lambda spot: (spot.distance_m, spot.name)))


assert set(WORDS) == set(ADVICE) == set(CAUSES)
