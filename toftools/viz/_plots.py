"""What the charts drawn with matplotlib share: a row of axes, their labels, a PNG."""

import io
from typing import Any

import numpy as np

DPI = 130
INK, SOFT = "#1d2330", "#667085"


def row(columns: int, height_in: float) -> tuple[Any, Any]:
    """A figure of axes side by side, all of matplotlib: the figure, and its axes."""
    from matplotlib.figure import Figure

    count = max(columns, 1)
    width = 4.6 * count if count > 1 else 6.4
    figure = Figure(figsize=(width, height_in), dpi=DPI, facecolor="white", layout="constrained")
    return figure, np.atleast_1d(figure.subplots(1, count))


def labels(ax: Any, title: str, x: str, y: str) -> None:  # noqa: ANN401 - no types here
    """Title and units, and quiet lines."""
    ax.set_title(title, fontsize=10, loc="left", color=INK)
    ax.set_xlabel(x, fontsize=9, color=INK)
    ax.set_ylabel(y, fontsize=9, color=INK)
    ax.tick_params(labelsize=8, color=SOFT, labelcolor=INK)
    ax.grid(color="#e4e7ec", lw=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color("#98a2b3")


def png(figure: Any) -> bytes:  # noqa: ANN401
    """The figure as a PNG, without a word of who drew it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(
        buffer, metadata={"Software": None}, pil_kwargs={"optimize": True}
    )
    return buffer.getvalue()
