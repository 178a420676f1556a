"""Views of one board by two cameras: pictures of the second one beside captures of the first."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from toftools.calib._corners import Seen, find_board
from toftools.calib._lens_views import read_view, view_of
from toftools.calib._poses import Sight
from toftools.calib._stereo import Pair
from toftools.calib.board import Board
from toftools.conditions import name_of
from toftools.types import Camera, Capture

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
LEAST_CORNERS = 6


def pictures(where: str) -> list[Path]:
    """Images of a folder or a pattern, in the order of their names.

    Parameters
    ----------
    where : str
        A folder, a pattern such as ``rgb/view_*.png``, or one image.

    Returns
    -------
    list of Path
        Images.

    Raises
    ------
    ValueError
        If there is none.
    """
    folder = Path(where)
    found = folder.iterdir() if folder.is_dir() else folder.parent.glob(folder.name)
    images = sorted(path for path in found if path.suffix.lower() in IMAGES)
    if not images:
        msg = f"got no picture in {where!r}; give colour=FOLDER with those of the colour camera"
        raise ValueError(msg)
    return images


def matched(captures: Sequence[Capture], images: Sequence[Path]) -> list[tuple[Capture, Path]]:
    """Captures with the picture that was taken at the same time.

    Parameters
    ----------
    captures : sequence of Capture
        ToF captures with their file names.
    images : sequence of Path
        Pictures of the colour camera.

    Returns
    -------
    list of (Capture, Path)
        By equal names (``03.h5`` and ``03.png``); without any, by their order.

    Raises
    ------
    ValueError
        If no name is equal and the numbers differ.
    """
    by_name = {path.stem: path for path in images}
    named = [(c, by_name[stem]) for c in captures if (stem := Path(name_of(c)).stem) in by_name]
    if named:
        return named
    if len(captures) != len(images):
        msg = (
            f"got {len(captures)} board captures and {len(images)} pictures, and no two of the "
            f"same name ({name_of(captures[0])}, {images[0].name}); name each pair alike"
        )
        raise ValueError(msg)
    return list(zip(sorted(captures, key=name_of), images, strict=True))


def found_pairs(
    together: Sequence[tuple[Capture, Path]], board: Board, colour: Camera
) -> tuple[list[Pair], list[str]]:
    """Board corners of both images of every pair.

    Parameters
    ----------
    together : sequence of (Capture, Path)
        What belongs together.
    board : Board
        The board.
    colour : Camera
        Optics of the pictures.

    Returns
    -------
    tuple of (list of Pair, list of str)
        Views in which both cameras see the board, and the names of images in which one does not.

    Raises
    ------
    ValueError
        If a picture is of another size than its camera.
    """
    pairs, missed = [], []
    for capture, path in together:
        view = read_view(path)
        height, width = view.image.shape
        if (height, width) != colour.shape:
            msg = (
                f"{path.name} has {width} x {height} px and the intrinsics are for "
                f"{colour.width} x {colour.height}; give those of this resolution"
            )
            raise ValueError(msg)
        tof, other = find_board(view_of(capture), board), find_board(view, board)
        lost = [
            name
            for name, seen in ((name_of(capture), tof), (path.name, other))
            if seen is None or len(seen.ids) < LEAST_CORNERS
        ]
        missed += lost
        if tof is not None and other is not None and not lost:
            pairs.append(Pair(name_of(capture), _sight(tof, board), _sight(other, board)))
    return pairs, missed


def _sight(seen: Seen, board: Board) -> Sight:
    return Sight(board.points()[np.asarray(seen.ids)], seen.corners)
