"""Toy stages with closed forms, to test what is done with stages."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from toftools.calib.stage import Residual
from toftools.types import Phasors


def turned(phasors, error_rad, slope=0.0):
    values = phasors.values * np.exp(-1j * error_rad)
    sigma = phasors.sigma
    if sigma is not None:
        sigma = (sigma * np.abs(1 - slope)).astype(np.float32)
    return Phasors(values.astype(np.complex64), sigma, phasors.valid)


def angles(phasors):
    return np.angle(phasors.values.astype(np.complex128))


@dataclass(frozen=True, eq=False)
class Waves:
    residual: Residual = field(default_factory=Residual)
    slot: ClassVar[str] = "wiggling"

    def error_rad(self, phase_rad, amplitude):
        return 0.07 * np.sin(4 * phase_rad + 0.3) + 0.01 * np.cos(8 * phase_rad)

    def __call__(self, phasors):
        phase = angles(phasors)
        slope = 0.28 * np.cos(4 * phase + 0.3) - 0.08 * np.sin(8 * phase)
        return turned(phasors, self.error_rad(phase, None), slope)


@dataclass(frozen=True, eq=False)
class Constant:
    offset_rad: np.ndarray
    residual: Residual = field(default_factory=Residual)
    slot: ClassVar[str] = "common_phase"

    def error_rad(self, phase_rad, amplitude):
        return self.offset_rad[:, None, None]

    def __call__(self, phasors):
        return turned(phasors, self.error_rad(None, None))


@dataclass(frozen=True, eq=False)
class Pattern:
    map_rad: np.ndarray
    residual: Residual = field(default_factory=Residual)
    slot: ClassVar[str] = "fixed_pattern"

    def error_rad(self, phase_rad, amplitude):
        return self.map_rad

    def __call__(self, phasors):
        known = np.isfinite(self.map_rad).all(axis=0)
        done = turned(phasors, np.nan_to_num(self.map_rad))
        return replace(done, valid=done.valid & known)


@dataclass(frozen=True, eq=False)
class Bend:
    residual: Residual = field(default_factory=Residual)
    amplitude_span: ClassVar[tuple[float, float]] = (8.0, 2.0**16)
    slot: ClassVar[str] = "amplitude"

    def error_rad(self, phase_rad, amplitude):
        level = np.log(np.clip(amplitude, *self.amplitude_span) / 1000)
        return 0.02 * level * (1 + 0.3 * np.cos(phase_rad))

    def __call__(self, phasors):
        amplitude = np.abs(phasors.values).astype(np.float64)
        return turned(phasors, self.error_rad(angles(phasors), amplitude))


@dataclass(frozen=True, eq=False)
class Drift(Constant):
    slot: ClassVar[str] = "temperature"
    needs: tuple[str, ...] = ("sensor_c",)
    sensor_c: float = float("nan")

    def at(self, **temperatures):
        return replace(self, sensor_c=temperatures["sensor_c"])

    def error_rad(self, phase_rad, amplitude):
        if np.isnan(self.sensor_c):
            msg = "the temperature stage has no temperature; call at()"
            raise ValueError(msg)
        return self.offset_rad[:, None, None] * (self.sensor_c - 25)
