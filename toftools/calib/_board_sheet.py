"""A calibration board on paper, at true size, with a ruler and what to know before printing."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftools._arrays import Bool
from toftools.calib.board import Board, dark_squares, markers
from toftools.io.atomic import atomic_path

MM_PER_INCH = 25.4
PAPERS_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
"""Width and height of paper upright, mm."""
DPI = 254
"""Ten pixels per mm: squares of whole tenths of a millimetre end between pixels."""
MARGIN_MM = 8.0
STRIP_MM = 12.0
"""Ruler and text below the board."""
INFRARED = (
    "Check it in the infrared: at 850 and 940 nm inks of dye (most inkjet photo printers, many "
    "colour blacks) turn transparent and the board fades; carbon black is dark (most laser toner, "
    "pigment black). Look at a print through the camera first. Matt paper, glued flat on glass or "
    "aluminium."
)
SHORT = (
    "Print at 100 % (actual size), measure the ruler. Carbon black (laser toner, pigment) is dark "
    "at 850/940 nm, dye ink is not. Matt paper, flat."
)


@dataclass(frozen=True)
class Sheet:
    """A board on paper.

    Parameters
    ----------
    board : Board
        What to print.
    paper : str
        One of `PAPERS_MM`.
    width_mm, height_mm : float
        The paper as it lies, mm.
    """

    board: Board
    paper: str
    width_mm: float
    height_mm: float

    @property
    def way(self) -> str:
        """``portrait`` or ``landscape``."""
        return "portrait" if self.width_mm < self.height_mm else "landscape"

    @property
    def origin_mm(self) -> tuple[float, float]:
        """Where the outer corner of the first square lies, from the upper left of the paper."""
        width, height = (1e3 * side for side in self.board.size_m)
        free = self.height_mm - STRIP_MM - MARGIN_MM
        return (self.width_mm - width) / 2, max((free + MARGIN_MM - height) / 2, MARGIN_MM)


def laid_out(board: Board, paper: str) -> Sheet:
    """A board on paper, upright or across.

    Parameters
    ----------
    board : Board
        What to print.
    paper : str
        One of `PAPERS_MM`, in any case.

    Returns
    -------
    Sheet
        The way it fits.

    Raises
    ------
    ValueError
        If the paper is unknown or too small; the sentence says which square or paper would do.
    """
    named = {name.lower(): name for name in PAPERS_MM}
    if paper.lower() not in named:
        msg = f"got the paper {paper!r}; wanted one of {', '.join(PAPERS_MM)}"
        raise ValueError(msg)
    name = named[paper.lower()]
    best = 0.0
    for width, height in (PAPERS_MM[name], PAPERS_MM[name][::-1]):
        share = _share(board, width, height)
        if share >= 1 - 1e-9:
            return Sheet(board, name, width, height)
        best = max(best, share)
    width, height = (1e3 * side for side in board.size_m)
    square = 1e3 * board.square_m
    fits = {n: max(_share(board, a, b), _share(board, b, a)) for n, (a, b) in PAPERS_MM.items()}
    larger = [n for n, share in fits.items() if share >= 1]
    other = f", or --paper {larger[0]}" if larger else ""
    msg = (
        f"the board is {width:.0f} x {height:.0f} mm and does not fit on {name}; squares of up to "
        f"{np.floor(square * best * 10) / 10:.1f} mm would (got {square:g}){other}"
    )
    raise ValueError(msg)


def _share(board: Board, width_mm: float, height_mm: float) -> float:
    """How many times the board fits on the paper."""
    width, height = (1e3 * side for side in board.size_m)
    free = height_mm - 2 * MARGIN_MM - STRIP_MM
    return min((width_mm - 2 * MARGIN_MM) / width, free / height)


def write_sheet(path: Path | str, sheet: Sheet, *, dpi: int = DPI) -> None:
    """Write a sheet, whole or not at all.

    Parameters
    ----------
    path : path
        Target, ``*.pdf`` (vector, the paper as its page) or ``*.png`` (with its dpi).
    sheet : Sheet
        What to write.
    dpi : int
        Pixels per inch of a PNG.

    Raises
    ------
    ValueError
        If the suffix or the dpi is wrong, or the target cannot be written.
    """
    kind = Path(path).suffix.lower()
    if kind not in (".pdf", ".png"):
        msg = f"got {Path(path).name}; a board is written as .pdf or .png"
        raise ValueError(msg)
    if not 72 <= dpi <= 1200:
        msg = f"dpi must be 72 to 1200, got {dpi}"
        raise ValueError(msg)
    figure = _drawn(sheet)
    with atomic_path(path) as temporary:
        if kind == ".pdf":
            figure.savefig(temporary, format="pdf", metadata={"CreationDate": None})
        else:
            figure.savefig(temporary, format="png", dpi=dpi, facecolor="white")


def _drawn(sheet: Sheet) -> Any:  # noqa: ANN401 - matplotlib has no types
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    size = sheet.width_mm / MM_PER_INCH, sheet.height_mm / MM_PER_INCH
    figure = Figure(figsize=size)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, sheet.width_mm), ylim=(sheet.height_mm, 0))
    axes.axis("off")
    left, top = sheet.origin_mm
    patches = [Rectangle((left + x, top + y), w, h) for x, y, w, h in _rectangles(sheet.board)]
    dark = PatchCollection(patches, facecolor="black", edgecolor="none", linewidth=0)
    dark.set_snap(False)  # edges stay where they belong, to a share of a pixel
    axes.add_collection(dark)
    _ruler(axes, sheet)
    axes.text(MARGIN_MM + 108, sheet.height_mm - MARGIN_MM - 6, _title(sheet), fontsize=6)
    axes.text(MARGIN_MM, sheet.height_mm - MARGIN_MM + 3.5, SHORT, fontsize=5)
    return figure


def _title(sheet: Sheet) -> str:
    square = 1e3 * sheet.board.square_m
    return f"squares {square:g} mm, {sheet.paper}\ntoftools {sheet.board.text()}"


def _ruler(axes: Any, sheet: Sheet) -> None:  # noqa: ANN401
    """A ruler of 100 mm, a mark every 10 mm."""
    y = sheet.height_mm - MARGIN_MM - 1
    axes.plot([MARGIN_MM, MARGIN_MM + 100], [y, y], color="black", linewidth=0.6)
    for i in range(11):
        x, long = MARGIN_MM + 10 * i, 3.0 if i % 5 == 0 else 1.8
        axes.plot([x, x], [y, y - long], color="black", linewidth=0.6)
    for i, text in ((0, "0"), (5, "50"), (10, "100 mm")):
        axes.text(MARGIN_MM + 10 * i + 0.6, y - 3.2, text, fontsize=5)


def _rectangles(board: Board) -> Iterator[tuple[float, float, float, float]]:
    """Dark parts: x, y, width and height from the first square, mm."""
    square = 1e3 * board.square_m
    for j, i in np.argwhere(dark_squares(board)):
        yield i * square, j * square, square, square
    for corner, cells in markers(board):
        step = 1e3 * board.marker_m / len(cells)
        x, y = 1e3 * corner
        # Runs along rows and along columns overlap, so that no hairline shows between cells.
        for row, start, length in _runs(cells):
            yield x + start * step, y + row * step, length * step, step
        for column, start, length in _runs(cells.T):
            yield x + column * step, y + start * step, step, length * step


def _runs(cells: Bool) -> Iterator[tuple[int, int, int]]:
    """Row, first cell and length of every run of dark cells."""
    for row, line in enumerate(cells):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for start, stop in edges.reshape(-1, 2):
            yield row, int(start), int(stop - start)
