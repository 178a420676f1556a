"""How good a relative pose is: scatter of the corners, views held out, what noise explains.

The measure is that of use: where a view's corners should appear in the colour image, foretold from
its ToF image alone. Errors are lengths in px, summarised as their root mean square.
"""

from collections.abc import Sequence

import numpy as np

from toftools.calib._poses import (
    Pose,
    Sight,
    after,
    moved,
    moved_slopes,
    projection_slopes,
    seen_or_lost,
)
from toftools.calib._stereo import Fit, Pair, refined
from toftools.calib.stage import Residual
from toftools.types import F64, Camera

FOLDS = 5
LEAST_SIGMA_PX = 1e-3
STRAY = 5.0
"""Standard deviations from which a corner is taken for a wrong find."""
SUSPECT = 2.0
"""Views held out that miss by this many times the noise speak against the intrinsics."""
PARALLEL_DEG = 15.0
"""Boards whose normals differ by less hardly tell a turn from a shift."""


def rms_px(errors: Sequence[F64]) -> float:
    """Root mean square length.

    Parameters
    ----------
    errors : sequence of ndarray, (N, 2)
        Errors of views, px.

    Returns
    -------
    float
        Over all points, px; NaN if there are none.
    """
    if not errors:
        return float("nan")
    return float(np.sqrt(np.mean(np.sum(np.concatenate(list(errors)) ** 2, axis=-1))))


def scatter_px(camera: Camera, sights: Sequence[Sight], poses: Sequence[Pose]) -> float:
    """Standard deviation of a coordinate of a corner, from how well every view fits by itself.

    Parameters
    ----------
    camera : Camera
        Camera.
    sights : sequence of Sight
        Corners of every view.
    poses : sequence of Pose
        Best pose of every view by itself.

    Returns
    -------
    float
        Median over the views, px.
    """
    variances = []
    for sight, pose in zip(sights, poses, strict=True):
        miss = seen_or_lost(camera, moved(pose, sight.board_m)) - sight.px
        variances.append(float(np.sum(miss**2)) / max(1, miss.size - 6))
    return max(LEAST_SIGMA_PX, float(np.sqrt(np.median(variances))))


def without_strays(camera: Camera, sight: Sight, pose: Pose) -> Sight:
    """Corners without those that lie far off where all the others say.

    Parameters
    ----------
    camera : Camera
        Camera.
    sight : Sight
        Corners of one view.
    pose : Pose
        Best pose of the board by a robust fit.

    Returns
    -------
    Sight
        The same object where nothing is wrong.
    """
    miss = np.linalg.norm(seen_or_lost(camera, moved(pose, sight.board_m)) - sight.px, axis=1)
    # Half of the lengths of a normal scatter in the plane are below 1.18 sigma.
    good = miss <= max(LEAST_SIGMA_PX, STRAY / 1.18 * float(np.median(miss)))
    return sight if good.all() else Sight(sight.board_m[good], sight.px[good])


def foretold_px(
    pairs: Sequence[Pair], camera: Camera, link: Pose, boards: Sequence[Pose]
) -> list[F64]:
    """Errors of corners in the colour image, foretold from the ToF image.

    Parameters
    ----------
    pairs : sequence of Pair
        Views.
    camera : Camera
        Colour camera.
    link : Pose
        ToF to colour.
    boards : sequence of Pose
        Board poses from the ToF image alone.

    Returns
    -------
    list of ndarray, (N, 2)
        Foretold minus found, px.
    """
    return [
        seen_or_lost(camera, moved(after(link, board), pair.colour.board_m)) - pair.colour.px
        for pair, board in zip(pairs, boards, strict=True)
    ]


