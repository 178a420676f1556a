"""How simple a model may be: along a ladder of models, the knee, and who suffices for which pixel.

The **knee** is the simplest rung whose error is within 10 % of the least on the ladder, or within
1 mm of it, whichever is more. A rung that failed anywhere, or answers less than half of the pixels
or a tenth fewer than another rung, is no candidate: who drops the hard pixels errs less. A rung
**suffices** for a pixel where its error is at most the tolerance; every pixel belongs to the first
rung that does, or to none. That first one may do so by chance: where noise is near the tolerance,
simple rungs get more than they deserve. Over all scenes, every scene counts alike.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.types import F64, Bool

SLACK, SLACK_M = 0.1, 1e-3
"""Errors this close to the least, relatively or in m, count as no worse."""
LEAST_VALID, FEWER = 0.5, 0.9
"""Share of the pixels that a candidate answers, and that share over the largest on the ladder."""
ALL = ""
"""Name of all scenes together."""

Pixels = Callable[[str], F64 | None]
"""Key of a point to its absolute error per pixel, m: infinite without an answer, NaN where nothing
is scored; None if there is no answer at all."""


@dataclass(frozen=True, eq=False)
class Climb:
    """One scene, or all of them, by the models of a ladder.

    Parameters
    ----------
    ladder, scene : str
        Which; `ALL` for all scenes.
    rungs : ndarray, (R,)
        Complexity, rising.
    labels, methods : tuple of str
        The rungs in words, and their models.
    error_m : ndarray, (R, S)
        Mean absolute error per seed, m; infinite where a point failed.
    valid : ndarray, (R,)
        Share of pixels answered.
    within : ndarray, (R,)
        Share of pixels for which the rung suffices.
    first : ndarray, (R,)
        Share of pixels for which it is the first that does.
    ms : ndarray, (R,)
        Time per frame, ms; NaN if nothing was timed.
    knee : int or None
        Number of the rung of the knee; None if no rung is a candidate.
    failures : tuple of str
        What went wrong on each rung, or empty.
    """

    ladder: str
    scene: str
    rungs: F64
    labels: tuple[str, ...]
    methods: tuple[str, ...]
    error_m: F64
    valid: F64
    within: F64
    first: F64
    ms: F64
    knee: int | None
    failures: tuple[str, ...]

    @property
    def mean_m(self) -> F64:
        """Mean error of every rung over seeds, m (R,)."""
        return np.asarray(self.error_m.mean(axis=1))


def climbs(
    name: str, ladder: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]], pixels: Pixels
) -> list[Climb]:
    """All scenes of a ladder, and all of them together as the last.

    Parameters
    ----------
    name : str
        Of the ladder.
    ladder : mapping
        ``within_m``, and ``rungs``: mappings with ``rung``, ``label``, ``method`` and ``scenes``,
        a mapping of scene to the keys of its points, one per seed.
    rows : mapping
        Key of a point to its row of results.
    pixels : callable
        Errors of its pixels.

    Returns
    -------
    list of Climb
        In the order of the ladder's scenes; only one if it has only one scene.
    """
    rungs = ladder["rungs"]
    scenes = dict.fromkeys(scene for rung in rungs for scene in rung["scenes"])
    found = [_climb(name, scene, ladder, rows, pixels) for scene in scenes]
    return [*found, _together(found)] if len(found) > 1 else found


def _climb(
    name: str, scene: str, ladder: Mapping[str, Any],
    rows: Mapping[str, Mapping[str, Any]], pixels: Pixels,
) -> Climb:  # fmt: skip
    rungs = ladder["rungs"]
    keys = [rung["scenes"].get(scene, []) for rung in rungs]
    seeds = max(len(mine) for mine in keys)
    error, valid, ms = (np.full((len(rungs), seeds), np.nan) for _ in range(3))
    for at, mine in enumerate(keys):
        for seed, key in enumerate(mine):
            error[at, seed], valid[at, seed], ms[at, seed] = _figures(rows.get(key, {}))
    error = np.where(np.isfinite(error), error, np.inf)
    shares = np.mean(
        [_shares([_one(mine, seed, pixels) for mine in keys], ladder["within_m"])
         for seed in range(seeds)], axis=0)  # fmt: skip
    answered = np.nan_to_num(valid).mean(axis=1)
    return Climb(
        name, scene, np.array([rung["rung"] for rung in rungs], np.float64),
        tuple(str(rung["label"]) for rung in rungs), tuple(str(rung["method"]) for rung in rungs),
        error, answered, shares[0], shares[1], _mean(ms), knee(error.mean(axis=1), answered),
        tuple(_failure(mine, rows) for mine in keys),
    )  # fmt: skip


def _figures(row: Mapping[str, Any]) -> tuple[float, float, float]:
    """Error, share of pixels answered and time of a row; NaN where there is none."""
    metrics = row.get("metrics") or {}
    found = (metrics.get("mae_m"), metrics.get("valid_share"), row.get("ms"))
    error, valid, ms = (np.nan if figure is None else float(figure) for figure in found)
    return error, valid, ms


def _one(keys: Sequence[str], seed: int, pixels: Pixels) -> F64 | None:
    return pixels(keys[seed]) if seed < len(keys) else None


def _shares(errors_m: Sequence[F64 | None], within_m: float) -> F64:
    """Shares of the pixels for which every rung suffices, and is the first that does, (2, R)."""
    known = [one for one in errors_m if one is not None]
    if not known:
        return np.zeros((2, len(errors_m)))
    scored = np.logical_and.reduce([~np.isnan(one) for one in known])
    good = np.array(
        [np.zeros(int(scored.sum()), bool) if one is None else one[scored] <= within_m
         for one in errors_m])  # fmt: skip
    first = first_sufficing(good)
    return np.stack([good.mean(axis=1) if scored.any() else np.zeros(len(good)), first])


def first_sufficing(good: Bool) -> F64:
    """Share of pixels for which each rung is the first that suffices.

    Parameters
    ----------
    good : ndarray, (R, P), bool
        Whether a rung suffices for a pixel, simplest rung first.

    Returns
    -------
    ndarray, (R,)
        Shares; what is missing to 1 is the share for which none does.

    Examples
    --------
    >>> first_sufficing(np.array([[True, False, False], [False, True, False]])).round(2).tolist()
    [0.33, 0.33]
    """
    if not good.shape[1]:
        return np.zeros(len(good))
    before = np.logical_or.accumulate(good, axis=0)
    before = np.concatenate([np.zeros((1, good.shape[1]), bool), before[:-1]])
    return np.asarray((good & ~before).mean(axis=1))


def knee(error_m: F64, valid: F64) -> int | None:
    """The simplest rung that errs hardly more than the best.

    Parameters
    ----------
    error_m : ndarray, (R,)
        Mean absolute error, m, simplest rung first; infinite where a rung failed.
    valid : ndarray, (R,)
        Share of pixels answered.

    Returns
    -------
    int or None
        Its number; None if no rung is a candidate.

    Examples
    --------
    >>> knee(np.array([0.09, 0.0204, 0.020]), np.ones(3))
    1
    """
    usable = np.isfinite(error_m) & (valid >= LEAST_VALID)
    if not usable.any():
        return None
    usable &= valid >= FEWER * valid[usable].max()
    least = float(error_m[usable].min())
    return int(np.flatnonzero(usable & (error_m <= least + max(SLACK * least, SLACK_M)))[0])


def _failure(keys: Sequence[str], rows: Mapping[str, Mapping[str, Any]]) -> str:
    """What went wrong on a rung of a scene, once each."""
    missing = {"status": "missing", "error": "not run"}
    mine = [rows.get(key, missing) for key in keys] or [missing]
    said = [f"{row['status']}: {row['error']}" for row in mine if row["status"] != "ok"]
    said += ["no answer" for row in mine if row["status"] == "ok" and np.isnan(_figures(row)[0])]
    return "; ".join(dict.fromkeys(said))


def _together(found: Sequence[Climb]) -> Climb:
    """All scenes of a ladder, every scene alike."""
    one = found[0]
    seeds = min(climb.error_m.shape[1] for climb in found)
    error = np.mean([climb.error_m[:, :seeds] for climb in found], axis=0)
    # A rung that hardly answers in one scene is no candidate, however much it answers elsewhere.
    least = np.min([climb.valid for climb in found], axis=0)
    valid, within, first, ms = (
        _mean(np.stack([getattr(climb, key) for climb in found], axis=1))
        for key in ("valid", "within", "first", "ms")
    )
    failures = [
        "; ".join(f"{climb.scene}: {climb.failures[at]}" for climb in found if climb.failures[at])
        for at in range(one.rungs.size)
    ]
    return Climb(
        one.ladder, ALL, one.rungs, one.labels, one.methods, error, valid, within, first, ms,
        knee(error.mean(axis=1), least), tuple(failures),
    )  # fmt: skip


def _mean(figures: F64) -> F64:
    """Means over the last axis of what is known; NaN where nothing is."""
    known = np.isfinite(figures)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, figures, 0).sum(axis=1) / known.sum(axis=1))
