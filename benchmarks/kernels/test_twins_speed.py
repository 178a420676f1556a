"""Kernels of unwrapping, sparse reflections and light transport beside their readable twins."""

import numpy as np
import reference_sra
import reference_unwrapping as slow
from reference_fuchs import transfer
from test_semi_global import twin as summed

from toftools._transfer import Patches, gather
from toftools.correct._paths import aggregate
from toftools.correct._sra_lookup import look_up
from toftools.correct._sra_table import make_table
from toftools.correct.crt import crt
from toftools.correct.kde import _density, _spatial_weights
from toftools.correct.residual_voting import residual_voting
from toftools.sensors import sensor
from toftools.units import joint_ambiguity_m, wrap_phase

KINECT = "kinect2_nominal:width=320,height=240"
PIXELS = 320 * 240
SLANT_M = np.linspace(0.5, 15.0, PIXELS).reshape(240, 320)


def test_crt(beside):
    run, frame = crt(sensor(KINECT)), slow.planted(KINECT, SLANT_M)
    freqs = sensor(KINECT).modulation.freqs_hz
    some = frame.values[:, 0, :20], frame.sigma[:, 0, :20]

    def twin():
        for p in range(20):
            slow.exhaustive(some[0][:, p], some[1][:, p], freqs, joint_ambiguity_m(freqs))

    beside("crt, 3 frequencies", lambda: run(frame), many=PIXELS,
           twin=("every wrap vector", twin), few=20)  # fmt: skip


def test_residual_voting(beside):
    device, frame = sensor(KINECT), slow.planted(KINECT, SLANT_M)
    run, order = residual_voting(device), np.argsort(device.modulation.freqs_hz)
    phases = wrap_phase(np.angle(frame.values[order, 0]))

    def twin():
        for p in range(320):
            slow.driver_votes(phases[:, p])

    beside("residual_voting", lambda: run(frame), many=PIXELS,
           twin=("the driver's steps", twin), few=320)  # fmt: skip


def test_density(beside):
    rng = np.random.default_rng(9)
    range_m, weight = rng.uniform(1, 3, (2, 3, 240, 320)).astype(np.float32)
    blur, narrow = _spatial_weights(5), np.float32(1 / (2 * 0.4**2))
    part = (slice(None), slice(0, 6), slice(0, 8))
    beside("kde, density in 5 x 5", lambda: _density(range_m, weight, blur, narrow), many=PIXELS,
           twin=("equation 13 by loops", lambda: slow.kde(range_m[part], weight[part], 5, 0.4)),
           few=48)  # fmt: skip


def test_paths(beside):
    rng = np.random.default_rng(1)
    range_m = rng.uniform(0, 3, (5, 240, 320)).astype(np.float32)
    cost, valid = 2 * range_m[:, ::-1].copy(), np.ones((240, 320), bool)
    part = (slice(None), slice(0, 24), slice(0, 32))
    beside("semi_global, sums along 8 paths", lambda: aggregate(range_m, cost, valid, 3.0),
           many=PIXELS, few=24 * 32,
           twin=("the recursion by loops",
                 lambda: summed(range_m[part], cost[part], valid[:24, :32], 3.0)))  # fmt: skip


def test_sra_table(beside):
    freqs = sensor("opt8241").modulation.freqs_hz
    table = make_table(freqs, grid_m=0.02, epsilon=0.05, max_range_m=0.0)
    frame = slow.planted("opt8241", SLANT_M)
    z, usable = frame.values.reshape(2, -1), np.ones(PIXELS, bool)

    def twin():
        for p in range(100):
            reference_sra.look_up(complex(z[0, p]), complex(z[1, p]), table, 0.05)

    beside("sra, look-up of two frequencies", lambda: look_up(z, usable, table, 0.05),
           many=PIXELS, twin=("the same by loops", twin), few=100)  # fmt: skip


def test_gather(beside):
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((3, 4800))
    normal /= np.linalg.norm(normal, axis=0)
    at = rng.uniform(0, 2, (3, 4800))
    area = np.full(4800, 1e-3)
    all_of = Patches(*(a.astype(np.float32) for a in (at, normal, area)))
    light, freqs = np.ones((1, 4800), np.complex64), np.array([70e6])
    few = (slice(None), slice(0, 1200))
    part = at[few], normal[few], at[few], normal[few], area[:1200]
    beside("light between patches", lambda: gather(all_of, all_of, light, freqs), many=4800**2,
           twin=("plain numpy", lambda: transfer(*part, 70e6)), few=1200**2,
           unit="pairs")  # fmt: skip
