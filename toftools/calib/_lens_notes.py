"""What a user should know about a lens calibration: bend of the board, coverage, range scale."""

import math
from collections.abc import Sequence

import numpy as np

from toftools._arrays import F64
from toftools.calib._corners import Seen
from toftools.calib._lens_fit import Fit, covariance
from toftools.calib._lens_model import Corners, projected
from toftools.calib._lens_views import View
from toftools.calib.board import Board
from toftools.types import Camera
from toftools.units import range_to_phase

GRID = (6, 8)
"""Rows and columns of the coverage map."""
SURE = 25.0
"""Chi-squared of the four numbers of a board's shape from which they are told."""
SCALES = np.arange(0.70, 1.3601, 0.0025)
"""Ratios of measured range to the range by the board that are tried."""
OFF = 0.03
"""Ratio that is told."""


def coverage_map(corners: Sequence[F64], shape: tuple[int, int]) -> F64:
    """How many corners fell into each part of the image.

    Parameters
    ----------
    corners : sequence of ndarray (N, 2)
        Corners per view, px.
    shape : tuple of int
        Height and width of the image, px.

    Returns
    -------
    ndarray, (6, 8)
        Counts.
    """
    every = np.concatenate(list(corners))
    edges = [np.linspace(-0.5, size - 0.5, n + 1) for size, n in zip(shape, GRID, strict=True)]
    counts, _, _ = np.histogram2d(every[:, 1], every[:, 0], bins=edges)
    return np.asarray(counts)


def coverage_note(counts: F64) -> str:
    """Where corners are missing, in words.

    Parameters
    ----------
    counts : ndarray, (rows, columns)
        Coverage map.

    Returns
    -------
    str
        A sentence, or nothing.
    """
    seen = counts > 0
    share = seen.mean()
    half = seen.shape[0] // 2, seen.shape[1] // 2
    parts = {
        "upper left": seen[: half[0], : half[1]],
        "upper right": seen[: half[0], half[1] :],
        "lower left": seen[half[0] :, : half[1]],
        "lower right": seen[half[0] :, half[1] :],
    }
    thin = [name for name, part in parts.items() if part.mean() < 0.5]
    if share >= 0.7 and not thin:
        return ""
    where = f", least in the {' and '.join(thin)}" if thin else ""
    return (
        f"corners reach {share:.0%} of the image{where}: distortion is extrapolated elsewhere; add "
        "views with the board near the edges"
    )


def board_notes(fit: Fit, views: Sequence[Corners], board: Board) -> list[str]:
    """Whether the errors look like a bent board or a stretched print.

    One Gauss-Newton step for a quadratic bend z = a x^2 + b y^2 + c x y and a stretch of x,
    together with the camera, poses free.

    Parameters
    ----------
    fit : Fit
        Least-squares fit.
    views : sequence of Corners
        Its data.
    board : Board
        Board.

    Returns
    -------
    list of str
        Sentences, if significant.
    """
    half = np.array(board.size_m) / 2
    extra = [
        _shape_columns(fit.camera, p, v.points, half) for p, v in zip(fit.poses, views, strict=True)
    ]
    step, spread = covariance(fit, views, extra)
    shape, spread = step[-4:], spread[-4:, -4:]
    notes = []
    if _chi2(shape[:3], spread[:3, :3]) > SURE:
        bend = _bend(board.points(), half)
        height = bend @ shape[:3]
        top, low = int(np.argmax(height)), int(np.argmin(height))
        lever = bend[top] - bend[low]
        error = math.sqrt(float(lever @ spread[:3, :3] @ lever))
        notes.append(
            f"the board seems bent by {1e3 * np.ptp(height):.2g} mm over its corners (standard "
            f"deviation {1e3 * error:.1g} mm): glue it to glass or an aluminium plate"
        )
    stretch, error = float(shape[3]), math.sqrt(float(spread[3, 3]))
    if abs(stretch) > max(5 * error, 2e-3):
        way = "wider" if stretch > 0 else "narrower"
        notes.append(
            f"squares seem {100 * abs(stretch):.2g} % {way} than high (standard deviation "
            f"{100 * error:.1g} %): measure the print along both sides"
        )
    return notes


