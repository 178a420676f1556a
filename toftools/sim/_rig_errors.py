"""What a virtual rig plants into a camera."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from toftools._arrays import set_fields
from toftools._params import checked_params, parse_entry
from toftools.electronics import PerFreq


@dataclass(frozen=True, eq=False)
class Errors:
    """What makes one unit of a camera differ from its data sheet.

    A phase that is one number is that of the highest frequency; the others have it in proportion,
    as a delay makes it. Several numbers are one per frequency.

    Parameters
    ----------
    focal : tuple of 2 floats
        Relative deviation of the focal lengths fx and fy.
    centre : tuple of 2 floats
        Shift of the principal point, share of image width and height.
    dist : tuple of float
        Distortion coefficients in OpenCV order.
    waveform : str
        Light waveform against a square reference: see `toftools.sim.waveform.with_waveform`.
    delay_s : float
        Delay of the light that nobody has told, s.
    offset_rad : float
        Standard deviation, over frequencies, of a phase offset of each, rad; drawn from `unit`.
    fppn_rad : float or tuple of float
        Standard deviation of the phase offset over pixels, rad.
    sensor_rad_per_k, light_rad_per_k : float or tuple of float
        Drift of the phase with the temperature of sensor and light source, rad/K.
    reference_sensor_c, reference_light_c : float
        Temperatures at which there is no drift, and of all captures but warm-up and check,
        degrees Celsius.
    room_c : float
        Temperature of both before they were switched on, degrees Celsius.
    sensor_tau_s, light_tau_s : float
        Time constants with which they warm up, s.
    amplitude_rad, amplitude_bend_rad, amplitude_wave_rad : float or tuple of float
        Amplitude-related phase error ``a x + b x^2 + c x cos(phase)``, rad, x being the octaves by
        which the amplitude exceeds the reference amplitude.
    prnu, dsnu_e, dark_e : float
        Relative spread of the pixels' gains, spread and mean of their dark charge, electrons.
    ab_gain : float
        Share by which node B of a two-tap pixel collects more than node A.
    bad_share : float
        Share of pixels that are dead or hot, one as often as the other.
    unit : int
        Serial number, seed of the patterns.
    """

    focal: tuple[float, ...] = (0.015, 0.012)
    centre: tuple[float, ...] = (0.012, -0.009)
    dist: tuple[float, ...] = (-0.12, 0.05, 8e-4, -6e-4, 0.0)
    waveform: str = "square"
    delay_s: float = 0.3e-9
    offset_rad: float = 0.05
    fppn_rad: PerFreq = 0.03
    sensor_rad_per_k: PerFreq = 1e-3
    light_rad_per_k: PerFreq = 2.5e-3
    reference_sensor_c: float = 40.0
    reference_light_c: float = 45.0
    room_c: float = 22.0
    sensor_tau_s: float = 600.0
    light_tau_s: float = 120.0
    amplitude_rad: PerFreq = 0.012
    amplitude_bend_rad: PerFreq = 1e-3
    amplitude_wave_rad: PerFreq = 3e-3
    prnu: float = 0.01
    dsnu_e: float = 10.0
    dark_e: float = 100.0
    ab_gain: float = 0.01
    bad_share: float = 5e-4
    unit: int = 0

    def __post_init__(self) -> None:
        for name in ("focal", "centre", "dist"):
            set_fields(self, **{name: tuple(np.ravel(getattr(self, name)).astype(float).tolist())})
        if len(self.focal) != 2 or len(self.centre) != 2 or min(self.focal) <= -1:
            msg = f"focal and centre hold two shares each, got {self.focal} and {self.centre}"
            raise ValueError(msg)
        least = {
            name: getattr(self, name)
            for name in ("offset_rad", "prnu", "dsnu_e", "dark_e", "bad_share", "unit")
        }
        if min(least.values()) < 0 or self.bad_share > 0.5:
            msg = f"spreads must not be negative and bad_share at most 0.5, got {least}"
            raise ValueError(msg)
        taus = (self.sensor_tau_s, self.light_tau_s)
        if not min(taus) > 0:
            msg = f"time constants must be positive seconds, got {taus}"
            raise ValueError(msg)


FAULTLESS = Errors(
    focal=(0.0, 0.0), centre=(0.0, 0.0), dist=(), waveform="sine", delay_s=0.0, offset_rad=0.0,
    fppn_rad=0.0, sensor_rad_per_k=0.0, light_rad_per_k=0.0, amplitude_rad=0.0,
    amplitude_bend_rad=0.0, amplitude_wave_rad=0.0, prnu=0.0, dsnu_e=0.0, dark_e=0.0, ab_gain=0.0,
    bad_share=0.0,
)  # fmt: skip
"""Nothing planted."""


def typed() -> dict[str, Any]:
    """Every error with a typical value, whose type says what is wanted.

    Returns
    -------
    dict
        Defaults; a tuple where several numbers may be given.
    """
    return {
        field.name: (field.default,) if field.type == PerFreq else field.default
        for field in fields(Errors)
    }


def parse_errors(text: str) -> Errors:
    """Errors from ``key=val,...``; ``none,key=val`` plants nothing else.

    Parameters
    ----------
    text : str
        As typed, such as ``waveform=sine,fppn_rad=0.02+0.04``.

    Returns
    -------
    Errors
        The defaults with these changes.

    Raises
    ------
    ValueError
        If a key is unknown or a value is not what it should be.

    Examples
    --------
    >>> parse_errors("none,delay_s=1e-9").delay_s, parse_errors("").waveform
    (1e-09, 'square')
    """
    first, _, rest = text.strip().partition(",")
    none = first.strip() == "none"
    params = parse_entry(f"errors:{rest if none else text}")[1]
    return replace(FAULTLESS if none else Errors(), **checked_params("errors", typed(), params))
