"""Captures with planted phase errors for the tests of the phase stages.

What is planted lies in the maps of the simulated sensor; the captures carry the nominal one.
"""

from dataclasses import replace

import numpy as np

from toftools.conditions import Conditions, with_conditions
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Phasors, PixelMaps, Scene, Shot
from toftools.units import range_to_phase

NOMINAL = sensor("opt8241:width=24,height=18")


def planted(nominal, phase_rad):
    """The same sensor with a phase offset per frequency and pixel."""
    ones = np.ones((1, *nominal.camera.shape))
    shape = (nominal.modulation.n_freqs, *nominal.camera.shape)
    offsets = np.broadcast_to(phase_rad, shape)
    return replace(nominal, maps=PixelMaps(ones, 0 * ones, offsets))


def wall(distance_m, *, phase_rad=0.0, seed=0, kind="wall", off_m=0.0, tilt=0.0, albedo=0.5,
         file="wall.h5", nominal=NOMINAL, sigma=True, ambient_e=0.0, **told):  # fmt: skip
    """A wall at `distance_m + off_m` that is said to stand at `distance_m`."""
    params = {"range": distance_m + off_m, "albedo": albedo, "ambient_e": ambient_e}
    scene = Scene("tilted", {**params, "tilt": tilt}) if tilt else Scene("wall", params)
    shot = analytic(scene)(Shot(planted(nominal, np.asarray(phase_rad)), seed=seed))
    phasors = shot.phasors if sigma else Phasors(shot.phasors.values, valid=shot.phasors.valid)
    capture = replace(shot, sensor=nominal, phasors=phasors)
    return with_conditions(capture, Conditions(kind, distance_m, **told), file=file)


def pattern(seed, spread_rad, nominal=NOMINAL):
    """White pattern of zero mean per frequency, (F, H, W)."""
    shape = (nominal.modulation.n_freqs, *nominal.camera.shape)
    drawn = spread_rad * np.random.default_rng(seed).normal(size=shape)
    return drawn - drawn.mean(axis=(1, 2), keepdims=True)


def true_range_m(capture):
    return capture.truth.range_m.astype(np.float64)


def true_phase_rad(capture):
    freqs = capture.sensor.modulation.freqs_hz[:, None, None]
    return range_to_phase(true_range_m(capture), freqs)


def share(inside):
    return float(np.mean(inside))
