"""Bad pixels, residuals and notes of the response stage."""

import itertools
from collections.abc import Sequence

import numpy as np

from toftools.calib._response_data import Level
from toftools.calib._response_fit import (
    Curve,
    curve_values,
    fit_curve,
    fit_gain,
    linear_moment,
)
from toftools.calib._response_noise import Transfer
from toftools.calib.stage import Residual
from toftools.types import F64, Bool

HOT, DEAD, NOISY = 1, 2, 4
DEAD_SHARE = 0.2
"""A pixel that answers to less than this share of the light its neighbours see is dead."""
SHADING_DEGREE = 4
UNEVEN = 0.02
"""Shading of the flats from which on a note says so."""
MAD = 1.4826
"""Standard deviation of a normal law over its median absolute deviation."""


def rough_good(dark: Sequence[Level], lit: Sequence[Level]) -> Bool:
    """Pixels that are not plainly hot or dead, for averages.

    Parameters
    ----------
    dark, lit : sequence of Level
        Levels.

    Returns
    -------
    ndarray, (H, W), bool
        True where a pixel may be averaged.
    """
    level = np.mean([x.moments[0] for x in dark], axis=0)
    far = np.abs(level - np.median(level, axis=(1, 2), keepdims=True))
    spread = MAD * np.median(far, axis=(1, 2), keepdims=True)
    signal = lit[-1].moments[0] - level
    usual = np.median(signal[:, lit[-1].ok], axis=-1)[:, None, None]
    fine = (far <= np.maximum(10 * spread, 0.01 * usual)) & (signal > 0.3 * usual)
    return np.asarray(fine.all(axis=0))


def bad_pixels(
    offset: F64, light: F64, noisy: Bool, floor: float, z_bad: float
) -> tuple[np.ndarray, float]:
    """Hot, dead and noisy pixels, and how unevenly the flats were lit.

    Parameters
    ----------
    offset, light : ndarray, (N, H, W)
        Dark level and response of every node.
    noisy : ndarray, (H, W), bool
        From photon transfer.
    floor : float
        Standard deviation of `offset` by noise: no spread counts as less.
    z_bad : float
        Robust standard deviations beyond which a pixel is bad.

    Returns
    -------
    tuple of ndarray (H, W) and float
        Sum of 1 hot, 2 dead, 4 noisy; and relative standard deviation of the smooth part of the
        response.
    """
    bad = NOISY * noisy.astype(np.int64)
    shading = 0.0
    for level, answer in zip(offset, light, strict=True):
        bad |= HOT * (np.abs(_z(level, floor)) > z_bad)
        usable = np.isfinite(answer) & (answer > 0)
        smooth = _smooth(answer, usable)
        ratio = np.where(usable, answer, 0.0) / smooth
        bad |= DEAD * (~usable | (ratio < DEAD_SHARE) | (np.abs(_z(ratio, 1e-6)) > z_bad))
        shading = max(shading, float(smooth.std() / smooth.mean()))
    return bad, shading


def _z(image: F64, floor: float) -> F64:
    centred = image - np.median(image)
    return np.asarray(centred / max(MAD * float(np.median(np.abs(centred))), floor, 1e-12))


def _smooth(image: F64, usable: Bool) -> F64:
    """Polynomial over the image without outliers; the median if it is not positive all over."""
    height, width = image.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    powers = [(i, j) for i, j in itertools.product(range(SHADING_DEGREE + 1), repeat=2)
              if i + j <= SHADING_DEGREE]  # fmt: skip
    basis = np.stack([x**i * y**j for i, j in powers], axis=-1)
    use, usual = usable.copy(), float(np.median(image[usable])) if usable.any() else 1.0
    use &= np.abs(np.where(usable, image, 0.0) - usual) < 0.9 * usual
    fitted = np.full(image.shape, usual)
    for _ in range(4):
        if use.sum() < 4 * len(powers):
            break
        fitted = basis @ np.linalg.lstsq(basis[use], image[use], rcond=None)[0]
        far = np.abs(np.where(usable, image, 0.0) - fitted)
        use = usable & (far < 5 * MAD * max(float(np.median(far[use])), 1e-12))
    return np.asarray(fitted if (fitted > 0).all() else np.full(image.shape, usual))


