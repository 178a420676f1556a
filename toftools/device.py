"""The camera side of the types: optics, modulation, light sources; no computation.

Import these names from `toftools.types`, which holds all types together.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toftools._arrays import F64, expect_shape, frozen, set_fields
from toftools.electronics import Defects, Noise, PixelMaps, Timing
from toftools.units import check_freqs

CAMERA_MODELS = ("pinhole", "fisheye")


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera with OpenCV's distortion; pixel centres lie at integer coordinates.

    Parameters
    ----------
    width, height : int
        Image size, px.
    K : ndarray, (3, 3)
        Intrinsic matrix, px.
    dist : ndarray, (n,)
        Distortion coefficients in OpenCV order, n in {0, 4, 5, 8, 12, 14}; empty for none. A
        fisheye has exactly 4, k1..k4.
    model : str
        ``pinhole`` or ``fisheye``: OpenCV's cv2.fisheye, in which the image radius is a polynomial
        of the angle from the axis, so that views of 180 degrees and more fit in.
    """

    width: int
    height: int
    K: F64
    dist: F64 = field(default_factory=lambda: np.zeros(0))
    model: str = "pinhole"

    def __post_init__(self) -> None:
        if not (0 < int(self.width) <= 65_536 and 0 < int(self.height) <= 65_536):
            msg = f"width and height must be 1..65536 px, got {self.width} x {self.height}"
            raise ValueError(msg)
        K = frozen(self.K, np.float64, "K", 2)
        expect_shape("K", K, (3, 3))
        if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[2, 2] - 1) > 1e-9:
            msg = f"K must be finite with positive focal lengths and K[2,2] = 1, got {K.tolist()}"
            raise ValueError(msg)
        dist = np.asarray(self.dist, dtype=np.float64).reshape(-1).view()
        dist.flags.writeable = False
        if dist.size not in (0, 4, 5, 8, 12, 14) or not np.isfinite(dist).all():
            msg = f"dist must hold 0, 4, 5, 8, 12 or 14 finite coefficients, got {dist.tolist()}"
            raise ValueError(msg)
        if self.model not in CAMERA_MODELS:
            msg = f"got the camera model {self.model!r}; wanted {' or '.join(CAMERA_MODELS)}"
            raise ValueError(msg)
        if self.model == "fisheye" and dist.size != 4:
            msg = f"a fisheye has exactly 4 coefficients (zeros for none), got {dist.size}"
            raise ValueError(msg)
        set_fields(self, width=int(self.width), height=int(self.height), K=K, dist=dist)

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
        freqs = frozen(check_freqs(self.freqs_hz), np.float64, "freqs_hz", 1)
        steps = np.asarray(self.steps_rad, dtype=np.float64)
        if steps.ndim == 1:
            steps = np.broadcast_to(steps, (freqs.size, steps.size))
        steps = frozen(steps, np.float64, "steps_rad", 2)
        if steps.shape[0] != freqs.size or steps.shape[1] < 3 or not np.isfinite(steps).all():
            msg = (
                f"steps_rad must be (K,) or ({freqs.size}, K) finite radians with K >= 3 taps, "
                f"got shape {np.shape(self.steps_rad)}"
            )
            raise ValueError(msg)
        harmonics = np.ones((freqs.size, 1)) if self.harmonics is None else self.harmonics
        harmonics = frozen(harmonics, np.complex128, "harmonics", 2)
        if harmonics.shape[0] != freqs.size or not np.allclose(harmonics[:, 0], 1.0):
            msg = f"harmonics must be ({freqs.size}, M) with first column 1, got {harmonics.shape}"
            raise ValueError(msg)
        set_fields(self, freqs_hz=freqs, steps_rad=steps, harmonics=harmonics)

    @property
    def n_freqs(self) -> int:
        """Number of frequencies F."""
        return int(self.freqs_hz.size)

    @property
    def n_taps(self) -> int:
        """Number of taps K per frequency."""
        return int(self.steps_rad.shape[1])


