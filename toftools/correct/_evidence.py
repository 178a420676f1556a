"""How well a model of the light explains the phasors: residuals across frequencies, pooled.

Phasors freed from indirect light agree on one range at all frequencies; their disagreement,
``chi^2 = sum_f w_f (e_f - e)^2``, e_f the range residuals, ``w_f = (k_f |z_f| / sigma_f)^2``, has
F - 1 degrees of freedom if the model holds. One pixel says little; a window of n says it
with a standard error of ``sqrt(2 (F - 1) / n)``. Reference: textbook goodness of fit. Inputs:
phasors and a range whose wraps are right. Fails with one frequency, which cannot disagree.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from toftools.correct import kernel_input
from toftools.types import C64, F32, F64, Bool, Phasors
from toftools.units import TWO_PI

MOST = 50.0
"""A pixel's chi^2 per degree of freedom counts as no more: no outlier speaks for a window."""
FRAME_SHARE = 0.15
"""Share of a frame's excess residual that a model must explain to be believed."""
WINDOW_SHARE = 0.3
"""The same for a window of a frame that is not convinced as a whole."""
LEAST_NOISE = 1e-4
"""Phase noise counts as no less, rad: calibration is never better."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A range near a given one, and what is left unexplained.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Range, m, with the wraps of the given one; NaN outside the valid pixels.
    chi2 : ndarray, (H, W)
        Residual, F - 1 degrees of freedom.
    sigma_m : ndarray, (H, W)
        Cramer-Rao bound at the amplitudes left, m.
    """

    range_m: F32
    chi2: F32
    sigma_m: F32


def explained(values: C64, sigma: F32, range_m: F32, k: F64, valid: Bool) -> Explained:
    """Range of one return near a given range.

    Parameters
    ----------
    values : ndarray, (F, H, W)
        Phasors, freed from what a model says is indirect.
    sigma : ndarray, (F, H, W)
        Their noise.
    range_m : ndarray, (H, W)
        Range that fixes the wraps, m.
    k : ndarray, (F,)
        Phase per range, rad/m.
    valid : ndarray, (H, W), bool
        Pixels to look at.

    Returns
    -------
    Explained
        The answer.
    """
    shape = range_m.shape
    out = np.empty((3, range_m.size), np.float32)
    _explain(
        kernel_input(values.astype(np.complex64, copy=False)).reshape(k.size, -1),
        kernel_input(sigma.astype(np.float32, copy=False)).reshape(k.size, -1),
        kernel_input(range_m.astype(np.float32, copy=False)).reshape(-1),
        k,
        kernel_input(valid).reshape(-1),
        out,
    )
    return Explained(*out.reshape(3, *shape))


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _explain(values: C64, sigma: F32, range_m: F32, k: F64, valid: Bool, out: F32) -> None:
    """Range, chi^2 and sigma of every pixel."""
    for p in prange(range_m.size):
        out[0, p], out[1, p], out[2, p] = np.nan, 0.0, np.inf
        if not valid[p]:
            continue
        total, first, second = 0.0, 0.0, 0.0  # moments of the range residuals
        for f in range(k.size):
            re, im = float(values[f, p].real), float(values[f, p].imag)
            amplitude = np.sqrt(re * re + im * im)
            if not (amplitude > 0 and sigma[f, p] < np.inf):
                continue
            turns = (np.arctan2(im, re) - k[f] * range_m[p]) / TWO_PI
            off = (turns - np.rint(turns)) * TWO_PI / k[f]
            weight = (k[f] / max(sigma[f, p] / amplitude, LEAST_NOISE)) ** 2
            total += weight
            first += weight * off
            second += weight * off * off
        shift = first / total if total > 0 else 0.0
        out[0, p] = max(range_m[p] + shift, 0.0)
        out[1, p] = max(second - first * shift, 0.0)
        out[2, p] = 1.0 / np.sqrt(total) if total > 0 else np.inf


