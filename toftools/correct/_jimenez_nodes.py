"""A frame on few nodes: one small patch for every block of pixels, for an optimiser to move.

A node is the flat pixel nearest to the middle of its block. It stands for those pixels of the
block that lie on its plane: their areas are added, and their phasors averaged once the way to the
camera is taken off, so that a slanted block loses no contrast. What lies on no such plane gets a
node of its own, or light would be lost at creases and in noise. References: none, plain
bookkeeping. Inputs: the surface elements and phasors of a frame. Fails where objects are smaller
than a block: what has no node neither sends light nor is moved.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools._transfer import Patches
from toftools.correct._scene import Optics, Surface, lit, patches
from toftools.types import C64, F32, F64, Bool
from toftools.units import range_to_phase

SAME_PLANE = 0.25
"""Pixels farther from a node's plane than this share of the block's width are not of it."""
SAME_NORMAL = 0.8
"""Nor are those whose normal is turned by more than 37 degrees."""
LAYERS = 3
"""Blocks have up to as many nodes: what is not of the first one's plane gets more."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Patches on a coarse grid.

    Parameters
    ----------
    patches : Patches
        Places, normals, areas of the N nodes.
    ray : ndarray, (3, N)
        Viewing direction of each.
    range_m : ndarray, (N,)
        Range, m, float64.
    light : ndarray, (F, N)
        Mean phasor with the way to the camera and back taken off, complex128: real and positive
        without multipath and noise.
    noise : ndarray, (F, N)
        Standard deviation of its real and imaginary part.
    flash : ndarray, (F, N)
        Irradiance of the flash in the unit of the phasors.
    pairs : ndarray, (2, E)
        Numbers of the first nodes of neighbouring blocks.
    """

    patches: Patches
    ray: F32
    range_m: F64
    light: NDArray[np.complex128]
    noise: F64
    flash: F64
    pairs: NDArray[np.intp]


def place(
    view: Optics, seen: Surface, values: C64, sigma: F32 | None, usable: Bool, *, count: int
) -> Nodes:
    """Choose nodes on a frame.

    Parameters
    ----------
    view : Optics
        Of the camera.
    seen : Surface
        Surface elements.
    values : ndarray, (F, H, W)
        Phasors.
    sigma : ndarray, (F, H, W), or None
        Their standard deviation; None counts as none.
    usable : ndarray, (H, W), bool
        Pixels that may take part.
    count : int
        About how many nodes to have.

    Returns
    -------
    Nodes
        N of them, about `count` and more at edges; possibly none.
    """
    shape = usable.shape
    block = max(1, round(float(np.sqrt(usable.size / count))))
    rows = -(-shape[0] // block), -(-shape[1] // block)
    v, u = np.indices(shape, np.int32)
    number = ((v // block) * rows[1] + u // block).ravel()
    off = ((v % block - (block - 1) / 2) ** 2 + (u % block - (block - 1) / 2) ** 2).ravel()
    left = np.flatnonzero(usable & seen.flat)
    left = left[np.lexsort((off[left], number[left]))]
    chosen, members, mine, total = [], [], [], 0
    grid = np.full(rows[0] * rows[1], -1)
    for layer in range(LAYERS):
        found, first, which = np.unique(number[left], return_index=True, return_inverse=True)
        if layer == 0:
            grid[found] = np.arange(found.size)
        own = left[first][which]
        alike = _alike(seen, left, own, block)
        chosen.append(left[first])
        members.append(left[alike])
        mine.append(total + which[alike])
        total += found.size
        left = left[~alike]
    all_chosen, all_members, all_mine = (np.concatenate(a) for a in (chosen, members, mine))
    pairs = _pairs(grid.reshape(rows))
    return _collected(view, seen, values, sigma, all_chosen, all_members, all_mine, pairs)


def _alike(seen: Surface, pixels: NDArray[np.intp], own: NDArray[np.intp], block: int) -> Bool:
    """Whether pixels lie on the planes of their nodes."""
    at, normal = seen.position.reshape(3, -1), seen.normal.reshape(3, -1)
    off = np.abs(np.sum((at[:, pixels] - at[:, own]) * normal[:, own], axis=0))
    width = block * np.sqrt(seen.area_m2.flat[own])
    turned = np.sum(normal[:, pixels] * normal[:, own], axis=0)
    return np.asarray((off <= SAME_PLANE * width) & (turned > SAME_NORMAL))


def _collected(
    view: Optics, seen: Surface, values: C64, sigma: F32 | None,
    chosen: NDArray[np.intp], members: NDArray[np.intp], mine: NDArray[np.intp],
    pairs: NDArray[np.intp],
) -> Nodes:  # fmt: skip
    """Sums over the pixels `members` of the nodes `mine`."""
    n_freqs, count = view.freqs_hz.size, chosen.size
    row, column = np.unravel_index(chosen, seen.known.shape)
    range_m = np.sqrt(np.sum(seen.position.astype(np.float64) ** 2, axis=0))
    way = range_m.flat[members]
    n = np.maximum(np.bincount(mine, minlength=count), 1)
    light = np.empty((n_freqs, count), np.complex128)
    noise = np.zeros((n_freqs, count))
    for f, freq in enumerate(view.freqs_hz):
        z = values[f].flat[members] * np.exp(-1j * range_to_phase(way, freq))
        light[f] = (np.bincount(mine, z.real, count) + 1j * np.bincount(mine, z.imag, count)) / n
        if sigma is not None:
            power = np.square(sigma[f].flat[members], dtype=np.float64)
            noise[f] = np.sqrt(np.bincount(mine, power, count)) / n
    area = np.bincount(mine, seen.area_m2.flat[members], count)
    one = np.zeros(seen.known.shape, bool)
    one[row, column] = True
    order = np.argsort(np.argsort(chosen))  # `patches` keeps the order of the image
    here = patches(seen, one)
    placed = Patches(here.position[:, order], here.normal[:, order], area.astype(np.float32))
    return Nodes(
        placed,
        np.asarray(view.rays[:, row, column]),
        range_m[row, column],
        light,
        noise,
        lit(view, seen)[:, row, column].astype(np.float64),
        pairs,
    )


def _pairs(grid: NDArray[np.intp]) -> NDArray[np.intp]:
    """Neighbours to the right and below that both exist."""
    across = np.stack([grid[:, :-1].ravel(), grid[:, 1:].ravel()])
    down = np.stack([grid[:-1].ravel(), grid[1:].ravel()])
    both = np.concatenate([across, down], axis=1)
    return np.asarray(both[:, (both >= 0).all(axis=0)])
