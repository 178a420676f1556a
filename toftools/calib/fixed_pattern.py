"""Fixed-pattern phase noise: a phase offset per pixel and frequency.

``measured = true + map_rad[f, v, u]``, zero on average over the usable pixels, since the constant
is `common_phase`'s. Input: one or more walls (kind ``wall``) at known distances; the cosine of each
ray is applied to the true distance of the plane, never to the measured phase, which would tilt
with the offset that it holds. Similar: TI calibration wizard (github.com/3dtof/calibwizard),
which divides the phase. Walls are averaged with the weights of their noise, robustly from three
on. What no wall can tell: a tilt and a delay that grows across the sensor look alike in metres at
one distance (see `tilt`), and a wall 1 mm off its stated distance bends the map like a bowl, by
0.33 mm from the centre to the corner of a field of view of 82 degrees across the diagonal.
Standard deviations take the lens as exact: of five virtual cameras of 64 x 48 px with a lens from
six views, 25 to 84 % of the pixels lay in their 95 % interval, 87 to 92 % with the true lens.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from toftools._arrays import expect_shape, frozen, set_fields
from toftools.calib import _phase_tilt
from toftools.calib._phase_apply import check_freqs, residual_in_mm, rotated, to_mm
from toftools.calib._phase_errors import Errors, errors_of, picked
from toftools.calib._phase_pixels import TwoWay, two_way
from toftools.calib.stage import Residual
from toftools.conditions import conditions_of
from toftools.types import F64, Bool, Capture, Phasors

MISPLACED_SIGMA, MISPLACED_MM = 4.0, 0.5
"""A wall farther off the others than both is worth a note."""
DISAGREE = 1.3
"""Scatter of pixels over walls relative to noise from which on something else is at work."""


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """A phase offset per pixel and frequency.

    Parameters
    ----------
    map_rad : ndarray, (F, H, W)
        Measured minus true phase, rad; NaN where no wall showed the pixel, which the stage then
        marks invalid: an offset of 0 would be a guess.
    sigma_rad : ndarray, (F, H, W)
        Standard deviation of the map, rad; NaN likewise.
    residual : Residual
        What the fit left, each wall's own mean taken off: where a wall stood is not the pattern's.

    Examples
    --------
    >>> stage = FixedPattern(np.full((1, 1, 2), [0.1, np.nan]), np.full((1, 1, 2), [0.01, np.nan]))
    >>> out = stage(Phasors(np.ones((1, 1, 2))))
    >>> round(float(np.angle(out.values[0, 0, 0])), 4), out.valid.tolist()
    (-0.1, [[True, False]])
    """

    slot: ClassVar[str] = "fixed_pattern"

    map_rad: F64
    sigma_rad: F64
    residual: Residual = field(default_factory=Residual)

    def __post_init__(self) -> None:
        pattern = frozen(self.map_rad, np.float64, "map_rad", 3)
        sigma = frozen(self.sigma_rad, np.float64, "sigma_rad", 3)
        expect_shape("sigma_rad", sigma, pattern.shape)
        if np.isinf(pattern).any() or np.isinf(sigma).any() or (sigma < 0).any():
            msg = "map_rad and sigma_rad must be finite or NaN, and sigma_rad not negative"
            raise ValueError(msg)
        if not np.isfinite(pattern).all(axis=0).any():
            msg = "map_rad holds no pixel that is known at all frequencies"
            raise ValueError(msg)
        set_fields(self, map_rad=pattern, sigma_rad=sigma)

    def error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Measured minus true phase, whatever phase and amplitude.

        Parameters
        ----------
        phase_rad : ndarray, (F, H, W)
            Measured phase, rad.
        amplitude : ndarray, (F, H, W)
            Measured amplitude.

        Returns
        -------
        ndarray, (F, H, W)
            The map, rad; NaN where unknown.
        """
        return self.map_rad

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors without the pattern.

        Parameters
        ----------
        phasors : Phasors
            (F, H, W).

        Returns
        -------
        Phasors
            Turned back; pixels without an offset are invalid.

        Raises
        ------
        ValueError
            If frequencies or image size differ.
        """
        check_freqs(self.slot, self.map_rad.shape[0], phasors)
        expect_shape("phasors for this fixed pattern", phasors.values, self.map_rad.shape)
        return rotated(phasors, self.map_rad)


def fixed_pattern(captures: Sequence[Capture], *, tilt: bool = False) -> FixedPattern:
    """Fit the offset of every pixel.

    Parameters
    ----------
    captures : sequence of Capture
        Among them walls at known distances, corrected for lens, response, wiggling and common
        phase.
    tilt : bool
        Also estimate the normal of the walls, one for all. With walls at distances 1.3 or more
        apart as a ratio it is told from the pattern; at one distance all that looks like a tilt,
        a delay growing across the sensor included, is taken for one, and a note says so.

    Returns
    -------
    FixedPattern
        The stage.

    Raises
    ------
    ValueError
        If there is no wall, one is empty or of unknown distance, or sensors differ.
    """
    used = picked(captures, "fixed_pattern", ("wall",))
    errors, notes = errors_of(used), []
    if tilt:
        _phase_tilt.check_tiltable(used)
        found = _phase_tilt.estimate(used, errors)
        used = _phase_tilt.tilted(used, found.normal)
        errors = errors_of(used)
        notes.append(_about_tilt(found))
    fit = two_way(errors)
    scale = np.maximum(fit.scale, 1) if errors.told else fit.scale
    weight = fit.weight.sum(axis=0)
    known = (weight > 0).all(axis=0)
    with np.errstate(divide="ignore"):
        sigma = np.where(known, scale[:, None, None] / np.sqrt(weight), np.nan)
    pattern = np.where(known, fit.pixel_rad, np.nan)
    notes += [*_placement(used, errors, fit), *_disagreement(errors, fit), *_gaps(known, errors)]
    before = errors.error_rad - fit.capture_rad[:, :, None, None]
    residual = residual_in_mm(
        errors.freqs_hz,
        before,
        before - pattern,
        _left_out(before, fit.weight) if len(used) > 1 else None,
        errors.sigma_rad if errors.told else None,
        notes,
    )
    return FixedPattern(pattern, sigma, residual)


def _left_out(level: F64, weight: F64) -> F64:
    """Error of every capture under the pattern of all others."""
    filled = np.where(np.isfinite(level), level, 0.0)
    others = weight.sum(axis=0) - weight
    sums = (weight * filled).sum(axis=0) - weight * filled
    # What is left of a sum by subtraction is nothing but rounding below a millionth of it.
    seen = others > 1e-6 * weight.sum(axis=0)
    return np.asarray(np.where(seen, level - sums / np.where(seen, others, 1.0), np.nan))


def _about_tilt(found: _phase_tilt.Tilt) -> str:
    across, down = (float(np.degrees(np.arctan(x))) for x in found.normal[:2])
    words = f"walls are tilted by {across:.2f} and {down:.2f} degrees (x, y)"
    if found.separated:
        return f"{words}, +- {found.sigma_deg:.2f} by noise"
    return (
        f"{words}, if the sensor has no delay that grows across it: walls at one distance cannot "
        "tell these apart; add a wall at another distance and the same tilt"
    )


def _disagreement(errors: Errors, fit: TwoWay) -> list[str]:
    worst = float(fit.scale.max())
    if not errors.told or worst < DISAGREE:
        return []
    return [
        f"pixels differ from wall to wall by {worst:.1f} times their noise: tilted walls (try "
        "tilt=true), or an error of lens, wiggling or amplitude is left"
    ]


def _gaps(known: Bool, errors: Errors) -> list[str]:
    notes = []
    missing = int((~known).sum())
    if missing:
        notes.append(f"{missing} pixels were never usable; the stage marks them invalid")
    if len(errors.names) == 1:
        notes.append("one wall only: its noise is in the map, and nothing is held out")
    if not errors.told:
        how = "from their scatter" if len(errors.names) > 1 else "from differences of neighbours"
        notes.append(f"phasors carry no sigma: noise is guessed {how}")
    return notes


def _placement(used: Sequence[Capture], errors: Errors, fit: TwoWay) -> list[str]:
    """Sentences about walls that stood elsewhere than told."""
    if len(used) < 2:
        return []
    off_mm = to_mm(fit.capture_rad, errors.freqs_hz)  # (K, F)
    counts = np.isfinite(errors.error_rad).sum(axis=(2, 3))
    noise_mm = to_mm(np.sqrt(np.nansum(errors.sigma_rad**2, axis=(2, 3))) / counts, errors.freqs_hz)
    weight = 1 / noise_mm**2
    off = (weight * off_mm).sum(axis=1) / weight.sum(axis=1)
    noise = 1 / np.sqrt(weight.sum(axis=1))
    if len(used) == 2:
        gap, limit = abs(float(off[1] - off[0])), MISPLACED_SIGMA * float(np.hypot(*noise))
        if gap <= max(limit, MISPLACED_MM):
            return []
        return [
            f"{errors.names[0]} and {errors.names[1]} differ by {gap:.1f} mm: one stood elsewhere "
            "than told, or wiggling is left"
        ]
    middle = float(np.median(off))
    bad = np.abs(off - middle) > np.maximum(MISPLACED_SIGMA * noise, MISPLACED_MM)
    if 2 * bad.sum() >= len(used):
        low, high = errors.names[int(off.argmin())], errors.names[int(off.argmax())]
        return [
            f"walls disagree by up to {np.ptp(off):.1f} mm ({high} against {low}): their distances "
            "are wrong, or an error of lens, wiggling or amplitude is left"
        ]
    return [
        f"{errors.names[k]} reads {off[k] - middle:+.1f} mm against the other walls: its distance "
        f"of {conditions_of(used[k]).distance_m:g} m is wrong, it moved, or wiggling is left"
        for k in map(int, np.flatnonzero(bad))
    ]
