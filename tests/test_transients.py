"""Transients: histograms and kernel densities against closed forms, slow twins and phasors.

The source of samples is a walk in a Lambertian sphere, light and camera at its centre, in plain
numpy; n legs of it have the n-fold convolution of l / (2 R^2) as their density.
"""

import math
from dataclasses import replace
from functools import partial
from itertools import islice, pairwise

import numpy as np
import pytest

from toftools.camera import pinhole, rays
from toftools.sensors import sensor
from toftools.sim import _density
from toftools.sim.bandwidth import bandwidths_m, kernel_gain, rule_of_thumb_m
from toftools.sim.shapes import cavity
from toftools.sim.transients import histogram, progressive, transient
from toftools.transient import (
    Samples,
    Transient,
    cut_share,
    first_return_m,
    phasors,
    samples_phasor,
)
from toftools.types import Scene, Shot
from toftools.units import path_to_phase, phase_to_range

RADIUS = 2.0


# closed forms


def density(length_m, legs):
    """n-fold convolution of l / (2 R^2) on [0, 2 R], term by term from its Laplace transform."""
    wide, total = 2 * RADIUS, np.zeros_like(length_m)
    for m in range(legs + 1):
        past = np.clip(length_m - wide * m, 0, None)
        for q in range(m + 1):
            power = 2 * legs - q - 1
            factor = math.comb(legs, m) * (-1) ** m * math.comb(m, q) * wide**q
            total += factor * np.where(length_m > wide * m, past**power, 0) / math.factorial(power)
    return total / (2 * RADIUS**2) ** legs


def roughness(values, step):
    return float((values**2).sum() * step)


def walk(count, legs, rng):
    """Lengths (legs, N) of the legs of a walk over the wall, cosine-distributed directions."""
    at = rng.normal(size=(count, 3))
    at *= RADIUS / np.linalg.norm(at, axis=1, keepdims=True)
    lengths = []
    for _ in range(legs):
        # A point of the unit sphere plus the inward normal points in a cosine-distributed way.
        turn = rng.normal(size=at.shape)
        turn = turn / np.linalg.norm(turn, axis=1, keepdims=True) - at / RADIUS
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        length = -2 * (at * turn).sum(axis=1)
        at = at + length[:, None] * turn
        lengths.append(length)
    return np.array(lengths)


def cavity_pass(count, pixels, albedo, bounces, rng):
    """One pass over `pixels` pixels, `count` walks each, as the tracer would give it."""
    legs = walk(count * pixels, bounces, rng)
    path_m = 2 * RADIUS + np.concatenate([np.zeros((1, legs.shape[1])), np.cumsum(legs, axis=0)])
    weight = albedo ** np.arange(1, bounces + 2)[:, None] / RADIUS**2 / count
    pixel = np.broadcast_to(np.repeat(np.arange(pixels), count), path_m.shape)
    weight = np.broadcast_to(weight, path_m.shape)
    return Samples(pixel.ravel(), path_m.ravel(), weight.ravel())


def chord_passes(passes, pixels, count, legs, rng):
    """Passes of `count` samples in each of `pixels` independent pixels, total weight 1 each."""
    pixel = np.repeat(np.arange(pixels), count)
    for _ in range(passes):
        path_m = 2 * RADIUS * np.sqrt(rng.random((legs, pixel.size))).sum(axis=0)
        yield Samples(pixel, path_m, np.full(pixel.size, 1 / count))


# slow twins


def slow_scatter(n_bins, at, half, weight):
    """One sample in readable Python: integral of the mirrored kernel over each bin."""

    def below(x):
        x = min(1.0, max(-1.0, x))
        return (2 + 3 * x - x**3) / 4

    bins = np.zeros(n_bins)
    if half == 0:
        bins[int(at)] += weight
        return bins
    for t in range(n_bins):
        for image in (at, -at, 2 * n_bins - at):
            bins[t] += weight * (below((t + 1 - image) / half) - below((t - image) / half))
    return bins


