"""Outlying views and corners of a lens calibration, and the size of its distortion model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toftools._arrays import F64
from toftools.calib._lens_fit import MAD, Fit, fit_camera, fit_poses, refit
from toftools.calib._lens_model import Corners
from toftools.camera import rays
from toftools.types import Camera

FOCALS = (0.5, 0.8, 1.3, 2.5)
"""Focal lengths to start from, in image widths."""
WORSE = 3.0
"""A view whose error is so many times the median of all views is left out."""
FAR = 6.0
"""A corner so many standard deviations off is left out."""
TINY = 1e-12
FOLDED = 1.2
"""Held-out error, relative to the best, at which a model that does not turn back is preferred."""
SPOILT = 0.3
"""A view that loses a larger share of its corners is left out whole."""


@dataclass(frozen=True, eq=False)
class Kept:
    """What is left of the views after the outliers are gone, and the fit to it."""

    views: tuple[Corners, ...]
    fit: Fit
    rejected: tuple[str, ...]
    dropped: int


@dataclass(frozen=True, eq=False)
class Trial:
    """A distortion model: its fit and its error in views that its fit has not seen."""

    terms: int
    fit: Fit
    loss: F64  # (V,) mean squared error per held-out view, px^2
    counts: F64  # (V,) corners
    folds: bool  # the polynomial turns back within the image

    @property
    def held_out_px(self) -> float:
        """Root mean square length of the held-out errors, px."""
        return math.sqrt(float((self.loss * self.counts).sum() / self.counts.sum()))

    @property
    def typical_px(self) -> float:
        """Geometric mean over views of the held-out errors, which no single view rules, px."""
        return math.exp(0.5 * float(np.log(self.loss + TINY).mean()))


def resized(camera: Camera, terms: int) -> Camera:
    """The camera with more or fewer distortion coefficients.

    Parameters
    ----------
    camera : Camera
        Camera.
    terms : int
        How many; new ones are 0.

    Returns
    -------
    Camera
        Camera.
    """
    dist = np.zeros(terms)
    kept = min(terms, camera.dist.size)
    dist[:kept] = camera.dist[:kept]
    return replace(camera, dist=dist)


def starts(nominal: Camera | None, shape: tuple[int, int], model: str) -> list[Camera]:
    """Cameras to start from: the nominal one if it is sensible, and common focal lengths.

    Parameters
    ----------
    nominal : Camera or None
        What the capture says.
    shape : tuple of int
        Height and width of the image, px.
    model : {"pinhole", "fisheye"}
        Lens model.

    Returns
    -------
    list of Camera
        Four coefficients each, all 0.
    """
    height, width = shape
    matrices = []
    for focal in FOCALS:
        f = focal * max(width, height)
        matrices.append([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
    if nominal is not None:
        K = nominal.K
        near = 0 < K[0, 2] < width and 0 < K[1, 2] < height
        if near and 0.2 * width < K[0, 0] < 10 * width:
            matrices.insert(0, [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    return [Camera(width, height, np.array(K, float), np.zeros(4), model) for K in matrices]


def without_outliers(views: Sequence[Corners], cameras: Sequence[Camera], terms: int) -> Kept:
    """The fit that most corners agree on, and the views that do not.

    Parameters
    ----------
    views : sequence of Corners
        All views.
    cameras : sequence of Camera
        Where to start.
    terms : int
        Distortion coefficients.

    Returns
    -------
    Kept
        Views without outliers and their least-squares fit.
    """
    tried = [fit_camera(views, camera, robust=True) for camera in cameras]
    robust = [float(np.median(np.concatenate([np.abs(e) for e in fit.errors]))) for fit in tried]
    first = tried[int(np.argmin(robust))].camera
    kept, rejected = list(views), []
    fit = fit_camera(kept, resized(first, terms), robust=True)
    for _ in range(3):
        rms = np.array([math.sqrt(float(np.median((e**2).sum(axis=1)))) for e in fit.errors])
        limit = WORSE * float(np.median(rms)) + 1e-3
        spread = MAD * float(np.median(np.abs(np.concatenate(fit.errors)))) + 1e-3
        inliers = [(np.abs(e) < FAR * spread).all(axis=1) for e in fit.errors]
        bad = [
            r > limit or good.mean() < 1 - SPOILT or good.sum() < 6
            for r, good in zip(rms, inliers, strict=True)
        ]
        if not any(bad):
            break
        rejected += [view.name for view, out in zip(kept, bad, strict=True) if out]
        kept = [view for view, out in zip(kept, bad, strict=True) if not out]
        if len(kept) < 3:
            break
        fit = fit_camera(kept, fit.camera, robust=True)
        inliers = [np.ones(len(view.pixels), bool) for view in kept]
    thinned = [
        Corners(view.name, view.points[good], view.pixels[good])
        for view, good in zip(kept, inliers, strict=True)
    ]
    dropped = sum(len(v.pixels) for v in kept) - sum(len(v.pixels) for v in thinned)
    if len(kept) >= 3:
        fit = refit(thinned, fit)
    return Kept(tuple(thinned), fit, tuple(rejected), dropped)


def trial(views: Sequence[Corners], near: Fit, terms: int, folds: int) -> Trial:
    """One distortion model, scored on views that its fit did not see (by their pose alone).

    Parameters
    ----------
    views : sequence of Corners
        Views without outliers.
    near : Fit
        Solution to start from.
    terms : int
        Distortion coefficients.
    folds : int
        Parts that are held out in turn.

    Returns
    -------
    Trial
        Fit to all views, and losses.
    """
    fit = refit(views, Fit(resized(near.camera, terms), near.poses, near.errors))
    loss = np.full(len(views), np.inf)
    for part in range(min(folds, len(views))):
        out = np.arange(len(views)) % folds == part
        seen = [i for i in range(len(views)) if not out[i]]
        poses = tuple(fit.poses[i] for i in seen)
        errors = tuple(fit.errors[i] for i in seen)
        fold = refit([views[i] for i in seen], Fit(fit.camera, poses, errors))
        scored = fit_poses(
            [view for view, held in zip(views, out, strict=True) if held], fold.camera
        )
        loss[out] = scored.view_rms() ** 2
    counts = np.array([len(view.pixels) for view in views], dtype=np.float64)
    folded = bool(np.isnan(rays(fit.camera)).any())
    return Trial(terms, fit, loss, counts, folded)


def chosen(trials: Sequence[Trial]) -> Trial:
    """The smallest model that the best does not beat by more than two standard errors.

    Compared is the logarithm of the error of each held-out view, view by view, so that what makes a
    view hard for all models cancels and no single view rules; two standard errors, because by one a
    superfluous model wins in every sixth case. Models that turn back within the image are taken
    only if all others are clearly worse.

    Parameters
    ----------
    trials : sequence of Trial
        Models from the smallest to the largest.

    Returns
    -------
    Trial
        The choice.
    """
    sound = [t for t in trials if np.isfinite(t.loss).all()] or list(trials)
    best = min(sound, key=lambda t: t.typical_px)
    whole = [t for t in sound if not t.folds and t.typical_px < FOLDED * best.typical_px]
    if whole:
        sound, best = whole, min(whole, key=lambda t: t.typical_px)
    for candidate in sound:
        worse = np.log(candidate.loss + TINY) - np.log(best.loss + TINY)
        error = float(np.std(worse, ddof=1)) / math.sqrt(len(worse))
        if candidate is best or float(np.mean(worse)) <= 2 * error:
            return candidate
    return best
