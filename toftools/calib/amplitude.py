"""Amplitude-related error: a phase error that depends on amplitude and phase, per frequency.

``measured = true + g[f](log amplitude, measured phase)``, a tensor-product B-spline, periodic in
phase: M. Lindner, I. Schiller, A. Kolb, R. Koch, "Time-of-Flight sensor calibration for accurate
range sensing", Computer Vision and Image Understanding 114 (2010) 1318-1328, who use distance and
intensity (from the abstract). Input: planes of several brightnesses at known distances (kind
``gray``; ``wall`` and ``rail`` count too). How many functions, perhaps none at all, is decided on
held-out captures. The constant is common phase's: the surface is 0 on average over the walls.
Each pixel may keep an offset of its own. It fails where brightness and distance change together
only (one white wall at all distances): then the error belongs to the wiggling, and both fit it.
Wrong distances go right into it: 2 mm at random for each of 15 targets leave 7 mrad rms where exact
ones leave 1.6 mrad, and the standard deviations know only some of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from toftools._arrays import expect_shape, frozen, set_fields
from toftools.calib._phase_apply import check_freqs, residual_in_mm, rotated
from toftools.calib._phase_bright_fit import fit_surface, samples_of
from toftools.calib._phase_errors import picked
from toftools.calib._phase_surface import design, surface
from toftools.calib.stage import Residual
from toftools.phasor import phasors_of
from toftools.types import F64, Capture, Phasors


@dataclass(frozen=True, eq=False)
class Amplitude:
    """A surface of phase error over amplitude and phase, per frequency.

    Parameters
    ----------
    knot_rad : ndarray, (F, A, P)
        Coefficients of A functions of log amplitude times P functions of phase, rad.
    covariance_rad2 : ndarray, (F, A P, A P)
        Their covariance, rad^2.
    span : ndarray, (F, 2)
        Lowest and highest amplitude of the fit, unit of the phasors; the surface is level outside.
    reference_amplitude : ndarray, (F,)
        Amplitude at which the error is 0 on average: the geometric mean of the walls.
    residual : Residual
        What the fit left.
    """

    slot: ClassVar[str] = "amplitude"

    knot_rad: F64
    covariance_rad2: F64
    span: F64
    reference_amplitude: F64
    residual: Residual = field(default_factory=Residual)

    def __post_init__(self) -> None:
        knots = frozen(self.knot_rad, np.float64, "knot_rad", 3)
        covariance = frozen(self.covariance_rad2, np.float64, "covariance_rad2", 3)
        span = frozen(self.span, np.float64, "span", 2)
        reference = frozen(self.reference_amplitude, np.float64, "reference_amplitude", 1)
        n_freqs, count, turn = knots.shape
        expect_shape("covariance_rad2", covariance, (n_freqs, count * turn, count * turn))
        expect_shape("span", span, (n_freqs, 2))
        expect_shape("reference_amplitude", reference, (n_freqs,))
        if turn in (2, 3):
            msg = f"knot_rad must have 1 or at least 4 functions of phase, got {turn}"
            raise ValueError(msg)
        finite = all(np.isfinite(x).all() for x in (knots, covariance, span, reference))
        if not (finite and (span[:, 0] > 0).all() and (span[:, 1] > span[:, 0]).all()):
            msg = f"wanted finite coefficients and rising positive spans, got {span.tolist()}"
            raise ValueError(msg)
        set_fields(
            self,
            knot_rad=knots,
            covariance_rad2=covariance,
            span=span,
            reference_amplitude=reference,
        )

    @property
    def amplitude_span(self) -> tuple[float, float]:
        """Amplitudes outside which no frequency's error changes any more."""
        return float(self.span[:, 0].min()), float(self.span[:, 1].max())

    def error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Measured minus true phase.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Measured phase, rad.
        amplitude : ndarray, (F, ...)
            Measured amplitude, unit of the phasors.

        Returns
        -------
        ndarray, (F, ...)
            Error, rad.
        """
        phase, level = (np.asarray(x, dtype=np.float64) for x in (phase_rad, amplitude))
        parts = zip(self.knot_rad, level, phase, self.span, strict=True)
        return np.stack([surface(knots, a, p, span) for knots, a, p, span in parts])

    def sigma_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Standard deviation of `error_rad`.

        Parameters
        ----------
        phase_rad, amplitude : ndarray, (F, ...)
            As for `error_rad`.

        Returns
        -------
        ndarray, (F, ...)
            Standard deviation, rad.
        """
        shape = (self.knot_rad.shape[1], self.knot_rad.shape[2])
        out = []
        parts = zip(self.covariance_rad2, amplitude, phase_rad, self.span, strict=True)
        for covariance, level, phase, span in parts:
            rows = design(np.ravel(level), np.ravel(phase), span, shape)
            variance = np.einsum("ni,ij,nj->n", rows, covariance, rows)
            out.append(np.sqrt(np.maximum(variance, 0)).reshape(np.shape(phase)))
        return np.stack(out)

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors without the amplitude error.

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
        check_freqs(self.slot, self.knot_rad.shape[0], phasors)
        values = phasors.values.astype(np.complex128)
        return rotated(phasors, self.error_rad(np.angle(values), np.abs(values)))


def amplitude(captures: Sequence[Capture]) -> Amplitude:
    """Fit the amplitude error of every frequency.

    Parameters
    ----------
    captures : sequence of Capture
        Among them planes of several brightnesses at known distances (gray, wall or rail), corrected
        for lens, response, wiggling, common phase and fixed pattern.

    Returns
    -------
    Amplitude
        The stage; zero where held-out captures show no amplitude error.

    Raises
    ------
    ValueError
        If there are fewer than three captures, they are of one brightness, one is empty or of
        unknown distance, or sensors differ.

    References
    ----------
    M. Lindner, I. Schiller, A. Kolb, R. Koch, "Time-of-Flight sensor calibration for accurate range
    sensing", Computer Vision and Image Understanding 114 (2010) 1318-1328.
    """
    used = picked(captures, "amplitude", ("gray", "wall", "rail"))
    data = samples_of(used)
    fit = fit_surface(data)
    told = all(phasors_of(capture).sigma is not None for capture in used)
    sigma = data.sigma_rad if told else None
    residual = residual_in_mm(
        data.freqs_hz, fit.before_rad, fit.after_rad, fit.held_out_rad, sigma, fit.notes
    )
    spans = np.stack([samples.span for samples in data.samples])
    return Amplitude(fit.knot_rad, fit.covariance_rad2, spans, fit.reference_amplitude, residual)