@pytest.mark.parametrize("width_m", [0.0, 0.003, 0.07, 0.35, 1.0])
def test_the_compiled_scatter_is_its_slow_twin(width_m):
    rng = np.random.default_rng(3)
    n_bins, bin_m, start_m = 20, 0.05, 0.5
    path_m = np.r_[rng.uniform(0.3, 1.7, 200), 0.5, 1.5, 0.5 + 1e-12, 1.5 - 1e-12, 0.55]
    weight, pixel = rng.uniform(0, 2, path_m.size), rng.integers(0, 6, path_m.size)
    slow = np.zeros((6, n_bins))
    outside = np.zeros(6)
    for p, l, w in zip(pixel, path_m, weight, strict=True):  # noqa: E741
        at = (l - start_m) / bin_m
        if 0 <= at < n_bins:
            slow[p] += slow_scatter(n_bins, at, width_m / bin_m, w)
        else:
            outside[p] += w
    one = Samples(pixel, path_m, weight)
    axis = {"shape": (2, 3), "bin_m": bin_m, "n_bins": n_bins, "start_m": start_m}
    made = progressive([one], bandwidth_m=width_m, **axis) if width_m else histogram([one], **axis)
    # float32 of the result; sums are kept in float64 on both sides.
    np.testing.assert_allclose(made.values.reshape(n_bins, 6).T, slow, rtol=2e-7, atol=1e-7)
    np.testing.assert_allclose(made.missed.ravel(), outside, rtol=2e-7)
    # No light is lost, however wide the kernel and however near the end: float32 sums of 20 bins.
    total = made.values.sum(axis=0, dtype=np.float64).ravel() + made.missed.ravel()
    np.testing.assert_allclose(total, np.bincount(pixel, weight, 6), rtol=1e-6)


def test_sums_do_not_depend_on_the_number_of_workers():
    rng = np.random.default_rng(4)
    pixel = rng.integers(0, 7, 1000)
    results = []
    for workers in (1, 2, 5):
        values, missed = np.zeros((7, 30)), np.zeros((7, 2))
        position, weight = rng.uniform(-5, 35, 1000), np.ones(1000)
        rng = np.random.default_rng(5)  # the same positions from the second time on
        position = rng.uniform(-5, 35, 1000)
        _density.scatter(values, missed, pixel, position, weight, 2.5, workers)
        results.append(values.tobytes() + missed.tobytes())
    assert len(set(results)) == 1


def test_samples_outside_are_counted_and_their_light_kept_apart():
    one = Samples(np.array([0, 0, 1, 1]), np.array([0.5, 1.5, 2.0, 7.0]), np.array([1.0, 2, 4, 8]))
    made = histogram([one, one], shape=(1, 2), bin_m=0.5, n_bins=2, start_m=1.0)
    assert made.values[:, 0].tolist() == [[0, 0], [2, 0]]
    assert made.missed.tolist() == [[1, 12]]
    assert (made.info["samples"], made.info["before"], made.info["beyond"]) == (8, 2, 4)
    assert cut_share(made) == pytest.approx(13 / 15)


# the source itself


def test_the_walk_has_the_chord_law_of_the_sphere():
    rng = np.random.default_rng(6)
    legs = walk(40_000, 3, rng)
    for count in (1, 2, 3):
        path = legs[:count].sum(axis=0)
        made = histogram([Samples(np.zeros(path.size, int), path, np.full(path.size, 1.0))],
                         shape=(1, 1), bin_m=0.25, n_bins=16 * count)  # fmt: skip
        edges = np.linspace(0, 4 * count, 64 * 16 * count + 1)
        middle = (edges[1:] + edges[:-1]) / 2
        share = density(middle, count).reshape(-1, 64).mean(axis=1) * 0.25
        expected = path.size * share
        z = (made.values.ravel() - expected) / np.sqrt(expected * (1 - share))
        # Up to 48 bins: 4 standard errors are passed by chance once in 300 runs, and seeds stand.
        assert np.abs(z[expected > 20]).max() < 4
        assert made.values.sum() == path.size


