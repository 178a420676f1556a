"""Which model of the light a method chose, as shares of the pixels, for methods that say so."""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toftools.bench.plan import Point
from toftools.bench.results import result_path
from toftools.bench.score import read_answer
from toftools.bench.table import label_of

MOST_NAMES = 20
"""Models in a table at most."""


def choices(out: Path, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Table of a group: share of the answered pixels that each model got, per setting and capture.

    Parameters
    ----------
    out : Path
        Benchmark folder.
    rows : sequence of mapping
        Rows of one group.

    Returns
    -------
    dict
        ``head`` and ``rows``, and ``table`` for programs; empty if no method names models.
    """
    found = []
    for row in rows:
        if row["status"] != "ok":
            continue
        point = Point(str(row["capture_id"]), str(row["method"]), row["params"])
        shares = model_shares(result_path(out, point).with_suffix(".npz"))
        if shares:
            found.append((label_of(row), str(row["capture"]), shares))
    names = list(dict.fromkeys(name for _, _, shares in found for name in shares))[:MOST_NAMES]
    if not names:
        return {}
    return {
        "head": ["method", "capture", *names],
        "rows": [
            [label, capture, *(f"{100 * shares.get(name, 0.0):.1f} %" for name in names)]
            for label, capture, shares in found
        ],
        "table": [
            {"setting": label, "capture": capture, "model": name, "share": share}
            for label, capture, shares in found
            for name, share in shares.items()
        ],
    }


def model_shares(path: Path) -> dict[str, float]:
    """Share of the answered pixels by model.

    Parameters
    ----------
    path : Path
        Stored answer of a point.

    Returns
    -------
    dict of str to float
        Shares of 1 by name; empty if the answer is not there, or the method chose no model.
    """
    if not path.exists() or not _names_models(path):
        return {}
    depth = read_answer(path)
    model, names = np.asarray(depth.info["model"]), [str(n) for n in depth.info["models"]]
    answered = np.isfinite(depth.range_m)
    counts = np.bincount(model[answered].ravel(), minlength=len(names))[: len(names)]
    total = max(int(answered.sum()), 1)
    return {name: float(count) / total for name, count in zip(names, counts, strict=True)}


def _names_models(path: Path) -> bool:
    """Whether an answer holds a map of models; the maps themselves are not read."""
    try:
        with zipfile.ZipFile(path) as stored:
            return "model.npy" in stored.namelist() and "models.npy" in stored.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
