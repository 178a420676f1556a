"""Relative pose of two cameras that saw the same boards: start, joint refinement, covariance.

A board pose takes board points into the ToF camera, the relative pose from there to the colour
camera: x_colour = R x_tof + t. All are refined together, in pixels of both cameras.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib._poses import (
    Pose,
    Sight,
    after,
    changed,
    inverse,
    moved,
    moved_slopes,
    projection_slopes,
    seen_or_lost,
)
from toftools.types import F64, Camera

SIDES = ("tof", "colour")


@dataclass(frozen=True, eq=False)
class Pair:
    """A board that both cameras saw at rest; each may see other corners of it.

    Parameters
    ----------
    name : str
        Name for messages.
    tof, colour : Sight
        What they saw.
    """

    name: str
    tof: Sight
    colour: Sight


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a joint refinement.

    Parameters
    ----------
    pose : Pose
        From the ToF to the colour camera.
    boards : tuple of Pose
        From the boards to the ToF camera.
    covariance : ndarray, (6, 6)
        Of turn (rad) and translation (m), from the scatter of the corners.
    errors_px : (tuple of ndarray (N, 2), tuple of ndarray (N, 2))
        Projected minus found corners of every view, ToF and colour.
    """

    pose: Pose
    boards: tuple[Pose, ...]
    covariance: F64
    errors_px: tuple[tuple[F64, ...], tuple[F64, ...]]


def consensus(
    candidates: Sequence[tuple[Sequence[Pose], Sequence[Pose]]],
) -> tuple[Pose, list[Pose]]:
    """The relative pose with which most views agree, and the board poses that belong to it.

    Parameters
    ----------
    candidates : sequence of (list of Pose, list of Pose)
        Of every view the board poses in the ToF camera and in the colour camera.

    Returns
    -------
    tuple of (Pose, list of Pose)
        ToF to colour, the one with the least median distance to the nearest of every view; and
        of every view the board pose in the ToF camera.
    """
    reach = float(np.median([tof[0][1][2] for tof, _ in candidates]))
    options = [
        [(after(c, inverse(t)), t) for t, c in itertools.product(tof, colour)]
        for tof, colour in candidates
    ]

    def apart(a: Pose, b: Pose) -> float:
        cosine = np.clip((np.trace(a[0].T @ b[0]) - 1) / 2, -1, 1)
        return float(np.arccos(cosine) + np.linalg.norm(a[1] - b[1]) / reach)

    def nearest(pose: Pose, view: Sequence[tuple[Pose, Pose]]) -> tuple[float, Pose]:
        return min(((apart(pose, other), board) for other, board in view), key=lambda item: item[0])

    every = [pose for view in options for pose, _ in view]
    costs = [np.median([nearest(pose, view)[0] for view in options]) for pose in every]
    best = every[int(np.argmin(costs))]
    return best, [nearest(best, view)[1] for view in options]


def refined(
    pairs: Sequence[Pair],
    cameras: tuple[Camera, Camera],
    start: tuple[Pose, Sequence[Pose]],
    sigma_px: tuple[float, float],
    loss: str = "linear",
) -> Fit:
    """Relative pose and board poses that explain all corners best.

    Parameters
    ----------
    pairs : sequence of Pair
        Views.
    cameras : (Camera, Camera)
        ToF and colour.
    start : (Pose, sequence of Pose)
        Relative pose, and board poses in the ToF camera.
    sigma_px : (float, float)
        Scatter of the corners in the two cameras, px: their weights.
    loss : str
        Loss of scipy.optimize.least_squares.

    Returns
    -------
    Fit
        The optimum.
    """
    from scipy.optimize import least_squares

    found_px = [np.concatenate([getattr(pair, k).px for pair in pairs]) for k in SIDES]

    def error(x: F64) -> F64:
        places = _places(pairs, start, x)
        miss = [
            (seen_or_lost(camera, np.concatenate(place)) - px).ravel() / sigma
            for camera, place, px, sigma in zip(cameras, places, found_px, sigma_px, strict=True)
        ]
        return np.concatenate(miss)

    def slope(x: F64) -> F64:
        return _joint_slope(pairs, cameras, start, sigma_px, x)

    found = least_squares(
        error, np.zeros(6 + 6 * len(pairs)), jac=slope, loss=loss, x_scale="jac", max_nfev=50
    )
    freedom = max(1, found.fun.size - found.x.size)
    scatter = float(np.sum(found.fun**2)) / freedom
    covariance = np.linalg.pinv(found.jac.T @ found.jac)[:6, :6] * max(scatter, 1e-12)
    tof, colour = np.split(found.fun.reshape(-1, 2), [len(found_px[0])])
    changes = found.x[6:].reshape(-1, 6)
    return Fit(
        changed(start[0], found.x[:6]),
        tuple(changed(b, c) for b, c in zip(start[1], changes, strict=True)),
        covariance,
        (
            _by_view(pairs, "tof", tof * sigma_px[0]),
            _by_view(pairs, "colour", colour * sigma_px[1]),
        ),
    )


def _by_view(pairs: Sequence[Pair], side: str, errors: F64) -> tuple[F64, ...]:
    ends = np.cumsum([len(getattr(pair, side).px) for pair in pairs])[:-1]
    return tuple(np.split(errors, ends))


def _places(
    pairs: Sequence[Pair], start: tuple[Pose, Sequence[Pose]], x: F64
) -> tuple[list[F64], list[F64]]:
    """Corners of every view in the frames of the two cameras."""
    link = changed(start[0], x[:6])
    tof, colour = [], []
    for n, pair in enumerate(pairs):
        board = changed(start[1][n], x[6 * n + 6 : 6 * n + 12])
        tof.append(moved(board, pair.tof.board_m))
        colour.append(moved(after(link, board), pair.colour.board_m))
    return tof, colour


def _joint_slope(
    pairs: Sequence[Pair],
    cameras: tuple[Camera, Camera],
    start: tuple[Pose, Sequence[Pose]],
    sigma_px: tuple[float, float],
    x: F64,
) -> F64:
    """Jacobian of the weighted errors, all of the ToF camera first."""
    tof, colour = _places(pairs, start, x)
    by_pixel = [
        _by_view(pairs, side, projection_slopes(camera, np.concatenate(place)) / sigma)
        for side, camera, place, sigma in zip(SIDES, cameras, (tof, colour), sigma_px, strict=True)
    ]
    link = changed(start[0], x[:6])
    rows = ([], [])  # type: tuple[list[F64], list[F64]]
    for n, pair in enumerate(pairs):
        own = slice(6 * n + 6, 6 * n + 12)
        _, by_board = moved_slopes(start[1][n], x[own], pair.tof.board_m)
        row = np.zeros((len(pair.tof.px), 2, x.size))
        row[:, :, own] = by_pixel[0][n] @ by_board
        rows[0].append(row.reshape(-1, x.size))
        place, by_board = moved_slopes(start[1][n], x[own], pair.colour.board_m)
        _, by_link = moved_slopes(start[0], x[:6], place)
        row = np.zeros((len(pair.colour.px), 2, x.size))
        row[:, :, :6] = by_pixel[1][n] @ by_link
        row[:, :, own] = by_pixel[1][n] @ (link[0] @ by_board)
        rows[1].append(row.reshape(-1, x.size))
    return np.concatenate([*rows[0], *rows[1]])