@pytest.mark.parametrize("freq_hz", [0.0, 20e6, 100e6])
def test_phasors_of_samples_are_those_of_the_closed_form(freq_hz):
    rng = np.random.default_rng(7)
    passes = [cavity_pass(500, 4, 0.8, 12, rng) for _ in range(40)]
    z = np.array([samples_phasor(one, (2, 2), freq_hz) for one in passes]).reshape(40, -1)
    exact = cavity(pinhole(2, 2, hfov_deg=40), radius=RADIUS, albedo=0.8).phasor(freq_hz, 12)[0, 0]
    for part in (np.real, np.imag):
        spread = part(z).std(ddof=1) / np.sqrt(z.size)
        # At zero frequency nothing is left to chance.
        assert abs(part(z).mean() - part(exact)) < 3.5 * spread + 1e-12


# phasors of transients


def test_the_phasor_of_a_histogram_converges_to_that_of_its_samples():
    one = cavity_pass(2000, 1, 0.8, 8, np.random.default_rng(8))
    keep = one.path_m > 2 * RADIUS + 1e-9  # the lone direct return is the next test
    one = Samples(*(array[keep] for array in one))
    exact = samples_phasor(one, (1, 1), 50e6)[0, 0]
    k = float(path_to_phase(1.0, 50e6))
    for bin_m in (0.4, 0.1, 0.025, 0.00625, 0.0015625):
        made = histogram([one], shape=(1, 1), bin_m=bin_m, n_bins=round(40 / bin_m))
        error = abs(phasors(made, 50e6)[0, 0, 0] - exact)
        # Samples stand anywhere in their bins: k bin / sqrt(12) of phase each, at random.
        spread = k * bin_m / np.sqrt(12) * np.sqrt((one.weight**2).sum())
        assert error < 3 * spread
    assert error < 1e-4 * abs(exact)


def test_the_box_of_the_bins_is_divided_out_where_light_is_smooth():
    """Bins filled from the closed form itself; the axis holds all legs but the kinks."""
    bin_m, freq_hz = 0.25, 100e6
    fine = (np.arange(64 * 64) + 0.5) * bin_m / 64
    light = density(fine, 4).reshape(64, 64).mean(axis=1) * bin_m
    k = float(path_to_phase(1.0, freq_hz))
    turn = np.exp(2j * k * RADIUS)
    exact = ((turn * (1 - 2j * k * RADIUS) - 1) / (2 * RADIUS**2 * k**2)) ** 4
    made = Transient(light.astype(np.float32)[:, None, None], bin_m)
    point = Transient(made.values, bin_m, box_m=0.0)
    with_box, without = (phasors(one, freq_hz)[0, 0, 0] / exact for one in (made, point))
    # What is left is aliasing of the sampled density, far below the 1.1 % of the box.
    assert abs(with_box - 1) < 1e-3
    assert abs(without) == pytest.approx(np.sinc(k * bin_m / (2 * np.pi)), abs=1e-3)


def test_a_lone_return_is_off_by_up_to_a_quarter_of_a_bin_in_range():
    """The figures that mitransient's bins gave: 7.50, 2.25 and 0.50 mm on 9 m of path."""
    path_m = 2 * np.linspace(1.9, 2.1, 2001)
    one = Samples(np.arange(path_m.size), path_m, np.ones(path_m.size))
    worst = []
    for n_bins in (300, 1000, 4096):
        made = histogram([one], shape=(1, path_m.size), bin_m=9 / n_bins, n_bins=n_bins)
        z = phasors(made, 20e6)[0, 0]
        worst.append(np.abs(phase_to_range(np.angle(z), 20e6) - path_m / 2).max())
    np.testing.assert_allclose(worst, 9 / np.array([300, 1000, 4096]) / 4, rtol=0.05)
    np.testing.assert_allclose(1e3 * np.array(worst[:2]), [7.5, 2.25], rtol=0.01)


