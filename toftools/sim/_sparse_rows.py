"""Which pixels see one surface, and the weights by which sampled pixels answer for another.

Two pixels are alike if each lies in the tangent plane of the other, or if they are joined by a
smooth surface that bends no more than a chord between them allows: on planes, spheres and cylinders
the mean of two normals is at right angles to the chord. Inside a cell whose four corners are alike
the pixel, weights are bilinear. Elsewhere a local linear fit over the nearest samples that are
alike takes their place: the weighted sum of eq. (2.23) there, with gradients from the samples.

Fails where surfaces are closer to one another than a tenth of a pixel's footprint: those are one.

References
----------
J. Marco, "Transient Light Transport", PhD thesis, Universidad de Zaragoza, 2018, chapter 2.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.types import F64, Bool

Ints = NDArray[np.int64]
Sparse = Any
"""A scipy sparse matrix or tree; the package has no types."""

COSINE = 0.9
"""Between normals of pixels that are alike."""
FLAT = 0.1
"""Distance from a tangent plane that counts as none, in footprints of a pixel."""
BEND = 0.5
"""Share of the chord times the sine between normals by which a smooth surface may be uneven."""
NEAREST = (8, 40)
"""Samples tried where the corners of a cell do not serve, at first and again."""
STIFF = 0.01
"""Pull of the local linear fit towards a constant, against the spread of its samples."""
NORMAL_PX = 32.0
"""Distance in footprints that a unit of normal counts for, when neighbours are sought."""
CHUNK = 8192
"""Pairs of pixels compared at once, so that they stay in the cache."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What each pixel sees first.

    Parameters
    ----------
    position : ndarray, (H, W, 3), m
        In any one frame; not read where invalid.
    normal : ndarray, (H, W, 3)
        Unit vector on the side of the camera.
    valid : ndarray of bool, (H, W)
        False where no answer is wanted.
    """

    position: F64
    normal: F64
    valid: Bool


@dataclass(frozen=True, eq=False)
class Ground:
    """A `Surface` with its pixels in one row (N = H W), and what follows from it.

    Parameters
    ----------
    shape : tuple of int
        H, W.
    position, normal : ndarray, (N, 3)
        Zero where invalid.
    valid : ndarray of bool, (N,)
        As in `Surface`.
    footprint_m : ndarray, (N,)
        Distance to the nearest neighbour, 0 where there is none.
    label : ndarray of int, (N,)
        Number of the smooth surface that pixels are joined by.
    kind : ndarray of int, (N,)
        Label and rough direction of the normal as one number; -1 where invalid.
    """

    shape: tuple[int, int]
    position: F64
    normal: F64
    valid: Bool
    footprint_m: F64
    label: Ints
    kind: Ints


def ground_of(surface: Surface) -> Ground:
    """The surface, labelled by smooth connected parts."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    valid = np.asarray(surface.valid, bool)
    count, seen = valid.size, valid[..., None]
    position = np.where(seen, surface.position, 0.0).reshape(count, 3)
    normal = np.where(seen, surface.normal, 0.0).reshape(count, 3)
    number = np.arange(count).reshape(valid.shape)
    a = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    b = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    flat = valid.ravel()
    both = flat[a] & flat[b]
    a, b = a[both], b[both]
    footprint = np.full(count, np.inf)
    apart = np.linalg.norm(position[a] - position[b], axis=1)
    for end in (a, b):
        np.minimum.at(footprint, end, apart)
    footprint[np.isinf(footprint)] = 0.0
    none = np.zeros(count, np.int64)
    bare = Ground(valid.shape, position, normal, flat, footprint, none, none)
    joined = alike(bare, a, b)
    links = coo_array((np.ones(joined.sum(), np.int8), (a[joined], b[joined])), (count, count))
    label = connected_components(links, directed=False)[1].astype(np.int64)
    # Odd offsets keep walls along the axes off the borders between bins.
    bins = np.floor(2.0 * normal + (0.313, 0.337, 0.359)).astype(np.int64) + 3
    key = ((label * 8 + bins[:, 0]) * 8 + bins[:, 1]) * 8 + bins[:, 2]
    kind = np.where(flat, key, -1)
    return Ground(valid.shape, position, normal, flat, footprint, label, kind)


def alike(ground: Ground, a: Ints, b: Ints) -> Bool:
    """Whether pairs of pixels lie on one surface, plane or smoothly joined.

    Parameters
    ----------
    ground : Ground
        Geometry.
    a, b : ndarray of int, (n,)
        Pixel numbers.

    Returns
    -------
    ndarray of bool, (n,)
        True if light may be interpolated between them.
    """
    parts = [
        _alike(ground, a[i : i + CHUNK], b[i : i + CHUNK]) for i in range(0, max(1, len(a)), CHUNK)
    ]
    return np.concatenate(parts)


