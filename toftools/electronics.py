"""The pixel side of the types: noise, defects of one unit, timing of the taps; no computation.

Every term is off by default. Import these names from `toftools.types`, which holds all types
together; `toftools.sim.noise` says what each term does to the taps.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from toftools._arrays import F64, frozen, set_fields

PerFreq = float | tuple[float, ...]
"""One number for all frequencies, or one per frequency."""

MOST_CODES = 4096


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
        Conversion gain, digital numbers per electron; None takes that of `adc_bits` or `codes_dn`
        over the full well, or keeps taps in electrons where there is neither.
    contrast : float or tuple of float
        Demodulation contrast A / B of a lone direct return, 0..1; one for all frequencies or one
        per frequency.
    signal_e : float
        Mean charge B per tap from a white, fronto-parallel surface at 1 m, electrons.
    dark_e : float
        Mean dark charge per tap, electrons, with its own shot noise; it stays in the taps.
    adc_bits : int or None
        Resolution of the converter: codes end at ``2^bits - 1``, above which a tap saturates. The
        black level counts as subtracted: read noise about zero keeps its sign.
    codes_dn : tuple of float
        Companded converter: the digital number of each code, rising from 0, the same with the
        other sign below zero; taps hold these numbers. Empty for a linear converter.
    """

    read_e: float = 0.0
    full_well_e: float = float("inf")
    dn_per_e: float | None = None
    contrast: PerFreq = 0.8
    signal_e: float = 20_000.0
    dark_e: float = 0.0
    adc_bits: int | None = None
    codes_dn: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        gain = 1.0 if self.dn_per_e is None else self.dn_per_e
        positive = self.full_well_e > 0 and gain > 0 and self.signal_e > 0
        if not (positive and self.read_e >= 0 and self.dark_e >= 0):
            msg = f"noise terms must be positive (read_e and dark_e may be zero), got {self}"
            raise ValueError(msg)
        set_fields(self, contrast=_per_freq(self.contrast, "contrast"))
        if not all(0 < value <= 1 for value in _listed(self.contrast)):
            msg = f"contrast must be in (0, 1], got {self.contrast}"
            raise ValueError(msg)
        if self.adc_bits is not None and not (
            int(self.adc_bits) == self.adc_bits and 1 <= self.adc_bits <= 24
        ):
            msg = f"adc_bits must be a whole number from 1 to 24, got {self.adc_bits}"
            raise ValueError(msg)
        set_fields(self, codes_dn=tuple(float(code) for code in self.codes_dn))
        self._check_codes()
        if self.top_dn < np.inf and self.gain_dn_per_e is None:
            msg = "a converter needs full_well_e or dn_per_e to know its gain; got neither"
            raise ValueError(msg)

    def _check_codes(self) -> None:
        codes = np.asarray(self.codes_dn)
        if codes.size and self.adc_bits is not None:
            msg = f"got adc_bits={self.adc_bits} and {codes.size} companded codes; wanted one"
            raise ValueError(msg)
        rising = codes.size > 1 and codes[0] == 0 and bool((np.diff(codes) > 0).all())
        if codes.size and not (rising and codes.size <= MOST_CODES and np.isfinite(codes[-1])):
            msg = f"codes_dn must hold 2..{MOST_CODES} numbers rising from 0, got {codes.size}"
            raise ValueError(msg)

    @property
    def top_dn(self) -> float:
        """Largest digital number of the converter; infinite without one."""
        if self.codes_dn:
            return self.codes_dn[-1]
        return float("inf") if self.adc_bits is None else float(2 ** int(self.adc_bits) - 1)

    @property
    def gain_dn_per_e(self) -> float | None:
        """Digital numbers per electron; None where taps stay in electrons."""
        if self.dn_per_e is not None or not (self.top_dn < np.inf and self.full_well_e < np.inf):
            return self.dn_per_e
        return self.top_dn / self.full_well_e