def test_kernels_shrink_phasors_by_a_real_number_and_move_no_phase():
    rng = np.random.default_rng(9)
    path_m = rng.uniform(3, 17, (5, 400))  # far from the ends of the axis
    passes = [Samples(np.zeros(400, int), row, rng.uniform(0, 1, 400)) for row in path_m]
    made = progressive(passes, shape=(1, 1), bin_m=0.005, n_bins=4000, bandwidth_m=1.5)
    freqs = np.array([10e6, 50e6, 100e6])
    direct = np.array([[samples_phasor(one, (1, 1), f)[0, 0] for f in freqs] for one in passes])
    gains = np.array([kernel_gain([width], freqs) for width in made.info["bandwidths_m"]])
    # Bins are float32, 1e-7 of each; kernels are smooth over a bin.
    np.testing.assert_allclose(phasors(made, freqs)[:, 0, 0], (gains * direct).mean(axis=0),
                               atol=1e-5 * abs(direct).max())  # fmt: skip
    np.testing.assert_allclose(kernel_gain(made.info["bandwidths_m"], freqs), gains.mean(axis=0))
    one = progressive(passes[:1], shape=(1, 1), bin_m=0.005, n_bins=4000, bandwidth_m=1.5)
    turned = np.angle(phasors(one, freqs)[:, 0, 0] / direct[0] / gains[0])
    assert np.abs(turned).max() < 1e-5


def test_kernel_gain_is_the_integral_of_the_kernel_against_the_wave():
    u = (np.arange(20_000) + 0.5) / 10_000 - 1
    kernel = 0.75 * (1 - u**2)
    # On both sides of where the closed form gives way to its series, x = 0.01, and far away.
    for x in (0.0, 1e-4, 0.0099, 0.0101, 1.0, 5.0, 20.0):
        width_m = x / float(path_to_phase(1.0, 50e6))
        exact = (kernel * np.cos(x * u)).mean() * 2
        # The midpoint sum is good to 1e-8, the series to x^4 / 280 = 4e-11.
        np.testing.assert_allclose(kernel_gain([width_m], 50e6), exact, rtol=0, atol=2e-8)


def test_frequencies_that_bins_cannot_hold_are_refused():
    made = Transient(np.ones((4, 1, 1), np.float32), 1.0)
    assert np.isfinite(phasors(made, 140e6)).all()
    for freq_hz in (160e6, -1.0, np.nan):
        with pytest.raises(ValueError, match="bins under half a wavelength"):
            phasors(made, freq_hz)


# convergence


def squared_error(made, legs):
    """Integrated squared error per pixel against the density, on a grid finer than the bins."""
    fine = max(1, math.ceil(made.bin_m / 0.05))
    values = np.repeat(made.values[:, 0] / made.bin_m, fine, axis=0).astype(np.float64)
    step = made.bin_m / fine
    middle = (np.arange(len(values)) + 0.5) * step
    return ((values - density(middle, legs)[:, None]) ** 2).sum(axis=0) * step


LEGS, PIXELS, COUNT = 4, 256, 10
AXIS_M = 2 * RADIUS * LEGS
GRID = np.linspace(0, AXIS_M, 100_001)
SHAPE_OF = density(GRID, LEGS)
STEP = GRID[1]


def kernel_error(passes, first_m):
    """Expected variance and squared bias to leading order, for ``COUNT`` samples a pass.

    Epanechnikov: roughness 3/5, second moment 1/5 (Silverman 1986, section 3.3, recalled).
    """
    widths = np.array(list(islice(bandwidths_m(first_m), passes)))
    curvature = roughness(np.gradient(np.gradient(SHAPE_OF, STEP), STEP), STEP)
    variance = (0.6 * np.mean(1 / widths) - roughness(SHAPE_OF, STEP)) / (COUNT * passes)
    return np.array([variance, 0.01 * curvature * np.mean(widths**2) ** 2])


def slope(x, y):
    return np.polyfit(np.log(x), np.log(y), 1)[0]


