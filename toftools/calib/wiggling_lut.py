"""Wiggling, the cyclic error of the phase, as table over the measured phase.

Model, per frequency: ``measured - true`` linear between K equal knots around the turn, the first at
phase 0; the knots add up to 0, a constant belongs to the common phase. 16 knots are what the
calibration of Texas Instruments' cameras stores (3dtof/calibwizard: 4096 codes of phase in steps of
256).

Inputs as for `toftools.calib.wiggling`. Fails to follow what bends between knots: of the wiggling
of square waves and four taps (orders 4, 8, 12; 50.9 mrad rms) 16 knots leave 12.5 mrad, 32 knots
2.1 and a Fourier series 0.6 (its noise). Its slope jumps at the knots, and sigma with it. Knots
where the turn has no data are drawn towards 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from toftools._arrays import set_fields
from toftools.calib._basis import spline, spline_curve
from toftools.calib._choice import Family
from toftools.calib._wiggling_stage import checked, checked_knots, fit_all, rotated, same_freqs
from toftools.calib.stage import Residual
from toftools.types import F64, Bool, Capture, Phasors

SIZES = (4, 8, 16, 32)
"""Numbers of knots to choose from."""
LEAST, MOST = 2, 256
"""Numbers of knots that may be asked for."""


def _columns(phase_rad: F64, knots: int) -> F64:
    return spline(phase_rad, knots, 1)


@dataclass(frozen=True, eq=False)
class WigglingLut:
    """Cyclic phase error as piecewise linear table.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.
    knot_rad : ndarray, (F, K)
        Errors at phases ``2 pi k / knots``, rad; 0 beyond the last knot.
    knot_sd_rad : ndarray, (F, K)
        Their standard deviations, rad; NaN beyond the last knot.
    knots : tuple of int
        Knots per frequency.
    dof : int
        Degrees of freedom of the standard deviations.
    covered : ndarray, (F, 64), bool
        Which of 64 equal parts of the turn, from phase 0, had data.
    residual : Residual
        Errors, mm, weighted as in the fit.
    """

    slot: ClassVar[str] = "wiggling"
    freqs_hz: F64
    knot_rad: F64
    knot_sd_rad: F64
    knots: tuple[int, ...]
    dof: int
    covered: Bool
    residual: Residual

    def __post_init__(self) -> None:
        tables = {"knot_rad": self.knot_rad, "knot_sd_rad": self.knot_sd_rad}
        fields = checked(self.freqs_hz, self.covered, **tables)
        knots = checked_knots(self.knots, np.asarray(fields["knot_rad"]), LEAST)
        set_fields(self, **fields, knots=knots)

    def _at(self, phase_rad: F64, *, slope: bool) -> F64:
        phase = same_freqs(self.freqs_hz, phase_rad)
        rows = [
            spline_curve(self.knot_rad[f : f + 1, :count], phase[f : f + 1], 1, slope=slope)
            for f, count in enumerate(self.knots)
        ]
        return np.concatenate(rows)

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
        return self._at(phase_rad, slope=False)

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
        return self._at(phase_rad, slope=True)

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


def wiggling_lut(captures: Sequence[Capture], *, knots: int = 16) -> WigglingLut:
    """Fit the cyclic phase error as piecewise linear table.

    Parameters
    ----------
    captures : sequence of Capture
        Captures of the kind rail, delay or wall, or with reference depth; the kind with the most
        captures is used.
    knots : int
        Knots on the turn, the same for all frequencies, 2 to 256; 0 chooses them per frequency by
        held-out error.

    Returns
    -------
    WigglingLut
        Stage.

    Raises
    ------
    ValueError
        If no capture can be used, or captures are of different sizes or frequencies.
    """
    if knots and not LEAST <= knots <= MOST:
        msg = f"knots must be 0 (choose) or {LEAST} to {MOST}, got {knots}"
        raise ValueError(msg)
    result = fit_all(captures, Family(_columns, (knots,) if knots else SIZES), "knots")
    return WigglingLut(
        freqs_hz=result.freqs_hz,
        knot_rad=result.padded(lambda fit: fit.theta - fit.theta.mean(), 0.0),
        knot_sd_rad=result.padded(lambda fit: fit.sd, np.nan),
        knots=result.sizes,
        dof=result.dof,
        covered=result.covered,
        residual=result.residual,
    )
