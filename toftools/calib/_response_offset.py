"""Level of a node from taps that modulated light may move about.

Modulated light moves the taps of a pixel about their offset B, so a node's level is the
least-squares offset of its taps, ``sum_k b_k I_k``; being linear, it also gives the offset of any
polynomial of the taps, which is what fitting the curve needs.
"""

import numpy as np

from toftools.types import F64, Bool, Sensor

MODULATED = 0.02
"""Spread of the taps of one node, relative to their mean, from which on light is modulated."""
BLOCK_PX = 8


def offset_weights(sensor: Sensor, name: str, *, modulated: bool) -> list[F64]:
    """Weights of the taps of each node that give its offset, all frequencies averaged.

    Parameters
    ----------
    sensor : Sensor
        Tap steps and nodes.
    name : str
        Capture, for the message.
    modulated : bool
        Whether phase must drop out; else it is a plain mean.

    Returns
    -------
    list of ndarray, (F, K / N)
        One per node; each sums to 1.

    Raises
    ------
    ValueError
        If phase cannot drop out.
    """
    nodes, steps = sensor.timing.taps_per_exposure, sensor.modulation.steps_rad
    found = []
    for n in range(nodes):
        own = steps[:, n::nodes]
        weights = np.full(own.shape, 1 / own.shape[1])
        if modulated:
            basis = np.stack([np.ones_like(own), np.cos(own), np.sin(own)], axis=-1)
            weights = np.linalg.pinv(basis, rcond=1e-6)[:, 0, :]
            if np.abs(np.einsum("fk,fkb->fb", weights, basis) - [1, 0, 0]).max() > 1e-6:
                msg = (
                    f"the light of {name} is modulated, and {own.shape[1]} taps of a node do not "
                    "tell its level from its phase; take flats in light that is not modulated"
                )
                raise ValueError(msg)
        found.append(weights / own.shape[0])
    return found


def is_modulated(values: F64, ok: Bool, sensor: Sensor) -> bool:
    """Whether block means of taps of one node differ; blocks, since phase varies slowly.

    Parameters
    ----------
    values : ndarray, (F, K, H, W)
        Taps.
    ok : ndarray, (H, W), bool
        Pixels to use.
    sensor : Sensor
        Its nodes.

    Returns
    -------
    bool
        True if they differ by more than noise and ripple of the converter make them.
    """
    nodes = sensor.timing.taps_per_exposure
    means = blocks(np.where(ok, values, np.nan))  # (F, K, blocks)
    spread = [
        np.ptp(means[:, n::nodes], axis=1) / means[:, n::nodes].mean(axis=1) for n in range(nodes)
    ]
    seen = np.concatenate([s.ravel() for s in spread])
    seen = seen[np.isfinite(seen)]
    return bool(seen.size and np.median(seen) > MODULATED)


def blocks(image: F64) -> F64:
    """Means of blocks of pixels, NaN left out.

    Parameters
    ----------
    image : ndarray, (..., H, W)
        Images, NaN where unknown.

    Returns
    -------
    ndarray, (..., blocks)
        Mean of every block; NaN where it holds no pixel.
    """
    height, width = image.shape[-2:]
    known = np.isfinite(image)
    rows, cols = (np.arange(0, n, BLOCK_PX) for n in (height, width))
    total, count = (
        np.add.reduceat(np.add.reduceat(part, rows, axis=-2), cols, axis=-1)
        for part in (np.where(known, image, 0.0), known.astype(np.float64))
    )
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return np.asarray(mean.reshape(*image.shape[:-2], -1))