def _bend(points: F64, half: F64) -> F64:
    x, y = (points[:, :2] / half - 1).T
    return np.stack([x * x, y * y, x * y], axis=-1)


def _shape_columns(camera: Camera, pose: F64, points: F64, half: F64) -> F64:
    """Derivatives (2 N, 4) of the image points by the bend, m, and by the stretch of x."""
    tiny = 1e-5

    def by(axis: int) -> F64:
        shift = np.zeros(3)
        shift[axis] = tiny
        ahead = projected(camera, pose, points + shift)[0]
        behind = projected(camera, pose, points - shift)[0]
        return np.asarray((ahead - behind) / (2 * tiny))

    bend = by(2)[:, :, None] * _bend(points, half)[:, None, :]
    stretch = by(0)[:, :, None] * points[:, None, :1]
    return np.concatenate([bend, stretch], axis=2).reshape(-1, 4)


def _chi2(value: F64, spread: F64) -> float:
    return float(value @ np.linalg.pinv(spread, hermitian=True) @ value)


def range_note(
    fit: Fit, views: Sequence[View], seen: Sequence[Seen], board: Board, freqs_hz: F64
) -> str:
    """Whether the board is as far as the camera measures, up to a constant offset.

    The ratio s and one offset per frequency that make measured phases agree best with
    ``4 pi f (s range)`` over the corners of all views are searched on a grid of s.

    Parameters
    ----------
    fit : Fit
        Camera and poses.
    views, seen : sequences
        Views with phasors, and their corners, in the order of the poses.
    board : Board
        Board; its square_m sets the scale of the poses.
    freqs_hz : ndarray, (F,)
        Frequencies, Hz.

    Returns
    -------
    str
        A sentence where the ratio is off by more than 3 %, or nothing.
    """
    range_m, phasors = _at_corners(fit, views, seen, board)
    if range_m.size < 20 or np.ptp(range_m) < 0.15 * np.median(range_m):
        return ""
    unit = phasors / np.maximum(np.abs(phasors), 1e-30)
    agreed = np.empty(len(SCALES))
    for i, scale in enumerate(SCALES):
        model = np.exp(-1j * range_to_phase(scale * range_m, freqs_hz[:, None]))
        agreed[i] = float(np.abs((unit * model).mean(axis=1)).mean())
    best = float(SCALES[int(np.argmax(agreed))])
    as_said = float(np.interp(1.0, SCALES, agreed))
    clear = (1 - as_said) > 2 * (1 - float(agreed.max())) and float(agreed.max()) > 0.9
    if abs(best - 1) <= OFF or not clear:
        return ""
    return (
        f"the camera measures {100 * (best - 1):+.1f} % in range against the board: square_m = "
        f"{board.square_m:g} looks wrong, {board.square_m * best:.4g} would agree; measure it"
    )


def _at_corners(
    fit: Fit, views: Sequence[View], seen: Sequence[Seen], board: Board
) -> tuple[F64, F64]:
    """Range by the pose (N,), m, and measured phasors (F, N) at corners of views that have them."""
    import cv2

    ranges, measured = [], []
    for view, corners, pose in zip(views, seen, fit.poses, strict=True):
        if view.phasors is None:
            continue
        rotation = np.asarray(cv2.Rodrigues(pose[:3].copy())[0])
        points = board.points()[corners.ids] @ rotation.T + pose[3:]
        u, v = np.round(corners.corners).astype(int).T
        height, width = view.image.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        inside[inside] &= view.phasors.valid[v[inside], u[inside]]
        ranges.append(np.linalg.norm(points[inside], axis=1))
        measured.append(view.phasors.values[:, v[inside], u[inside]])
    if not ranges:
        return np.zeros(0), np.zeros((1, 0))
    return np.concatenate(ranges), np.concatenate(measured, axis=1)
