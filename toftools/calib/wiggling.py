"""Wiggling, the cyclic error of the phase, as Fourier series of the measured phase.

Model, per frequency: ``measured - true = sum_m a_m cos(m psi) + b_m sin(m psi)``, psi being the
measured phase; its mean over a turn is 0, a constant belongs to the common phase. Cause: harmonics
of the correlation that alias onto the first, orders 4, 8, ... with four taps and 3, 6, ... with
three (R. Lange, "3D time-of-flight distance measurement with custom solid-state image sensors",
thesis, Siegen 2000). M. Lindner, A. Kolb, "Lateral and depth calibration of PMD-distance sensors"
(ISVC 2006) fit a spline instead: `wiggling_spline`.

Inputs: a plane on a rail, an electronic delay sweep, or captures with a known range per pixel.
What adds a constant to a pixel (fixed pattern, drift, wrong zero of the rail) is taken off first
and does no harm, if pixels see two phases or more. Fails where the phases seen do not fill the
turn: the curve is right where there are data and drawn towards 0 elsewhere (docs/calibration/
real.md: 2 of 6.3 rad leave single coefficients undetermined).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from toftools._arrays import set_fields
from toftools.calib._basis import fourier, fourier_curve
from toftools.calib._choice import Family
from toftools.calib._wiggling_stage import checked, fit_all, rotated, same_freqs
from toftools.calib.stage import Residual
from toftools.types import F64, Bool, Capture, Phasors
from toftools.units import TWO_PI

MOST_HARMONICS = 32
"""Orders to choose from: with square waves and four taps order 28 still moves phase by 0.2 mrad,
which would bend the coefficients below it by more than their deviations."""


@dataclass(frozen=True, eq=False)
class Wiggling:
    """Cyclic phase error as Fourier series.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    cos_rad, sin_rad : ndarray, (F, M)
        Coefficients of orders 1..M, rad; 0 for orders that the data do not need.
    cos_sd_rad, sin_sd_rad : ndarray, (F, M)
        Their standard deviations, rad; NaN for orders that were not fitted.
    dof : int
        Degrees of freedom of the standard deviations: a 95 % interval is
        ``scipy.stats.t.ppf(0.975, dof)`` times as wide.
    covered : ndarray, (F, 64), bool
        Which of 64 equal parts of the turn, from phase 0, had data.
    residual : Residual
        Errors, mm, weighted as in the fit.
    """

    slot: ClassVar[str] = "wiggling"
    freqs_hz: F64
    cos_rad: F64
    sin_rad: F64
    cos_sd_rad: F64
    sin_sd_rad: F64
    dof: int
    covered: Bool
    residual: Residual

    def __post_init__(self) -> None:
        tables = {
            name: getattr(self, name) for name in ("cos_rad", "sin_rad", "cos_sd_rad", "sin_sd_rad")
        }
        set_fields(self, **checked(self.freqs_hz, self.covered, **tables))

    @property
    def harmonics(self) -> tuple[int, ...]:
        """Largest order per frequency."""
        return tuple(int(n) for n in np.isfinite(self.cos_sd_rad).sum(axis=1))

    @property
    def phase_span_rad(self) -> F64:
        """How much of the turn had data, (F,), rad."""
        return np.asarray(self.covered.mean(axis=1) * TWO_PI)

    def error_rad(self, phase_rad: F64, amplitude: F64 | None = None) -> F64:
        """Measured minus true phase, whatever the amplitude.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Measured phase, rad.
        amplitude : ndarray or None
            Not used.

        Returns
        -------
        ndarray, (F, ...)
            Error, rad.
        """
        return fourier_curve(self.cos_rad, self.sin_rad, same_freqs(self.freqs_hz, phase_rad))

    def slope(self, phase_rad: F64) -> F64:
        """Derivative of the error by the measured phase.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Measured phase, rad.

        Returns
        -------
        ndarray, (F, ...)
            Slope, rad/rad.
        """
        phase = same_freqs(self.freqs_hz, phase_rad)
        return fourier_curve(self.cos_rad, self.sin_rad, phase, slope=True)

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors without wiggling.

        Parameters
        ----------
        phasors : Phasors
            Measurement (F, H, W).

        Returns
        -------
        Phasors
            Rotated by minus the error; sigma changes by ``|1 - slope|``.
        """
        phase = np.angle(phasors.values).astype(np.float64)
        return rotated(phasors, self.error_rad(phase), self.slope(phase))


def wiggling(captures: Sequence[Capture], *, harmonics: int = 0) -> Wiggling:
    """Fit the cyclic phase error as Fourier series.

    Parameters
    ----------
    captures : sequence of Capture
        Captures of the kind rail, delay or wall, or with reference depth; the kind with the most
        captures is used.
    harmonics : int
        Largest order, the same for all frequencies; 0 chooses it per frequency by held-out error.

    Returns
    -------
    Wiggling
        Stage.

    Raises
    ------
    ValueError
        If no capture can be used, or captures are of different sizes or frequencies.
    """
    if not 0 <= harmonics <= 4 * MOST_HARMONICS:
        msg = f"harmonics must be 0 (choose) to {4 * MOST_HARMONICS}, got {harmonics}"
        raise ValueError(msg)
    sizes = (harmonics,) if harmonics else tuple(range(MOST_HARMONICS + 1))
    result = fit_all(captures, Family(fourier, sizes, nested=True), "orders up to")
    return Wiggling(
        freqs_hz=result.freqs_hz,
        cos_rad=result.padded(lambda fit: fit.theta[::2], 0.0),
        sin_rad=result.padded(lambda fit: fit.theta[1::2], 0.0),
        cos_sd_rad=result.padded(lambda fit: fit.sd[::2], np.nan),
        sin_sd_rad=result.padded(lambda fit: fit.sd[1::2], np.nan),
        dof=result.dof,
        covered=result.covered,
        residual=result.residual,
    )
