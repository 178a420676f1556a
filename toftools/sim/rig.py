"""A virtual calibration rig: every capture of a calibration, of one camera with known errors.

What is planted (`Errors`) sits in true optics, waveform and pixel maps; the captures carry what
the maker says (`nominal`), so that a fit has to find it out. Phases add in the order of nature:

    measured = W(phase of the light + delay + common + fixed pattern + drift + g(phase, amplitude))

with the wiggling W of the waveform, which the taps alias by themselves. A calibration takes W off
first and finds the others in what is left; the answers are told by `truth_of`. The amplitude of g
is the measured one, as a calibration knows it: for square waves and four taps it ripples by 15 %
with the phase. A fit of W alone, from a delay sweep, therefore finds g of this ripple in it; only
a fit of both together tells them apart. There is no bounced light, scatter in the lens, or curve
of the response in these captures.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from toftools.conditions import Conditions, with_conditions
from toftools.phasor import demodulate, phase
from toftools.sim._rig_boards import BOARD as BOARD
from toftools.sim._rig_boards import WALL_BEHIND_M, pattern
from toftools.sim._rig_errors import FAULTLESS as FAULTLESS
from toftools.sim._rig_errors import Errors as Errors
from toftools.sim._rig_errors import parse_errors as parse_errors
from toftools.sim._rig_plan import PLANS as PLANS
from toftools.sim._rig_plan import Plan as Plan
from toftools.sim._rig_plan import Take as Take
from toftools.sim._rig_plan import takes
from toftools.sim._rig_truth import RigTruth as RigTruth
from toftools.sim._rig_truth import truth_of as truth_of
from toftools.sim._rig_unit import Unit as Unit
from toftools.sim._rig_unit import unit_of as unit_of
from toftools.sim._rig_wiggling import Wiggling as Wiggling
from toftools.sim.noise import clean_taps, contrasts
from toftools.sim.readout import expose
from toftools.sim.shapes import C128, Transport
from toftools.sim.target import plane, printed
from toftools.types import F64, Capture, Noise, PixelMaps, Sensor, Taps
from toftools.units import TWO_PI

ROUNDS = 5
"""Of the fixed point of phase and amplitude."""


def rig(
    sensor: Sensor,
    errors: Errors,
    *,
    plan: str | Plan = "small",
    seed: int = 0,
    frames: int = 1,
    noisy: bool = True,
) -> Iterator[tuple[str, Capture]]:
    """Capture a whole calibration of one camera, one after another.

    Parameters
    ----------
    sensor : Sensor
        The camera as its maker describes it; distortion is left out of it.
    errors : Errors
        What makes this one different.
    plan : str or Plan
        Captures to make, by name out of `PLANS` or a plan of one's own.
    seed : int
        Of noise, board poses and check set; not of the camera, which is ``errors.unit``.
    frames : int
        Exposures averaged into every capture.
    noisy : bool
        False gives the expectation.

    Yields
    ------
    str, Capture
        File name, and capture with conditions, nominal sensor, taps and phasors, without truth.

    Raises
    ------
    ValueError
        If the sensor brings errors along, the plan is unknown, or the distortion folds the image.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> name, capture = next(rig(sensor("deeptof:width=48,height=36"), Errors()))
    >>> name, capture.provenance["conditions"]["kind"]
    ('board_00.h5', 'board')
    """
    unit = unit_of(errors, sensor)
    for i, take in enumerate(planned(unit, plan, seed=seed, frames=frames)):
        capture = exposed(take, unit, noise_of(seed, i) if noisy else None, frames)
        yield take.name, replace(capture, provenance={**capture.provenance, "seed": seed})


def noise_of(seed: int, place: int) -> np.random.Generator:
    """Source of the noise of one capture.

    Parameters
    ----------
    seed : int
        Seed of the rig.
    place : int
        Place of the capture in the plan.

    Returns
    -------
    numpy.random.Generator
        The same whether or not the captures before it are made.
    """
    return np.random.default_rng((seed, 2, place))


def planned(unit: Unit, plan: str | Plan, *, seed: int, frames: int = 1) -> list[Take]:
    """The captures of a plan, not made yet.

    Parameters
    ----------
    unit : Unit
        Camera.
    plan : str or Plan
        Name out of `PLANS`, or a plan.
    seed : int
        Of poses and check set.
    frames : int
        Exposures per capture, checked.

    Returns
    -------
    list of Take
        In the order of a day.

    Raises
    ------
    ValueError
        If the plan is unknown or a number is out of range.
    """
    if isinstance(plan, str) and plan not in PLANS:
        msg = f"unknown plan {plan!r}; known: {', '.join(PLANS)}"
        raise ValueError(msg)
    if frames < 1 or seed < 0:
        msg = f"wanted frames of 1 or more and a seed of 0 or more, got {frames} and {seed}"
        raise ValueError(msg)
    return takes(PLANS[plan] if isinstance(plan, str) else plan, unit, seed)


def exposed(take: Take, unit: Unit, rng: np.random.Generator | None, frames: int = 1) -> Capture:
    """Make one capture.

    Parameters
    ----------
    take : Take
        What.
    unit : Unit
        With what camera.
    rng : numpy.random.Generator or None
        Source of the noise; None gives the expectation.
    frames : int
        Exposures to average.

    Returns
    -------
    Capture
        With conditions and the nominal sensor, whose noise is that of the average.
    """
    sensor, told = unit.sensor, take.conditions
    view = None if take.albedo == 0 else _view(take, unit)
    strength = sensor.noise.signal_e * told.exposure

    def light(freq_hz: float) -> C128:
        if view is None:
            return np.zeros(sensor.camera.shape, np.complex128)
        return strength * view.phasor(freq_hz, 0)

    maps = sensor.maps
    assert maps is not None
    layers = np.stack([light(float(freq)) for freq in sensor.modulation.freqs_hz])
    added = maps.phase_rad + phase_added_rad(unit, told, layers, maps.phase_rad)
    true = replace(sensor, maps=PixelMaps(maps.gain, maps.dark_e, added))
    charge = clean_taps(light, take.lamp_e, true)
    taps = _mean([expose(charge, true, rng) for _ in range(frames if rng is not None else 1)])
    nominal = replace(unit.nominal, noise=averaged(unit.nominal.noise, frames))
    if frames > 1:  # electrons of the average are no electrons: less noisy by far
        taps = Taps(taps.values, "DN", taps.valid)
    provenance = {"engine": "rig", "frames": frames}
    capture = Capture(nominal, taps, demodulate(taps, nominal), provenance=provenance)
    return with_conditions(capture, told, file=take.name)


def phase_added_rad(unit: Unit, told: Conditions, light: C128, pattern_rad: F64) -> F64:
    """Phase that is added to the light before it wiggles, fixed pattern aside.

    The amplitude-related error depends on the measured amplitude, which ripples with the phase
    that this error is part of: a fixed point, a hundred times nearer with every round.

    Parameters
    ----------
    unit : Unit
        Camera.
    told : Conditions
        Delay and temperatures.
    light : ndarray, (F, H, W)
        Light at the frequencies, electrons per tap.
    pattern_rad : ndarray, (F, H, W)
        Fixed pattern, rad.

    Returns
    -------
    ndarray, (F, H, W)
        Phase, rad.
    """
    freqs = unit.nominal.modulation.freqs_hz
    delay = 2 * np.pi * freqs * told.delay_s
    shift = (delay + unit.drift_rad(told.sensor_c, told.light_c))[:, None, None]
    constant = unit.common_rad[:, None, None]
    scale = contrasts(unit.nominal) * (unit.nominal.noise.gain_dn_per_e or 1.0)
    sine = scale[:, None, None] * np.abs(light)
    angle, related = phase(light) + shift, np.zeros(light.shape)
    for _ in range(ROUNDS if sine.any() else 0):
        arriving = angle + related + constant + pattern_rad
        turn = np.linspace(0, TWO_PI, unit.ripple.shape[1], endpoint=False)
        ripples = [
            np.interp(layer, turn, wave, period=TWO_PI)
            for layer, wave in zip(arriving, unit.ripple, strict=True)
        ]
        amplitude = np.where(sine > 0, sine * np.stack(ripples), unit.reference[:, None, None])
        related = unit.amplitude_error_rad(angle + related, amplitude)
    return np.asarray(constant + shift + related)


def averaged(noise: Noise, frames: int) -> Noise:
    """Electronics of the average of several exposures: one as long as all, of lower gain.

    Parameters
    ----------
    noise : Noise
        Electronics of one exposure.
    frames : int
        Number of exposures.

    Returns
    -------
    Noise
        So that the noise of averaged taps follows from them as that of single ones does; rounding
        of the converter is taken too large, which shows only where it rules the noise.
    """
    if frames == 1:
        return noise
    return replace(
        noise,
        read_e=noise.read_e * float(np.sqrt(frames)),
        full_well_e=noise.full_well_e * frames,
        signal_e=noise.signal_e * frames,
        dark_e=noise.dark_e * frames,
        dn_per_e=(noise.gain_dn_per_e or 1.0) / frames,
    )


def _mean(exposures: list[Taps]) -> Taps:
    """Average of exposures; a pixel is valid if it is in all of them."""
    if len(exposures) == 1:
        return exposures[0]
    total = np.zeros(exposures[0].values.shape)
    for one in exposures:
        total += one.values
    values = np.asarray(total / len(exposures), dtype=np.float32)
    valid = np.logical_and.reduce([one.valid for one in exposures])
    return Taps(values, exposures[0].unit, valid)


def _view(take: Take, unit: Unit) -> Transport:
    """What the true optics see."""
    told, emitter_m = take.conditions, unit.sensor.emitter_offset_m
    if take.pose is None:
        return plane(
            unit.directions, distance_m=told.distance_m, normal=told.normal, albedo=take.albedo,
            emitter_m=emitter_m,
        )  # fmt: skip
    rotation, origin_m = take.pose
    return printed(
        unit.fine_directions, pattern(), rotation=rotation, origin_m=origin_m,
        wall_m=float(origin_m[2]) + WALL_BEHIND_M, emitter_m=emitter_m,
    )  # fmt: skip
