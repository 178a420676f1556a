"""Which views show the board, and clear words where they cannot calibrate a lens."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from toftools._arrays import F64
from toftools.calib._corners import Seen, find_board
from toftools.calib._lens_doubts import larger_board, strange_markers
from toftools.calib._lens_fit import Fit
from toftools.calib._lens_views import View, trouble
from toftools.calib.board import Board

LEAST = 4
"""Views that a fit needs; three determine a pinhole, one more tells whether they agree."""
PATIENCE = 1
"""Views without the board from the start after which another board is looked for in them."""
LEAST_TILT_DEG = 5.0
MOST_SPREAD, WIDE_SPREAD = 0.2, 0.02
"""Standard deviation of a focal length, relative to it, that is refused and that is told."""


def same_size(views: Sequence[View]) -> None:
    """Refuse views of different sizes.

    Parameters
    ----------
    views : sequence of View
        Views of one camera.

    Raises
    ------
    ValueError
        If one differs from the first, by name.
    """
    for view in views[1:]:
        if view.image.shape != views[0].image.shape:
            (h, w), (height, width) = view.image.shape, views[0].image.shape
            msg = (
                f"{view.name} has {w} x {h} px and {views[0].name} {width} x {height}; "
                "calibrate one resolution at a time"
            )
            raise ValueError(msg)


def distinct(views: Sequence[View]) -> list[View]:
    """Views whose names differ: repeated ones are counted.

    Parameters
    ----------
    views : sequence of View
        Views.

    Returns
    -------
    list of View
        The same images.
    """
    names = [view.name for view in views]
    return [
        view if names.count(view.name) == 1 else replace(view, name=f"{view.name} {i}")
        for i, view in enumerate(views)
    ]


def boards_in(views: Sequence[View], board: Board) -> tuple[list[Seen], list[str]]:
    """The board in every view that shows it.

    Parameters
    ----------
    views : sequence of View
        Views of one camera.
    board : Board
        What to look for.

    Returns
    -------
    seen : list of Seen
        Corners.
    missed : list of str
        Names of views without the board.

    Raises
    ------
    ValueError
        If a view is black or saturated, another board is seen, or too few views show it.
    """
    same_size(views)
    seen, missed = [], []
    for view in views:
        found = find_board(view, board)
        if found is not None:
            seen.append(found)
            continue
        if wrong := trouble(view):
            cure = "a longer" if wrong == "black" else "a shorter"
            msg = f"{view.name} is {wrong} and shows no board; take it again with {cure} exposure"
            raise ValueError(f"{msg}, or leave it out")
        missed.append(view.name)
        if len(missed) == PATIENCE and not seen:
            _check_board(views, board, [], [v for v in views if v.name in missed])
    lost = [view for view in views if view.name in missed] if 0 < len(seen) < LEAST else []
    _check_board(views, board, seen, lost[:PATIENCE])
    if len(seen) < LEAST:
        unseen = f" (not seen in {listed(missed)})" if missed else ""
        shown = f" in {listed([s.name for s in seen])}" if seen else ""
        msg = (
            f"got {len(seen)} views of the board {board.text()}{shown}{unseen}; wanted at least "
            f"{LEAST}, better 20, tilted by 20 to 50 degrees in different directions"
        )
        raise ValueError(msg)
    return seen, missed


def _check_board(
    views: Sequence[View], board: Board, seen: Sequence[Seen], lost: Sequence[View]
) -> None:
    """Refuse a board of another size or dictionary than the one said."""
    said = f"{board.columns} x {board.rows}"
    if board.kind == "charuco":
        for view in (*[v for v in views if v.name in {s.name for s in seen}][:1], *lost):
            if wrong := strange_markers(view, board):
                raise ValueError(f"{view.name} {wrong}; check the board, got {board.text()}")
        return
    by_name = {view.name: view for view in views}
    for view, corners in [*((by_name[s.name], s) for s in seen[:3]), *((v, None) for v in lost)]:
        found = larger_board(view, board, corners)
        if found is not None:
            size = f"{found[0]} x {found[1]}" if found[0] else "more"
            msg = (
                f"{view.name} shows a chessboard of {size} inner corners, got a board of {said}; "
                "count inner corners, not squares"
            )
            raise ValueError(msg)


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names in a sentence, the first few of many.

    Parameters
    ----------
    names : sequence of str
        Names.
    most : int
        How many to spell out.

    Returns
    -------
    str
        Words.
    """
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def tilt_deg(fit: Fit) -> float:
    """Largest angle between the board normals of any two views.

    Parameters
    ----------
    fit : Fit
        Camera and poses.

    Returns
    -------
    float
        Angle, degrees.
    """
    import cv2

    normals = np.array([np.asarray(cv2.Rodrigues(pose[:3].copy())[0])[:, 2] for pose in fit.poses])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)).max()))


def check_observable(fit: Fit, sigma: F64, names: Sequence[str], board: Board) -> None:
    """Refuse views that cannot tell the focal length, and corners that are on no such board.

    Parameters
    ----------
    fit : Fit
        Solution.
    sigma : ndarray, (4 + n,)
        Standard deviations of the camera.
    names : sequence of str
        Views.
    board : Board
        Board.

    Raises
    ------
    ValueError
        If all views are parallel, or the errors are a good part of a square.
    """
    angle, K = tilt_deg(fit), fit.camera.K
    spread = float(max(sigma[0] / K[0, 0], sigma[1] / K[1, 1]))
    if angle < LEAST_TILT_DEG or not spread < MOST_SPREAD:
        seen = f"the board is tilted by at most {angle:.1f} degrees between views"
        if angle >= LEAST_TILT_DEG:
            seen = "the views leave too much room"
        msg = (
            f"{listed(names)} cannot tell the focal length: {seen} (its standard deviation is "
            f"{100 * spread:.3g} %); add views tilted by 20 to 50 degrees in different directions"
        )
        raise ValueError(msg)
    nearest = min(float(np.linalg.norm(pose[3:])) for pose in fit.poses)
    square_px = K[0, 0] * board.square_m / nearest
    if fit.rms_px > 0.25 * square_px:
        msg = (
            f"corners of {listed(names)} miss the board {board.text()} by {fit.rms_px:.3g} px rms; "
            "is it really this board, and does it lie flat?"
        )
        raise ValueError(msg)