@pytest.mark.parametrize("first_m", [1.0, 2.0])
def test_progressive_kernels_err_as_theory_says(first_m):
    """Thesis 5.4: the mean square error falls as n^-4/5."""
    rng = np.random.default_rng(10)
    passes = np.array([16, 64, 256, 1024])
    errors = np.array([
        squared_error(progressive(chord_passes(n, PIXELS, COUNT, LEGS, rng), shape=(1, PIXELS),
                                  bin_m=0.1, n_bins=160, bandwidth_m=first_m), LEGS)
        for n in passes])  # fmt: skip
    mean, se = errors.mean(axis=1), errors.std(axis=1, ddof=1) / np.sqrt(PIXELS)
    expected = np.array([kernel_error(n, first_m).sum() for n in passes])
    # Leading order only: kernels of 2 m on a density 10 m wide leave terms of a few per cent.
    assert (np.abs(mean - expected) < 3.5 * se + 0.06 * expected).all(), mean / expected
    # The pixels give slopes of their own, so the spread of the mean slope is known.
    halves = errors.reshape(len(passes), 16, -1).mean(axis=2)
    slopes = np.array([slope(passes, column) for column in halves.T])
    se_slope = slopes.std(ddof=1) / 4
    assert abs(slopes.mean() - slope(passes, expected)) < 3 * se_slope + 0.01
    if first_m == 1.0:  # near its limit already, and clearly steeper than histograms
        assert abs(slopes.mean() + 4 / 5) < 3 * se_slope + 0.02
        assert slopes.mean() + 3 * se_slope < -2 / 3


def test_the_limit_of_variance_and_of_bias_is_n_to_the_minus_4_5():
    steps = np.array([2**17, 2**20])
    both = np.array([kernel_error(n, 1.0) for n in steps])
    # Corrections to the powers fade as n^-1/5 and n^-3/5.
    np.testing.assert_allclose([slope(steps, part) for part in both.T], -0.8, atol=0.01)


def test_histograms_with_the_best_bins_fall_as_n_to_the_minus_2_3():
    """Scott 1979 (recalled): error ``1 / (n h) + h^2 R(f') / 12``, best at h ~ n^-1/3."""
    rng = np.random.default_rng(11)
    passes = np.array([16, 64, 256, 1024])
    rough = roughness(np.gradient(SHAPE_OF, STEP), STEP)
    mean, se, expected = [], [], []
    for n in passes:
        total = n * COUNT
        n_bins = round(AXIS_M / (6 / (rough * total)) ** (1 / 3))
        width = AXIS_M / n_bins
        made = histogram(chord_passes(n, PIXELS, COUNT, LEGS, rng), shape=(1, PIXELS),
                         bin_m=width, n_bins=n_bins)  # fmt: skip
        errors = squared_error(made, LEGS)
        mean.append(errors.mean())
        se.append(errors.std(ddof=1) / np.sqrt(PIXELS))
        expected.append((1 / width - roughness(SHAPE_OF, STEP)) / total + width**2 * rough / 12)
    mean, se, expected = map(np.array, (mean, se, expected))
    assert (np.abs(mean - expected) < 3.5 * se + 0.02 * expected).all(), mean / expected
    # Relative errors of a few per cent over a factor 64 move the slope by less than 0.02.
    assert slope(passes, mean) == pytest.approx(-2 / 3, abs=0.03)
    # Same samples, less error: the reason for kernels.
    assert (np.array([kernel_error(n, 2.0).sum() for n in passes]) < mean / 2).all()


def test_a_jump_in_the_density_costs_the_kernel_its_rate():
    """One leg ends in a jump to zero: inside an axis that goes on, no kernel follows it."""
    rng = np.random.default_rng(12)
    passes = np.array([16, 64, 256])
    errors = [squared_error(progressive(chord_passes(n, 64, COUNT, 1, rng), shape=(1, 64),
                                        bin_m=0.05, n_bins=160, bandwidth_m=1.0), 1).mean()
              for n in passes]  # fmt: skip
    assert slope(passes, errors) > -0.5


