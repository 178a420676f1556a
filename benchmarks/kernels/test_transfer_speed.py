"""Light transport: thousand million pairs per second, and milliseconds per 320 x 240 frame.

python -m pytest benchmarks/kernels/test_transfer_speed.py \\
    -p no:dash -o addopts="" --benchmark-only
"""

import numpy as np
import pytest

from toftools._transfer import Patches, gather
from toftools.registry import CORRECTIONS, SIMULATORS, find
from toftools.sensors import sensor as preset
from toftools.types import Scene, Shot

SIDE = 9600


@pytest.mark.parametrize("n_freqs", [1, 2])
def test_pairs(benchmark, n_freqs):
    rng = np.random.default_rng(0)
    some = Patches(
        rng.uniform(0, 2, (3, SIDE)).astype(np.float32),
        rng.standard_normal((3, SIDE)).astype(np.float32),
        np.full(SIDE, 1e-3, np.float32),
    )
    light = np.ones((n_freqs, SIDE), np.complex64)
    freqs = np.linspace(40e6, 70e6, n_freqs)
    gather(some, some, light, freqs)
    benchmark(gather, some, some, light, freqs)
    benchmark.extra_info["gpairs_per_s"] = n_freqs * SIDE**2 / benchmark.stats["min"] / 1e9


@pytest.mark.parametrize("tol_mm", [0.3, 1, 3, 10])
def test_corner(benchmark, tol_mm):
    camera = preset("opt8241")
    scene = Scene("corner", {"angle": 90.0, "range": 2.0, "albedo": 0.8})
    phasors = SIMULATORS["analytic"].build(scene)(Shot(camera)).phasors
    run = find(CORRECTIONS, f"fuchs2010:tol_mm={tol_mm}").build(camera)
    benchmark(run, phasors)
