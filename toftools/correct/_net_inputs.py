"""What a network of the kind `phasors` sees of a frame: numbers that keep their meaning.

Per pixel (full resolution): the likeliest ranges, the one first that the neighbourhood prefers
(`_net_guide`), how well each explains the phases, by how much the frequencies disagree, the
reflectance, the viewing direction. Per patch (`_net_coarse`): what light of one bounce between
visible surfaces would do. Global amplitude drops out (reflectance is relative to the frame's
median), absolute phase too (residuals are taken at the candidates), and ranges count in wavelengths
of the trained frequencies, so that a set k times higher sees a world k times smaller. Reference:
the encoding is ours; one-bounce light after S. Fuchs, ICPR 2010. Inputs: phasors, optics. Fails as
its candidates do: none is near the truth when noise is a quarter turn.
"""

from dataclasses import dataclass

import numpy as np

from toftools.camera import rays
from toftools.correct import kernel_input
from toftools.correct._net_coarse import (
    COARSE,
    Coarse,
    coarse_light,
    coarse_optics,
)
from toftools.correct._net_guide import Guide, guide_of, prefer
from toftools.correct._net_pixels import describe, propose
from toftools.correct._scene import flash_of
from toftools.correct._wraps import Plan, plan
from toftools.types import F32, Bool, Phasors, Sensor
from toftools.units import TWO_PI, range_to_phase

CANDIDATES = 3
"""Ranges that a network of several frequencies may choose from."""
RELATIVE_MAX = 4.0
"""Largest logarithm of a relative reflectance."""


@dataclass(frozen=True, eq=False)
class View:
    """What does not change from frame to frame.

    Parameters
    ----------
    walk : Plan
        Search for candidates.
    turns_per_m : ndarray, (F,)
        Phase per range, turns/m, float32.
    rays : ndarray, (2, H, W)
        x and y of the unit viewing directions, float32.
    dim : ndarray, (H, W)
        One over the amplitude of a white surface facing the camera at 1 m, float32.
    seen_px : ndarray, (H, W), bool
        False where no ray belongs to a pixel.
    coarse : Coarse
        The same view on few pixels.
    guide : Guide or None
        Coarse unwrapping; None for one frequency.
    metre : float
        Metres of the trained frequencies per metre: ratio of these frequencies to those.
    """

    walk: Plan
    turns_per_m: F32
    rays: F32
    dim: F32
    seen_px: Bool
    coarse: Coarse
    guide: Guide | None
    metre: float


@dataclass(frozen=True, eq=False)
class Seen:
    """Input of a network.

    Parameters
    ----------
    full : ndarray, (C, H, W)
        Channels at full resolution, float32.
    coarse : ndarray, (D, H / 4, W / 4)
        Channels of patches, float32.
    candidates_m : ndarray, (K, H, W)
        Ranges that the output refers to, m, likeliest first.
    valid : ndarray, (H, W), bool
        Pixels with a signal.
    longest_m : float
        Longest range that can be told, m.
    """

    full: F32
    coarse: F32
    candidates_m: F32
    valid: Bool
    longest_m: float


def channels(n_freqs: int) -> tuple[int, int]:
    """Channels at full resolution and of patches.

    Parameters
    ----------
    n_freqs : int
        Frequencies.

    Returns
    -------
    tuple of int
        Their numbers.
    """
    extra = n_candidates(n_freqs) - 1
    return 5 + (n_freqs + 1 if n_freqs > 1 else 0) + 2 * extra, COARSE + 2 * n_freqs


def n_candidates(n_freqs: int) -> int:
    """Ranges a network chooses from.

    Parameters
    ----------
    n_freqs : int
        Frequencies.

    Returns
    -------
    int
        One for one frequency, which has one range within its ambiguity.
    """
    return CANDIDATES if n_freqs > 1 else 1


def view_of(sensor: Sensor, metre: float, max_range_m: float) -> View:
    """Prepare for a sensor.

    Parameters
    ----------
    sensor : Sensor
        Camera, light and frequencies.
    metre : float
        Ratio of its frequencies to those trained.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity.

    Returns
    -------
    View
        For frames of the camera's shape.
    """
    freqs, camera = sensor.modulation.freqs_hz, sensor.camera
    way = rays(camera)
    seen_px = np.asarray(np.isfinite(way).all(axis=-1))
    way = np.where(seen_px[..., None], way, 0)
    flash = flash_of(sensor, way).mean(axis=0)
    walk = plan(sensor, max_range_m, least_freqs=1, method="network")
    return View(
        walk,
        (range_to_phase(1.0, freqs) / TWO_PI).astype(np.float32),
        kernel_input(np.ascontiguousarray(np.moveaxis(way[..., :2], -1, 0), np.float32)),
        kernel_input(
            (1 / np.maximum(flash, 1e-6 * max(float(flash.max()), 1e-12))).astype(np.float32)
        ),
        seen_px,
        coarse_optics(sensor),
        guide_of(sensor, metre, walk.max_range_m) if freqs.size > 1 else None,
        metre,
    )


def seen(phasors: Phasors, view: View) -> Seen:
    """What a network sees of a frame.

    Parameters
    ----------
    phasors : Phasors
        Values (F, H, W); amplitudes in any unit.
    view : View
        Of its sensor, of the same shape.

    Returns
    -------
    Seen
        Network input.
    """
    n_freqs, height, width = phasors.values.shape
    cycles, bright, lit, candidates = _candidates(phasors, view)
    full = np.empty((channels(n_freqs)[0], height, width), np.float32)
    describe(
        cycles, bright, lit, candidates, view.turns_per_m, view.rays, view.dim, view.metre, full
    )
    _relative(full[3], lit)
    coarse = coarse_light(candidates[0], full[3], lit, view.coarse, view.metre)
    return Seen(full, coarse, candidates, lit, view.walk.max_range_m)


def ranges(phasors: Phasors, view: View) -> tuple[F32, Bool]:
    """What a network of the kind `range` sees of a frame.

    Parameters
    ----------
    phasors : Phasors
        Values (F, H, W); amplitudes in any unit.
    view : View
        Of its sensor, of the same shape.

    Returns
    -------
    range_m : ndarray, (H, W)
        Likeliest range, m.
    valid : ndarray, (H, W), bool
        Pixels with a signal.
    """
    _, _, lit, candidates = _candidates(phasors, view)
    return candidates[0], lit


def _candidates(phasors: Phasors, view: View) -> tuple[F32, F32, Bool, F32]:
    """Phases, mean amplitudes, pixels with a signal, ranges."""
    top = n_candidates(phasors.values.shape[0])
    found = propose(phasors.values, phasors.valid & view.seen_px, view.walk, top)
    if view.guide is not None:
        prefer(found[3], phasors.values, found[2], view.dim, view.guide)
    return found


def _relative(reflectance: F32, lit: Bool) -> None:
    """Logarithms of reflectance relative to the frame's median, in place."""
    some = reflectance[::4, ::4][lit[::4, ::4]]
    if not some.size:
        some = reflectance[lit]
    middle = np.median(some) if some.size else np.float32(0)
    reflectance -= middle
    np.clip(reflectance, -RELATIVE_MAX, RELATIVE_MAX, out=reflectance)
    reflectance *= lit
