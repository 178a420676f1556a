"""What a view shows where it does not show the board that was said."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from toftools._arrays import F32, F64
from toftools.calib._corners import Seen, chessboard, find_board, searches
from toftools.calib._lens_views import View
from toftools.calib.board import DICTIONARIES, Board


def larger_board(view: View, board: Board, seen: Seen | None) -> tuple[int, int] | None:
    """Inner corners of the chessboard in a view that does not show the board said.

    Parameters
    ----------
    view : View
        Image.
    board : Board
        The chessboard said.
    seen : Seen or None
        Where it was found: a part of a larger board looks like it.

    Returns
    -------
    tuple of int, or None
        Columns and rows, (0, 0) if unknown but more; None if nothing speaks against the board.
    """
    if seen is not None and not _goes_on(view.image, board, seen):
        return None
    columns, rows = board.corners
    steps = range(4) if seen is not None else range(-2, 3)
    sizes = [(columns + i, rows + j) for i in steps for j in steps if (i, j) != (0, 0)]
    # Squares counted for corners, or the other way round, come first.
    sizes.sort(key=lambda size: abs(size[0] - columns - (size[1] - rows)) + (size[0] > columns))
    for search in itertools.islice(searches(view.image), 0, 3, 2):
        for size in sizes:
            if min(size) < 3:
                continue
            other = replace(board, columns=size[0], rows=size[1])
            found = chessboard(search, other)
            if found is None:
                continue
            part = Seen(view.name, *found)
            if not _goes_on(view.image, other, part):
                return size
    return (0, 0) if seen is not None else None


def _goes_on(image: F32, board: Board, seen: Seen) -> bool:
    """Whether squares alternate beyond the outer squares, too, on any side."""
    import cv2

    columns, rows = board.corners
    places = board.points()[seen.ids, :2] / board.square_m - 1
    matrix, _ = cv2.findHomography(places, seen.corners)

    def bright(i: F64, j: F64) -> F64:
        at = np.column_stack([i, j, np.ones_like(i)]) @ matrix.T
        u, v = np.round(at[:, :2] / at[:, 2:]).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
        v, u = np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)
        return np.where(inside, np.sqrt(np.maximum(image[v, u], 0)), np.nan)

    def contrast(i: F64, j: F64) -> float:
        # Light against dark squares of a line; neighbours differ, whatever the light does.
        values = bright(i, j)
        steps = np.diff(values) * (-1.0) ** np.arange(len(values) - 1)
        return abs(float(np.mean(steps)))

    across = np.arange(columns + 1, dtype=np.float64) - 0.5
    down = np.arange(rows + 1, dtype=np.float64) - 0.5
    lines = [
        *((across, np.full_like(across, j)) for j in (-1.5, rows + 0.5)),
        *((np.full_like(down, i), down) for i in (-1.5, columns + 0.5)),
    ]
    inner = contrast(across, np.full_like(across, 0.5))
    return any(contrast(i, j) > 0.5 * inner for i, j in lines)


def strange_markers(view: View, board: Board) -> str:
    """What speaks against a ChArUco board in a view.

    Parameters
    ----------
    view : View
        Image.
    board : Board
        The ChArUco board said.

    Returns
    -------
    str
        End of a sentence; empty if nothing.
    """
    import cv2

    def ids_of(name: str, image: Any) -> Any:  # noqa: ANN401 - arrays of OpenCV
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        ids = cv2.aruco.ArucoDetector(words).detectMarkers(image)[1]
        return np.ravel(ids) if ids is not None else np.zeros(0, int)

    images = [s.image for s in itertools.islice(searches(view.image), 1, 3)]
    ids = np.concatenate([ids_of(board.dictionary, image) for image in images])
    there = board.columns * board.rows // 2
    if (ids >= there).sum() >= 2:
        return f"shows marker {ids.max()}, where the board said has markers 0 to {there - 1} only"
    if len(set(ids)) >= 3:
        return "" if find_board(view, board) else "shows markers, but not where the board has them"
    for name in DICTIONARIES:
        if any(len(set(ids_of(name, image))) >= 4 for image in images):
            return f"shows markers of {name}, not of {board.dictionary}"
    return ""
