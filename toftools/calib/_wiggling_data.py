"""What the three wiggling models are fitted to: phases and phase errors, one frequency at a time.

Captures are read one after another and only pixels on a grid are kept, so that any number of them
fits in memory.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toftools.calib.residuals import phase_error_rad, same_sensor, wrap_half
from toftools.conditions import conditions_of, name_of, with_conditions
from toftools.phasor import phase_sigma_rad, phasors_of
from toftools.types import F64, Bool, Capture
from toftools.units import TWO_PI

KEPT = 300_000
"""Most measurements to keep per frequency; they know a coefficient to sqrt(2 / KEPT) = 0.26 % of
the noise of one."""
MOVED_RAD = 0.2
"""Phases of a pixel that differ by less than this between captures do not count as different."""
FEW = 5
"""Fewer captures than this are held out as blocks of pixels instead."""
TILES = 8
"""Blocks of pixels along either side of the image."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Measurements of one frequency.

    Parameters
    ----------
    phase_rad : ndarray, (C, P)
        Measured phase of the kept pixels in every capture, rad.
    error_rad : ndarray, (C, P)
        Measured minus expected phase, less a constant per pixel or of all, rad; 0 without weight.
    weight : ndarray, (C, P)
        Inverse variance, 1/rad^2, or 1 where noise is unknown; 0 for what must not be used.
    sigma_rad : ndarray, (C, P), or None
        Noise of the phase, rad.
    per_pixel : bool
        Whether every pixel has a constant of its own that the fit must not see.
    parts : tuple of (int or None, slice)
        What is held out together: a capture (all pixels), or a block of pixels (all captures).
    """

    phase_rad: F64
    error_rad: F64
    weight: F64
    sigma_rad: F64 | None
    per_pixel: bool
    parts: tuple[tuple[int | None, slice], ...]

    @property
    def by_capture(self) -> bool:
        """Whether whole captures are held out."""
        return self.parts[0][0] is not None


def chosen_captures(captures: Sequence[Capture]) -> tuple[list[Capture], str]:
    """The captures that show wiggling best, and their kind: rail, delay, or with a known range.

    Parameters
    ----------
    captures : sequence of Capture
        Captures of any kinds.

    Returns
    -------
    list of Capture, str
        The largest set of one kind.

    Raises
    ------
    ValueError
        If none can be used, or sizes or frequencies differ.
    """
    sets: dict[str, list[Capture]] = {"rail": [], "delay": [], "wall": []}
    kinds = [conditions_of(capture) for capture in captures]
    for capture, told in zip(captures, kinds, strict=True):
        kind = told.kind if told.kind in sets else "wall"
        if told.kind in sets or told.reference == "depth":
            sets[kind].append(capture)
    best = max(sets, key=lambda kind: len(sets[kind]))
    if not sets[best]:
        got = ", ".join(sorted({told.kind for told in kinds})) or "none"
        msg = (
            f"wiggling needs captures of the kind rail, delay or wall, got {got}; take a plane at "
            "many known distances, or one capture with a known range per pixel (reference depth)"
        )
        raise ValueError(msg)
    same_sensor(sets[best])
    return sets[best], best


def gather(captures: Sequence[Capture]) -> list[Samples]:
    """Phases and phase errors on a grid of pixels, per frequency.

    Parameters
    ----------
    captures : sequence of Capture
        Captures of one camera whose range is known up to a constant per pixel.

    Returns
    -------
    list of Samples
        One per frequency.

    Raises
    ------
    ValueError
        If no pixel can be used.
    """
    height, width = captures[0].sensor.camera.shape
    step = max(1, round(float(np.sqrt(len(captures) * height * width / KEPT)) + 0.499))
    rows, columns = (np.arange(min(step // 2, n - 1), n, step) for n in (height, width))
    read = [_read(capture, rows[:, None], columns[None]) for capture in captures]
    if not any(np.isfinite(error).any() for _, error, _ in read):
        msg = (
            f"{name_of(captures[0])} and {len(captures) - 1} more captures hold no pixel with both "
            "a measured phase and a known range; check exposure and the reference"
        )
        raise ValueError(msg)
    tile = (rows * TILES // height)[:, None] * TILES + columns * TILES // width
    order = np.argsort(tile.ravel(), kind="stable")
    edges = np.flatnonzero(np.diff(tile.ravel()[order], prepend=-1, append=TILES**2))
    tiles = tuple((None, slice(a, b)) for a, b in itertools.pairwise(edges))
    phase = np.stack([part[0] for part in read])[..., order]
    error = np.stack([part[1] for part in read])[..., order]
    noise = [part[2] for part in read if part[2] is not None]
    sigma = np.stack(noise)[..., order] if len(noise) == len(read) else None
    return [
        _samples(phase[:, f], error[:, f], None if sigma is None else sigma[:, f], tiles)
        for f in range(phase.shape[1])
    ]


def _read(
    capture: Capture, row: NDArray[np.intp], column: NDArray[np.intp]
) -> tuple[F64, F64, F64 | None]:
    """Phase, error and noise (F, P) of the pixels on a grid."""
    told = conditions_of(capture)
    if told.kind == "delay" and told.reference == "plane" and not told.known:
        # The wall stands still: how far away it is only adds a constant to every pixel.
        capture = with_conditions(capture, replace(told, distance_m=1.0))
    phasors = phasors_of(capture)
    error = phase_error_rad(capture)[:, row, column]
    flat = (error.shape[0], -1)
    phase = np.angle(phasors.values[:, row, column]).astype(np.float64)
    with np.errstate(over="ignore"):  # dark pixels, which no error belongs to
        sigma = phase_sigma_rad(phasors)
    noise = None if sigma is None else sigma[:, row, column].astype(np.float64).reshape(flat)
    return phase.reshape(flat), error.reshape(flat), noise


def _samples(
    phase: F64, error: F64, sigma: F64 | None, tiles: tuple[tuple[None, slice], ...]
) -> Samples:
    """Samples of one frequency, weighted and with errors about their centre."""
    used = np.isfinite(error) & np.isfinite(phase)
    if sigma is None:
        weight = used.astype(np.float64)
    else:
        used &= np.isfinite(sigma)
        # No measurement is trusted more than twice the median one: near, bright captures would
        # otherwise outvote all others by their systematic errors.
        floor = float(np.median(sigma[used])) if used.any() else 1.0
        weight = np.where(used, 1 / np.maximum(sigma**2 + floor**2, 1e-12), 0)
    per_pixel = _moves(np.where(used, phase, 0), used)
    axis = 0 if per_pixel else None
    turn = np.exp(1j * np.where(used, error, 0)) * weight
    error = wrap_half(np.where(used, error, 0) - np.angle(turn.sum(axis=axis, keepdims=True)))
    by_capture = per_pixel and phase.shape[0] >= FEW
    whole = tuple((c, slice(None)) for c in range(phase.shape[0]))
    return Samples(
        phase_rad=np.where(used, phase, 0),
        error_rad=np.where(used, error, 0),
        weight=weight,
        sigma_rad=None if sigma is None else np.where(used, sigma, 0),
        per_pixel=per_pixel,
        parts=whole if by_capture else tiles,
    )


def _moves(phase: F64, used: Bool) -> bool:
    """Whether most pixels see different phases in different captures."""
    seen = used.sum(axis=0)
    if phase.shape[0] < 2 or not (seen > 1).any():
        return False
    mean = np.angle((np.exp(1j * phase) * used).sum(axis=0))
    away = np.where(used, np.abs(wrap_half(phase - mean)), 0).max(axis=0)
    return bool(np.median(away[seen > 1]) > MOVED_RAD)


def covered(samples: Samples, bins: int) -> Bool:
    """Which parts of the turn have data.

    Parameters
    ----------
    samples : Samples
        Measurements.
    bins : int
        Number of equal parts, the first from phase 0.

    Returns
    -------
    ndarray, (bins,), bool
        True where a part holds at least a fiftieth of its fair share.
    """
    place = (samples.phase_rad[samples.weight > 0] % TWO_PI) * (bins / TWO_PI)
    counts = np.bincount(place.astype(np.intp) % bins, minlength=bins)
    return np.asarray(counts > 0.02 * counts.sum() / bins)
