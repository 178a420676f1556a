"""Common phase: one constant per frequency, what the electronics delay besides the way of light.

``measured = true + phase_rad[f]``; the name is that of the TI calibration wizard
(github.com/3dtof/calibwizard). Input: captures of kind ``wall``, or ``rail`` where there is no
wall, at known distances. Every capture gives the mean over its pixels; captures are combined as
measurements with an error of their own each, since all pixels of a capture share its wrong
distance: R. DerSimonian, N. Laird, "Meta-analysis in clinical trials", Controlled Clinical Trials 7
(1986) 177-188 (pages recalled), with the variance of J. Hartung, G. Knapp, Statistics in Medicine
20 (2001) 3875-3889, outliers left out from four captures on. It fails silently where every wall is
wrong by the same length: 1 mm is 2.9 mrad at 70 MHz, against 0.3 mrad of noise of one 48 x 36 px
frame at 1 m. From two misplaced walls alone the interval holds the truth 88 times in 100, from
three or more 93 to 95.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from toftools._arrays import expect_shape, frozen, set_fields
from toftools.calib._phase_apply import check_freqs, mhz, rad_per_mm, residual_in_mm, rotated, to_mm
from toftools.calib._phase_errors import MAD_TO_SIGMA, Errors, errors_of, inliers, picked
from toftools.calib._phase_pixels import two_way
from toftools.calib.stage import Residual
from toftools.conditions import conditions_of
from toftools.types import F64, Bool, Capture, Phasors

OUTLIER = 6.0
"""Captures farther from the median than this many robust standard deviations do not count."""
SPAN_K = 2.0
"""Captures that differ by more than this in temperature are worth a note, K."""


@dataclass(frozen=True, eq=False)
class CommonPhase:
    """A constant phase per frequency.

    Parameters
    ----------
    phase_rad : ndarray, (F,)
        Measured minus true phase, rad.
    sigma_rad : ndarray, (F,)
        Its standard deviation, rad; 1.96 of them to each side hold the truth 19 times in 20.
    reference_c : ndarray, (2,)
        Mean temperatures of sensor and light source of its captures, degrees Celsius; NaN unknown.
    residual : Residual
        What the fit left.

    Examples
    --------
    >>> stage = CommonPhase([0.5], [0.001], [np.nan, np.nan])
    >>> z = np.full((1, 1, 1), np.exp(1.7j))
    >>> round(float(np.angle(stage(Phasors(z)).values[0, 0, 0])), 4)
    1.2
    """

    slot: ClassVar[str] = "common_phase"

    phase_rad: F64
    sigma_rad: F64
    reference_c: F64
    residual: Residual = field(default_factory=Residual)

    def __post_init__(self) -> None:
        phase = frozen(self.phase_rad, np.float64, "phase_rad", 1)
        sigma = frozen(self.sigma_rad, np.float64, "sigma_rad", 1)
        reference = frozen(self.reference_c, np.float64, "reference_c", 1)
        expect_shape("sigma_rad", sigma, phase.shape)
        expect_shape("reference_c", reference, (2,))
        if not (np.isfinite(phase).all() and (sigma >= 0).all() and not np.isinf(reference).any()):
            msg = f"common phase must be finite radians with sigma >= 0, got {phase} +- {sigma}"
            raise ValueError(msg)
        set_fields(self, phase_rad=phase, sigma_rad=sigma, reference_c=reference)

    def error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Measured minus true phase, whatever phase and amplitude.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Measured phase, rad.
        amplitude : ndarray, (F, ...)
            Measured amplitude.

        Returns
        -------
        ndarray, (F, 1, ...)
            Constant per frequency, rad.
        """
        return self.phase_rad.reshape(-1, *(1,) * (np.ndim(phase_rad) - 1))

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors without the constant.

        Parameters
        ----------
        phasors : Phasors
            (F, H, W).

        Returns
        -------
        Phasors
            Turned back; sigma stays.

        Raises
        ------
        ValueError
            If the number of frequencies differs.
        """
        check_freqs(self.slot, self.phase_rad.size, phasors)
        return rotated(phasors, self.phase_rad[:, None, None])


def common_phase(captures: Sequence[Capture]) -> CommonPhase:
    """Fit the constant of every frequency.

    Parameters
    ----------
    captures : sequence of Capture
        Among them walls, or else rail positions, at known distances; corrected for lens, response
        and wiggling.

    Returns
    -------
    CommonPhase
        The stage. Its residual counts pixels, fixed pattern included.

    Raises
    ------
    ValueError
        If there is no such capture, one is empty or of unknown distance, or sensors differ.
    """
    used = picked(captures, "common_phase", ("wall",), ("rail",))
    errors = errors_of(used)
    means, spreads = capture_means(errors)
    n_freqs = errors.freqs_hz.size
    fits = [combined(means[:, f], spreads[:, f]) for f in range(n_freqs)]
    phase, sigma = (np.array([fit[i] for fit in fits]) for i in (0, 1))
    temperatures = np.array([[c.sensor_c, c.light_c] for c in map(conditions_of, used)])
    kept = _without_outliers(errors.error_rad)
    held = None
    if len(used) > 1:
        others = [np.arange(len(used)) != k for k in range(len(used))]
        left_out = [
            [combined(means[rest, f], spreads[rest, f])[0] for f in range(n_freqs)]
            for rest in others
        ]
        held = kept - np.asarray(left_out)[:, :, None, None]
    residual = residual_in_mm(
        errors.freqs_hz,
        kept,
        kept - phase[:, None, None],
        held,
        errors.sigma_rad if errors.told else None,
        _notes(errors, means - phase, temperatures),
    )
    return CommonPhase(phase, sigma, _mean_c(temperatures), residual)


def _mean_c(temperatures: F64) -> F64:
    """Mean of what is known of each temperature, NaN if nothing is."""
    told = np.isfinite(temperatures)
    total = np.where(told, temperatures, 0).sum(axis=0)
    return np.where(told.any(axis=0), total / np.maximum(told.sum(axis=0), 1), np.nan)


def _without_outliers(error_rad: F64) -> F64:
    kept = [[np.where(inliers(x), x, np.nan) for x in layer] for layer in error_rad]
    return np.asarray(kept)


def capture_means(errors: Errors) -> tuple[F64, F64]:
    """Mean error of every capture and its standard deviation by noise, rad, (K, F) each.

    The mean is over all pixels that any capture sees: a pixel missing from one capture is replaced
    by what the others say of its pattern, so that captures with different pixels agree.

    Parameters
    ----------
    errors : Errors
        Errors of K captures.

    Returns
    -------
    means, spreads : ndarray, (K, F)
        Mean and standard deviation.
    """
    fit = two_way(errors)
    total = np.isfinite(errors.error_rad).sum(axis=(2, 3))
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.nansum(errors.sigma_rad**2, axis=(2, 3))) / total
    scale = np.maximum(fit.scale, 1) if errors.told else fit.scale
    return fit.capture_rad, np.asarray(spread * scale)


def combined(means: F64, spreads: F64) -> tuple[float, float]:
    """Robust mean of measurements that carry a common and an unknown error of their own.

    Parameters
    ----------
    means, spreads : ndarray, (K,)
        Measurements and their known standard deviations.

    Returns
    -------
    mean, sigma : float
        Mean, and the standard deviation whose 1.96-fold is the 95 % interval (Student's factor
        for few captures included where they scatter more than their noise).
    """
    near = _near(means, spreads)
    means, spreads = means[near], spreads[near]
    freedom = means.size - 1
    if freedom == 0:
        return float(means[0]), float(spreads[0])
    weight = 1 / spreads**2
    start = float((weight * means).sum() / weight.sum())
    excess = float((weight * (means - start) ** 2).sum()) - freedom
    between = max(0.0, excess / (weight.sum() - (weight**2).sum() / weight.sum()))
    weight = 1 / (spreads**2 + between)
    mean = float((weight * means).sum() / weight.sum())
    if between == 0:
        return mean, float(1 / np.sqrt(weight.sum()))
    scatter = max(1.0, float((weight * (means - mean) ** 2).sum()) / freedom)
    return mean, float(np.sqrt(scatter / weight.sum())) * _student(freedom)


def _near(means: F64, spreads: F64) -> Bool:
    """All but outliers, which three captures cannot show."""
    if means.size < 4:
        return np.ones(means.shape, np.bool_)
    off = np.abs(means - np.median(means))
    scatter = MAD_TO_SIGMA * max(float(np.median(off)), float(np.median(spreads)))
    return np.asarray(off <= OUTLIER * scatter)


def _student(freedom: int) -> float:
    """95 % point of Student's distribution relative to the normal one."""
    from scipy.stats import t

    return float(t.ppf(0.975, freedom)) / 1.96


def _notes(errors: Errors, offsets: F64, temperatures: F64) -> list[str]:
    per_mm = " and ".join(f"{x:.4f}" for x in rad_per_mm(errors.freqs_hz))
    what = f"1 mm of wrong wall distance is {per_mm} rad at {mhz(errors.freqs_hz)}"
    if offsets.shape[0] == 1:
        notes = [f"one capture only: {what}, which no standard deviation here knows"]
    else:
        worst = np.abs(to_mm(offsets, errors.freqs_hz)).max(axis=1)
        k = int(worst.argmax())
        notes = [f"{what}; {errors.names[k]} is off the others most, by {worst[k]:.2f} mm"]
    if not errors.told:
        notes.append("phasors carry no sigma: noise is guessed from differences of neighbours")
    for name, column in zip(("sensor_c", "light_c"), temperatures.T, strict=True):
        told = column[np.isfinite(column)]
        if told.size and np.ptp(told) > SPAN_K:
            notes.append(
                f"captures span {np.ptp(told):.1f} K of {name}: their drift is in the constant"
            )
    return notes
