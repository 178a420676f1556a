"""Materials of a frame: few albedos, each over connected regions, from brightness alone.

The logarithm of the albedo is split into classes of least squares by dynamic programming over its
histogram (exact in one dimension), as many as stand apart, and labels become coherent by the mean
field of a Potts model. References: W. D. Fisher, "On grouping for maximum homogeneity", JASA 53
(1958) 789-798, for the split; J. Besag, "On the statistical analysis of dirty pictures", J. Royal
Statistical Society B 48 (1986) 259-302, for the model (his iterated modes depend on the order of
the pixels, the mean field does not). Inputs: an albedo image, noisy. Fails on textures finer than a
few pixels and on albedos that change slowly: there are no classes.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toftools.types import F32, F64, Bool

BIN = 0.02
"""Width of the bins of log albedo: 2 %."""
APART = 3.0
"""Neighbouring classes are one if their means are closer than this many standard deviations of
either: the halves of a normal distribution are 2.65 apart."""
LEAST_GAP = 0.2
"""Nor are albedos different that differ by less than 20 %, which moves a correction by 10 %."""
LEAST_SPREAD = 0.03
"""Standard deviation of a material's albedo as seen, at least."""
NEIGHBOUR = 1.0
"""What a neighbour of another class costs, in squared standard deviations / 2."""
MOST_COST = 8.0
"""What a class that does not fit at all costs, so that outliers follow their neighbours."""
SWEEPS = 6
MOST_CLASSES = 8
MOST_LABEL = 126

Labels = NDArray[np.int8]


def classes(albedo: F32, usable: Bool, count: int) -> F64:
    """Albedos of at most `count` classes.

    Parameters
    ----------
    albedo : ndarray, (H, W)
        Albedo, positive where usable.
    usable : ndarray, (H, W), bool
        Pixels that count.
    count : int
        Most classes.

    Returns
    -------
    ndarray, (C,)
        Albedos, rising; empty without a usable pixel.
    """
    values = np.log(albedo[usable].astype(np.float64))
    if not values.size:
        return np.zeros(0)
    low, high = np.percentile(values, [1, 99])
    inside = np.clip(values, low, high)
    edges = low + BIN * np.arange(max(int(np.ceil((high - low) / BIN)), 1) + 1)
    weight, _ = np.histogram(inside, edges)
    middle = (edges[:-1] + edges[1:]) / 2
    for cuts in _splits(weight.astype(np.float64), middle, min(count, middle.size)):
        if _stand_apart(weight, middle, cuts):
            break
    groups = np.split(np.sort(inside), np.searchsorted(np.sort(inside), edges[cuts[1:-1]]))
    return np.exp([np.median(group) for group in groups if group.size])


def _splits(weight: F64, middle: F64, count: int) -> Iterator[list[int]]:
    """Bins where classes of least squares begin, and the end: Fisher's recursion, count to one."""
    sums = [np.concatenate([[0.0], np.cumsum(weight * middle**p)]) for p in range(3)]
    n, s, q = (a[None, :] - a[:, None] for a in sums)  # [i, j]: bins i..j-1
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = np.where(n > 0, q - s * s / n, 0.0)
    cost[np.tril_indices(weight.size + 1, -1)] = np.inf
    best, origin = cost[0], []
    for _ in range(count - 1):
        total = best[:, None] + cost
        origin.append(np.argmin(total, axis=0))
        best = np.min(total, axis=0)
    for classes_left in range(count, 0, -1):
        cuts = [weight.size]
        for back in reversed(origin[: classes_left - 1]):
            cuts.append(int(back[cuts[-1]]))
        yield sorted({0, *cuts})


def _stand_apart(weight: NDArray[np.integer], middle: F64, cuts: list[int]) -> bool:
    """Whether every two neighbouring classes are two."""
    mean, spread = np.empty(len(cuts) - 1), np.empty(len(cuts) - 1)
    for c, (a, b) in enumerate(pairwise(cuts)):
        total = max(int(weight[a:b].sum()), 1)
        mean[c] = weight[a:b] @ middle[a:b] / total
        spread[c] = np.sqrt(weight[a:b] @ (middle[a:b] - mean[c]) ** 2 / total)
    needed = np.maximum(APART * (spread[1:] + spread[:-1]) / 2, LEAST_GAP)
    return bool((np.diff(mean) >= needed).all())


def labelled(albedo: F32, usable: Bool, albedos: F64) -> Labels:
    """Class of every pixel, coherent over neighbours.

    Parameters
    ----------
    albedo : ndarray, (H, W)
        Albedo, positive where usable.
    usable : ndarray, (H, W), bool
        Pixels whose albedo means something; the others follow their neighbours.
    albedos : ndarray, (C,)
        Albedos of the classes, one or more.

    Returns
    -------
    ndarray, (H, W), int8
        Number of the class.
    """
    off = np.zeros((albedos.size, *albedo.shape), np.float32)
    given = np.log(albedo[usable])
    for c, own in enumerate(albedos):
        off[c][usable] = given - np.float32(np.log(own))
    nearest = np.abs(off).min(axis=0)[usable]
    spread = max(1.48 * float(np.median(nearest)) if nearest.size else 0.0, LEAST_SPREAD)
    cost = np.minimum(0.5 * (off / np.float32(spread)) ** 2, np.float32(MOST_COST))
    share = _soft(-cost)
    for _ in range(SWEEPS):
        share = _soft(NEIGHBOUR * np.stack([_neighbours(own) for own in share]) - cost)
    return np.asarray(np.argmax(share, axis=0), np.int8)


def _soft(score: F32) -> F32:
    """Probabilities of the classes."""
    power = np.exp(score - score.max(axis=0))
    return np.asarray(power / power.sum(axis=0), np.float32)


def _neighbours(share: F32) -> F32:
    """How many of the eight neighbours are of a class, in probability."""
    padded = np.pad(share, 1)
    across = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return np.asarray(across[:-2] + across[1:-1] + across[2:] - padded[1:-1, 1:-1])


def read_labels(path: str, shape: tuple[int, int]) -> Labels:
    """Labels that a user drew.

    Parameters
    ----------
    path : str
        ``.npy`` of integers, or a one-channel ``.png``; 0 is the first class.
    shape : (int, int)
        Height and width of the frame.

    Returns
    -------
    ndarray, (H, W), int8
        Number of the class of every pixel.

    Raises
    ------
    ValueError
        If the file cannot be read, or does not hold whole numbers 0..126 of that shape.
    """
    wanted = f"a .npy or one-channel .png of whole numbers 0..126, {shape[1]} x {shape[0]} pixels"
    try:
        drawn = _image(path)
    except (OSError, ValueError, EOFError) as error:
        msg = f"got labels={path!r}, which cannot be read ({error}); wanted {wanted}"
        raise ValueError(" ".join(msg.split())) from error
    whole = drawn.dtype.kind in "biu" and drawn.shape == shape
    if not (whole and drawn.min() >= 0 and drawn.max() <= MOST_LABEL):
        msg = f"got labels={path!r} of {drawn.dtype} {drawn.shape}; wanted {wanted}"
        raise ValueError(msg)
    return drawn.astype(np.int8)


def _image(path: str) -> NDArray[np.generic]:
    """An array from a file that nothing in it can make run."""
    if path.lower().endswith(".npy"):
        return np.asarray(np.load(path, allow_pickle=False))
    import cv2

    drawn = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if drawn is None:
        msg = "not an image"
        raise ValueError(msg)
    return np.asarray(drawn)
