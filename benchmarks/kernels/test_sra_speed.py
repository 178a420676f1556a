"""Speed of SRA: ``pytest benchmarks/kernels/test_sra_speed.py --benchmark-only``.

Published for the original on a 2014 single thread: 31.2 ms per frame, as the thesis table quotes
it; frame size and frequencies differ (recalled: Kinect, three frequencies).
"""

import numpy as np
import pytest

from toftools.correct._sra_table import make_table
from toftools.correct.sra import sra
from toftools.correct.sra_lp import sra_lp
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import range_to_phase

CAMERA = sensor("opt8241")  # 320 x 240, 40 and 70 MHz
LIMITS = {"joint_ambiguity": 0.0, "limit_4m": 4.0}


@pytest.fixture(scope="module")
def phasors():
    """Two returns and noise in every pixel: nothing is alike, so the table is read all over."""
    rng = np.random.default_rng(0)
    shape = CAMERA.camera.shape
    first, apart, ratio = (rng.uniform(*span, shape) for span in ((0.5, 2), (0.3, 2), (0.05, 0.8)))
    freqs = CAMERA.modulation.freqs_hz[:, None, None]
    z = np.exp(1j * range_to_phase(first, freqs))
    z += ratio * np.exp(1j * range_to_phase(first + apart, freqs))
    z += 0.01 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    return Phasors(z.astype(np.complex64))


@pytest.mark.parametrize("limit", LIMITS)
def test_frame_320x240(benchmark, phasors, limit):
    run = sra(CAMERA, max_range_m=LIMITS[limit])
    depth = benchmark(run, phasors)
    assert np.isfinite(depth.range_m).mean() > 0.99


@pytest.mark.parametrize("limit", LIMITS)
def test_table(benchmark, limit):
    params = {"grid_m": 0.01, "epsilon": 0.05, "max_range_m": LIMITS[limit]}
    make_table(CAMERA.modulation.freqs_hz, **params)  # compiles
    table = benchmark.pedantic(
        make_table, (CAMERA.modulation.freqs_hz,), params, rounds=3, iterations=1
    )
    benchmark.extra_info["bytes"] = table.range_m.nbytes + table.share.nbytes


def test_linear_program_100_pixels(benchmark, phasors):
    run = sra_lp(CAMERA)
    some = Phasors(phasors.values[:, :10, :10])
    benchmark.pedantic(run, (some,), rounds=3, iterations=1)