@dataclass(frozen=True, eq=False)
class Emitter:
    """Small light source that travels with the camera.

    Parameters
    ----------
    offset_m : tuple of 3 floats
        Position in the camera frame (x right, y down, z forward), m.
    beam : ndarray, (N, 2), or None
        Angle from the optical axis, degrees, rising from 0, against intensity relative to the
        axis; linear in between, dark beyond the last angle. None is isotropic.
    strength : float
        Intensity on the axis relative to what `Noise.signal_e` describes.
    modulated : bool
        False for a lamp that adds offset and shot noise only.
    delay_s : float
        Time by which its modulation lags behind the reference, s.
    """

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    beam: F64 | None = None
    strength: float = 1.0
    modulated: bool = True
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        set_fields(self, offset_m=_metres(self.offset_m, "offset_m"))
        if not (np.isfinite(self.strength) and self.strength > 0 and np.isfinite(self.delay_s)):
            msg = (
                "an emitter needs positive strength and a finite delay_s, "
                f"got {self.strength} and {self.delay_s} s"
            )
            raise ValueError(msg)
        if self.beam is not None:
            beam = frozen(self.beam, np.float64, "beam", 2)
            expect_shape("beam", beam, (beam.shape[0], 2))
            rising = beam[0, 0] == 0 and (np.diff(beam[:, 0]) > 0).all() and beam[-1, 0] <= 180
            shines = (beam[:, 1] >= 0).all() and (beam[:, 1] > 0).any()
            if not (rising and np.isfinite(beam).all() and shines):
                msg = "beam must hold angles rising from 0 to at most 180 degrees and intensities"
                raise ValueError(f"{msg} of 0 or more, not all 0, got {beam.tolist()}")
            set_fields(self, beam=beam)


def _metres(value: tuple[float, float, float], name: str) -> tuple[float, float, float]:
    offset = tuple(float(x) for x in value)
    if len(offset) != 3 or not np.isfinite(offset).all():
        msg = f"{name} must be three finite metres, got {list(offset)}"
        raise ValueError(msg)
    return offset


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
    emitters : tuple of Emitter
        All light sources; empty for one isotropic source at `emitter_offset_m`. Where given,
        `emitter_offset_m` becomes the place of the first modulated one.
    defects : Defects
        What makes this unit differ from its data sheet.
    timing : Timing
        When the taps are taken.
    maps : PixelMaps or None
        Measured pixel patterns; None draws them from `defects`.
    """

    camera: Camera
    modulation: Modulation
    noise: Noise = field(default_factory=Noise)
    emitter_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "custom"
    emitters: tuple[Emitter, ...] = ()
    defects: Defects = field(default_factory=Defects)
    timing: Timing = field(default_factory=Timing)
    maps: PixelMaps | None = None

    def __post_init__(self) -> None:
        first = next((e.offset_m for e in self.emitters if e.modulated), self.emitter_offset_m)
        if self.emitters and not any(e.modulated for e in self.emitters):
            msg = f"got {len(self.emitters)} emitters, none modulated; a ToF camera needs one"
            raise ValueError(msg)
        set_fields(self, emitter_offset_m=_metres(first, "emitter_offset_m"))
        _check_per_freq(self)
        _check_steps(self.modulation, self.timing)
        if self.maps is not None:
            nodes = (self.timing.taps_per_exposure, *self.camera.shape)
            expect_shape("gain map", self.maps.gain, nodes)
            expect_shape("dark map", self.maps.dark_e, nodes)
            layers = (self.modulation.n_freqs, *self.camera.shape)
            expect_shape("phase map", self.maps.phase_rad, layers)

    @property
    def sources(self) -> tuple[Emitter, ...]:
        """Every light source, the implied one included."""
        return self.emitters or (Emitter(self.emitter_offset_m),)


def _check_per_freq(sensor: Sensor) -> None:
    """Values per frequency are as many as the frequencies."""
    wanted = sensor.modulation.n_freqs
    for name, owner in (
        ("contrast", sensor.noise),
        ("fppn_rad", sensor.defects),
        ("drift_rad_per_k", sensor.defects),
    ):
        value = getattr(owner, name)
        if isinstance(value, tuple) and len(value) != wanted:
            msg = f"{name} must be one number or one per frequency ({wanted}), got {len(value)}"
            raise ValueError(msg)


def _check_steps(modulation: Modulation, timing: Timing) -> None:
    """Nodes A and B are half a turn apart; heterodyne steps follow from the times."""
    nodes, steps = timing.taps_per_exposure, modulation.steps_rad
    if nodes == 1 and not timing.beat_hz:
        return
    if modulation.n_taps % nodes:
        msg = f"a two-tap pixel needs an even number of taps, got {modulation.n_taps}"
        raise ValueError(msg)
    base = steps[:, ::nodes]
    if timing.beat_hz:
        times_s = timing.tap_interval_s * np.arange(base.shape[1])
        base = np.broadcast_to(2 * np.pi * timing.beat_hz * times_s, base.shape)
    wanted = base[:, :, None] + np.pi * np.arange(nodes)
    if np.abs(np.exp(1j * (wanted.reshape(steps.shape) - steps)) - 1).max() > 1e-6:
        msg = (
            f"taps of this timing step by {np.round(wanted[0].ravel(), 4).tolist()} rad, "
            f"got {np.round(steps[0], 4).tolist()}"
        )
        raise ValueError(msg)
