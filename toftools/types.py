"""The inert data types of toftools and the plug-in protocol; no computation lives here.

Arrays are checked once, when the value is made, and kept as read-only views: the caller's own
array stays writable. Two values compare by identity (``eq=False``), since array equality has no
single answer.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

import numpy as np

from toftools._arrays import C64 as C64
from toftools._arrays import F32 as F32
from toftools._arrays import F64 as F64
from toftools._arrays import Bool as Bool
from toftools._arrays import expect_shape, frozen, frozen_mapping, set_fields, valid_mask
from toftools.device import Camera as Camera
from toftools.device import Emitter as Emitter
from toftools.device import Modulation as Modulation
from toftools.device import Sensor as Sensor
from toftools.electronics import Defects as Defects
from toftools.electronics import Noise as Noise
from toftools.electronics import PixelMaps as PixelMaps
from toftools.electronics import Timing as Timing

Context = TypeVar("Context", contravariant=True)
Input = TypeVar("Input", contravariant=True)
Output = TypeVar("Output", covariant=True)

UNITS = ("e-", "DN")


@dataclass(frozen=True, eq=False)
class Taps:
    """Raw correlation samples ``I_k = B + A cos(phi - step_k)``.

    Parameters
    ----------
    values : ndarray, (F, K, H, W)
        Samples, float32, in `unit`.
    unit : {"e-", "DN"}
        Electrons or digital numbers.
    valid : ndarray, (H, W), bool
        False where a tap is saturated or missing.
    """

    values: F32
    unit: str = "e-"
    valid: Bool = None  # type: ignore[assignment]  # filled in __post_init__

    def __post_init__(self) -> None:
        values = frozen(self.values, np.float32, "taps", 4)
        if self.unit not in UNITS:
            msg = f"unit must be one of {UNITS}, got {self.unit!r}"
            raise ValueError(msg)
        set_fields(self, values=values, valid=valid_mask(self.valid, values.shape[2:]))


@dataclass(frozen=True, eq=False)
class Phasors:
    """Demodulated signal ``z = A exp(+j phi)`` per frequency.

    Parameters
    ----------
    values : ndarray, (F, H, W)
        Phasors, complex64, in the unit of the taps they came from.
    sigma : ndarray, (F, H, W), or None
        Standard deviation across the phasor, which moves its phase: for four or more equispaced
        taps that of the real and of the imaginary part; None if unknown.
    valid : ndarray, (H, W), bool
        False where the measurement must not be used; non-finite phasors are always invalid.
    """

    values: C64
    sigma: F32 | None = None
    valid: Bool = None  # type: ignore[assignment]  # filled in __post_init__

    def __post_init__(self) -> None:
        values = frozen(self.values, np.complex64, "phasors", 3)
        valid = valid_mask(self.valid, values.shape[1:])
        finite = np.isfinite(values).all(axis=0)
        if not finite[valid].all():
            valid = valid_mask(valid & finite, values.shape[1:])
        sigma = self.sigma
        if sigma is not None:
            sigma = frozen(sigma, np.float32, "sigma", 3)
            expect_shape("sigma", sigma, values.shape)
        set_fields(self, values=values, sigma=sigma, valid=valid)


@dataclass(frozen=True, eq=False)
class DepthMap:
    """An answer: radial range per pixel, with how far to trust it.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Radial range, float32, m; NaN where there is no answer.
    sigma_m : ndarray, (H, W), or None
        Standard deviation of the range, m.
    confidence : ndarray, (H, W), or None
        Method's own confidence, higher is better; only its order is used.
    amplitude : ndarray, (H, W), or None
        Signal strength that came with the range.
    info : mapping
        Diagnostics: ``status``, iterations, residuals.
    """

    range_m: F32
    sigma_m: F32 | None = None
    confidence: F32 | None = None
    amplitude: F32 | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        range_m = frozen(self.range_m, np.float32, "range_m", 2)
        if np.isinf(range_m).any() or (range_m < 0).any():
            msg = "range_m must be non-negative metres, NaN for no answer; got infinite or negative"
            raise ValueError(msg)
        set_fields(self, range_m=range_m, info=frozen_mapping(self.info))
        for name in ("sigma_m", "confidence", "amplitude"):
            extra = getattr(self, name)
            if extra is not None:
                extra = frozen(extra, np.float32, name, 2)
                expect_shape(name, extra, range_m.shape)
                set_fields(self, **{name: extra})


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a capture; the phasors are those of the taps without noise and defects.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Radial range without multipath, float32, m; NaN where unknown.
    direct, one_bounce, rest : ndarray, (F, H, W), or None
        Phasors of the direct light alone, of light with one indirect bounce, and of all other
        light, complex64; they sum to what the camera sees.
    normals : ndarray, (H, W, 3), or None
        Surface normals in the camera frame, towards the camera, float32.
    albedo : ndarray, (H, W), or None
        Diffuse albedo at the modulated wavelength, float32; NaN where none is defined.
    """

    range_m: F32
    direct: C64 | None = None
    one_bounce: C64 | None = None
    rest: C64 | None = None
    normals: F32 | None = None
    albedo: F32 | None = None

    def __post_init__(self) -> None:
        range_m = frozen(self.range_m, np.float32, "truth range_m", 2)
        if np.isinf(range_m).any():
            range_m = frozen(np.where(np.isinf(range_m), np.nan, range_m), np.float32, "truth", 2)
        set_fields(self, range_m=range_m)
        for name in ("direct", "one_bounce", "rest"):
            part = getattr(self, name)
            if part is not None:
                part = frozen(part, np.complex64, f"truth {name}", 3)
                expect_shape(f"truth {name}", part, (part.shape[0], *range_m.shape))
                set_fields(self, **{name: part})
        for name, shape in (("normals", (*range_m.shape, 3)), ("albedo", range_m.shape)):
            extra = getattr(self, name)
            if extra is not None:
                extra = frozen(extra, np.float32, f"truth {name}", len(shape))
                expect_shape(f"truth {name}", extra, shape)
                set_fields(self, **{name: extra})


