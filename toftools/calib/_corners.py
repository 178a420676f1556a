"""Corners of a printed board in amplitude and infrared images, which are small, dark and uneven.

Amplitude falls with the square of the range and with the cosine of the surface, so boards are
looked for in several renderings of one image (linear, square root, flattened by its own local mean,
the same smoothed, CLAHE) at several sizes, cheapest first. The first find that makes a grid is
refined in the square root of the image as it is, where shot noise is even (_lens_saddle). Fails
below about 5 px a square.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools._arrays import F32, F64
from toftools.calib._lens_saddle import REACH, crossing
from toftools.calib._lens_views import View, trouble
from toftools.calib.board import Board, charuco

SMALL_PX, MIDDLE_PX, LARGE_PX = 200, 400, 1400
"""Longer side up to which an image is enlarged up to 4, 2 and 2 times; beyond, it is halved."""
OFF_GRID = 0.3
"""Squares by which corners may lie off a plane grid: lens distortion bends one by less."""
LEAST = 6
"""Corners that make a view."""
AFTER = 6
"""Further searches for the corners that a first one missed."""
TONES = ("linear", "root", "flat", "smooth", "clahe")
SMOOTH_PX = 0.8
"""Blur against noise, before the image is flattened."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Corners of the board in one view.

    Parameters
    ----------
    name : str
        View.
    ids : ndarray, (N,), int
        Which of `Board.points`.
    corners : ndarray, (N, 2)
        Where, x and y, px.
    """

    name: str
    ids: Any
    corners: F64


def find_board(view: View, board: Board) -> Seen | None:
    """Corners of a board in a view.

    Parameters
    ----------
    view : View
        Image.
    board : Board
        What to look for.

    Returns
    -------
    Seen or None
        Corners in subpixels; None if the board is not found.
    """
    if trouble(view) == "black":
        return None
    search = _markers if board.kind == "charuco" else chessboard
    most, best, left = len(board.points()), None, AFTER
    for rendering in searches(view.image):
        found = search(rendering, board)
        left -= best is not None
        if left < 0:
            break
        if found is None or (best is not None and len(found[0]) <= len(best.ids)):
            continue
        ids, corners = _refined(view.image, board, *found)
        if _is_grid(board, ids, corners):
            best = Seen(view.name, ids, corners)
            if len(found[0]) == most:
                break
    return best


@dataclass(frozen=True, eq=False)
class Search:
    """One rendering of an image and how to look at it."""

    image: Any  # (h, w) uint8
    scale: float
    sector: bool  # OpenCV's sector-based detector, else its classic one

    def home(self, corners: Any) -> F64:  # noqa: ANN401 - of OpenCV, any shape
        """Corners of the rendering as pixels of the image."""
        return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / self.scale - 0.5


def searches(image: F32) -> Iterator[Search]:
    """Renderings of an image, the cheapest and most promising first."""
    import cv2

    side = max(image.shape)
    scales: tuple[float, ...] = (2, 4, 3, 1) if side <= SMALL_PX else (2, 1)
    if side > MIDDLE_PX:
        scales = (1, 2) if side <= LARGE_PX else (0.5, 1)
    for scale in scales:
        greys = []
        for tone in TONES:
            grey = _rendered(image, tone)
            if scale != 1:
                way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
                grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=way)
            greys.append(grey)
            yield Search(grey, scale, sector=False)
        for grey in greys:
            yield Search(grey, scale, sector=True)


def _rendered(image: F32, tone: str) -> Any:  # noqa: ANN401 - (H, W) uint8
    """8-bit rendering of an image."""
    import cv2

    light = np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)
    light = np.maximum(light - min(float(light.min()), 0.0), 0.0)
    if tone == "linear":
        return _stretched(light)
    if tone == "smooth":
        light = cv2.GaussianBlur(light, (0, 0), SMOOTH_PX)
    root = np.sqrt(light)
    if tone == "root":
        return _stretched(root)
    if tone == "clahe":
        return cv2.createCLAHE(3.0, (4, 4)).apply(_stretched(root))
    box = (max(image.shape) // 8 | 1,) * 2
    mean = cv2.blur(cv2.blur(root, box), box)
    return _stretched(root / (mean + 1e-3 * float(root.max())))


def _stretched(image: F32) -> Any:  # noqa: ANN401 - (H, W) uint8
    low, high = np.percentile(image, [1.0, 99.5])
    share = (image - low) / max(float(high - low), 1e-30)
    return np.asarray(np.clip(share, 0, 1) * 255).astype(np.uint8)


def chessboard(search: Search, board: Board) -> tuple[Any, F64] | None:
    """Corners of a chessboard in one rendering, in the order of the board; None if not found."""
    import cv2

    if search.sector:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(search.image, board.corners, flags=flags)
    else:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(search.image, board.corners, flags=flags)
    if not found:
        return None
    ordered = _ordered(search.image, board, np.asarray(corners, np.float64).reshape(-1, 2))
    return np.arange(len(ordered)), search.home(ordered)


def _ordered(image: Any, board: Board, corners: F64) -> F64:  # noqa: ANN401 - (h, w) uint8
    """Corners in the order of `Board.points`: seen from the front, from the dark first square.

    A board that looks the same after a turn starts at whichever end is nearer to the upper left
    corner of the image.
    """
    columns, rows = board.corners
    grid = corners.reshape(rows, columns, 2)
    turns = [grid, grid[::-1, ::-1]]
    if columns == rows:
        turns += [np.rot90(grid), np.rot90(grid, 3)]
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # a mirrored order
        turns = [turn[:, ::-1] for turn in turns]
    darkness = [_darkness(image, turn) for turn in turns]
    likely = [t for t, d in zip(turns, darkness, strict=True) if d >= max(darkness) - 10]
    return np.asarray(min(likely, key=lambda t: float(t[0, 0].sum()))).reshape(-1, 2)


def _darkness(image: Any, grid: F64) -> float:  # noqa: ANN401 - (h, w) uint8
    """How much darker those squares are that should be dark, grey levels.

    The square between the first four inner corners is dark, as the first of the board is.
    """
    middle = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    x, y = np.round(middle).astype(int).transpose(2, 0, 1)
    height, width = image.shape
    grey = image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(float)
    j, i = np.mgrid[0 : grey.shape[0], 0 : grey.shape[1]]
    return float(grey[(i + j) % 2 == 1].mean() - grey[(i + j) % 2 == 0].mean())


def _markers(search: Search, board: Board) -> tuple[Any, F64] | None:
    import cv2

    if search.sector:
        return None  # one detector only
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers = 1  # beside a corner; the grid is checked afterwards
    detector = cv2.aruco.CharucoDetector(charuco(board), settings)
    corners, ids, _, _ = detector.detectBoard(search.image)
    if ids is None or np.size(ids) < LEAST:
        return None
    return np.ravel(ids), search.home(corners)


def _refined(image: F32, board: Board, ids: Any, corners: F64) -> tuple[Any, F64]:  # noqa: ANN401
    """Corners where their edges cross in the image itself; those that cannot be told are dropped.

    A corner that fails, or lies off the others, starts once more from where the others put it.
    """
    light = np.sqrt(np.maximum(np.nan_to_num(image, nan=0.0, posinf=0.0), 0.0)).astype(np.float32)
    reach = REACH
    if board.kind == "charuco":  # keep off the markers
        reach = min(reach, (board.square_m - board.marker_m) / (math.sqrt(2) * board.square_m))
    mapped = _mapped(board, ids, corners)
    if mapped is None:
        return ids, corners
    moved, good = crossing(light, corners, mapped[1], reach)
    mapped = _mapped(board, ids, moved) or mapped
    good &= ~_off(moved, mapped)
    if not good.all():
        again, well = crossing(light, mapped[0][~good], mapped[1][~good], reach)
        moved[~good] = again
        good[~good] = well
        good &= ~_off(moved, mapped)
    return ids[good], moved[good]


def _mapped(board: Board, ids: Any, corners: F64) -> tuple[F64, F64] | None:  # noqa: ANN401
    """Corners as most of them place each other in perspective, and their steps along the board.

    Steps (N, 2, 2) go to the next corner along columns and along rows.
    """
    import cv2

    places = board.points()[ids, :2] / board.square_m
    if len(places) < 6 or np.ptp(places[:, 0]) == 0 or np.ptp(places[:, 1]) == 0:
        return None
    matrix, _ = cv2.findHomography(places, corners, cv2.LMEDS)
    if matrix is None or not np.isfinite(matrix).all():
        return None

    def flat(places: F64) -> F64:
        mapped = np.column_stack([places, np.ones(len(places))]) @ matrix.T
        return np.asarray(mapped[:, :2] / mapped[:, 2:])

    ahead = [flat(places + step) - flat(places - step) for step in 0.5 * np.eye(2)]
    return flat(places) + _smooth(places, corners - flat(places)), np.stack(ahead, axis=1)


def _smooth(places: F64, off: F64) -> F64:
    """What most of some shifts (N, 2) have in common: a polynomial, as a lens bends the board."""
    x, y = ((places - places.mean(axis=0)) / np.ptp(places, axis=0)).T
    powers = [(i, j) for i in range(4) for j in range(4 - i)] if len(x) >= 30 else []
    powers = powers or [(i, j) for i in range(3) for j in range(3 - i)]
    by = np.stack([x**i * y**j for i, j in powers], axis=-1)
    if len(x) < 2 * len(powers):
        return np.zeros_like(off)
    weight = np.ones(len(x))
    bent = np.zeros_like(off)
    for _ in range(8):
        fit = np.linalg.lstsq(by * weight[:, None], off * weight[:, None], rcond=None)[0]
        bent = by @ fit
        left = np.linalg.norm(off - bent, axis=1)
        weight = 1 / (1 + left / (2 * np.median(left) + 1e-6))
    return np.asarray(bent)


def _off(corners: F64, mapped: tuple[F64, F64]) -> Any:  # noqa: ANN401 - (N,) bool
    """Corners much farther from their place in perspective than the others."""
    off = np.linalg.norm(corners - mapped[0], axis=1)
    square = np.linalg.norm(mapped[1], axis=2).min(axis=1)
    return off > np.maximum(5 * np.median(off), 0.06 * square)


def _is_grid(board: Board, ids: Any, corners: F64) -> bool:  # noqa: ANN401 - whole numbers
    """Whether corners lie on a grid seen in perspective, up to what a lens bends."""
    mapped = _mapped(board, ids, corners) if len(ids) >= LEAST else None
    if mapped is None or not np.isfinite(corners).all():
        return False  # corners in a row say nothing about a plane
    off = np.linalg.norm(corners - mapped[0], axis=1)
    spacing = np.linalg.norm(mapped[1], axis=2).min(axis=1)
    return bool(spacing.min() > 2 and (off < OFF_GRID * spacing).mean() > 0.5)
