"""Which model every pixel got: a map in few colours with a legend, as PNG bytes."""

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toftools.types import Bool

COLOURS = ("#dfe6ec", "#2f7ebc", "#e07b39", "#6a51a3", "#3a9d5d", "#c2453f")
"""One colour per model, the plainest first; more models start again."""
DPI = 100


def models_png(
    model: NDArray[np.integer],
    names: Sequence[str],
    known: Bool,
    *,
    title: str = "",
    width_px: int = 460,
) -> bytes:
    """Map of the chosen model, with the share of each in the legend.

    Parameters
    ----------
    model : ndarray, (H, W), int
        Index into `names`.
    names : sequence of str
        Names of the models.
    known : ndarray, (H, W), bool
        Pixels with an answer; the others stay white.
    title : str
        Title.
    width_px : int
        Width of the picture, px.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    ValueError
        If the image is not two-dimensional or an index has no name.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    if model.ndim != 2 or known.shape != model.shape or int(model.max(initial=0)) >= len(names):
        top = int(model.max(initial=0))
        msg = f"got indices {model.shape} up to {top}, wanted (H, W) below {len(names)}"
        raise ValueError(msg)
    ground = np.array([_rgb(COLOURS[i % len(COLOURS)]) for i in range(len(names))])
    image = np.where(known[..., None], ground[model], 255).astype(np.uint8)
    height_px = width_px * model.shape[0] / model.shape[1] + 28 + 22 * len(names)
    figure = Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    picture = width_px * model.shape[0] / model.shape[1] / height_px
    axes = figure.add_axes((0.01, 1 - picture - 24 / height_px, 0.98, picture))
    axes.imshow(image, interpolation="nearest")
    axes.set_axis_off()
    axes.set_title(title, fontsize=9, loc="left", color="#222")
    shares = np.bincount(model[known].ravel(), minlength=len(names)) / max(int(known.sum()), 1)
    handles = [
        Patch(facecolor=COLOURS[i % len(COLOURS)], edgecolor="#999", label=f"{name}: {share:.1%}")
        for i, (name, share) in enumerate(zip(names, shares, strict=True))
    ]
    figure.legend(handles=handles, loc="lower left", frameon=False, fontsize=9)
    png = io.BytesIO()
    figure.savefig(png, format="png", metadata={"Software": None})
    return png.getvalue()


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue
