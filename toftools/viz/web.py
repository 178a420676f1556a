"""A cloud as one HTML page to turn and zoom: no server, no network, no library.

Positions travel as 16-bit steps inside the cloud's bounding box (a 10 m box: 0.15 mm), colours as
8-bit values with their colour map, all in base64; viewer.html draws them with plain WebGL.
"""

import base64
import importlib.resources
import json
from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.viz._view import PITCH_DEG, YAW_DEG
from toftools.viz.cloud import MAPS, flat, scale, shares

MAX_POINTS = 60_000


def cloud_html(
    points: NDArray[Any], values: Mapping[str, NDArray[Any]], *, title: str = "cloud"
) -> str:
    """Self-contained page that shows a cloud.

    Parameters
    ----------
    points : ndarray, (..., 3)
        Points x right, y down, z forward, m; rows that are not finite are left out, and above
        60 000 points a random choice of that many is shown.
    values : mapping of str to ndarray, (...)
        What the colour can show: ``range`` (m), ``amplitude``; the first is shown at the start.
    title : str
        Title.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    ValueError
        If there is no value, no finite point, or shapes or kinds do not fit.
    """
    if not values:
        msg = f"got no values to colour the cloud by, wanted at least one of {', '.join(MAPS)}"
        raise ValueError(msg)
    columns = {kind: flat(points, array, kind) for kind, array in values.items()}
    xyz = next(iter(columns.values()))[0]
    chosen = np.arange(len(xyz))
    if len(xyz) > MAX_POINTS:
        # Evenly random, with a fixed seed: every n-th pixel would draw stripes.
        rng = np.random.default_rng(0)
        chosen = np.sort(rng.choice(len(xyz), MAX_POINTS, replace=False))
    xyz = xyz[chosen]
    low, span = xyz.min(axis=0), np.maximum(np.ptp(xyz, axis=0), 1e-9)
    inner = np.percentile(xyz, [1, 99], axis=0)  # stray points must not shrink the rest to a dot
    radius = max(float(np.linalg.norm(inner[1] - inner[0])) / 2, 1e-6)
    steps = np.round((xyz - low) / span * 65_535).astype("<u2")
    data = {
        "xyz": _text(steps),
        "low": low.tolist(),
        "span": span.tolist(),
        "centre": inner.mean(axis=0).tolist(),
        "radius": radius,
        "spacing": 2 * radius / float(np.sqrt(len(xyz))),
        "yaw": float(np.radians(YAW_DEG)),
        "pitch": float(np.radians(PITCH_DEG)),
        "channels": {kind: _channel(kind, shade[chosen]) for kind, (_, shade) in columns.items()},
    }
    page = importlib.resources.files("toftools.viz").joinpath("viewer.html")
    text = page.read_text(encoding="utf-8").replace("__DATA__", json.dumps(data))
    return text.replace("__TITLE__", escape(title))


def _channel(kind: str, shade: NDArray[np.float64]) -> dict[str, Any]:
    """One way to colour: values 1..255 (0 unknown), colour map, tick labels from the top."""
    from matplotlib import colormaps

    norm = scale(shade, kind)
    share = shares(shade, norm)
    codes = np.where(np.isfinite(share), 1 + np.round(np.nan_to_num(share) * 254), 0)
    table = np.round(colormaps[MAPS[kind]](np.linspace(0, 1, 256))[:, :3] * 255)
    return {
        "name": "range, m" if kind == "range" else kind,
        "values": _text(codes.astype(np.uint8)),
        "map": _text(table.astype(np.uint8)),
        "ticks": [f"{float(f'{value:.4g}'):.10g}" for value in norm.inverse(np.linspace(1, 0, 5))],
    }


def _text(array: NDArray[Any]) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
