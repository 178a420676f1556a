"""Slow, readable twins of the unwrapping kernels (float64, loops, every wrap vector tried), and
the planted frames they are compared on."""

import itertools

import numpy as np

from toftools.sensors import sensor as preset
from toftools.types import Phasors
from toftools.units import ambiguity_m, range_to_phase, wrap_phase

TURN = 2 * np.pi


def planted(text, range_m, *, snr=20.0, seed=0, known=True):
    """Lone returns with phasor noise of amplitude / snr; range_m (H, W)."""
    freqs = preset(text).modulation.freqs_hz
    rng = np.random.default_rng(seed)
    values = np.exp(1j * range_to_phase(range_m, freqs[:, None, None]))
    noise = rng.standard_normal((2, *values.shape)) / snr
    sigma = np.full(values.shape, 1 / snr, np.float32) if known else None
    return Phasors((values + noise[0] + 1j * noise[1]).astype(np.complex64), sigma)


def weights(values, sigma, freqs_hz):
    """Information of each frequency about the range, (F, ...), 1/m^2."""
    power = np.abs(values.astype(np.complex128)) ** 2
    noise = power.mean(axis=0, keepdims=True) if sigma is None else sigma.astype(np.float64) ** 2
    slope = np.reshape(range_to_phase(1.0, freqs_hz), (-1,) + (1,) * (values.ndim - 1))
    return slope**2 * power / noise


def ranges(values, freqs_hz):
    """Range of each frequency without wraps, (F, ...), m."""
    turns = wrap_phase(np.angle(values.astype(np.complex128))) / TURN
    return turns * np.reshape(ambiguity_m(freqs_hz), (-1,) + (1,) * (values.ndim - 1))


def constrained(d, w, longest_m):
    """Best common range in [0, longest] of unwrapped ranges d, (F,), and its chi-squared."""
    best = min(max(np.sum(w * d) / np.sum(w), 0.0), longest_m)
    return best, float(np.sum(w * (d - best) ** 2))


def exhaustive(values, sigma, freqs_hz, longest_m):
    """Most likely range and its cost of one pixel, values (F,), over all wrap vectors."""
    U = ambiguity_m(freqs_hz)
    d, w = ranges(values, freqs_hz), weights(values, sigma, freqs_hz)
    wraps = [range(-1, int(np.ceil(longest_m / u)) + 1) for u in U]
    tried = [constrained(d + n * U, w, longest_m) for n in itertools.product(*wraps)]
    return min(tried, key=lambda pair: pair[1])


def plain_crt(values, freqs_hz, n_wraps):
    """The search as others published it: closest pair of two ranges, average with weights f^2."""
    U, freqs = ambiguity_m(freqs_hz), np.asarray(freqs_hz)
    d = ranges(values, freqs_hz)
    best, answer = np.full(d.shape[1:], np.inf), np.zeros(d.shape[1:])
    for i, j in itertools.product(range(n_wraps[0]), range(n_wraps[1])):
        a, b = d[0] + i * U[0], d[1] + j * U[1]
        closer = np.abs(a - b) < best
        best = np.where(closer, np.abs(a - b), best)
        mean = (freqs[0] ** 2 * a + freqs[1] ** 2 * b) / np.sum(freqs**2)
        answer = np.where(closer, mean, answer)
    return answer


def numpy_crt(values, sigma, freqs_hz, longest_m):
    """Ranges (H, W): the walk along the wraps of the highest frequency, in plain numpy."""
    U = ambiguity_m(freqs_hz).reshape(-1, 1, 1)
    d, w = ranges(values, freqs_hz), weights(values, sigma, freqs_hz)
    top = int(np.argmax(freqs_hz))
    best, answer = np.full(d.shape[1:], np.inf), np.zeros(d.shape[1:])
    for n in range(-1, int(np.ceil(longest_m / U[top].item())) + 1):
        near = d + U * np.round((d[top] + n * U[top] - d) / U)
        mean = np.clip((w * near).sum(axis=0) / w.sum(axis=0), 0, longest_m)
        cost = (w * (near - mean) ** 2).sum(axis=0)
        answer = np.where(cost < best, mean, answer)
        best = np.minimum(cost, best)
    return answer


def driver_votes(phases):
    """Range in m and residual in rad of one pixel at 16, 80 and 120 MHz, the driver's own steps.

    Unit of length: 0.625 m, in which the wraps are 15, 3 and 2 and the joint ambiguity is 30.
    """
    low, mid, high = (p / TURN * wrap for p, wrap in zip(phases, (15, 3, 2), strict=True))
    mid += 3 * np.floor((low - mid) / 3 + 0.5)  # nearest to the lowest: 0..15
    odd = np.mod(mid - high, 2)  # 120 MHz repeats every 2, so a half turn means the far wrap
    if 0.5 < odd < 1.5:
        low, mid = low + 15, mid + 15
    high += 2 * np.floor((mid - high) / 2 + 0.5)
    turns = np.array([low / 15, mid / 3, high / 2])
    line = np.array([16.0, 80.0, 120.0]) / np.linalg.norm([16.0, 80.0, 120.0])
    residual = np.linalg.norm(np.cross(TURN * turns, line))
    joint_m = float(ambiguity_m(8e6))
    return turns.sum() / 27 * joint_m, residual  # 2 + 10 + 15 turns in the joint ambiguity


def kde(range_m, weight, window_px, bandwidth_m):
    """Density (T, H, W) at hypotheses range_m with weights (T, H, W): equation 13, by loops."""
    n_hyp, height, width = range_m.shape
    half = window_px // 2
    offsets = range(-half, half + 1)
    blur = {o: np.exp(-0.5 * (o / (window_px / 4)) ** 2) for o in offsets}
    norm = sum(blur.values())
    density = np.zeros(range_m.shape)
    for y, x in np.ndindex(height, width):
        around = [
            (blur[dy] * blur[dx] / norm**2, y + dy, x + dx)
            for dy, dx in itertools.product(offsets, offsets)
            if 0 <= y + dy < height and 0 <= x + dx < width
        ]
        inside = sum(g for g, _, _ in around)
        mass = sum(g * weight[h, v, u] for g, v, u in around for h in range(n_hyp))
        for k in range(n_hyp):
            gap = [((range_m[k, y, x] - range_m[h, v, u]) / bandwidth_m, g * weight[h, v, u])
                   for g, v, u in around for h in range(n_hyp)]  # fmt: skip
            total = sum(w * np.exp(-0.5 * e**2) for e, w in gap)
            density[k, y, x] = total / max(mass, 0.5 * inside)
    return density
