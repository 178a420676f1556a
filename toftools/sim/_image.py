"""What an engine is asked for, and what it gives back."""

from dataclasses import dataclass
from typing import Any

from toftools.sim._phasors import C128
from toftools.types import F64, Camera


@dataclass(frozen=True, eq=False)
class Image:
    """Light of all pixels, and how well it is known.

    Parameters
    ----------
    direct, one_bounce, rest : ndarray, (Q, H, W), complex128
        Phasors in units of `Noise.signal_e`, by number of indirect bounces.
    ambient : ndarray, (H, W)
        Unmodulated radiance in the same unit.
    samples : ndarray, (H, W)
        Paths per pixel.
    error_m : ndarray, (H, W)
        Standard error of range, pooled over the tile, m; NaN where nothing told.
    """

    direct: C128
    one_bounce: C128
    rest: C128
    ambient: F64
    samples: F64
    error_m: F64


@dataclass(frozen=True, eq=False)
class Order:
    """What to render.

    Parameters
    ----------
    camera : Camera
        Optics.
    side : int
        Points along each side of a pixel.
    freqs_hz : ndarray, (Q,)
        All frequencies wanted, Hz.
    used : ndarray, (F,), int
        Which of them are modulation frequencies, whose phases give the range.
    bounces : int
        Indirect bounces.
    samples : int or None
        Paths per pixel; None goes on until `tol_m`.
    tol_m : float
        Standard error of range to reach, m.
    ambient_bounces : int
        Bounces of unmodulated light, whose charge does not depend on the tolerance of range.
    max_samples : int
        Paths per pixel at which even a noisy tile is left.
    seed : int
        Of all sequences.
    """

    camera: Camera
    side: int
    freqs_hz: F64
    used: Any
    bounces: int
    ambient_bounces: int
    samples: int | None
    tol_m: float
    max_samples: int
    seed: int
