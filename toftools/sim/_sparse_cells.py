"""Cells of an image that halve where interpolation is too coarse, and what their middles tell."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toftools.sim._sparse_rows import Ground, Ints, rows
from toftools.types import F64, Bool

C128 = NDArray[np.complex128]
Evaluate = Callable[[Ints], C128]
Errors = Callable[[C128, Ints], F64]

CELLS_ACROSS = 12
"""At least so many of the first cells lie across the shorter side of an image."""
STEPS = (64, 32, 16, 8, 4, 2)
"""Sizes of first cells, px."""
SMOOTH = 0.25
"""Error after a split against before, where second derivatives exist."""
KEPT = 0.6
"""Share of the budget for cells that stay as they are, when others must be split."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Squares of pixels without gap or overlap; corners are kept inside the image.

    Parameters
    ----------
    y, x, step : ndarray of int, (K,)
        First corner and side, px.
    seen_m : ndarray, (K,)
        Error measured at the cell's corners and parts when it was made, NaN if none.
    error_m : ndarray, (K,)
        Error expected inside; infinite if unknown.
    home : ndarray of int, (N,)
        The cell of each pixel.
    """

    y: Ints
    x: Ints
    step: Ints
    seen_m: F64
    error_m: F64
    home: Ints


@dataclass(frozen=True, eq=False)
class Picked:
    """Sampled pixels (S,), their values (C, S), and the number of a pixel's sample (N,) or -1."""

    pixels: Ints
    values: C128
    slot: Ints