def test_bandwidths_shrink_by_the_ratio_of_the_thesis():
    widths = list(islice(bandwidths_m(3.0, 0.7), 50))
    for j, (first, second) in enumerate(pairwise(widths), start=1):
        assert second / first == pytest.approx((j + 0.7) / (j + 1))
    made = progressive(chord_passes(4, 1, 5, 1, np.random.default_rng(0)), shape=(1, 1),
                       bin_m=0.1, n_bins=40, bandwidth_m=3.0, alpha=0.7)  # fmt: skip
    assert made.info["bandwidths_m"] == widths[:4]


def test_the_first_bandwidth_follows_silverman():
    rng = np.random.default_rng(13)
    pixel, mean = np.repeat([0, 1], 5000), np.repeat([4.0, 9.0], 5000)
    one = Samples(pixel, mean + rng.normal(0, 0.5, 10_000), np.ones(10_000))
    assert rule_of_thumb_m(one, (1, 2)) == pytest.approx(1.17 * 0.5 * 5000**-0.2, rel=0.03)
    same = Samples(np.zeros(9, int), np.full(9, 4.0), np.ones(9))
    made = progressive([same], shape=(1, 1), bin_m=0.1, n_bins=100)
    assert made.values.sum() == pytest.approx(9)
    assert made.info["bandwidths_m"] == [1e-3]


# the type


def lone(path_m, bin_m=0.1, n_bins=100, light=1.0, tail=0.0):
    values = np.full((n_bins, 1, 1), tail, np.float32)
    values[int(path_m / bin_m)] += light
    return values


def test_the_first_return_is_found_only_where_it_stands_apart():
    bins = np.concatenate([lone(4.05), lone(4.05, tail=0.02), lone(4.05, tail=0.2),
                           np.zeros((100, 1, 1), np.float32)], axis=2)  # fmt: skip
    bins[41, 0, 0] = 1  # straddles an edge
    found = first_return_m(Transient(bins, 0.1))[0]
    np.testing.assert_allclose(found[:2], [4.1 / 2, 4.05 / 2])
    assert np.isnan(found[2:]).all()  # a floor of light, and none at all
    smooth = density((np.arange(100) + 0.5) * 0.04, 1).astype(np.float32)[:, None, None]
    assert np.isnan(first_return_m(Transient(smooth, 0.04))).all()
    sloping = np.zeros((100, 1, 1), np.float32)
    sloping[[40, 41, 43, 44]] = 1  # one dark bin by chance
    assert first_return_m(Transient(sloping, 0.01)).item() == pytest.approx(0.425 / 2)
    assert np.isnan(first_return_m(Transient(sloping, 0.1))).all()
    missed = np.full((1, 1), 9.0, np.float32)
    assert np.isnan(first_return_m(Transient(lone(4.05), 0.1, missed=missed))).all()


def test_light_beyond_the_axis_shows_in_its_end():
    decay = np.exp(-np.arange(4000) * 0.01 / 2)
    for n_bins in (800, 1600, 3000):
        seen = decay[:n_bins].astype(np.float32)[:, None, None]
        outside = decay[n_bins:].sum() / decay.sum()
        assert cut_share(Transient(seen, 0.01)) == pytest.approx(outside, rel=0.05, abs=2e-9)
    assert cut_share(Transient(np.ones((50, 1, 1), np.float32), 0.1)) == 1
    assert cut_share(Transient(lone(4.0), 0.1)) == 0
    assert cut_share(Transient(np.zeros((9, 1, 1), np.float32), 0.1)) == 0
    assert cut_share(Transient(lone(0.0), 0.1, start_m=3.0)) == pytest.approx(0.5)