@dataclass(frozen=True, eq=False)
class Defects:
    """What makes one camera differ from its data sheet: pixel patterns, temperature, lens scatter.

    Parameters
    ----------
    prnu : float
        Photo-response non-uniformity: relative standard deviation of the charge that pixels
        collect from the same light.
    dsnu_e : float
        Dark-signal non-uniformity: standard deviation of the dark charge over pixels, electrons.
    fppn_rad : float or tuple of float
        Fixed-pattern phase noise: standard deviation of the phase offset over pixels, rad; one
        number is that of the highest frequency, the others in proportion, as a delay makes it.
    ab_gain : float
        Share by which node B of a two-tap pixel collects more charge than node A.
    temperature_c, reference_c : float
        Temperature, and the one at which there is no drift, degrees Celsius.
    drift_rad_per_k : float or tuple of float
        Phase drift, rad/K; one number or one per frequency, as `fppn_rad`.
    drift_gain_per_k : float
        Relative change of the emitted light, 1/K.
    scatter : float
        Share of the light that the lens spreads over its neighbourhood, 0..1.
    scatter_px : float
        Standard deviation of that neighbourhood, px.
    unit : int
        Serial number of the camera, seed of its pixel patterns.
    """

    prnu: float = 0.0
    dsnu_e: float = 0.0
    fppn_rad: PerFreq = 0.0
    ab_gain: float = 0.0
    temperature_c: float = 25.0
    reference_c: float = 25.0
    drift_rad_per_k: PerFreq = 0.0
    drift_gain_per_k: float = 0.0
    scatter: float = 0.0
    scatter_px: float = 30.0
    unit: int = 0

    def __post_init__(self) -> None:
        for name in ("fppn_rad", "drift_rad_per_k"):
            set_fields(self, **{name: _per_freq(getattr(self, name), name)})
        numbers = [x for value in vars(self).values() for x in _listed(value)]
        least = (self.prnu, self.dsnu_e, *_listed(self.fppn_rad), self.unit)
        if not (np.isfinite(numbers).all() and min(least) >= 0 and self.ab_gain > -1):
            msg = f"defects must be finite and spreads not negative, got {self}"
            raise ValueError(msg)
        if not (0 <= self.scatter < 1 and 1 <= self.scatter_px <= 1e4):
            msg = (
                "scatter must lie in 0..1 and scatter_px in 1..10000 px, "
                f"got {self.scatter} and {self.scatter_px}"
            )
            raise ValueError(msg)
        if not self.light_gain > 0:
            msg = f"drift leaves no light at {self.temperature_c} degrees, got {self}"
            raise ValueError(msg)

    @property
    def light_gain(self) -> float:
        """Emitted light relative to that at the reference temperature."""
        return 1 + self.drift_gain_per_k * (self.temperature_c - self.reference_c)


@dataclass(frozen=True, eq=False)
class Timing:
    """When the taps are taken.

    Parameters
    ----------
    tap_interval_s : float
        Time from one exposure to the next, frequencies one after another, s; 0 takes all taps at
        once.
    exposure_s : float
        Time over which an exposure collects charge, s; it counts for heterodyne taps only.
    beat_hz : float
        Heterodyne: frequency of the reference above that of the light, Hz; 0 is homodyne. The
        steps of the taps are then ``2 pi beat_hz time``, time being that of the middle of each
        exposure after the first of its frequency.
    taps_per_exposure : int
        1, or 2 for a two-tap pixel whose nodes A and B collect every other half period: taps 2i
        and 2i + 1 come from the same exposure, half a turn apart.
    """

    tap_interval_s: float = 0.0
    exposure_s: float = 0.0
    beat_hz: float = 0.0
    taps_per_exposure: int = 1

    def __post_init__(self) -> None:
        times = (self.tap_interval_s, self.exposure_s)
        if not (np.isfinite((*times, self.beat_hz)).all() and min(times) >= 0):
            msg = f"times of taps must be finite and not negative, got {self}"
            raise ValueError(msg)
        if self.taps_per_exposure not in (1, 2):
            msg = f"taps_per_exposure must be 1 or 2, got {self.taps_per_exposure}"
            raise ValueError(msg)
        if self.beat_hz and not 0 < self.exposure_s <= self.tap_interval_s * (1 + 1e-9):
            msg = f"heterodyne taps need 0 < exposure_s <= tap_interval_s, got {self}"
            raise ValueError(msg)


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """Patterns of one camera, measured or drawn; N is `Timing.taps_per_exposure`.

    Parameters
    ----------
    gain : ndarray, (N, H, W)
        Charge collected relative to the mean pixel, per node.
    dark_e : ndarray, (N, H, W)
        Dark charge of a tap, electrons, per node.
    phase_rad : ndarray, (F, H, W)
        Phase offset per frequency, rad, added to the phase of the light.
    """

    gain: F64
    dark_e: F64
    phase_rad: F64

    def __post_init__(self) -> None:
        for name in ("gain", "dark_e", "phase_rad"):
            array = frozen(getattr(self, name), np.float64, name, 3)
            if not (np.isfinite(array).all() and (name == "phase_rad" or (array >= 0).all())):
                msg = f"{name} must be finite, and gain and dark_e not negative"
                raise ValueError(msg)
            set_fields(self, **{name: array})


def _listed(value: PerFreq) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _per_freq(value: PerFreq | Iterable[float], name: str) -> PerFreq:
    """A lone number as a float, several as a tuple."""
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if numbers.ndim != 1 or numbers.size == 0:
        msg = f"{name} must be one number or one per frequency, got shape {numbers.shape}"
        raise ValueError(msg)
    return float(numbers[0]) if numbers.size == 1 else tuple(numbers.tolist())