def _alike(ground: Ground, a: Ints, b: Ints) -> Bool:
    chord = ground.position[a] - ground.position[b]
    up_a, up_b = ground.normal[a], ground.normal[b]
    off_a, off_b = _dot(up_a, chord), _dot(up_b, chord)
    cosine = _dot(up_a, up_b)
    sine = np.sqrt(np.clip(1.0 - cosine * cosine, 0.0, None))
    slack = FLAT * np.minimum(ground.footprint_m[a], ground.footprint_m[b])
    flat = np.maximum(np.abs(off_a), np.abs(off_b)) <= slack
    uneven = slack + BEND * sine * np.sqrt(_dot(chord, chord))
    bent = (ground.label[a] == ground.label[b]) & (np.abs(off_a + off_b) <= 2.0 * uneven)
    return np.asarray((flat | bent) & (cosine > COSINE) & ground.valid[a] & ground.valid[b])


def rows(
    ground: Ground, targets: Ints, corners: Ints, weights: F64, slot: Ints
) -> tuple[Sparse, Bool]:
    """Weights of the samples in every target pixel.

    Parameters
    ----------
    ground : Ground
        Geometry.
    targets : ndarray of int, (n,)
        Pixel numbers.
    corners : ndarray of int, (n, 4)
        Pixel numbers of the corners of their cells.
    weights : ndarray, (n, 4)
        Bilinear weights of the corners.
    slot : ndarray of int, (N,)
        Number of the sample at a pixel, -1 where there is none.

    Returns
    -------
    matrix : csr_array, (n, S)
        Rows sum to 1, or are empty where no sample serves.
    served : ndarray of bool, (n,)
        Which rows are not empty.
    """
    from scipy.sparse import coo_array

    used = np.flatnonzero(weights > 0)
    fits = np.zeros(weights.size, bool)
    fits[used] = alike(ground, np.repeat(targets, 4)[used], corners.ravel()[used])
    fits[used] &= slot[corners.ravel()[used]] >= 0
    whole: Bool = np.all(fits.reshape(-1, 4) | (weights <= 0), axis=1)
    entries = np.flatnonzero(fits & np.repeat(whole, 4))
    lone = np.flatnonzero(~whole)
    row, sample, weight = _fitted(ground, targets[lone], slot)
    at = np.concatenate([entries // 4, lone[row]])
    of = np.concatenate([slot[corners.ravel()[entries]], sample])
    values = np.concatenate([weights.ravel()[entries], weight])
    served: Bool = np.array(whole)
    served[lone[row]] = True
    size = (len(targets), int(slot.max(initial=-1)) + 1)
    return coo_array((values, (at, of)), size).tocsr(), served


def _fitted(ground: Ground, targets: Ints, slot: Ints) -> tuple[Ints, Ints, F64]:
    """Entries (row, sample, weight) of the local fit: near samples first, then farther ones."""
    from scipy.spatial import cKDTree

    pixels = np.flatnonzero(slot >= 0)
    parts: list[tuple[Ints, Ints, F64]] = []
    if len(targets) and len(pixels):
        scale = NORMAL_PX * float(np.median(ground.footprint_m[pixels]))
        place = np.hstack([ground.position, scale * ground.normal])
        tree = cKDTree(place[pixels], balanced_tree=False, compact_nodes=False)
        left = np.arange(len(targets))
        for near in NEAREST:
            number = tree.query(place[targets[left]], min(near, len(pixels)))[1]
            found = pixels[number.reshape(len(left), -1)]
            weight = _fit(ground, targets[left], found)
            some = (weight != 0).any(axis=1)
            row, column = np.nonzero(weight)
            parts.append((left[row], slot[found[row, column]], weight[row, column]))
            left = left[~some]
            if not len(left):
                break
    if not parts:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    row, sample, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    return row, sample, weight


def _fit(ground: Ground, targets: Ints, found: Ints) -> F64:
    """Weights (n, k) of a linear fit in the tangent plane to samples that are alike; else zero."""
    pairs = np.repeat(targets[:, None], found.shape[1], axis=1)
    fits = alike(ground, pairs.ravel(), found.ravel()).reshape(found.shape) & (found != pairs)
    away = ground.position[found] - ground.position[targets][:, None]
    u, v = (np.einsum("nkc,nc->nk", away, axis) for axis in _tangents(ground.normal[targets]))
    square = u * u + v * v
    tiny = (0.1 * ground.footprint_m[targets][:, None]) ** 2 + 1e-18
    trust = fits / (square + tiny)
    total = trust.sum(axis=1, keepdims=True)
    trust = np.divide(trust, total, out=np.zeros_like(trust), where=total > 0)
    mean_u, mean_v = ((trust * x).sum(axis=1, keepdims=True) for x in (u, v))
    u, v = u - mean_u, v - mean_v
    uu, uv, vv = ((trust * x).sum(axis=1, keepdims=True) for x in (u * u, u * v, v * v))
    stiff = STIFF * (uu + vv) + 1e-18
    uu, vv = uu + stiff, vv + stiff
    slope = u * (vv * mean_u - uv * mean_v) + v * (uu * mean_v - uv * mean_u)
    return np.asarray(trust * (1.0 - slope / (uu * vv - uv * uv)))


def _tangents(normal: F64) -> tuple[F64, F64]:
    """Two unit vectors at right angles to each normal."""
    steep = np.abs(normal[:, 0:1]) > 0.6
    first = np.cross(normal, np.where(steep, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]))
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    return first, np.cross(normal, first)


def _dot(a: F64, b: F64) -> F64:
    return np.asarray(np.einsum("nc,nc->n", a, b))
