"""Bundle adjustment of one camera over views of a flat board, with honest covariances.

Model: corner = project(theta, R(pose) X + t) + noise, theta = (fx, fy, cx, cy, distortion). All
poses and theta are solved together by Levenberg-Marquardt; the poses are eliminated by the Schur
complement, whose inverse times the variance of the residuals is the covariance of theta. Jacobians
are OpenCV's. Reference: Z. Zhang, A flexible new technique for camera calibration, PAMI 22(11),
2000; B. Triggs et al., Bundle adjustment, a modern synthesis, 2000.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools._arrays import F64
from toftools.calib._lens_model import Corners as Corners
from toftools.calib._lens_model import first_pose, projected, unknowns, with_unknowns
from toftools.types import Camera

HUBER = 2.0
"""Residuals beyond so many standard deviations count linearly in a robust fit."""
STEPS = 60
MAD = 1.4826  # standard deviation of a normal variable whose median absolute value is 1


@dataclass(frozen=True, eq=False)
class Fit:
    """A camera, the pose of the board in every view (rotation vector, metres), and the errors."""

    camera: Camera
    poses: tuple[F64, ...]  # each (6,)
    errors: tuple[F64, ...]  # each (N, 2), measured minus modelled, px

    @property
    def cost(self) -> float:
        """Sum of all squared errors, px^2."""
        return float(sum((e**2).sum() for e in self.errors))

    @property
    def rms_px(self) -> float:
        """Root mean square length of the errors, as OpenCV counts it, px."""
        return math.sqrt(self.cost / max(sum(len(e) for e in self.errors), 1))

    def view_rms(self) -> F64:
        """The same per view, (V,)."""
        return np.array([math.sqrt((e**2).sum() / len(e)) for e in self.errors])


def fit_camera(views: Sequence[Corners], start: Camera, *, robust: bool = False) -> Fit:
    """Camera and poses that explain all corners best.

    Parameters
    ----------
    views : sequence of Corners
        Views of the board.
    start : Camera
        Where to start; its distortion says how many coefficients to fit.
    robust : bool
        True counts large errors linearly (Huber).

    Returns
    -------
    Fit
        The solution.
    """
    return _adjusted(views, start, [first_pose(start, v) for v in views], robust=robust, free=True)


def refit(views: Sequence[Corners], fit: Fit) -> Fit:
    """The least-squares fit from a solution nearby.

    Parameters
    ----------
    views : sequence of Corners
        Views of the board.
    fit : Fit
        Solution with a pose for each of them.

    Returns
    -------
    Fit
        The solution.
    """
    return _adjusted(views, fit.camera, list(fit.poses), robust=False, free=True)


def fit_poses(views: Sequence[Corners], camera: Camera) -> Fit:
    """Poses that explain the corners of a known camera best.

    Parameters
    ----------
    views : sequence of Corners
        Views of the board.
    camera : Camera
        Camera, which stays as it is.

    Returns
    -------
    Fit
        Camera, poses and errors.
    """
    alone = [
        _adjusted([view], camera, [first_pose(camera, view)], robust=False, free=False)
        for view in views
    ]
    return Fit(camera, tuple(f.poses[0] for f in alone), tuple(f.errors[0] for f in alone))


def _adjusted(
    views: Sequence[Corners], camera: Camera, poses: list[F64], *, robust: bool, free: bool
) -> Fit:
    damping, last = 1e-3, math.inf
    now = _linearised(camera, poses, views, robust)
    for _ in range(STEPS):
        step, turns = _step(now, damping, free)
        moved = [pose + turn for pose, turn in zip(poses, turns, strict=True)]
        theta = unknowns(camera) + step
        if not np.isfinite(theta).all() or min(theta[:2]) <= 0:
            damping *= 10
            continue
        trial = with_unknowns(camera, theta) if free else camera
        then = _linearised(trial, moved, views, robust, now.scale if robust else 0.0)
        if then.cost <= now.cost:
            last, camera, poses = now.cost - then.cost, trial, moved
            now, damping = then, max(damping / 10, 1e-12)
            if last <= 1e-10 * max(now.cost, 1e-12):
                break
        else:
            damping *= 10
            if damping > 1e12:
                break
    return Fit(camera, tuple(poses), tuple(now.errors))


@dataclass(frozen=True, eq=False)
class Linear:
    """A fit and its normal equations: a tuple of five blocks per view.

    Blocks are camera by camera, camera by pose, pose by pose, camera by error, pose by error.
    """

    errors: list[F64]
    blocks: Sequence[tuple[F64, ...]]
    cost: float
    scale: float


def _linearised(
    camera: Camera, poses: Sequence[F64], views: Sequence[Corners], robust: bool, scale: float = 0.0
) -> Linear:
    """Normal equations at a camera and poses; `scale` is the deviation a robust fit clips at."""
    parts = [projected(camera, pose, v.points) for pose, v in zip(poses, views, strict=True)]
    errors = [v.pixels - part[0] for v, part in zip(views, parts, strict=True)]
    if robust and not scale:
        scale = max(MAD * float(np.median(np.abs(np.concatenate(errors)))), 1e-4)
    blocks, cost = [], 0.0
    for error, (_, by_camera, by_pose) in zip(errors, parts, strict=True):
        flat, weight = error.ravel(), np.ones(error.size)
        if robust:
            limit, size = HUBER * scale, np.abs(error.ravel())
            weight = np.minimum(1.0, limit / np.maximum(size, 1e-12))
            cost += float(np.where(size <= limit, size**2, limit * (2 * size - limit)).sum())
        else:
            cost += float(flat @ flat)
        g, p = (by_camera * weight[:, None]).T, (by_pose * weight[:, None]).T
        blocks.append((g @ by_camera, g @ by_pose, p @ by_pose, g @ flat, p @ flat))
    return Linear(errors, blocks, cost if math.isfinite(cost) else math.inf, scale)


def _step(now: Linear, damping: float, free: bool) -> tuple[F64, list[F64]]:
    """Damped step of the camera and of every pose."""
    cc, cp, pp, ce, pe = (list(block) for block in zip(*now.blocks, strict=True))
    pp = [m + damping * np.diag(np.diag(m)) for m in pp]
    theta = np.zeros(len(ce[0]))
    if free:
        total, right = np.sum(cc, axis=0), np.sum(ce, axis=0)
        total[np.diag_indices(theta.size)] *= 1 + damping
        for across, own, error in zip(cp, pp, pe, strict=True):
            total -= across @ _solved(own, across.T)
            right -= across @ _solved(own, error)
        theta = _solved(total, right)
    turns = zip(pp, pe, cp, strict=True)
    return theta, [_solved(own, error - across.T @ theta) for own, error, across in turns]


def _solved(matrix: F64, right: F64) -> F64:
    """Solution of a symmetric system, its unknowns brought to one size first."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(size, size)
    sides = size[:, None] if right.ndim == 2 else size
    try:
        return np.asarray(np.linalg.solve(scaled, right / sides) / sides)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(scaled, right / sides, rcond=None)[0] / sides)


