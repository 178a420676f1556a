"""Arithmetic of the equal-time comparison: range errors without the reference's own noise, curves.

Two reference images with independent noise, ``a`` and ``b``, give the mean squared error of an
image ``x`` without bias, as the mean of ``(x - a)(x - b)``: the noise of neither is squared.
"""

from dataclasses import dataclass

import numpy as np

from toftools.camera import rays
from toftools.units import phase_to_range

EDGE = 0.003
Z_SHARE = 4.0


@dataclass(frozen=True)
class Point:
    """One setting of an engine: seconds of each timed run, errors of every run's image.

    `floor_m2` is the standard error that the reference leaves in the mean squared error.
    """

    samples: int
    seconds: list[float]
    mean_square_m2: list[float]
    median_m: list[float]
    first_s: float
    peak_mb: float
    floor_m2: float

    @property
    def known(self):
        """Whether the error is not lost in the noise of the reference."""
        return np.mean(self.mean_square_m2) > 4 * self.floor_m2


@dataclass(frozen=True)
class Ratio:
    """How many times larger the peer's mean squared error is at the same time.

    `value` is the geometric mean over all times that both cover, `low` and `high` bound 95 % of
    its bootstrap; `at` lists (seconds, ratio).
    """

    value: float
    low: float
    high: float
    at: list[tuple[float, float]]


@dataclass(frozen=True)
class Reference:
    """Converged phasors at one frequency: independent images (N, H, W) of one engine, N even."""

    images: np.ndarray
    samples: int
    seconds: float

    def __post_init__(self):
        n = len(self.images)
        if n < 4 or n % 2:
            raise ValueError(f"a reference needs an even number of images, 4 or more, got {n}")

    @property
    def mean(self):
        return self.images.mean(0)

    @property
    def halves(self):
        return self.images[0::2].mean(0), self.images[1::2].mean(0)

    @property
    def variance(self):
        """Of the mean; of real and imaginary part together."""
        return self.images.var(0, ddof=1) / len(self.images)


def range_error_m(phasors, truth, freq_hz):
    """Difference of the ranges that two phasor images read, m, wrapped to half the ambiguity."""
    return phase_to_range(np.angle(phasors * np.conj(truth)), freq_hz)


def mean_square_m2(phasors, halves, freq_hz, keep):
    """Mean squared range error over the pixels `keep`, free of the reference's noise."""
    first, second = (range_error_m(phasors, half, freq_hz)[keep] for half in halves)
    return float(np.mean(first * second))


def median_m(phasors, truth, freq_hz, keep):
    """Median absolute range error; the reference's noise, if any, counts as error."""
    return float(np.median(np.abs(range_error_m(phasors, truth, freq_hz)[keep])))


def away_from_edges(camera, range_m):
    """Pixels whose neighbourhood is one smooth surface: 1/z, affine on a plane, bends little."""
    inverse = 1 / (range_m * rays(camera)[..., 2])
    padded = np.pad(inverse, 1, constant_values=np.nan)
    height, width = inverse.shape

    def shifted(dy, dx):
        return padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    smooth = np.isfinite(inverse)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        bend = np.abs(shifted(dy, dx) + shifted(-dy, -dx) - 2 * inverse)
        smooth &= bend < EDGE * inverse  # False at the rim, where a neighbour is missing
    return smooth


def agreement(one, other, keep):
    """Whether two references tell the same truth within their noise.

    Mean squared deviation in units of the expected one (1 if they agree), share of the pixels
    beyond four standard errors, and the relative gap of the mean phasor with its error.
    """
    gap, variance = (one.mean - other.mean)[keep], (one.variance + other.variance)[keep]
    # No division by noisy pixels: their noise would shrink both means, one more than the other.
    light = np.abs(other.mean[keep].sum())
    sums = [[z[keep].sum() / light for z in r.images] for r in (one, other)]
    shift = np.mean(sums[0]) - np.mean(sums[1])
    # Neighbours may share paths: only whole images are independent.
    noise = sum(np.var(values, ddof=1) / len(values) for values in sums)
    return {
        "pixels": int(keep.sum()),
        "chi2_per_pixel": float(np.sum(np.abs(gap) ** 2) / np.sum(variance)),
        "share_beyond": float(np.mean(np.abs(gap) ** 2 > Z_SHARE**2 * variance)),
        "mean_gap": [float(shift.real), float(shift.imag)],
        "mean_gap_se": float(np.sqrt(noise / 2)),
    }


def standard_error_m(ref, freq_hz, keep):
    """Root mean square over pixels of a reference's standard error of range, m."""
    return float(np.sqrt(np.mean(_variance_m2(ref, freq_hz)[keep])))


def floor_m2(ref, freq_hz, keep):
    """Standard error that the product of the two halves' noise leaves in a mean square."""
    return float(2 * np.sqrt(np.sum(_variance_m2(ref, freq_hz)[keep] ** 2)) / keep.sum())


def _variance_m2(ref, freq_hz):
    phase = np.sqrt(ref.variance / 2) / np.maximum(np.abs(ref.mean), 1e-30)
    return phase_to_range(phase, freq_hz) ** 2


def slope(points):
    """Exponent of the mean squared error against time: -1 for independent samples."""
    time, error = _curve(points)
    return float(np.polyfit(time, error, 1)[0]) if len(time) > 1 else float("nan")


def equal_time(theirs, ours, *, draws=2000, seed=0):
    """Ratio of mean squared errors at equal time, the peer's over ours; None if times do not meet.

    Between the measured points the curves are straight in the logarithms of time and error, as
    an error that falls with a power of time is.
    """
    times = _shared_times(theirs, ours)
    if times is None:
        return None

    def ratios(pick):
        curves = [np.interp(times, *_curve(points, pick)) for points in (theirs, ours)]
        return curves[0] - curves[1]

    centre = ratios(None)
    rng = np.random.default_rng(seed)
    spread = np.exp([ratios(rng).mean() for _ in range(draws)])
    low, high = np.quantile(spread, [0.025, 0.975])
    shown = [0, len(times) // 2, len(times) - 1]
    at = [(float(np.exp(times[i])), float(np.exp(centre[i]))) for i in shown]
    return Ratio(float(np.exp(centre.mean())), float(low), float(high), at)


def _shared_times(theirs, ours):
    spans = [_curve(points)[0] for points in (theirs, ours)]
    if not all(len(s) for s in spans):
        return None
    low, high = max(s[0] for s in spans), min(s[-1] for s in spans)
    return np.linspace(low, high, 33) if low < high else None


def _curve(points, rng=None):
    """Logarithms of time and mean squared error, by time; a generator redraws the runs."""
    known = [p for p in points if p.known]
    centre = np.array([np.mean(p.mean_square_m2) for p in known])
    error = centre
    if rng is not None:
        error = np.array(
            [rng.choice(p.mean_square_m2, len(p.mean_square_m2)).mean() for p in known]
        )
    time = np.array([min(p.seconds) for p in known])
    order = np.argsort(time)
    return np.log(time[order]), np.log(np.maximum(error, 1e-3 * centre)[order])