def residual_of(
    levels: tuple[Sequence[Level], Sequence[Level]],
    curve: Curve,
    good: Bool,
    found: Transfer,
    top: float,
    notes: tuple[str, ...],
) -> Residual:
    """Relative error of the levels of flats, pixel by pixel.

    Parameters
    ----------
    levels : tuple of two sequences of Level
        Darks and flats.
    curve : Curve
        Curve.
    good : ndarray, (H, W), bool
        Pixels that are not bad.
    found : Transfer
        Noise.
    top : float
        Unit of the levels.
    notes : tuple of str
        Notes.

    Returns
    -------
    Residual
        In %: before, taps less the mean dark level on one straight line for all pixels; after, with
        this stage; held out, exposures that neither curve nor gain saw.
    """
    dark, lit = levels
    offset, light = fit_gain(dark, lit, curve.terms)[:2]
    flat = np.full(offset.shape, np.median(offset))
    raw = [np.median((x.moments[0] - flat)[:, x.ok & good]) for x in lit]
    e = np.array([x.exposure for x in lit])
    line = float((np.array(raw) / e).mean())
    before, after, held_out, noise = [], [], [], []
    for level in lit:
        use = level.ok & good
        before.append((level.moments[0] - flat)[:, use] / (line * level.exposure) - 1)
        after.append(_relative(level, curve.terms, offset, light, use))
        signal = top * np.median(light[:, use]) * level.exposure
        variance = max(found.variance + found.gain * signal, 0.0)
        noise.append(variance * offset.shape[0] / (level.n_taps * signal**2))
        others = [x for x in lit if x.exposure != level.exposure]
        if others:
            terms = fit_curve(dark, others, good).terms
            held_out.append(_relative(level, terms, *fit_gain(dark, others, terms)[:2], use))
    spread = 100 * float(np.sqrt(np.mean(noise)))
    n = sum(x.size for x in after)
    return Residual("%", _rms(before), _rms(after), _rms(held_out), spread, n, notes)


def _relative(level: Level, terms: F64, offset: F64, light: F64, use: Bool) -> F64:
    signal = (linear_moment(level.moments, terms) - offset)[:, use]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(signal / (light[:, use] * level.exposure) - 1)


def _rms(errors: Sequence[F64]) -> float:
    if not errors:
        return float("nan")
    flat = np.concatenate([x.ravel() for x in errors])
    return 100 * float(np.sqrt(np.mean(flat[np.isfinite(flat)] ** 2)))


def noted(
    bad: np.ndarray, shading: float, curve: Curve, lit: Sequence[Level], found: Transfer
) -> tuple[str, ...]:
    """What a user should know about the fit, a sentence each.

    Parameters
    ----------
    bad : ndarray, (H, W)
        Bad pixels.
    shading : float
        Unevenness of the light.
    curve : Curve
        Curve.
    lit : sequence of Level
        Flats.
    found : Transfer
        Noise.

    Returns
    -------
    tuple of str
        Notes.
    """
    counts = [int(((bad & bit) > 0).sum()) for bit in (HOT, DEAD, NOISY)]
    share = float((bad > 0).mean())
    notes = [
        f"{int((bad > 0).sum())} of {bad.size} pixels ({share:.2%}) are bad: {counts[0]} hot, "
        f"{counts[1]} dead or of odd gain, {counts[2]} noisy."
    ]
    exposures = len({x.exposure for x in lit})
    if curve.terms.size:
        at = np.linspace(0, 1, 101)
        bend = float(np.abs(curve_values(curve.terms, at) - at).max())
        notes.append(f"Taps bend by up to {bend:.2%} of the brightest flat; beyond it the curve "
                     "goes on straight.")  # fmt: skip
    elif exposures < 4:
        notes.append(f"Linearity was not examined: flats have {exposures} exposures, wanted four.")
    else:
        notes.append("Taps are straight: no curve predicts held-out exposures better.")
    if shading > UNEVEN:
        notes.append(f"The flats are lit unevenly: {shading:.1%} of smooth shading is in the gain.")
    if np.isnan(found.gain):
        notes.append("Conversion gain unknown: take two flats of one exposure, or flats in light "
                     "that is not modulated.")  # fmt: skip
    return tuple(notes)
