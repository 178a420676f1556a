"""What the three wiggling stages have in common: checks, correction, residuals and notes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toftools._arrays import expect_shape, frozen
from toftools.calib._choice import BINS, Family, Fitted, fitted
from toftools.calib._wiggling_data import chosen_captures, gather
from toftools.calib.stage import Residual
from toftools.conditions import conditions_of
from toftools.types import F64, Bool, Capture, Phasors
from toftools.units import TWO_PI, phase_to_range

NARROW = 0.95
"""Share of the turn that must have data for single coefficients to mean anything."""


@dataclass(frozen=True, eq=False)
class Result:
    """Fits of all frequencies.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    fits : tuple of Fitted
        One per frequency.
    covered : ndarray, (F, BINS), bool
        Which parts of the turn have data.
    residual : Residual
        Figures, mm.
    """

    freqs_hz: F64
    fits: tuple[Fitted, ...]
    covered: Bool
    residual: Residual

    def padded(self, values: Callable[[Fitted], F64], fill: float) -> F64:
        """Rows of different length as one array (F, K), at least one column wide."""
        rows = [values(fit) for fit in self.fits]
        out = np.full((len(rows), max(1, *(row.size for row in rows))), fill)
        for target, row in zip(out, rows, strict=True):
            target[: row.size] = row
        return out

    @property
    def sizes(self) -> tuple[int, ...]:
        """Chosen size per frequency."""
        return tuple(fit.size for fit in self.fits)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the standard deviations."""
        return max(min(fit.parts for fit in self.fits) - 1, 0)


def fit_all(captures: Sequence[Capture], family: Family, noun: str) -> Result:
    """Fit every frequency.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with conditions; those of the best kind are used.
    family : Family
        Models.
    noun : str
        What its size counts, for the notes.

    Returns
    -------
    Result
        Fits and residuals.

    Raises
    ------
    ValueError
        If no capture can be used.
    """
    used, kind = chosen_captures(captures)
    freqs = np.asarray(used[0].sensor.modulation.freqs_hz)
    all_samples = gather(used)
    noisy = all(conditions_of(capture).reference == "plane" for capture in used)
    fits = tuple(fitted(samples, family, noisy_phase=noisy) for samples in all_samples)
    notes = _notes(fits, freqs, len(used), kind, noun, all_samples[0].per_pixel)
    per_f = {
        name: phase_to_range(np.sqrt([getattr(fit, name) for fit in fits]), freqs) * 1e3
        for name in ("before", "after", "held_out", "noise")
    }
    pooled = {name: float(np.sqrt(np.mean(mm**2))) for name, mm in per_f.items()}
    residual = Residual("mm", **pooled, n=sum(fit.n for fit in fits), notes=notes)
    return Result(freqs, fits, np.stack([fit.covered for fit in fits]), residual)


def _notes(
    fits: Sequence[Fitted], freqs: F64, count: int, kind: str, noun: str, per_pixel: bool
) -> tuple[str, ...]:
    """What a user should know."""
    mhz = [f"{freq / 1e6:g}" for freq in freqs]
    sizes = ", ".join(str(fit.size) for fit in fits)
    notes = [f"Kind {kind}, {count} captures; {noun} at {', '.join(mhz)} MHz: {sizes}."]
    if count == 1:
        notes.append(
            "One capture only: fixed pattern and wiggling cannot be told apart; "
            "take a rail or a delay sweep."
        )
    elif not per_pixel:
        notes.append(
            "Pixels see the same phase in all captures: fixed pattern and wiggling cannot be told "
            "apart; move the target or the delay."
        )
    for freq, fit in zip(mhz, fits, strict=True):
        if fit.covered.mean() < NARROW:
            notes.append(
                f"At {freq} MHz phases cover only {fit.covered.mean() * TWO_PI:.1f} of 6.3 rad: "
                "trust the curve there, not single coefficients; elsewhere it is drawn towards 0."
            )
        share = fit.dropped / max(fit.dropped + fit.n, 1)
        if share > 0.005:
            notes.append(f"At {freq} MHz {share:.1%} of the measurements are outliers, left out.")
    if np.isnan(fits[0].noise):
        notes.append("Noise of the phases is unknown: all measurements count the same.")
    return tuple(notes)


