"""What every frame passes beside its correction: taps, calibration, filters, network, scores."""

import calibration_speed
import numpy as np
import reference_metrics
import test_filter_flying_pixels as flying
import test_filter_smooth
import test_register
from network_twin import described
from test_response import twin as slow_response
from test_transients import slow_scatter

from toftools.calib._register_kernel import cover, pick
from toftools.calib._response_kernel import linearise
from toftools.calib.chain import applied, chain_for, extended
from toftools.calib.fused import fused
from toftools.correct._net_inputs import seen, view_of
from toftools.metrics.statistics import histogram
from toftools.phasor import demodulate
from toftools.registry import CORRECTIONS, FILTERS, METRICS
from toftools.sensors import sensor
from toftools.sim._density import scatter
from toftools.sim.noise import capture_taps, clean_taps
from toftools.sim.readout import expose
from toftools.types import Capture, DepthMap, Phasors
from toftools.units import range_to_phase

OPT = "opt8241:width=320,height=240"
N = 320 * 240
SLANT_M = np.linspace(0.5, 6.0, N).reshape(240, 320)


def light(freq_hz):
    """Charge of a lone return, 2000 electrons at 1 m."""
    return 2000 / SLANT_M**2 * np.exp(1j * range_to_phase(SLANT_M, freq_hz))


def phasors(device=OPT):
    taps = capture_taps(light, 0.0, sensor(device), seed=1)
    return taps, demodulate(taps, sensor(device))


def slow_phasors(values, steps_rad):
    """The sum over taps, pixel by pixel."""
    share = 2 / len(steps_rad)
    pairs = (zip(taps, steps_rad, strict=True) for taps in values)
    return [sum(share * v * np.exp(1j * step) for v, step in pair) for pair in pairs]


def test_clean_taps(beside):
    device = sensor(OPT)
    beside("simulated taps without noise", lambda: clean_taps(light, 0.0, device), many=N)


def test_noise(beside):
    device = sensor(OPT)
    charge, rng = clean_taps(light, 0.0, device), np.random.default_rng(0)
    beside("shot and read noise, full well", lambda: expose(charge, device, rng), many=N)


def test_demodulation(beside):
    taps, _ = phasors()
    device = sensor(OPT)
    steps = np.broadcast_to(device.modulation.steps_rad, taps.values.shape[:2])
    some = taps.values[:, :, 0, :100].transpose(0, 2, 1)  # (F, 100, K)

    def twin():
        return [slow_phasors(part, own) for part, own in zip(some, steps, strict=True)]

    beside("taps to phasors with sigma", lambda: demodulate(taps, device), many=N,
           twin=("sums by loops, no sigma", twin), few=100)  # fmt: skip


def test_calibration(beside):
    device, frame, chain = (
        sensor("kinect2"),
        calibration_speed.frame(),
        chain_for(sensor("kinect2")),
    )
    for stage in calibration_speed.stages():
        chain = extended(chain, stage)
    told = {"kind": "wall", "sensor_c": 30.0, "light_c": 35.0}
    capture, run = Capture(device, phasors=frame, provenance={"conditions": told}), fused(chain)
    beside("calibration, five stages in one pass", lambda: run(frame), many=512 * 424,
           twin=("stage by stage", lambda: applied(chain, capture)),
           few=512 * 424)  # fmt: skip


def test_wiggling(beside):
    device, frame = sensor("kinect2"), calibration_speed.frame()
    wiggling = calibration_speed.stages()[0]
    chain = extended(chain_for(device), wiggling)
    run = fused(chain)
    beside("wiggling in one pass", lambda: run(frame), many=512 * 424,
           twin=("the stage itself", lambda: wiggling(frame)), few=512 * 424)  # fmt: skip


def test_smoothing(beside):
    _, frame = phasors()
    run = FILTERS["smooth"].build(sensor(OPT))
    part = Phasors(frame.values[:, :12, :16], frame.sigma[:, :12, :16])
    beside("smooth, radius 2", lambda: run(frame), many=N,
           twin=("formulas by loops", lambda: test_filter_smooth.twin(part, 2)),
           few=192)  # fmt: skip


def test_flying_pixels(beside):
    frame, depth, *_ = flying.mixed_edge()
    run = FILTERS["flying_pixels"].build(flying.DEVICE)
    forward = flying.rays(flying.CAMERA)[..., 2].astype(np.float32)
    small = DepthMap(depth.range_m[:20, 30:50], depth.sigma_m[:20, 30:50])
    beside("flying_pixels", lambda: run(depth, frame), many=4800, few=400,
           twin=("two rules by loops",
                 lambda: flying.twin(small, forward[:20, 30:50], 3, 0.01, 2.0)))  # fmt: skip


