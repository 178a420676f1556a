"""Smoothing of phasors: against a slow twin, honest about its noise, kind to edges and slopes."""

import numpy as np
import pytest

from toftools.correct.crt import crt
from toftools.filter.smooth import _estimated, smooth
from toftools.sensors import sensor as preset
from toftools.types import Phasors
from toftools.units import range_to_phase

DEVICE = preset("opt8241:width=160,height=120")
FREQS = DEVICE.modulation.freqs_hz[:, None, None]
V, U = np.mgrid[0:120, 0:160]


def noisy(range_m, snr, *, amplitude=1000.0, seed=0, freqs=FREQS):
    clean = np.broadcast_to(amplitude * np.exp(1j * range_to_phase(range_m, freqs)),
                            (freqs.size, *range_m.shape))  # fmt: skip
    sigma = np.broadcast_to(1000.0 / snr, clean.shape)
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
    return clean, Phasors((clean + sigma * noise).astype(np.complex64), sigma.astype(np.float32))


def angle(phasors, clean):
    return np.angle(phasors.values * clean.conj())


def twin(frame, radius):
    """The header's formulas, pixel by pixel in double precision."""
    z, valid = frame.values.astype(complex), frame.valid
    n, height, width = z.shape
    length = np.sqrt((np.abs(z) ** 2).sum(axis=0))
    u, s2 = z / length, np.maximum((frame.sigma / length) ** 2, 1e-14)
    dof = 2 * n - 1
    spread = 2 / (9 * dof)
    full = dof * (1 - spread + 2.326 * np.sqrt(spread)) ** 3

    def agrees(p, q):
        chi2 = (np.abs(u[:, *q] - u[:, *p]) ** 2 / (s2[:, *q] + s2[:, *p])).sum()
        return np.clip(2 - chi2 / full, 0, 1) * valid[q] * valid[p]

    value, noise = z.copy(), frame.sigma.astype(float)
    for p in np.ndindex(height, width):
        weights, means, variances = [1 / s2[:, *p].mean()], [u[:, *p]], [s2[:, *p]]
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                if (dy, dx) <= (0, 0):
                    continue
                a, b = (p[0] + dy, p[1] + dx), (p[0] - dy, p[1] - dx)
                inside = all(0 <= y < height and 0 <= x < width for y, x in (a, b))
                k = min(agrees(p, a), agrees(p, b)) if inside else 0.0
                if k > 0:
                    weights.append(k * 4 / (s2[:, *a].mean() + s2[:, *b].mean()))
                    means.append((u[:, *a] + u[:, *b]) / 2)
                    variances.append((s2[:, *a] + s2[:, *b]) / 4)
        w = np.array(weights)[:, None]
        if len(weights) > 1:
            value[:, *p] = length[p] * (w * means).sum(axis=0) / w.sum()
            noise[:, *p] = length[p] * np.sqrt((w**2 * variances).sum(axis=0)) / w.sum()
    return value, noise


@pytest.mark.parametrize("text", ["opt8241", "kinect2_nominal", "deeptof"])
def test_the_kernel_is_the_slow_twin(text):
    device = preset(f"{text}:width=14,height=11")
    v, u = np.mgrid[0:11, 0:14]
    albedo = np.where(u % 5 < 2, 300.0, 1000.0)
    freqs = device.modulation.freqs_hz[:, None, None]
    _, frame = noisy(np.where(u < 8, 1.5 + 0.01 * v, 2.0), 30.0, amplitude=albedo, freqs=freqs)
    frame = Phasors(frame.values, frame.sigma, (u != 3) | (v != 4))
    have, (value, sigma) = smooth(device)(frame), twin(frame, 2)
    assert np.allclose(have.values, value, atol=0.02)  # float32: 1e-5 of the amplitude
    assert np.allclose(have.sigma, sigma, rtol=2e-3)


@pytest.mark.parametrize("snr", [5, 20, 100, 1000])
@pytest.mark.parametrize("slope_m", [0.0, 0.003])
def test_sigma_is_honest_and_falls(snr, slope_m):
    clean, frame = noisy(2.0 + slope_m * U + 0.5 * slope_m * V, snr)
    out = smooth(DEVICE)(frame)
    score = angle(out, clean) / (out.sigma / 1000.0)
    inner = (slice(None), slice(3, -3), slice(3, -3))
    for part in (score[inner], score[:, 0], score[..., 0]):
        assert 0.9 < part.std() < 1.1
    # Neighbours' errors are alike: about 760 independent ones in the image.
    assert abs(score[inner].mean()) < 5 / np.sqrt(760)
    gain = 1000.0 / snr / np.median(out.sigma[inner])
    assert gain > (4.8 if slope_m == 0 or snr < 100 else 1.5)
    assert gain <= 5 + 1e-3