@dataclass(frozen=True, eq=False)
class Capture:
    """One measurement with all that is known about it.

    Parameters
    ----------
    sensor : Sensor
        The camera that took it.
    taps, phasors, depth : Taps, Phasors, DepthMap or None
        What was measured; at least one of them.
    truth : Truth or None
        Ground truth.
    reported : mapping of str to ndarray, (H, W)
        Ranges that somebody else published for this capture, float32, m.
    provenance : mapping
        Where it came from: source, convention, seed, versions (JSON values).
    """

    sensor: Sensor
    taps: Taps | None = None
    phasors: Phasors | None = None
    depth: DepthMap | None = None
    truth: Truth | None = None
    reported: Mapping[str, F32] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.taps is None and self.phasors is None and self.depth is None:
            msg = "a capture needs at least one of taps, phasors and depth, got none"
            raise ValueError(msg)
        shape, mod = self.sensor.camera.shape, self.sensor.modulation
        if self.taps is not None:
            expect_shape("taps", self.taps.values, (mod.n_freqs, mod.n_taps, *shape))
        if self.phasors is not None:
            expect_shape("phasors", self.phasors.values, (mod.n_freqs, *shape))
        if self.depth is not None:
            expect_shape("depth range_m", self.depth.range_m, shape)
        if self.truth is not None:
            expect_shape("truth range_m", self.truth.range_m, shape)
            for part in (self.truth.direct, self.truth.one_bounce, self.truth.rest):
                if part is not None:
                    expect_shape("truth phasors", part, (mod.n_freqs, *shape))
        reported = {
            name: frozen(value, np.float32, name, 2) for name, value in self.reported.items()
        }
        for name, value in reported.items():
            expect_shape(name, value, shape)
        set_fields(
            self,
            reported=MappingProxyType(reported),
            provenance=frozen_mapping(self.provenance),
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """What is out there, without a camera.

    Parameters
    ----------
    name : str
        Scene family, such as ``wall`` or ``corner``, or a file.
    params : mapping
        Parameters of the family, SI units.
    """

    name: str
    params: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        set_fields(self, params=frozen_mapping(self.params))


@dataclass(frozen=True, eq=False)
class Shot:
    """One exposure to simulate.

    Parameters
    ----------
    sensor : Sensor
        Camera to simulate.
    seed : int
        Seed of all noise.
    noisy : bool
        False gives the expectation of the taps.
    max_bounces : int or None
        Indirect bounces to keep: 0 is direct light only; None keeps all that matter.
    samples : int or None
        Paths per pixel of a sampling engine; None takes as many as `tol_m` needs.
    tol_m : float
        Standard error of range that a sampling engine may leave, m.
    light_seed : int or None
        Seed of sampled light alone; None takes `seed`. Shots that follow on each other and differ
        in electronics and `seed` only then share light that is traced once.
    """

    sensor: Sensor
    seed: int = 0
    noisy: bool = True
    max_bounces: int | None = None
    samples: int | None = None
    tol_m: float = 1e-3
    light_seed: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("max_bounces", 0), ("samples", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                msg = f"{name} must be {least} or more, got {value}"
                raise ValueError(msg)
        if not (np.isfinite(self.tol_m) and self.tol_m > 0):
            msg = f"tol_m must be a positive number of metres, got {self.tol_m}"
            raise ValueError(msg)


class Factory(Protocol[Context, Input, Output]):
    """The plug-in protocol: ``make(context, *, params) -> run(input) -> output``.

    Making may be slow (tables, compilation, sessions); running is pure and is what is timed.
    Parameters are keyword-only with working defaults.
    """

    def __call__(self, context: Context, /) -> Callable[[Input], Output]:
        """Build the method for one context."""
        ...