def covariance(fit: Fit, views: Sequence[Corners], extra: Sequence[F64] = ()) -> tuple[F64, F64]:
    """How well a least-squares fit knows its camera, and further global unknowns at 0.

    Parameters
    ----------
    fit : Fit
        Least-squares solution.
    views : sequence of Corners
        Its data.
    extra : sequence of ndarray (2 N, M)
        Derivatives of every view by further unknowns, such as the bend of the board.

    Returns
    -------
    step : ndarray, (4 + n + M,)
        Where one more Gauss-Newton step would put camera (as a difference) and further unknowns.
    covariance : ndarray, (4 + n + M, 4 + n + M)
        Covariance of all of them, poses unknown, by the scatter of the residuals; scaled up where
        the views scatter more than their corners say, as they do if errors within a view agree.
    """
    squares, pulls = [], []
    for i, (pose, view) in enumerate(zip(fit.poses, views, strict=True)):
        _, by_camera, by_pose = projected(fit.camera, pose, view.points)
        by = np.hstack([by_camera, extra[i]]) if len(extra) else by_camera
        error = fit.errors[i].ravel()
        # What the pose cannot explain.
        basis, _ = np.linalg.qr(by_pose)
        rest = by - basis @ (basis.T @ by)
        squares.append(rest.T @ rest)
        pulls.append(rest.T @ error)
    schur = np.sum(squares, axis=0)
    size = np.sqrt(np.maximum(np.diag(schur), 1e-300))
    inverse = np.linalg.pinv(schur / np.outer(size, size), rcond=1e-13, hermitian=True)
    inverse = inverse / np.outer(size, size)
    free = 2 * sum(len(e) for e in fit.errors) - 6 * len(fit.errors) - len(size)
    right = np.sum(pulls, axis=0)
    step = inverse @ right
    left = max(fit.cost - float(right @ step), 0.0)
    by_corners = inverse * (left / max(free, 1))
    # What every view alone does to the unknowns, once the step is taken.
    moved = (np.array(pulls) - np.array(squares) @ step) @ inverse
    by_views = (moved**2).sum(axis=0) * len(moved) / max(len(moved) - 1, 1)
    more = np.sqrt(np.maximum(by_views / np.maximum(np.diag(by_corners), 1e-300), 1.0))
    return step, by_corners * np.outer(more, more)
