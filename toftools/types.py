"""The inert data types of toftools and the plug-in protocol; no computation lives here.

Arrays are checked once, when the value is made, and kept as read-only views: the caller's own
array stays writable. Two values compare by identity (``eq=False``), since array equality has no
single answer.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from toftools.units import check_freqs

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
C64: TypeAlias = NDArray[np.complex64]
Bool: TypeAlias = NDArray[np.bool_]
Context = TypeVar("Context", contravariant=True)
Input = TypeVar("Input", contravariant=True)
Output = TypeVar("Output", covariant=True)

UNITS = ("e-", "DN")


def _frozen(value: ArrayLike, dtype: DTypeLike, what: str, ndim: int) -> NDArray[Any]:
    """A read-only view of `value` as `dtype`, refused if its rank is wrong."""
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        msg = f"{what} must be an array of {np.dtype(dtype).name}, got {type(value).__name__}"
        raise ValueError(msg) from error
    if array.ndim != ndim or 0 in array.shape:
        msg = f"{what} must have {ndim} dimensions and no empty one, got shape {array.shape}"
        raise ValueError(msg)
    view = array.view()
    view.flags.writeable = False
    return view


def _expect_shape(what: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Refuse an array whose shape is not the one its siblings have."""
    if array.shape != shape:
        msg = f"{what} must have shape {shape}, got {array.shape}"
        raise ValueError(msg)


def _frozen_mapping(value: Mapping[str, Any]) -> Mapping[str, Any]:
    return MappingProxyType(dict(value))


def _valid_mask(valid: ArrayLike | None, shape: tuple[int, int]) -> Bool:
    """The given pixel mask, or all pixels."""
    mask = _frozen(np.ones(shape, bool) if valid is None else valid, np.bool_, "valid", 2)
    _expect_shape("valid", mask, shape)
    return mask