def first_cells(shape: tuple[int, int]) -> Cells:
    """One layer of equal cells over an image (H, W) px."""
    height, width = shape
    step = next((s for s in STEPS if s * CELLS_ACROSS <= min(shape)), STEPS[-1])
    down, across = (max(1, -(-(n - 1) // step)) for n in shape)
    y, x = (part.ravel() * step for part in np.indices((down, across)))
    row = np.minimum(np.arange(height) // step, down - 1)
    column = np.minimum(np.arange(width) // step, across - 1)
    home = (row[:, None] * across + column).ravel()
    nothing, unknown = np.full(y.size, np.nan), np.full(y.size, np.inf)
    return Cells(y, x, np.full(y.size, step), nothing, unknown, home)


def nodes(cells: Cells, shape: tuple[int, int]) -> tuple[Ints, Bool]:
    """Corners, edge middles and centres as pixel numbers (K, 3, 3), and which are not corners."""
    near, middle, far = _thirds(cells, shape)
    ys, xs = (np.stack(part, axis=1) for part in zip(near, middle, far, strict=True))
    tall, wide = (m < f for m, f in zip(middle, far, strict=True))
    new = np.zeros((len(cells.y), 3, 3), bool)
    new[:, 1, ::2] = tall[:, None]
    new[:, ::2, 1] = wide[:, None]
    new[:, 1, 1] = tall & wide
    return ys[:, :, None] * shape[1] + xs[:, None, :], new


def bilinear(cells: Cells, which: Ints, targets: Ints, shape: tuple[int, int]) -> tuple[Ints, F64]:
    """Corners (n, 4) of cells as pixel numbers, and their bilinear weights in target pixels."""
    width = shape[1]
    (y0, x0), _, (y1, x1) = _thirds(cells, shape)
    y0, x0, y1, x1 = (part[which] for part in (y0, x0, y1, x1))
    corners = np.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1], 1)
    t = (targets // width - y0) / np.maximum(y1 - y0, 1)
    s = (targets % width - x0) / np.maximum(x1 - x0, 1)
    return corners, np.stack([(1 - t) * (1 - s), (1 - t) * s, t * (1 - s), t * s], axis=1)


def added(picked: Picked, evaluate: Evaluate, pixels: Ints) -> Picked:
    """The samples with those of new pixels, each of which is evaluated once."""
    new = np.unique(pixels)
    new = new[picked.slot[new] < 0]
    if not len(new):
        return picked
    values, slot = np.asarray(evaluate(new)), picked.slot.copy()
    slot[new] = len(picked.pixels) + np.arange(len(new))
    if len(picked.pixels):
        values = np.concatenate([picked.values, values], axis=1)
    return Picked(np.concatenate([picked.pixels, new]), values, slot)


def strangers(ground: Ground, cells: Cells, slot: Ints, among: Bool) -> Ints:
    """One pixel of every kind of surface in a cell that neither corners nor samples there show."""
    pixels = np.flatnonzero(ground.valid & among)
    corners, _ = bilinear(cells, np.arange(len(cells.y)), np.zeros(len(cells.y), int), ground.shape)
    known = ground.kind[corners][cells.home[pixels]] == ground.kind[pixels][:, None]
    sampled = slot[pixels] >= 0
    key = ground.kind[pixels] * len(cells.y) + cells.home[pixels]
    # Pixels whose corners know them need no look at the samples.
    open_ = np.flatnonzero(~known.any(axis=1))
    open_ = open_[~np.isin(key[open_], key[sampled])]
    _, begin, count = np.unique(np.sort(key[open_]), return_index=True, return_counts=True)
    order = np.argsort(key[open_], kind="stable")
    return np.asarray(pixels[open_[order[begin + count // 2]]])


def chosen(ground: Ground, cells: Cells, slot: Ints, budget: float) -> Bool:
    """The fewest cells that should be split, so that the sum of squared errors meets a budget.

    Parameters
    ----------
    ground : Ground
        Geometry.
    cells : Cells
        As they are.
    slot : ndarray of int, (N,)
        Sampled pixels have no error.
    budget : float
        Sum of squared errors over the pixels, m^2.

    Returns
    -------
    ndarray of bool, (K,)
        Cells to split; none if the budget is met.
    """
    open_ = ground.valid & (slot < 0)
    area = np.bincount(cells.home[open_], minlength=len(cells.y))
    able = (cells.step > 1) & (area > 0)
    unknown = able & np.isinf(cells.error_m)
    known = able & ~unknown
    mass = np.where(known, area * np.where(known, cells.error_m, 0.0) ** 2, 0.0)
    order = np.argsort(-mass)
    rest = mass.sum() - np.concatenate([[0.0], np.cumsum(mass[order])])
    count = int(np.argmax(rest <= KEPT * budget)) if rest[0] > budget else 0
    choice = unknown.copy()
    choice[order[:count]] |= mass[order[:count]] > 0
    return choice


def split(
    ground: Ground, cells: Cells, picked: Picked, choice: Bool, tools: tuple[Evaluate, Errors]
) -> tuple[Cells, Picked]:
    """Cells with some of them split in four, samples at the new corners, and what these showed.

    Parameters
    ----------
    ground : Ground
        Geometry.
    cells, picked : Cells, Picked
        As they are.
    choice : ndarray of bool, (K,)
        Cells to split.
    tools : tuple of callable
        `evaluate` and `errors_m` of `place`.

    Returns
    -------
    Cells, Picked
        As they are then.
    """
    parents = np.flatnonzero(choice)
    grid, new = (part[parents] for part in nodes(cells, ground.shape))
    new &= ground.valid[grid]
    middles: Ints
    middles, first = np.unique(grid[new], return_index=True)
    owners = np.repeat(parents, new.sum(axis=(1, 2)))[first]
    made = _with_children(cells, choice, ground.shape)
    guests = strangers(ground, made, _marked(picked.slot, middles), choice[cells.home])
    targets: Ints = np.concatenate([middles, guests])
    owner: Ints = np.concatenate([owners, cells.home[guests]])
    corners, weights = bilinear(cells, owner, targets, ground.shape)
    matrix, served = rows(ground, targets, corners, weights, picked.slot)
    before, picked = picked, added(picked, tools[0], targets)
    wrong = picked.values[:, picked.slot[targets]] - (matrix @ before.values.T).T
    error = np.full(ground.valid.size, np.nan)
    error[targets[served]] = tools[1](wrong[:, served], targets[served])
    at_nodes = np.where(new, error[grid], np.nan)
    children = [at_nodes[:, i : i + 2, j : j + 2].reshape(-1, 4) for i in (0, 1) for j in (0, 1)]
    squares = np.stack(children, axis=1).reshape(-1, 4) ** 2
    base = len(made.y) - len(squares)
    hosts, extra = made.home[guests] - base, error[guests]
    count = np.isfinite(squares).sum(axis=1)
    count = count + np.bincount(hosts, np.isfinite(extra), len(squares))
    total = np.nansum(squares, axis=1) + np.bincount(hosts, np.nan_to_num(extra) ** 2, len(squares))
    worst = np.sqrt(np.fmax.reduce(squares, axis=1))
    worst = np.where(_mixed(ground, made)[base:], worst, np.nan)
    made = _expecting(made, base, np.sqrt(total / np.where(count > 0, count, np.nan)), worst)
    return _warned(made, middles, cells.step[owners], error[middles], ground.shape), picked


def _warned(cells: Cells, pixels: Ints, step: Ints, error_m: F64, shape: tuple[int, int]) -> Cells:
    """Cells that were not split, with the errors of nodes that lie on their edges too."""
    row, column = pixels // shape[1], pixels % shape[1]
    worst, known = cells.error_m.copy(), np.nan_to_num(error_m)
    for up, left in ((0, 0), (0, 1), (1, 0)):
        beside = np.maximum(row - up, 0) * shape[1] + np.maximum(column - left, 0)
        cell = cells.home[beside]
        own = cells.step[cell] >= step
        np.maximum.at(worst, cell[own], known[own])
    return replace(cells, error_m=worst)


def _mixed(ground: Ground, cells: Cells) -> Bool:
    """Cells with pixels of several kinds of surface, (K,)."""
    pixels = np.flatnonzero(ground.valid)
    home, kind = cells.home[pixels], ground.kind[pixels]
    least = np.full(len(cells.y), np.iinfo(np.int64).max)
    most = np.full(len(cells.y), -1)
    np.minimum.at(least, home, kind)
    np.maximum.at(most, home, kind)
    return np.asarray(most > least)


def _expecting(cells: Cells, base: int, seen_m: F64, least_m: F64) -> Cells:
    """Cells from `base` on with what was seen of them, and what that lets expect."""
    before, expected = cells.seen_m[base:], cells.error_m[base:]
    decay = np.full(len(seen_m), SMOOTH)
    np.divide(seen_m, before, out=decay, where=(before > 0) & np.isfinite(seen_m))
    found = np.isfinite(seen_m)
    expected = np.where(found, seen_m * np.clip(decay, SMOOTH, 1.0), expected)
    expected = np.fmax(expected, least_m)
    seen = np.concatenate([cells.seen_m[:base], np.where(found, seen_m, before)])
    error = np.concatenate([cells.error_m[:base], expected])
    return replace(cells, seen_m=seen, error_m=error)


def _with_children(cells: Cells, choice: Bool, shape: tuple[int, int]) -> Cells:
    """Cells that are not split, then four children of each that is, row by row."""
    stay, child = np.flatnonzero(~choice), np.tile(np.arange(4), int(choice.sum()))
    source = np.append(stay, np.repeat(np.flatnonzero(choice), 4))
    child = np.append(np.zeros(len(stay), int), child)
    half, halved = cells.step // 2, choice[source]
    y = cells.y[source] + child // 2 * half[source]
    x = cells.x[source] + child % 2 * half[source]
    step = np.where(halved, half[source], cells.step[source])
    number = np.where(
        choice, len(stay) + 4 * (np.cumsum(choice) - 1), np.cumsum(~choice) - 1
    )  # of a cell or its first child
    home = number[cells.home]
    moved = np.flatnonzero(choice[cells.home])
    cell = cells.home[moved]
    low = moved // shape[1] - cells.y[cell] >= half[cell]
    right = moved % shape[1] - cells.x[cell] >= half[cell]
    home[moved] += 2 * low + right
    return Cells(y, x, step, cells.seen_m[source], cells.error_m[source], home)


def _thirds(cells: Cells, shape: tuple[int, int]) -> list[tuple[Ints, Ints]]:
    """First, middle and last row and column of cells, kept inside the image."""
    bottom, right = shape[0] - 1, shape[1] - 1
    steps = (0, cells.step // 2, cells.step)
    return [(np.minimum(cells.y + s, bottom), np.minimum(cells.x + s, right)) for s in steps]


def _marked(slot: Ints, pixels: Ints) -> Ints:
    """Slots with more pixels taken for sampled."""
    marked = slot.copy()
    marked[pixels] = 0
    return marked
