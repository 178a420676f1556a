"""Temperature drift: a phase per frequency that is linear in the temperatures of sensor and light.

``measured = true + slope[f, 0] (T_sensor - R_sensor) + slope[f, 1] (T_light - R_light)``, 0 at the
reference R: the temperatures at which common phase was measured. Linear in both as in the TI
calibration wizard (github.com/3dtof/calibwizard). Input: frames of kind ``warmup`` of a
target that stands still, with their temperatures; walls that say theirs fix the reference. Each
frame counts by the mean over its pixels, so where the target stood does not matter. It fails
where the diode follows neither sensor: a lag shows as residuals that follow the order of the
frames, and a note says so (a wave of 10 mrad beside a drift of 30 mrad left 2.4 mm of 3.8 mm).
Temperatures that rise together, apart by less than 0.2 K rms about a line, are fitted as one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from toftools._arrays import expect_shape, frozen, set_fields
from toftools.calib._phase_apply import check_freqs, rad_per_mm, residual_in_mm, rotated
from toftools.calib._phase_drift import Drift, fitted
from toftools.calib._phase_errors import picked
from toftools.calib._phase_frames import WHICH, frames_of
from toftools.calib.stage import Residual
from toftools.conditions import conditions_of
from toftools.phasor import phasors_of
from toftools.types import F64, Capture, Phasors

BEYOND_K = 1.0
"""Temperatures farther outside those of the fit than this are extrapolation, K."""
LAGGED = 0.5
"""Correlation of residuals of neighbouring frames from which on they follow the order."""
LEAST_LAG_MM = 0.1


@dataclass(frozen=True, eq=False)
class Temperature:
    """Linear drift per frequency, at temperatures yet to be set or set.

    Parameters
    ----------
    slope_rad_per_k, sigma_rad_per_k : ndarray, (F, 2)
        Drift with the temperatures of sensor and light, rad/K, and its standard deviation; that of
        a temperature without use is 0 with a standard deviation of 0.
    reference_c : ndarray, (2,)
        Temperatures without drift, degrees Celsius; NaN for one without use.
    span_c : ndarray, (2, 2)
        Lowest and highest sensor temperature of the fit, then those of the light; NaN likewise.
    needs : tuple of str
        Temperatures that the stage needs: of ``sensor_c`` and ``light_c``.
    sensor_c, light_c : float
        Temperatures to correct for; NaN where not set, see `at`.
    residual : Residual
        What the fit left of the means of frames, the offset of each target taken off.

    Examples
    --------
    >>> drift = Temperature([[2e-3, 0]], [[1e-5, 0]], [25, np.nan], [[20, 40], [np.nan] * 2],
    ...                     ("sensor_c",))
    >>> z = Phasors(np.full((1, 1, 1), np.exp(1.52j)))
    >>> round(float(np.angle(drift.at(sensor_c=35.0)(z).values[0, 0, 0])), 4)
    1.5
    """

    slot: ClassVar[str] = "temperature"

    slope_rad_per_k: F64
    sigma_rad_per_k: F64
    reference_c: F64
    span_c: F64
    needs: tuple[str, ...] = WHICH
    sensor_c: float = math.nan
    light_c: float = math.nan
    residual: Residual = field(default_factory=Residual)

    def __post_init__(self) -> None:
        slope = frozen(self.slope_rad_per_k, np.float64, "slope_rad_per_k", 2)
        sigma = frozen(self.sigma_rad_per_k, np.float64, "sigma_rad_per_k", 2)
        reference = frozen(self.reference_c, np.float64, "reference_c", 1)
        span = frozen(self.span_c, np.float64, "span_c", 2)
        expect_shape("slope_rad_per_k", slope, (slope.shape[0], 2))
        expect_shape("sigma_rad_per_k", sigma, slope.shape)
        expect_shape("reference_c", reference, (2,))
        expect_shape("span_c", span, (2, 2))
        if not set(self.needs) <= set(WHICH):
            msg = f"needs must name {' and '.join(WHICH)} or less, got {self.needs}"
            raise ValueError(msg)
        needed = np.array([name in self.needs for name in WHICH])
        known = np.isfinite(reference[needed]).all() and not slope[:, ~needed].any()
        if not (np.isfinite(slope).all() and (sigma >= 0).all() and known):
            msg = (
                "slopes must be finite, 0 for a temperature without use, sigma not negative, and "
                f"the reference known; got {slope.tolist()}, {reference.tolist()}"
            )
            raise ValueError(msg)
        set_fields(
            self,
            slope_rad_per_k=slope,
            sigma_rad_per_k=sigma,
            reference_c=reference,
            span_c=span,
            needs=tuple(self.needs),
            sensor_c=float(self.sensor_c),
            light_c=float(self.light_c),
        )

    def at(self, *, sensor_c: float = math.nan, light_c: float = math.nan) -> "Temperature":
        """The stage for frames at given temperatures.

        Parameters
        ----------
        sensor_c, light_c : float
            Temperatures, degrees Celsius; those that are not among `needs` do not matter.

        Returns
        -------
        Temperature
            Ready to be called; a note of its residual says where the fit is extrapolated.

        Raises
        ------
        ValueError
            If a temperature that the stage needs is missing.
        """
        given = {"sensor_c": float(sensor_c), "light_c": float(light_c)}
        self._check(given)
        notes = list(self.residual.notes)
        for name, (low, high) in zip(WHICH, self.span_c, strict=True):
            value = given[name]
            if name in self.needs and not low - BEYOND_K <= value <= high + BEYOND_K:
                notes.append(
                    f"{name} of {value:.1f} lies outside the {low:.1f} to {high:.1f} degrees of "
                    "the warm-up: the drift there is extrapolated"
                )
        return replace(
            self,
            sensor_c=given["sensor_c"],
            light_c=given["light_c"],
            residual=replace(self.residual, notes=tuple(notes)),
        )

    def _check(self, given: dict[str, float]) -> None:
        missing = [name for name in self.needs if not math.isfinite(given[name])]
        if missing:
            msg = f"the temperature stage needs {' and '.join(missing)}; set them with at()"
            raise ValueError(msg)

    def error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Measured minus true phase at the temperatures that are set.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Measured phase, rad.
        amplitude : ndarray, (F, ...)
            Measured amplitude.

        Returns
        -------
        ndarray, (F, 1, ...)
            Drift per frequency, rad.

        Raises
        ------
        ValueError
            If a temperature that the stage needs is not set.
        """
        given = {"sensor_c": self.sensor_c, "light_c": self.light_c}
        self._check(given)
        needed = np.array([name in self.needs for name in WHICH])
        above = np.where(needed, np.array(list(given.values())) - self.reference_c, 0.0)
        drift = self.slope_rad_per_k @ above
        return np.asarray(drift.reshape(-1, *(1,) * (np.ndim(phase_rad) - 1)))

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors without the drift.

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
            If a temperature is missing, or the number of frequencies differs.
        """
        check_freqs(self.slot, self.slope_rad_per_k.shape[0], phasors)
        nothing = np.zeros((1, 1, 1))
        return rotated(phasors, self.error_rad(nothing, nothing))


def temperature(captures: Sequence[Capture]) -> Temperature:
    """Fit the drift of every frequency.

    Parameters
    ----------
    captures : sequence of Capture
        Among them frames of a warm-up in the order of time, with temperatures; walls, or else rail
        positions, whose temperatures are the reference.

    Returns
    -------
    Temperature
        The stage, temperatures not set. It uses no more temperatures than held-out parts of the
        warm-up ask for, perhaps none.

    Raises
    ------
    ValueError
        If there are fewer than four frames, they span less than 2 K, one does not say a temperature
        that others say, or one is empty or of unknown distance.
    """
    used = picked(captures, "temperature", ("warmup",))
    frames = frames_of(used)
    told = all(phasors_of(capture).sigma is not None for capture in used)
    drift = fitted(frames)
    reference, about = _reference(captures, drift, frames.celsius)
    needed = np.array([name in drift.needs for name in WHICH])
    span = np.stack([frames.celsius.min(axis=0), frames.celsius.max(axis=0)], axis=1)
    residual = residual_in_mm(
        frames.freqs_hz,
        drift.before_rad,
        drift.after_rad,
        drift.held_out_rad,
        frames.sigma_rad if told else None,
        [*drift.notes, *about, *_lag(drift, frames.freqs_hz)],
    )
    return Temperature(
        drift.slope,
        drift.sigma,
        np.where(needed, reference, np.nan),
        np.where(needed[:, None], span, np.nan),
        drift.needs,
        residual=residual,
    )


def _reference(
    captures: Sequence[Capture], drift: Drift, celsius: F64
) -> tuple[F64, tuple[str, ...]]:
    """Temperatures at which common phase was measured, and what to know about them."""
    if not drift.needs:
        return np.full(2, np.nan), ()
    told = [conditions_of(capture) for capture in captures]
    for kind in ("wall", "rail"):
        rows = np.array([[c.sensor_c, c.light_c] for c in told if c.kind == kind]).reshape(-1, 2)
        columns = [WHICH.index(name) for name in drift.needs]
        warm = rows[np.isfinite(rows[:, columns]).all(axis=1)]
        if warm.size:
            known = np.isfinite(warm)
            sums = np.where(known, warm, 0).sum(axis=0)
            return np.where(known.any(axis=0), sums / np.maximum(known.sum(axis=0), 1), np.nan), ()
        if rows.size:
            break
    least = int(np.argmin((drift.level_rad**2).sum(axis=1)))
    return celsius[least], (
        f"no wall says its {' and '.join(drift.needs)}: the reference is that of the frame of the "
        "warm-up that reads least wrong, so a misplaced target shifts it",
    )


def _lag(drift: Drift, freqs_hz: F64) -> list[str]:
    """A sentence where residuals follow the order of the frames."""
    size_mm = float(np.sqrt(np.nanmean((drift.after_rad / rad_per_mm(freqs_hz)) ** 2)))
    if drift.correlation < LAGGED or size_mm < LEAST_LAG_MM:
        return []
    return [
        f"residuals of {size_mm:.2f} mm follow the order of the frames (correlation of neighbours "
        f"{drift.correlation:.2f}): hysteresis, or a part that no sensor watches; standard "
        "deviations allow for it only roughly"
    ]