def _set(owner: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(owner, name, value)


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera with OpenCV distortion; pixel centres lie at integer coordinates.

    Parameters
    ----------
    width, height : int
        Image size, px.
    K : ndarray, (3, 3)
        Intrinsic matrix, px.
    dist : ndarray, (n,)
        Distortion coefficients in OpenCV order, n in {0, 4, 5, 8, 12, 14}; empty for none.
    """

    width: int
    height: int
    K: F64
    dist: F64 = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not (0 < int(self.width) <= 65_536 and 0 < int(self.height) <= 65_536):
            msg = f"width and height must be 1..65536 px, got {self.width} x {self.height}"
            raise ValueError(msg)
        K = _frozen(self.K, np.float64, "K", 2)
        _expect_shape("K", K, (3, 3))
        if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[2, 2] - 1) > 1e-9:
            msg = f"K must be finite with positive focal lengths and K[2,2] = 1, got {K.tolist()}"
            raise ValueError(msg)
        dist = np.asarray(self.dist, dtype=np.float64).reshape(-1).view()
        dist.flags.writeable = False
        if dist.size not in (0, 4, 5, 8, 12, 14) or not np.isfinite(dist).all():
            msg = f"dist must hold 0, 4, 5, 8, 12 or 14 finite coefficients, got {dist.tolist()}"
            raise ValueError(msg)
        _set(self, width=int(self.width), height=int(self.height), K=K, dist=dist)

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape (height, width)."""
        return self.height, self.width


@dataclass(frozen=True, eq=False)
class Modulation:
    """What the light source and the pixel do: frequencies, tap steps, correlation shape.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Modulation frequencies, Hz.
    steps_rad : ndarray, (K,) or (F, K)
        Reference phase of each tap, rad; kept as (F, K).
    harmonics : ndarray, (F, M)
        Complex harmonics of the correlation function relative to the first, which is 1: tap k
        is ``B + sum_m |h_m| A_m cos(m (phi - step_k) + arg h_m)``. Default: pure sine.
    """

    freqs_hz: F64
    steps_rad: F64 = field(default_factory=lambda: np.arange(4, dtype=np.float64) * (np.pi / 2))
    harmonics: NDArray[np.complex128] | None = None

    def __post_init__(self) -> None:
        freqs = _frozen(check_freqs(self.freqs_hz), np.float64, "freqs_hz", 1)
        steps = np.asarray(self.steps_rad, dtype=np.float64)
        if steps.ndim == 1:
            steps = np.broadcast_to(steps, (freqs.size, steps.size))
        steps = _frozen(steps, np.float64, "steps_rad", 2)
        if steps.shape[0] != freqs.size or steps.shape[1] < 3 or not np.isfinite(steps).all():
            msg = (
                f"steps_rad must be (K,) or ({freqs.size}, K) finite radians with K >= 3 taps, "
                f"got shape {np.shape(self.steps_rad)}"
            )
            raise ValueError(msg)
        harmonics = np.ones((freqs.size, 1)) if self.harmonics is None else self.harmonics
        harmonics = _frozen(harmonics, np.complex128, "harmonics", 2)
        if harmonics.shape[0] != freqs.size or not np.allclose(harmonics[:, 0], 1.0):
            msg = f"harmonics must be ({freqs.size}, M) with first column 1, got {harmonics.shape}"
            raise ValueError(msg)
        _set(self, freqs_hz=freqs, steps_rad=steps, harmonics=harmonics)

    @property
    def n_freqs(self) -> int:
        """Number of frequencies F."""
        return int(self.freqs_hz.size)

    @property
    def n_taps(self) -> int:
        """Number of taps K per frequency."""
        return int(self.steps_rad.shape[1])


@dataclass(frozen=True, eq=False)
class Noise:
    """Pixel electronics, per tap and exposure.

    Parameters
    ----------
    read_e : float
        Read noise, standard deviation, electrons.
    full_well_e : float
        Charge at which a tap saturates, electrons.
    dn_per_e : float or None
        Conversion gain, digital numbers per electron; None keeps taps in electrons. Needed to
        predict the shot noise of taps given in DN.
    contrast : float
        Demodulation contrast A / B of a lone direct return, 0..1.
    signal_e : float
        Mean charge B per tap from a white, fronto-parallel surface at 1 m, electrons.
    """

    read_e: float = 0.0
    full_well_e: float = float("inf")
    dn_per_e: float | None = None
    contrast: float = 0.8
    signal_e: float = 20_000.0

    def __post_init__(self) -> None:
        gain = 1.0 if self.dn_per_e is None else self.dn_per_e
        if not (self.read_e >= 0 and self.full_well_e > 0 and gain > 0 and self.signal_e > 0):
            msg = f"noise terms must be positive (read_e may be zero), got {self}"
            raise ValueError(msg)
        if not 0 < self.contrast <= 1:
            msg = f"contrast must be in (0, 1], got {self.contrast}"
            raise ValueError(msg)


@dataclass(frozen=True, eq=False)
class Sensor:
    """A ToF camera: optics, modulation, electronics and where its light sits.

    Parameters
    ----------
    camera : Camera
        Optics.
    modulation : Modulation
        Frequencies and taps.
    noise : Noise
        Electronics.
    emitter_offset_m : tuple of 3 floats
        Emitter position in the camera frame (x right, y down, z forward), m.
    name : str
        Label used in files and reports.
    """

    camera: Camera
    modulation: Modulation
    noise: Noise = field(default_factory=Noise)
    emitter_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "custom"

    def __post_init__(self) -> None:
        offset = tuple(float(x) for x in self.emitter_offset_m)
        if len(offset) != 3 or not np.isfinite(offset).all():
            msg = f"emitter_offset_m must be three finite metres, got {self.emitter_offset_m}"
            raise ValueError(msg)
        _set(self, emitter_offset_m=offset)


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
        values = _frozen(self.values, np.float32, "taps", 4)
        if self.unit not in UNITS:
            msg = f"unit must be one of {UNITS}, got {self.unit!r}"
            raise ValueError(msg)
        _set(self, values=values, valid=_valid_mask(self.valid, values.shape[2:]))


@dataclass(frozen=True, eq=False)
class Phasors:
    """Demodulated signal ``z = A exp(+j phi)`` per frequency.

    Parameters
    ----------
    values : ndarray, (F, H, W)
        Phasors, complex64, in the unit of the taps they came from.
    sigma : ndarray, (F, H, W), or None
        Standard deviation of the real and of the imaginary part; None if unknown.
    valid : ndarray, (H, W), bool
        False where the measurement must not be used; non-finite phasors are always invalid.
    """

    values: C64
    sigma: F32 | None = None
    valid: Bool = None  # type: ignore[assignment]  # filled in __post_init__

    def __post_init__(self) -> None:
        values = _frozen(self.values, np.complex64, "phasors", 3)
        valid = _valid_mask(self.valid, values.shape[1:])
        finite = np.isfinite(values).all(axis=0)
        if not finite[valid].all():
            valid = _valid_mask(valid & finite, values.shape[1:])
        sigma = self.sigma
        if sigma is not None:
            sigma = _frozen(sigma, np.float32, "sigma", 3)
            _expect_shape("sigma", sigma, values.shape)
        _set(self, values=values, sigma=sigma, valid=valid)


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
        range_m = _frozen(self.range_m, np.float32, "range_m", 2)
        if np.isinf(range_m).any() or (range_m < 0).any():
            msg = "range_m must be non-negative metres, NaN for no answer; got infinite or negative"
            raise ValueError(msg)
        _set(self, range_m=range_m, info=_frozen_mapping(self.info))
        for name in ("sigma_m", "confidence", "amplitude"):
            extra = getattr(self, name)
            if extra is not None:
                extra = _frozen(extra, np.float32, name, 2)
                _expect_shape(name, extra, range_m.shape)
                _set(self, **{name: extra})


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a capture.

    Parameters
    ----------
    range_m : ndarray, (H, W)
        Radial range without multipath, float32, m; NaN where unknown.
    direct : ndarray, (F, H, W), or None
        Phasors of the direct light alone, complex64.
    """

    range_m: F32
    direct: C64 | None = None

    def __post_init__(self) -> None:
        range_m = _frozen(self.range_m, np.float32, "truth range_m", 2)
        if np.isinf(range_m).any():
            range_m = _frozen(np.where(np.isinf(range_m), np.nan, range_m), np.float32, "truth", 2)
        direct = self.direct
        if direct is not None:
            direct = _frozen(direct, np.complex64, "truth direct", 3)
            _expect_shape("truth direct", direct, (direct.shape[0], *range_m.shape))
        _set(self, range_m=range_m, direct=direct)


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
            _expect_shape("taps", self.taps.values, (mod.n_freqs, mod.n_taps, *shape))
        if self.phasors is not None:
            _expect_shape("phasors", self.phasors.values, (mod.n_freqs, *shape))
        if self.depth is not None:
            _expect_shape("depth range_m", self.depth.range_m, shape)
        if self.truth is not None:
            _expect_shape("truth range_m", self.truth.range_m, shape)
            if self.truth.direct is not None:
                _expect_shape("truth direct", self.truth.direct, (mod.n_freqs, *shape))
        reported = {
            name: _frozen(value, np.float32, name, 2) for name, value in self.reported.items()
        }
        for name, value in reported.items():
            _expect_shape(name, value, shape)
        _set(
            self,
            reported=MappingProxyType(reported),
            provenance=_frozen_mapping(self.provenance),
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
        _set(self, params=_frozen_mapping(self.params))


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
        Indirect bounces to keep: 0 is direct light only; None keeps all the engine can do.
    """

    sensor: Sensor
    seed: int = 0
    noisy: bool = True
    max_bounces: int | None = None


class Factory(Protocol[Context, Input, Output]):
    """The plug-in protocol: ``make(context, *, params) -> run(input) -> output``.

    Making may be slow (tables, compilation, sessions); running is pure and is what is timed.
    Parameters are keyword-only with working defaults.
    """

    def __call__(self, context: Context, /) -> Callable[[Input], Output]:
        """Build the method for one context."""
        ...
