"""Sensor presets by name, with the source of every figure.

A preset gives optics, modulation and electronics of a camera that exists; electronics are rarely
published, so read noise, full well, contrast and signal are round, assumed values, the same for
all presets, and marked so in `SOURCES`. Override anything: ``deeptof:freqs=20e6+50e6,width=64``.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from toftools._overrides import KEYS as KEYS
from toftools._overrides import overridden
from toftools.camera import pinhole
from toftools.camera import resized as resized
from toftools.phasor import SCHEMES
from toftools.registry import parse_entry
from toftools.types import Camera, Modulation, Noise, Sensor

ASSUMED_NOISE = Noise(read_e=20.0, full_well_e=150_000.0, contrast=0.8, signal_e=20_000.0)


def _camera(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
    return Camera(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))


def _kinect2() -> Sensor:
    # Phase offsets per frequency in degrees; successive taps step by -120 degrees, so the sign
    # that makes I_k = B + A cos(phi - step_k) is the negative of the printed offset.
    offsets_deg = np.array(
        [[150.94, 30.94, 270.94], [-83.12, -203.12, 36.88], [68.19, -51.81, 188.19]]
    )
    freqs = np.array([80.1675385e6, 16.05444453e6, 120.44403642e6])
    camera = _camera(512, 424, 365.5, 365.5, 255.5, 211.5)
    return Sensor(camera, Modulation(freqs, -np.radians(offsets_deg)), ASSUMED_NOISE)


def _opt8241() -> Sensor:
    camera = _camera(320, 240, 230.0, 230.0, 160.0, 120.0)
    return Sensor(camera, Modulation(np.array([40e6, 70e6])), ASSUMED_NOISE)


def _mlx75027() -> Sensor:
    steps = SCHEMES["four_step_0_180_90_270"]
    camera = pinhole(640, 480, hfov_deg=70)
    return Sensor(camera, Modulation(np.array([60e6]), steps), ASSUMED_NOISE)


def _adtf3175() -> Sensor:
    # Six radial terms k1..k6 of the block; OpenCV wants k1 k2 p1 p2 k3 k4 k5 k6.
    dist = [0.23696414, -0.01807739, 0, 0, 0.00173649, 0.5738449, -0.00448902, 0.00164395]
    K = [[505.022766, 0, 520.297546], [0, 505.198730, 517.454468], [0, 0, 1.0]]
    whole = Camera(1024, 1024, np.array(K), np.array(dist))
    modulation = Modulation(np.array([198e6, 189e6, 54e6]), SCHEMES["three_step"])
    return Sensor(resized(whole, 512, 512), modulation, ASSUMED_NOISE)


def _pmd() -> Sensor:
    camera = pinhole(240, 180, hfov_deg=56)
    return Sensor(camera, Modulation(np.array([45.18e6, 37.65e6])), ASSUMED_NOISE)


def _deeptof() -> Sensor:
    camera = pinhole(256, 256, hfov_deg=70)
    return Sensor(camera, Modulation(np.array([20e6])), ASSUMED_NOISE)


def _longrange() -> Sensor:
    camera = _camera(512, 424, 365.5, 365.5, 255.5, 211.5)
    return Sensor(
        camera,
        Modulation(np.array([80e6, 16e6, 120e6]), SCHEMES["three_step"]),
        ASSUMED_NOISE,
    )


def _phasor_imaging() -> Sensor:
    # Differences of 10, 90 and 100 MHz: 15 m without ambiguity, no step above a ratio of 11.
    camera = pinhole(160, 120, hfov_deg=60)
    return Sensor(camera, Modulation(np.array([1000e6, 1010e6, 1100e6])), ASSUMED_NOISE)


def _heide2013() -> Sensor:
    camera = pinhole(160, 120, hfov_deg=60)
    return Sensor(camera, Modulation(np.linspace(10e6, 120e6, 221)), ASSUMED_NOISE)


PRESETS: Mapping[str, Callable[[], Sensor]] = MappingProxyType(
    {
        "kinect2": _kinect2,
        "kinect2_nominal": _longrange,
        "opt8241": _opt8241,
        "mlx75027": _mlx75027,
        "adtf3175": _adtf3175,
        "pmd": _pmd,
        "deeptof": _deeptof,
        "phasor_imaging": _phasor_imaging,
        "heide2013": _heide2013,
    }
)
"""Preset name to the function that makes it."""

SOURCES: Mapping[str, str] = MappingProxyType(
    {
        "kinect2": "frequencies and phase offsets: FLAT camera parameters as republished by RADU "
        "(schellmi42/RADU); 512x424, 3 taps: libfreenect2; focal length: iai_kinect2 typical",
        "kinect2_nominal": "nominal 80/16/120 MHz and steps 0/120/240 degrees of libfreenect2",
        "opt8241": "320x240, 40+70 MHz, f = 230 px: Su et al., CVPR 2018 release (rough optics)",
        "mlx75027": "640x480, 60 MHz, tap order 0/180/90/270: dartmouth-risc-lab/snapshot-lidar; "
        "field of view assumed",
        "adtf3175": "198/189/54 MHz, focal lengths, centre and radial distortion k1..k6 (120 "
        "degrees across): ADI factory block CCB_1909-0240034 of 2019 (analogdevicesinc/ToF, MIT), "
        "binned to 512x512; its tangential terms, whose order is not documented, and its centre of "
        "distortion, which OpenCV has not, are left out (below 0.3 px each); tap scheme assumed",
        "pmd": "240x180, 45.18 + 37.65 MHz, joint range 19.9 m: pmd Royale modes; field of view "
        "assumed",
        "deeptof": "256x256, 20 MHz: Marco et al., DeepToF, SIGGRAPH Asia 2017; field of view "
        "assumed",
        "phasor_imaging": "about 1 GHz: Gupta et al., Phasor Imaging, ACM TOG 2015 (order of "
        "magnitude recalled); the spacing of the frequencies is ours, pixels and optics assumed: "
        "no area sensor of the kind is known",
        "heide2013": "221 frequencies: calibration data named in the code released with Heide et "
        "al., SIGGRAPH 2013; 10..120 MHz, hence steps of 0.5 MHz, recalled; 160x120 is a small "
        "PMD, its field of view assumed",
    }
)
"""Where the figures of each preset come from."""


def sensor(text: str) -> Sensor:
    """Sensor from ``name:key=val,...``.

    Parameters
    ----------
    text : str
        Preset name and overrides: ``freqs`` (Hz, joined by +), ``steps`` (scheme name or rad),
        ``waveform`` (``sine``, ``square``, ``trapezoid`` or the file of a measured correlation)
        with ``duty`` and ``rise``, ``width``, ``height``, ``hfov_deg``, ``emitter`` (metres,
        joined by +), ``beam_deg`` or ``beam`` (file of a measured profile), ``companding``
        (``kinect2`` or a table), and the fields of `Noise`, `Defects` and `Timing`.

    Returns
    -------
    Sensor
        The preset with the overrides.

    Raises
    ------
    ValueError
        If the preset or a key is unknown, or a value is not what it should be.

    Examples
    --------
    >>> sensor("deeptof:freqs=20e6+50e6,width=64,height=64").modulation.freqs_hz.tolist()
    [20000000.0, 50000000.0]
    """
    name, params = parse_entry(text)
    if name not in PRESETS:
        msg = f"unknown sensor {name!r}; known: {', '.join(PRESETS)}"
        raise ValueError(msg)
    return overridden(replace(PRESETS[name](), name=name), params)