def test_range_and_its_sigma_follow():
    truth = 2.0 + 0.003 * U
    _, frame = noisy(truth, 20)
    plain, better = crt(DEVICE)(frame), crt(DEVICE)(smooth(DEVICE)(frame))
    for depth in (plain, better):
        assert 0.9 < ((depth.range_m - truth) / depth.sigma_m).std() < 1.1
    assert np.abs(better.range_m - truth).mean() < 0.3 * np.abs(plain.range_m - truth).mean()


def test_albedo_neither_hinders_nor_moves():
    albedo = np.where((U // 4 + V // 4) % 2, 300.0, 1000.0)
    clean, frame = noisy(np.full(U.shape, 3.0), 50, amplitude=albedo)
    out = smooth(DEVICE)(frame)
    amplitude = np.linalg.norm(np.abs(out.values), axis=0) / np.linalg.norm(np.abs(frame.values),
                                                                            axis=0)  # fmt: skip
    assert np.abs(amplitude - 1).max() < 0.02  # the pattern's length shrinks by its noise squared
    before, after = (angle(f, clean)[:, albedo == 300] for f in (frame, out))
    assert after.std() < 0.25 * before.std()


@pytest.mark.parametrize("snr", [20, 100])
@pytest.mark.parametrize(("step", "limit"), [(4, 1.0), (10, 0.3), (30, 0.2), (300, 0.2)])
def test_depth_edges_are_not_smeared(snr, step, limit):
    edge_m = step / snr / range_to_phase(1.0, FREQS[-1, 0, 0])  # in sigmas of the high frequency
    clean, frame = noisy(np.where(U < 80, 2.0, 2.0 + edge_m), snr)
    error = angle(smooth(DEVICE)(frame), clean)[-1] * snr
    for columns, sign in ((slice(78, 80), 1), (slice(80, 82), -1)):
        assert abs(sign * error[3:-3, columns].mean()) < limit
    if step >= 30:
        assert error[3:-3, 78:82].std() < 0.5


def test_a_noise_free_tilted_wall_stays_up_to_the_border():
    clean, frame = noisy(2.0 + 0.005 * U + 0.002 * V, 100)
    out = smooth(DEVICE)(Phasors(clean.astype(np.complex64), frame.sigma))
    moved_m = angle(out, clean) / range_to_phase(1.0, FREQS)
    assert np.abs(moved_m).max() < 5e-5


def test_two_returns_keep_their_pattern():
    """What separates returns is the ratio of the phasors, which averaging must not touch."""
    first, second = (np.exp(1j * range_to_phase(r, FREQS)) for r in (2.0, 2.7))
    clean = np.broadcast_to(1000.0 * (first + 0.4 * second), (2, *U.shape))
    rng = np.random.default_rng(3)
    noise = 20 * (rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape))
    frame = Phasors((clean + noise).astype(np.complex64), np.full(clean.shape, 20, np.float32))
    ratio = clean[1] / clean[0]
    before, after = (f.values[1] / f.values[0] / ratio - 1 for f in (frame, smooth(DEVICE)(frame)))
    assert abs(after.mean()) < 2e-3
    assert np.abs(after).mean() < 0.25 * np.abs(before).mean()


@pytest.mark.parametrize("snr", [20, 100])
def test_unknown_noise_is_found_on_the_image(snr):
    clean, frame = noisy(2.0 + 0.003 * U + 0.001 * V, snr)
    found = _estimated(Phasors(frame.values))
    assert np.allclose(found, frame.sigma, rtol=0.05)
    out = smooth(DEVICE)(Phasors(frame.values))
    assert out.sigma is None
    assert angle(out, clean)[:, 3:-3, 3:-3].std() * snr < 0.3


def test_a_radius_out_of_range_is_refused():
    for radius in (0, 17):
        with pytest.raises(ValueError, match=rf"radius_px must be 1\.\.16 pixels, got {radius}"):
            smooth(DEVICE, radius_px=radius)