def checked(freqs_hz: F64, covered: Bool, **tables: F64) -> dict[str, object]:
    """Fields of a stage, frozen and checked: (F, K) tables, finite unless they are deviations.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    covered : ndarray, (F, BINS), bool
        Which parts of the turn had data.
    **tables : ndarray, (F, K)
        Coefficients and their standard deviations (names with ``_sd_``, NaN for not fitted).

    Returns
    -------
    dict
        Frozen arrays by name.

    Raises
    ------
    ValueError
        If shapes differ or a coefficient is not finite.
    """
    freqs = frozen(freqs_hz, np.float64, "freqs_hz", 1)
    parts = frozen(covered, np.bool_, "covered", 2)
    expect_shape("covered", parts, (freqs.size, BINS))
    if not (np.isfinite(freqs).all() and (freqs > 0).all()):
        msg = f"freqs_hz must be positive, got {freqs.tolist()}"
        raise ValueError(msg)
    out: dict[str, object] = {"freqs_hz": freqs, "covered": parts}
    width: int | None = None
    for name, table in tables.items():
        array = frozen(table, np.float64, name, 2)
        width = array.shape[1] if width is None else width
        expect_shape(name, array, (freqs.size, width))
        good = ~(array < 0) & ~np.isinf(array) if "_sd_" in name else np.isfinite(array)
        if not good.all():
            msg = f"{name} must be finite, and deviations not negative"
            raise ValueError(msg)
        out[name] = array
    return out


def rotated(phasors: Phasors, error_rad: F64, slope: F64) -> Phasors:
    """Phasors with a phase taken off that depends on their own phase.

    Parameters
    ----------
    phasors : Phasors
        Measurement (F, H, W).
    error_rad, slope : ndarray, (F, H, W)
        Error at their phases, rad, and its derivative.

    Returns
    -------
    Phasors
        ``z exp(-j error)``; sigma times ``|1 - slope|``, by which noise of the phase passes.
    """
    values = (phasors.values * np.exp(-1j * error_rad)).astype(np.complex64)
    sigma = phasors.sigma
    if sigma is not None:
        sigma = (sigma * np.abs(1 - slope)).astype(np.float32)
    return replace(phasors, values=values, sigma=sigma)


def same_freqs(freqs_hz: F64, phase_rad: F64) -> F64:
    """Phases in float64, refused if they are not of as many frequencies.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies of the stage, Hz.
    phase_rad : ndarray, (F, ...)
        Phase, rad.

    Returns
    -------
    ndarray, (F, ...)
        Phase, rad.

    Raises
    ------
    ValueError
        If the first axis is not F long.
    """
    phase = np.asarray(phase_rad, dtype=np.float64)
    if phase.ndim < 1 or phase.shape[0] != freqs_hz.size:
        msg = f"phases must be ({freqs_hz.size}, ...), got shape {phase.shape}"
        raise ValueError(msg)
    return phase


def checked_knots(knots: Sequence[int], table: F64, least: int) -> tuple[int, ...]:
    """Numbers of knots as whole numbers, refused if they do not fit their table.

    Parameters
    ----------
    knots : sequence of int
        Knots per frequency.
    table : ndarray, (F, K)
        Coefficients.
    least : int
        Smallest number that the model can have.

    Returns
    -------
    tuple of int
        Knots per frequency.

    Raises
    ------
    ValueError
        If there are not F numbers from `least` to K.
    """
    counts = tuple(int(n) for n in knots)
    if len(counts) != table.shape[0] or not all(least <= n <= table.shape[1] for n in counts):
        msg = (
            f"knots must be {table.shape[0]} numbers from {least} to {table.shape[1]}, got {knots}"
        )
        raise ValueError(msg)
    return counts