def noise_px(
    pairs: Sequence[Pair],
    cameras: tuple[Camera, Camera],
    link: Pose,
    boards: Sequence[Pose],
    sigma_px: tuple[float, float],
) -> float:
    """Root mean square that the scatter of the corners alone gives to `foretold_px`.

    Parameters
    ----------
    pairs, cameras, link, boards
        As for the fit; cameras are ToF and colour.
    sigma_px : (float, float)
        Scatter of the corners, px.

    Returns
    -------
    float
        px.
    """
    squares = []
    still = np.zeros(6)
    for pair, board in zip(pairs, boards, strict=True):
        place, by_pose = moved_slopes(board, still, pair.tof.board_m)
        rows = (projection_slopes(cameras[0], place) @ by_pose).reshape(-1, 6) / sigma_px[0]
        spread = np.linalg.pinv(rows.T @ rows)
        place, by_pose = moved_slopes(board, still, pair.colour.board_m)
        seen = projection_slopes(cameras[1], moved(link, place)) @ (link[0] @ by_pose)
        squares.append(np.einsum("nij,jk,nik->n", seen, spread, seen) + 2 * sigma_px[1] ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def held_out_px(
    pairs: Sequence[Pair],
    cameras: tuple[Camera, Camera],
    fit: Fit,
    boards: Sequence[Pose],
    sigma_px: tuple[float, float],
) -> float:
    """Error of `foretold_px` for views that the relative pose was not fitted to.

    Parameters
    ----------
    pairs, cameras, sigma_px
        As for the fit.
    fit : Fit
        Fit of all views, from which the others start.
    boards : sequence of Pose
        Board poses from the ToF image alone.

    Returns
    -------
    float
        Root mean square over `FOLDS` folds of views, px; NaN with fewer than three views.
    """
    if len(pairs) < 3:
        return float("nan")
    errors: list[F64] = []
    for fold in range(min(FOLDS, len(pairs))):
        out = [n % FOLDS == fold for n in range(len(pairs))]
        kept = [pair for pair, gone in zip(pairs, out, strict=True) if not gone]
        start = [pose for pose, gone in zip(fit.boards, out, strict=True) if not gone]
        link = refined(kept, cameras, (fit.pose, start), sigma_px).pose
        tested = [pair for pair, gone in zip(pairs, out, strict=True) if gone]
        alone = [pose for pose, gone in zip(boards, out, strict=True) if gone]
        errors += foretold_px(tested, cameras[1], link, alone)
    return rms_px(errors)


def spread_deg(boards: Sequence[Pose]) -> float:
    """Largest angle between the normals of two boards.

    Parameters
    ----------
    boards : sequence of Pose
        Board poses.

    Returns
    -------
    float
        Degrees.
    """
    normals = np.stack([rotation[:, 2] for rotation, _ in boards])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))


def few(names: Sequence[str]) -> str:
    """Names in a sentence, at most five of them.

    Parameters
    ----------
    names : sequence of str
        Names.

    Returns
    -------
    str
        With the number of the others.
    """
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more


def notes_on(fit: Fit, residual: Residual, outliers: tuple[str, ...]) -> list[str]:
    """What a user should know about a fit.

    Parameters
    ----------
    fit : Fit
        The fit.
    residual : Residual
        Its errors, foretold.
    outliers : tuple of str
        Views left out.

    Returns
    -------
    list of str
        Sentences.
    """
    tof, colour = (rms_px(errors) for errors in fit.errors_px)
    sigma = np.sqrt(np.diag(fit.covariance))
    shift_mm, turn_mrad = 1e3 * np.linalg.norm(sigma[3:]), 1e3 * np.linalg.norm(sigma[:3])
    views = len(fit.boards)
    notes = [
        f"Reprojection error {tof:.3f} px in the ToF and {colour:.3f} px in the colour image, over "
        f"{views} {'view' if views == 1 else 'views'}.",
        f"The pose is known to {shift_mm:.2g} mm and {turn_mrad:.2g} mrad (one standard deviation, "
        "intrinsics taken as exact).",
    ]
    if outliers:
        notes.append(f"Left out because they contradict the other views: {few(outliers)}.")
    if views < 3:
        notes.append("Too few views to hold any out: errors of the intrinsics go unseen.")
    elif spread_deg(fit.boards) < PARALLEL_DEG:
        notes.append(
            f"The boards are nearly parallel (within {spread_deg(fit.boards):.0f} degrees); tilt "
            "some of them."
        )
    if residual.held_out > SUSPECT * residual.noise:
        notes.append(
            f"Views held out miss by {residual.held_out:.2g} px where noise explains "
            f"{residual.noise:.2g}: the intrinsics of one of the cameras are likely off."
        )
    return notes
