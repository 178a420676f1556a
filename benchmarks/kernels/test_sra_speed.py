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

PAIR = sensor("opt8241")  # 40 and 70 MHz
THREE = sensor("kinect2_nominal:width=320,height=240")  # 80, 16 and 120 MHz
CASES = {
    "pair": (PAIR, 0.0),
    "pair_limit_4m": (PAIR, 4.0),
    "three": (THREE, 0.0),
    "three_limit_4m": (THREE, 4.0),
}


def phasors(camera, second):
    """Noise and, in every pixel, other returns: nothing is alike."""
    rng = np.random.default_rng(0)
    shape = camera.camera.shape
    first, apart, ratio = (rng.uniform(*span, shape) for span in ((0.5, 2), (0.3, 2), (0.05, 0.8)))
    freqs = camera.modulation.freqs_hz[:, None, None]
    z = np.exp(1j * range_to_phase(first, freqs))
    z += second * ratio * np.exp(1j * range_to_phase(first + apart, freqs))
    z += 0.01 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    return Phasors(z.astype(np.complex64), np.full(z.shape, 0.01, np.float32))


@pytest.mark.parametrize("second", [0, 1], ids=["lone", "two"])
@pytest.mark.parametrize("case", CASES)
def test_frame_320x240(benchmark, case, second):
    camera, limit = CASES[case]
    run, frame = sra(camera, max_range_m=limit), phasors(camera, second)
    depth = benchmark.pedantic(run, (frame,), rounds=5, iterations=1, warmup_rounds=1)
    assert np.isfinite(depth.range_m).mean() > 0.99


@pytest.mark.parametrize("limit", [0.0, 4.0])
def test_table(benchmark, limit):
    params = {"grid_m": 0.01, "epsilon": 0.05, "max_range_m": limit}
    make_table(PAIR.modulation.freqs_hz, **params)  # compiles
    table = benchmark.pedantic(
        make_table, (PAIR.modulation.freqs_hz,), params, rounds=3, iterations=1
    )
    benchmark.extra_info["bytes"] = table.range_m.nbytes + table.share.nbytes


@pytest.mark.parametrize("camera", [PAIR, THREE], ids=["pair", "three"])
def test_linear_program_100_pixels(benchmark, camera):
    run, frame = sra_lp(camera), phasors(camera, 1)
    some = Phasors(frame.values[:, :10, :10])
    benchmark.pedantic(run, (some,), rounds=3, iterations=1)