def test_a_start_may_differ_from_pixel_to_pixel():
    values = np.zeros((10, 1, 3), np.float32)
    values[4] = 1
    start_m = np.array([[3.0, 3.1, 3.2]])
    made = Transient(values, 0.1, start_m)
    z = phasors(made, 20e6)[0, 0]
    np.testing.assert_allclose(phase_to_range(np.angle(z), 20e6), (start_m[0] + 0.45) / 2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"values": np.ones((2, 2), np.float32)}, "3 dimensions"),
        ({"values": np.full((2, 1, 1), -1.0)}, "light of 0 or more"),
        ({"values": np.full((2, 1, 1), np.nan)}, "light of 0 or more, got values from nan"),
        ({"values": np.full((2, 1, 1), np.inf)}, "light of 0 or more"),
        ({"bin_m": 0.0}, "bin_m must be positive"),
        ({"bin_m": np.nan}, "bin_m must be positive"),
        ({"box_m": -1.0}, "box_m not negative"),
        ({"start_m": np.nan}, "start_m must be finite"),
        ({"start_m": np.zeros((2, 2))}, "start_m must have shape"),
        ({"unit": "W"}, "unit must be one of"),
        ({"missed": np.full((1, 1), -1.0)}, "missed must hold light"),
        ({"missed": np.zeros((2, 2))}, "missed must have shape"),
    ],
)
def test_transients_that_make_no_sense_are_refused(change, words):
    given = {"values": np.ones((2, 1, 1), np.float32), "bin_m": 0.1, **change}
    with pytest.raises(ValueError, match=words) as caught:
        Transient(**given)
    assert "\n" not in str(caught.value)


ONE = Samples(np.array([0, 3]), np.array([1.0, 2.0]), np.array([1.0, 1.0]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"passes": []}, "at least one pass"),
        ({"passes": [ONE._replace(pixel=np.array([0, 4]))]}, r"pixels must lie in 0..3, got 0..4"),
        ({"passes": [ONE._replace(pixel=np.array([-1, 0]))]}, "pixels must lie"),
        ({"passes": [ONE._replace(path_m=np.array([1.0, np.nan]))]}, "must be finite"),
        ({"passes": [ONE._replace(weight=np.array([1.0, np.inf]))]}, "must be finite"),
        ({"passes": [ONE._replace(weight=np.ones(3))]}, r"must be \(N,\)"),
        ({"bin_m": 0.0}, "bin_m must be positive"),
        ({"start_m": np.inf}, "start_m finite"),
        ({"n_bins": 0}, "wanted 1 to"),
        ({"n_bins": 1 << 40}, "wider bins or a smaller image"),
    ],
)
@pytest.mark.parametrize("method", [histogram, progressive])
def test_samples_and_axes_that_make_no_sense_are_refused(method, change, words):
    given = {"passes": [ONE], "shape": (2, 2), "bin_m": 0.1, "n_bins": 40, **change}
    with pytest.raises(ValueError, match=words) as caught:
        method(given.pop("passes"), **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"alpha": 0.0}, "alpha"), ({"alpha": 1.1}, "alpha"), ({"bandwidth_m": 0.0}, "positive"),
     ({"bandwidth_m": 4.1}, "at most the axis of 4 m"), ({"bandwidth_m": np.nan}, "positive")],
)  # fmt: skip
def test_bandwidths_that_make_no_sense_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        progressive([ONE], shape=(2, 2), bin_m=0.1, n_bins=40, **change)


# scenes, through the tracer


CAVITY = Scene("cavity", {"radius": RADIUS, "albedo": 0.8})
EYE = sensor("deeptof:width=16,height=12,freqs=20e6+50e6")


def test_samples_of_the_tracer_are_what_its_phasors_sum_up():
    """The same seed draws the same paths; phases there are in single precision."""
    from toftools._native import import_mitsuba
    from toftools.sim._flash import flashes_of
    from toftools.sim._phasors import direct_light, indirect_light
    from toftools.sim._samples import direct_samples, indirect_samples
    from toftools.sim._task import Task, first_hits
    from toftools.sim.scenes import world_of
    from toftools.sim.stage import load

    mi = import_mitsuba()
    stage = load(world_of(Scene("cornell")))
    task = Task(mi, stage, flashes_of(mi, stage, EYE))
    first = first_hits(task, rays(EYE.camera).reshape(-1, 3))
    freqs = np.array([0.0, 50e6])
    shared = {"bounces": 5, "samples": 32, "seed": 3}
    for samples, light in (
        (direct_samples(task, first), direct_light(task, first, freqs)),
        (indirect_samples(task, first, **shared), indirect_light(task, first, freqs, **shared)),
    ):
        mine = [samples_phasor(samples, EYE.camera.shape, f).ravel() for f in freqs]
        np.testing.assert_allclose(mine, light.total, rtol=0, atol=2e-6 * abs(light.total).max())


