"""Phase maps of tables split into a constant and a pattern, and the chain around them."""

from dataclasses import replace
from typing import Any

import numpy as np

from toftools.calib.chain import Chain
from toftools.calib.common_phase import CommonPhase
from toftools.calib.fixed_pattern import FixedPattern
from toftools.calib.residuals import wrap_half
from toftools.calib.stage import Residual, Stage
from toftools.sensors import sensor as make_sensor
from toftools.types import F64, Bool, Camera, Modulation, Sensor


def check_sign(sign: int) -> None:
    """Refuse a sign that is none.

    Parameters
    ----------
    sign : int
        As given.

    Raises
    ------
    ValueError
        If it is neither 1 nor -1.
    """
    if sign not in (1, -1):
        msg = f"sign must be 1 or -1, got {sign}"
        raise ValueError(msg)


def phase_stages(
    error_rad: F64, usable: Bool, quantum_rad: float, notes: tuple[str, ...], *, turn: float = 1.0
) -> tuple[CommonPhase, FixedPattern]:
    """Common phase and fixed pattern of a phase map.

    Parameters
    ----------
    error_rad : ndarray, (F, H, W)
        Measured minus true phase, rad.
    usable : ndarray, (H, W), bool
        Pixels with an offset; the others become invalid.
    quantum_rad : float
        Step of the stored numbers, rad: all that the table tells of its accuracy.
    notes : tuple of str
        What a user should know.
    turn : float
        Share of a turn by which pixels may differ and still count as alike in the mean: 0.5 for
        rows that alternate by half a turn.

    Returns
    -------
    tuple of CommonPhase and FixedPattern
        Their errors add up to the map. The pattern has zero circular mean over usable pixels.
    """
    angles = error_rad[:, usable] / turn
    common = turn * np.angle(np.exp(1j * angles).mean(axis=1))
    pattern = wrap_half(error_rad - common[:, None, None])
    pattern = np.where(usable, pattern, np.nan)
    sigma = np.where(usable, quantum_rad / np.sqrt(12), np.nan)
    residual = Residual("mm", n=int(usable.sum()), notes=notes)
    return (
        CommonPhase(
            common, np.full(common.shape, quantum_rad / np.sqrt(12)), np.full(2, np.nan), residual
        ),
        FixedPattern(pattern, np.broadcast_to(sigma, pattern.shape), residual),
    )


def sensor_with(name: str, camera: Camera, freqs_hz: F64 | None = None) -> Sensor:
    """A sensor preset with the optics, and perhaps the frequencies, of a table.

    Parameters
    ----------
    name : str
        Sensor text, such as ``kinect2``.
    camera : Camera
        Optics.
    freqs_hz : ndarray, (F,), or None
        Frequencies, Hz; None keeps those of the preset.

    Returns
    -------
    Sensor
        The sensor; tap steps of the preset's first frequency where frequencies are given.
    """
    preset = make_sensor(name)
    if freqs_hz is None:
        return replace(preset, camera=camera)
    modulation = Modulation(freqs_hz, preset.modulation.steps_rad[0])
    return replace(preset, camera=camera, modulation=modulation)


def chain_of(sensor: Sensor, stages: list[Stage], notes: dict[str, Any]) -> Chain:
    """Chain of a factory table.

    Parameters
    ----------
    sensor : Sensor
        Name, size and frequencies.
    stages : list of Stage
        In their order.
    notes : dict
        Source, licence, convention.

    Returns
    -------
    Chain
        The chain.
    """
    camera, freqs = sensor.camera, sensor.modulation.freqs_hz
    return Chain(sensor.name, camera.width, camera.height, freqs, tuple(stages), notes)