def noise_of(phasors: Phasors, range_m: F32, k: F64) -> F32:
    """Standard deviation of the phasors: their own, or what neighbouring pixels say.

    Where it is unknown, the disagreement of two frequencies changes from pixel to pixel by noise
    alone wherever light and surface are smooth: the median of its changes is a robust measure, as
    one share of the amplitude for all pixels.

    Parameters
    ----------
    phasors : Phasors
        Measurement.
    range_m : ndarray, (H, W)
        Range with the right wraps in most pixels, m.
    k : ndarray, (F,)
        Phase per range, rad/m.

    Returns
    -------
    ndarray, (F, H, W)
        Noise in the unit of the phasors.
    """
    if phasors.sigma is not None:
        return phasors.sigma
    share = 0.01
    if k.size > 1 and min(range_m.shape) > 2:
        low, high = int(np.argmin(k)), int(np.argmax(k))
        turn = np.exp(-1j * k[:, None, None] * np.nan_to_num(range_m))
        ahead = np.angle(phasors.values * turn)
        gap = np.where(phasors.valid, ahead[high] / k[high] - ahead[low] / k[low], np.nan)
        change = np.abs(np.diff(gap, 2, axis=1))  # its variance is six times that of the gap
        known = change[np.isfinite(change)]
        per_rad = np.sqrt(6 * (1 / k[high] ** 2 + 1 / k[low] ** 2))
        if known.size:
            share = float(np.median(known)) / 0.6745 / per_rad
    return np.asarray(max(share, LEAST_NOISE) * np.abs(phasors.values), np.float32)


def pooled(chi2: F32, valid: Bool, dof: int, *, most: float = MOST) -> tuple[F32, F32]:
    """Mean residual per degree of freedom in a window, and how many pixels spoke.

    The window's side is an eighth of the shorter side of the image, at least 9 px.

    Parameters
    ----------
    chi2 : ndarray, (H, W)
        Residuals.
    valid : ndarray, (H, W), bool
        Pixels that count.
    dof : int
        Degrees of freedom of a pixel.
    most : float
        A pixel counts as no more.

    Returns
    -------
    mean, count : ndarray, (H, W)
        1 is what noise alone would leave.
    """
    import cv2

    side = max(9, 2 * (min(valid.shape) // 16) + 1)
    size = (side, side)
    capped = np.where(valid, np.minimum(chi2 / np.float32(dof), np.float32(most)), 0)
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(capped.astype(np.float32), -1, size, normalize=False, borderType=border)
    count = cv2.boxFilter(valid.astype(np.float32), -1, size, normalize=False, borderType=border)
    return np.asarray(total / np.maximum(count, 1)), np.asarray(count)


def frame_mean(chi2: F32, valid: Bool, dof: int, *, most: float = MOST) -> tuple[float, float]:
    """Mean residual per degree of freedom of a whole frame, and its standard error under noise.

    Parameters
    ----------
    chi2 : ndarray, (H, W)
        Residuals.
    valid : ndarray, (H, W), bool
        Pixels that count.
    dof : int
        Degrees of freedom of a pixel.
    most : float
        A pixel counts as no more.

    Returns
    -------
    mean, error : float
        1 is what noise alone would leave.
    """
    count = max(int(valid.sum()), 1)
    capped = np.minimum(chi2[valid] / np.float32(dof), np.float32(most))
    return float(capped.sum() / count), float(np.sqrt(2 / dof / count))


def explains_more(before: F32, after: F32, usable: Bool, dof: int) -> tuple[Bool, str]:
    """Where a model of the whole frame's light is to be believed.

    Parameters
    ----------
    before, after : ndarray, (H, W)
        Residuals without and with the model.
    usable : ndarray, (H, W), bool
        Pixels that count.
    dof : int
        Degrees of freedom of a pixel.

    Returns
    -------
    believed : ndarray, (H, W), bool
        If the frame is convinced, all windows that do not contradict; else those that are
        convinced by themselves.
    reason : str
        The frame's figures as a sentence.
    """
    # Where all of a frame is far from the model, more than outliers lies beyond `MOST`.
    typical = float(np.median(before[usable])) / dof if usable.any() else 0.0
    most = max(MOST, 3 * typical)
    old, count = pooled(before, usable, dof, most=most)
    new, _ = pooled(after, usable, dof, most=most)
    error = np.sqrt(2 / dof / np.maximum(count, 1))
    whole, whole_error = frame_mean(before, usable, dof, most=most)
    fallen = whole - frame_mean(after, usable, dof, most=most)[0]
    reason = f"mean residual {whole:.2f} falls to {whole - fallen:.2f}, where noise leaves 1"
    if fallen > max(4 * whole_error, FRAME_SHARE * (whole - 1)):
        return np.asarray(new < old + 2 * error), reason
    return np.asarray(old - new > np.maximum(3 * error, WINDOW_SHARE * (old - 1))), reason