def test_the_transient_of_the_cavity_has_the_phasors_of_the_closed_form():
    shot = Shot(EYE, seed=5, max_bounces=6, samples=256)
    # The lone direct return at 4 m stands in the middle of a bin.
    made = transient(CAVITY, shot, bin_m=0.02, n_bins=1600, start_m=0.01, method=histogram)
    assert made.info["max_bounces"] == 6
    assert made.info["beyond"] == 0
    freqs = np.array([0.0, *EYE.modulation.freqs_hz])
    exact = cavity(EYE.camera, radius=RADIUS, albedo=0.8)
    for z, freq in zip(phasors(made, freqs), freqs, strict=True):
        expected = exact.phasor(float(freq), 6)[0, 0]
        for part in (np.real, np.imag):
            se = part(z).std(ddof=1) / np.sqrt(z.size)
            assert abs(part(z).mean() - part(expected)) < 3.5 * se + 2e-5 * abs(expected)
    first = first_return_m(made, least_share=0.1)
    np.testing.assert_allclose(first, RADIUS, atol=0.02 / 4 + 1e-6)


def test_a_kernel_keeps_direct_light_sharp_and_all_light_there():
    shot = Shot(EYE, seed=5, max_bounces=4, samples=64)
    axis = {"bin_m": 0.05, "n_bins": 480}
    kernel = partial(progressive, bandwidth_m=1.0)
    smooth = transient(CAVITY, shot, method=kernel, **axis)
    binned = transient(CAVITY, shot, method=histogram, **axis)
    assert smooth.info["bandwidths_m"][0] == 1.0
    assert len(smooth.info["bandwidths_m"]) == 16
    # Same paths: the same light in all, float32 of 480 bins.
    np.testing.assert_allclose(smooth.values.sum(axis=0), binned.values.sum(axis=0), rtol=1e-5)
    direct = 0.8 / RADIUS**2
    at = round(2 * RADIUS / 0.05)
    assert (smooth.values[at - 1 : at + 1].sum(axis=0) > 0.999 * direct).all()
    assert (np.abs(np.diff(smooth.values[at + 1 : at + 20], axis=0)) < 0.05 * direct).all()


def test_a_seed_gives_the_same_transient_and_too_little_room_is_made_more(monkeypatch):
    from toftools.sim import _samples

    shot = Shot(EYE, seed=9, max_bounces=3, samples=32)
    axis = {"bin_m": 0.05, "n_bins": 400}
    whole = transient(CAVITY, shot, **axis)
    monkeypatch.setattr(_samples, "events_per_path", lambda _task, _bounces: 1)
    assert transient(CAVITY, shot, **axis).values.tobytes() == whole.values.tobytes()
    other = transient(CAVITY, replace(shot, seed=10), **axis)
    assert other.values.tobytes() != whole.values.tobytes()


def test_without_bounces_the_direct_light_is_all():
    made = transient(Scene("wall", {"range": 2.0, "albedo": 0.5}), Shot(EYE, max_bounces=0))
    assert made.info["paths"] == 0
    expected = 0.5 * rays(EYE.camera)[..., 2] ** 3 / 4
    np.testing.assert_allclose(made.values.sum(axis=0), expected, rtol=1e-5)
    np.testing.assert_allclose(
        first_return_m(made), 2 / rays(EYE.camera)[..., 2], atol=0.01 / 4 + 1e-6
    )
    with pytest.raises(ValueError, match="wider bins or a smaller image"):
        transient(CAVITY, Shot(EYE), n_bins=1 << 40)
