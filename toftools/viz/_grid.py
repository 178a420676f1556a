"""Where the maps, titles and colour bars of a picture stand, in pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Panel = tuple[str, NDArray[Any], str]
"""Title (may hold several lines), image (H, W), kind."""

BAR_PX = 118  # column of the colour bars, their tick labels included
KEY_PX = 28  # below the bars: what hatching means
GAP_PX = 10
LINE_PX = 17  # height of one line of a panel's title


@dataclass(frozen=True)
class Layout:
    """Where things stand, px: the page, its title, and the grid of maps with their own titles."""

    width_px: int
    height_px: int
    top_px: int
    columns: int
    cell_w_px: float
    cell_h_px: float
    head_px: int

    def cell(self, index: int) -> tuple[float, float, float, float]:
        """Box of one map as matplotlib wants it: left, bottom, width, height as shares."""
        row, column = divmod(index, self.columns)
        left = GAP_PX + column * (self.cell_w_px + GAP_PX)
        below = self.top_px + (row + 1) * (self.cell_h_px + self.head_px)
        return self.box(left, self.height_px - below, self.cell_w_px, self.cell_h_px)

    def box(
        self, left: float, bottom: float, width: float, height: float
    ) -> tuple[float, float, float, float]:
        """Pixels to shares of the page."""
        w, h = self.width_px, self.height_px
        return left / w, bottom / h, width / w, height / h


def layout(
    panels: Sequence[Panel], columns: int, width_px: int, titled: bool, n_bars: int
) -> Layout:
    """Layout of a grid of maps.

    Parameters
    ----------
    panels : sequence of (str, ndarray (H, W), str)
        Title, image and kind of each map.
    columns : int
        Maps side by side.
    width_px : int
        Width of the page.
    titled : bool
        Whether the page has a title.
    n_bars : int
        Number of colour bars.

    Returns
    -------
    Layout
        The layout; all cells have the median shape of the images.
    """
    rows = -(-len(panels) // columns)
    cell_w = (width_px - BAR_PX) / columns - GAP_PX
    cell_h = cell_w * float(np.median([image.shape[0] / image.shape[1] for _, image, _ in panels]))
    head = LINE_PX * max(text.count("\n") + 1 if text else 0 for text, _, _ in panels) + 14
    top = 2 * LINE_PX if titled else 0
    height = max(rows * (cell_h + head) + GAP_PX, 150 * n_bars + KEY_PX)
    return Layout(width_px, top + round(height), top, columns, cell_w, cell_h, head)