def test_covering(beside):
    rng = np.random.default_rng(2)
    at = rng.uniform(0, 300, (2, 20_000, 1))
    u, v = at + np.array([0.0, 3.0, 3.0, 0.0]), at[::-1] + np.array([0.0, 0.0, 3.0, 3.0])
    u, v, w = u[0], v[1], rng.uniform(0.2, 2, (20_000, 4))
    fast, slow = np.zeros((300, 300)), np.zeros((30, 30))
    part = u[:5], v[:5], w[:5]
    beside("register, covering", lambda: cover(u, v, w, fast), many=20_000, unit="quads",
           twin=("every pixel of 30 x 30 asked", lambda: test_register.slow_cover(*part, slow)),
           few=5)  # fmt: skip


def test_picking(beside):
    rng = np.random.default_rng(3)
    image, nearest = (
        rng.random((480, 640, 3)).astype(np.float32),
        rng.choice([0.5, 1.0], (480, 640)),
    )
    place = rng.uniform(0, 639, N), rng.uniform(0, 479, N), rng.choice([0.5, 1], N)
    lax, colours, status = np.full(N, 0.3), np.zeros((N, 3), np.float32), np.zeros(N, np.uint8)
    few = tuple(part[:200] for part in place)
    beside("register, picking", lambda: pick(place, lax, nearest, image, colours, status), many=N,
           twin=("the same by loops",
                 lambda: test_register.slow_pick(few, lax[:200], nearest, image)),
           few=200)  # fmt: skip


def test_response(beside):
    rng = np.random.default_rng(3)
    taps = rng.uniform(0, 1000, (8, 240, 320)).astype(np.float32)
    offset = rng.normal(20, 5, (2, 240, 320)).astype(np.float32)
    inverse = rng.uniform(0.9, 1.1, (2, 240, 320)).astype(np.float32)
    curve = np.cumsum(rng.uniform(5, 15, 65)).astype(np.float32)
    slope = (np.diff(curve) / 16).astype(np.float32)
    intercept = (curve[:-1] - slope * 16 * np.arange(64)).astype(np.float32)
    rest, valid = (16.0, (-40.0, 1080.0, 500.0)), np.ones((240, 320), bool)
    some = (slice(None), slice(0, 12), slice(0, 16))
    beside("response of raw taps", many=N, few=192,
           kernel=lambda: linearise(taps, offset, inverse, intercept, slope, *rest, valid),
           twin=("taps by loops",
                 lambda: slow_response(taps[some], offset[some], inverse[some], curve, *rest,
                                            valid[some[1:]])))  # fmt: skip


def test_density_of_paths(beside):
    rng = np.random.default_rng(4)
    pixel, position = rng.integers(0, 64, 20_000), rng.uniform(0, 256, 20_000)
    weight, values, missed = rng.random(20_000), np.zeros((64, 256)), np.zeros((64, 2))
    some = list(zip(position[:100], weight[:100], strict=True))
    beside("transient, density of path lengths", many=20_000, few=100, unit="samples",
           kernel=lambda: scatter(values, missed, pixel, position, weight, 2.5, 2),
           twin=("its integrals by loops",
                 lambda: [slow_scatter(256, at, 2.5, w) for at, w in some]))  # fmt: skip


def test_network_input(beside):
    _, frame = phasors()
    device, small = sensor(OPT), sensor("opt8241:width=32,height=24")
    view, part = view_of(device, 1.0, 0.0), frame.values[:, :24, :32]
    found = seen(Phasors(part), view_of(small, 1.0, 0.0)).candidates_m
    valid = np.ones((24, 32), bool)
    beside("input of a network", lambda: seen(frame, view), many=N, few=768,
           twin=("channels by loops",
                 lambda: described(part, found, valid, small, 1.0)))  # fmt: skip


def test_network(beside):
    _, frame = phasors()
    run = CORRECTIONS["network"].build(sensor(OPT))
    beside("network, whole", lambda: run(frame), many=N)


def scene():
    rng = np.random.default_rng(0)
    truth = DepthMap(SLANT_M.astype(np.float32))
    return truth, DepthMap((SLANT_M + 0.02 * rng.standard_normal(SLANT_M.shape)).astype(np.float32))


def test_errors(beside):
    truth, answer = scene()
    few = (slice(0, 24), slice(0, 32))
    named = reference_metrics.scores(
        truth.range_m[few], answer.range_m[few], np.ones((24, 32), bool)
    )
    runs = [METRICS[name].build(truth) for name in named]
    beside(f"{len(runs)} error metrics", lambda: [run(answer) for run in runs], many=N, few=768,
           twin=("sums and order by loops",
                 lambda: reference_metrics.scores(truth.range_m[few], answer.range_m[few],
                                                  np.ones((24, 32), bool))))  # fmt: skip


def test_histograms(beside):
    _, answer = scene()
    few = answer.range_m[:24, :32]
    beside("histogram of co-occurring ranges", lambda: histogram(answer.range_m, "cooccurrence"),
           many=N, few=768,
           twin=("bins by loops",
                 lambda: reference_metrics.histogram(few, "cooccurrence",
                                                     np.ones((24, 32), bool))))  # fmt: skip
