"""Calibration boards: chessboard and ChArUco, where their corners lie and which parts are dark.

Board frame: origin at the outer corner of the first square, x along the columns, y along the rows,
z into the board (away from who looks at it), m. A chessboard counts inner corners, as OpenCV does,
and its first square is dark; a ChArUco board counts squares, its markers lie in the light ones.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from toftools._arrays import F64, Bool
from toftools._params import checked_params, parse_entry

KINDS = ("chessboard", "charuco")
DICTIONARIES = {
    **{f"DICT_{n}X{n}_{size}": size for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
"""Marker dictionaries of OpenCV and how many markers each has."""
MOST = 64
"""Squares along one side that a board may have."""


@dataclass(frozen=True)
class Board:
    """A printed calibration board.

    Parameters
    ----------
    kind : {"chessboard", "charuco"}
        Pattern.
    columns, rows : int
        Inner corners of a chessboard, squares of a ChArUco board.
    square_m : float
        Side of a square, m.
    marker_m : float
        Side of a marker with its dark border, m; ChArUco only.
    dictionary : str
        OpenCV's name of the marker dictionary; ChArUco only.
    legacy : bool
        ChArUco pattern of OpenCV before 4.6, whose first square is light where rows are even.

    Examples
    --------
    >>> parse_board("chessboard:columns=8,rows=5,square_m=0.03").points().shape
    (40, 3)
    """

    kind: str = "chessboard"
    columns: int = 8
    rows: int = 5
    square_m: float = 0.03
    marker_m: float = 0.0
    dictionary: str = ""
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            msg = f"got the board {self.kind!r}; wanted {' or '.join(KINDS)}"
            raise ValueError(msg)
        if not (3 <= self.columns <= MOST and 3 <= self.rows <= MOST):
            what = "inner corners" if self.kind == "chessboard" else "squares"
            msg = f"a {self.kind} has 3 to {MOST} {what} a side, got {self.columns} x {self.rows}"
            raise ValueError(msg)
        if not (math.isfinite(self.square_m) and 1e-4 <= self.square_m <= 10):
            msg = f"square_m must be metres between 0.0001 and 10, got {self.square_m}"
            raise ValueError(msg)
        if self.kind == "charuco":
            self._check_markers()
        elif self.marker_m or self.dictionary or self.legacy:
            msg = "a chessboard has no markers; leave out marker_m, dictionary and legacy"
            raise ValueError(msg)

    def _check_markers(self) -> None:
        if self.dictionary not in DICTIONARIES:
            known = ", ".join(DICTIONARIES)
            msg = f"got the dictionary {self.dictionary!r}; wanted one of {known}"
            raise ValueError(msg)
        if not 0 < self.marker_m < self.square_m:
            msg = (
                f"marker_m must be positive and less than square_m ({self.square_m:g}), "
                f"got {self.marker_m}"
            )
            raise ValueError(msg)
        if self.columns * self.rows // 2 > DICTIONARIES[self.dictionary]:
            msg = (
                f"{self.columns} x {self.rows} squares need {self.columns * self.rows // 2} "
                f"markers, {self.dictionary} has {DICTIONARIES[self.dictionary]}; take a larger one"
            )
            raise ValueError(msg)

    @property
    def squares(self) -> tuple[int, int]:
        """Squares along columns and rows."""
        more = 1 if self.kind == "chessboard" else 0
        return self.columns + more, self.rows + more

    @property
    def corners(self) -> tuple[int, int]:
        """Inner corners along columns and rows."""
        columns, rows = self.squares
        return columns - 1, rows - 1

    @property
    def size_m(self) -> tuple[float, float]:
        """Outer size of the squares: width and height, m."""
        columns, rows = self.squares
        return columns * self.square_m, rows * self.square_m

    def points(self) -> F64:
        """Inner corners in the board frame.

        Returns
        -------
        ndarray, (N, 3)
            Corners row by row, m; z is 0.
        """
        columns, rows = self.corners
        y, x = np.mgrid[1 : rows + 1, 1 : columns + 1].reshape(2, -1) * self.square_m
        return np.stack([x, y, np.zeros_like(x)], axis=-1)

    def text(self) -> str:
        """What `parse_board` reads back as this board."""
        named = [f.name for f in fields(self) if f.name != "kind"]
        if self.kind == "chessboard":
            named = ["columns", "rows", "square_m"]
        values = ((name, getattr(self, name)) for name in named)
        told = [f"{k}={str(v).lower() if isinstance(v, bool) else v}" for k, v in values]
        return f"{self.kind}:{','.join(told)}"


DEFAULT = "chessboard:columns=8,rows=5,square_m=0.03"
"""A board that fits A4 and has one orientation only: columns + rows is odd."""
DEFAULTS: dict[str, dict[str, Any]] = {
    "chessboard": {"columns": 8, "rows": 5, "square_m": 0.03},
    "charuco": {
        "columns": 9,
        "rows": 6,
        "square_m": 0.03,
        "marker_m": 0.023,
        "dictionary": "DICT_4X4_50",
        "legacy": False,
    },
}


def parse_board(text: str) -> Board:
    """Board from ``KIND:key=val,...``.

    Parameters
    ----------
    text : str
        Such as ``charuco:columns=9,rows=6,square_m=0.03,marker_m=0.023,dictionary=DICT_4X4_50``.

    Returns
    -------
    Board
        Checked board.

    Raises
    ------
    ValueError
        If the kind, a key or a value is wrong.
    """
    kind, params = parse_entry(text)
    if kind not in DEFAULTS:
        msg = f"got the board {kind!r}; wanted {' or '.join(KINDS)}, such as {DEFAULT}"
        raise ValueError(msg)
    defaults = DEFAULTS[kind]
    if kind == "charuco" and "square_m" in params and "marker_m" not in params:
        msg = f"{text!r} gives square_m without marker_m; measure both on the print"
        raise ValueError(msg)
    return Board(kind, **{**defaults, **checked_params(kind, defaults, params)})


def charuco(board: Board) -> Any:  # noqa: ANN401 - an object of OpenCV, which has no types
    """The board as OpenCV knows it.

    Parameters
    ----------
    board : Board
        A ChArUco board.

    Returns
    -------
    cv2.aruco.CharucoBoard
        Its twin.
    """
    import cv2

    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.columns, board.rows)
    twin = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, words)
    twin.setLegacyPattern(board.legacy)
    return twin


def markers(board: Board) -> list[tuple[F64, Bool]]:
    """Markers of a ChArUco board.

    Parameters
    ----------
    board : Board
        Any board; a chessboard has none.

    Returns
    -------
    list of (ndarray (2,), ndarray (n, n) bool)
        Upper left corner x, y in the board frame, m, and which cells are dark, border included.
    """
    if board.kind != "charuco":
        return []
    twin = charuco(board)
    words = twin.getDictionary()
    cells = int(words.markerSize) + 2
    corners = np.asarray(twin.getObjPoints(), dtype=np.float64).reshape(-1, 4, 3)
    images = (words.generateImageMarker(int(i), cells) for i in np.ravel(twin.getIds()))
    return [
        (corner[:, :2].min(axis=0), np.asarray(image) < 128)
        for corner, image in zip(corners, images, strict=True)
    ]


def dark_squares(board: Board) -> Bool:
    """Which squares are dark.

    Parameters
    ----------
    board : Board
        Any board.

    Returns
    -------
    ndarray, (rows, columns), bool
        True where dark; squares with a marker are light.
    """
    columns, rows = board.squares
    y, x = np.mgrid[0:rows, 0:columns]
    found = markers(board)
    if not found:
        return np.asarray((x + y) % 2 == 0)
    column, row = np.floor(found[0][0] / board.square_m).astype(int)
    return np.asarray((x + y) % 2 != (column + row) % 2)


def dark_at(board: Board, x_m: F64, y_m: F64) -> Bool:
    """Whether the print is dark at any points of the board.

    Parameters
    ----------
    board : Board
        Any board.
    x_m, y_m : ndarray
        Points in the board frame, m.

    Returns
    -------
    ndarray, bool
        True where dark; outside of the squares the paper is white.
    """
    columns, rows = board.squares
    column, row = x_m / board.square_m, y_m / board.square_m
    inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    i = np.where(inside, column, 0).astype(int)
    j = np.where(inside, row, 0).astype(int)
    dark = dark_squares(board)[j, i] & inside
    for corner, cells in markers(board):
        step = board.marker_m / len(cells)
        u, v = (x_m - corner[0]) / step, (y_m - corner[1]) / step
        here = (u >= 0) & (v >= 0) & (u < len(cells)) & (v < len(cells))
        dark[here] = cells[v[here].astype(int), u[here].astype(int)]
    return np.asarray(dark)
