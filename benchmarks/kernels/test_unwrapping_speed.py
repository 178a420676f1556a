"""Milliseconds per 320 x 240 frame of every unwrapping method, and of crt in plain numpy.

python -m pytest benchmarks/kernels/test_unwrapping_speed.py \\
    -p no:dash -o addopts="" --benchmark-only
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from toftools.registry import CORRECTIONS, find
from toftools.sensors import sensor as preset
from toftools.types import Phasors
from toftools.units import joint_ambiguity_m, range_to_phase

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from reference_unwrapping import numpy_crt

SENSORS = ("opt8241", "kinect2_nominal")
METHODS = (
    "single",
    "crt",
    "residual_voting",
    "kde",
    "kde:hypotheses=4",
    "kde:window_px=11",
    "semi_global",
)


def frame(name):
    """Tilted plane over most of the range, amplitude falling with its square, SNR 200 at 1 m."""
    sensor = preset(f"{name}:width=320,height=240")
    freqs = sensor.modulation.freqs_hz
    range_m = np.linspace(0.5, 0.9 * joint_ambiguity_m(freqs), 320 * 240).reshape(240, 320)
    values = 200 / range_m**2 * np.exp(1j * range_to_phase(range_m, freqs[:, None, None]))
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    return sensor, Phasors((values + noise).astype(np.complex64), np.ones(values.shape, np.float32))


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("method", METHODS)
def test_method(benchmark, method, sensor):
    benchmark.group = sensor
    context, phasors = frame(sensor)
    if method == "residual_voting" and context.modulation.n_freqs != 3:
        pytest.skip("residual voting takes three frequencies")
    benchmark(find(CORRECTIONS, method).build(context), phasors)


@pytest.mark.parametrize("sensor", SENSORS)
def test_crt_in_plain_numpy(benchmark, sensor):
    benchmark.group = sensor
    context, phasors = frame(sensor)
    freqs = context.modulation.freqs_hz
    benchmark(numpy_crt, phasors.values, phasors.sigma, freqs, joint_ambiguity_m(freqs))
