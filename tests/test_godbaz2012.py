"""Godbaz's closed forms: exact where the model holds, against twins and bounds, and where not."""

import functools

import numpy as np
import pytest
from reference_two_returns import cauchy_twin, ratio_twin
from scipy.special import chdtri

from toftools.correct import OK
from toftools.correct import godbaz2012_cauchy as cauchy
from toftools.correct import godbaz2012_ratio as ratio
from toftools.correct._one_or_two import BLOCK
from toftools.correct._propagate import propagated_sigma_m
from toftools.correct.crt import crt
from toftools.crlb import crlb_returns_m
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import joint_ambiguity_m, range_to_phase

RATIO, CAUCHY = "deeptof:freqs=30e6+60e6", "deeptof:freqs=20e6+40e6+60e6+80e6"
MAKE = {RATIO: ratio.godbaz2012_ratio, CAUCHY: cauchy.godbaz2012_cauchy}
both = pytest.mark.parametrize("text", [RATIO, CAUCHY], ids=["ratio", "cauchy"])


@functools.cache
def built(text):
    return MAKE[text](sensor(text))


def wavenumbers(text):
    return range_to_phase(1.0, sensor(text).modulation.freqs_hz)


def planted(text, n, *, apart=(0.3, 2.0), ratios=(0.05, 0.8), noise=0.0, seed=0):
    """Phasors (F, n) of two returns, the stronger first, and its range."""
    rng = np.random.default_rng(seed)
    first, extra = rng.uniform(0.5, 2.5, n), rng.uniform(*apart, n)
    k = wavenumbers(text)[:, None]
    z = np.exp(1j * k * first) * (1 + rng.uniform(*ratios, n) * np.exp(1j * k * extra))
    return z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape)), first


def frame(z, noise=None):
    sigma = None if noise is None else np.full(z[:, None].shape, noise, np.float32)
    return Phasors(z[:, None].astype(np.complex64), sigma)


def separate(text, z, sigma=1.0):
    """Ranges, amplitudes and sigma of both returns, in double precision."""
    noise = np.broadcast_to(float(sigma), z.shape).copy()
    k = wavenumbers(text)
    if text == RATIO:
        phase, amplitude, spread = ratio.separate(z, noise)
        return phase / k[0], amplitude, spread / k[0]
    return cauchy.separate(z, noise, k[0], k[1] - k[0], 1)[:3]


@both
def test_two_returns_are_recovered_to_rounding(text):
    z, first = planted(text, 3000)
    ranges_m, _, _ = separate(text, z)
    # Rounding of 1e-16 is amplified by the bound: 1e4 at 0.3 m and a share of 5 %, and more.
    off = np.abs(ranges_m - first).min(axis=0)
    assert np.median(off) < 1e-12
    assert off.max() < 1e-8
    depth = built(text)(frame(z))
    assert (depth.info["status"] == OK).all()
    clear, first = planted(text, 3000, apart=(0.8, 2.0), ratios=(0.2, 0.8))
    assert np.abs(built(text)(frame(clear)).range_m[0] - first).max() < 1e-3  # float32 phasors


def test_ratio_is_pisarenko_in_closed_form():
    z, _ = planted(RATIO, 200, noise=0.01, seed=1)
    phase, amplitude, _ = ratio.separate(z, np.ones(z.shape))
    for p in range(z.shape[1]):
        phases, amplitudes = ratio_twin(*z[:, p])
        order = np.argsort(-amplitude[:, p])
        # The eigenvectors of nearly equal eigenvalues (close returns) have half the digits.
        assert np.allclose(np.exp(1j * phase[order, p]), np.exp(1j * phases), atol=1e-6)
        assert np.allclose(amplitude[order, p], amplitudes, atol=1e-6)


def test_any_two_phasors_are_explained_by_one_pair_of_positive_returns():
    rng = np.random.default_rng(2)
    z = rng.normal(size=(2, 2000)) + 1j * rng.normal(size=(2, 2000))
    phase, amplitude, _ = ratio.separate(z, np.ones(z.shape))
    assert (amplitude > 0).all()
    for i in (0, 1):
        model = np.sum(amplitude * np.exp(1j * (i + 1) * phase), axis=0)
        assert np.abs(model - z[i]).max() < 1e-6


def test_cauchy_is_prony_and_tells_the_widths():
    k = wavenumbers(CAUCHY)
    rng = np.random.default_rng(3)
    first, extra, wide = (rng.uniform(*of, 200) for of in ((1, 3), (0.5, 2), (0.0, 0.2)))
    near = np.exp((1j * first - wide) * k[:, None])
    z = near + 0.5 * np.exp((1j * (first + extra) - 0.1) * k[:, None])
    ranges_m, amplitude, _, width_m = cauchy.separate(z, np.ones(z.shape), k[0], k[1] - k[0], 1)
    at = np.abs(ranges_m - first).argmin(axis=0), np.arange(200)
    assert np.abs(ranges_m[at] - first).max() < 1e-9
    assert np.abs(width_m[at] - wide).max() < 1e-9
    assert np.allclose(amplitude[at], np.abs(near[0]), atol=1e-9)
    noisy = z + 0.003 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    ranges_m, amplitude, _, width_m = cauchy.separate(noisy, np.ones(z.shape), k[0], k[0], 1)
    for p in range(200):
        roots, amplitudes = cauchy_twin(noisy[:, p])
        order = np.argsort(-amplitude[:, p])
        assert np.allclose(amplitude[order, p], np.abs(amplitudes), rtol=1e-7)
        assert np.allclose(width_m[order, p], -np.log(np.abs(roots)) / k[0], atol=1e-8)


def test_cauchy_unwraps_beyond_the_spacing():
    text = "deeptof:freqs=25e6+35e6+45e6+55e6,width=1,height=1"
    freqs = sensor(text).modulation.freqs_hz
    turn = range_to_phase(1.0, freqs)
    run = cauchy.godbaz2012_cauchy(sensor(text))
    assert joint_ambiguity_m(freqs) == pytest.approx(29.979, abs=1e-3)
    for near in (2.0, 13.0, 21.0, 27.0):
        two = np.exp(1j * turn * near) + 0.4 * np.exp(1j * turn * (near + 1.7))
        depth = run(Phasors(two[:, None, None]))
        assert depth.info["ranges_m"].ravel() == pytest.approx([near, near + 1.7], abs=1e-3)


def test_sigma_of_ratio_is_the_bound():
    freqs = sensor(RATIO).modulation.freqs_hz
    for apart, share in ((0.3, 0.1), (0.8, 0.8), (2.1, 0.4)):
        k = wavenumbers(RATIO)
        z = np.exp(1j * k * 1.0) + share * np.exp(1j * k * (1.0 + apart))
        noise = np.array([[0.01], [0.03]])
        phase, amplitude, spread = ratio.separate(z[:, None], noise)
        order = np.argsort(phase[:, 0])
        bound = crlb_returns_m(freqs, [1.0, 1.0 + apart], [1.0, share], noise[:, 0])
        assert np.allclose(spread[order, 0] / k[0], bound, rtol=1e-6)
        assert np.allclose(amplitude[order, 0], [1.0, share], rtol=1e-6)


def test_sigma_of_cauchy_is_the_noise_carried_through():
    z, first = planted(CAUCHY, 200, apart=(0.6, 2.0), ratios=(0.2, 0.8))
    noise = np.full(z.shape, 1e-6)

    def nearest(values):
        ranges_m = separate(CAUCHY, values)[0]
        return ranges_m[np.abs(ranges_m - first).argmin(axis=0), np.arange(first.size)]

    ranges_m, _, sigma_m = separate(CAUCHY, z, 1e-6)
    own = sigma_m[np.abs(ranges_m - first).argmin(axis=0), np.arange(first.size)]
    assert np.allclose(own, propagated_sigma_m(nearest, z, noise), rtol=1e-3)


@both
@pytest.mark.parametrize("noise", [0.001, 0.005])
def test_sigma_is_honest_where_returns_are_apart(text, noise):
    z, first = planted(text, 6000, apart=(1.3, 2.0), ratios=(0.2, 0.8), noise=noise, seed=4)
    depth = built(text)(frame(z, noise))
    normalised = (depth.range_m[0] - first) / depth.sigma_m[0]
    assert (depth.info["returns"] == 2).mean() > 0.999
    assert 0.9 < normalised.std() < 1.1
    assert abs(normalised.mean()) < 0.1


def test_ratio_is_efficient_and_beats_one_return():
    noise = 0.01
    z, first = planted(RATIO, 4000, apart=(1.0, 1.0), ratios=(0.5, 0.5), noise=noise, seed=5)
    off = built(RATIO)(frame(z, noise)).range_m[0] - first
    bound = crlb_returns_m(sensor(RATIO).modulation.freqs_hz, [1.0, 2.0], [1.0, 0.5], noise)[0]
    assert np.sqrt(np.mean(off**2)) == pytest.approx(bound, rel=0.05)
    alone = crt(sensor(RATIO))(frame(z, noise)).range_m[0] - first
    assert np.median(np.abs(alone)) > 20 * bound  # 242 mm of multipath against 11 mm of noise


@both
def test_lone_returns_stay_alone(text):
    noise = 0.02
    z, _ = planted(text, 20000, ratios=(0.0, 0.0), noise=noise, seed=6)
    depth, alone = built(text)(frame(z, noise)), crt(sensor(text))(frame(z, noise))
    taken_for_two = depth.range_m != alone.range_m
    # A false alarm in 1000: 20 of them, and four standard deviations.
    alarms = depth.info["chi2_one"] > chdtri(2 * z.shape[0] - 2, 0.001)
    assert 2 <= alarms.sum() <= 38
    assert not taken_for_two[~alarms].any()
    assert np.allclose(depth.sigma_m[~taken_for_two], alone.sigma_m[~taken_for_two], rtol=0.1)


@both
def test_more_false_alarms_find_weaker_returns(text):
    z, _ = planted(text, 4000, apart=(1.0, 2.0), ratios=(0.05, 0.1), noise=0.02, seed=7)
    found = []
    for false_alarm in (1e-6, 1e-3, 0.1):
        run = MAKE[text](sensor(text), false_alarm=false_alarm, first_share=0.01)
        found.append((run(frame(z, 0.02)).info["returns"] == 2).mean())
    assert found[0] < found[1] < found[2]


@both
def test_order_of_frequencies_and_known_contrast_change_nothing(text):
    z, _ = planted(text, 500, noise=0.01, seed=8)
    straight = built(text)(frame(z, 0.01))
    head, freqs = text.split("=")
    backwards = f"{head}={'+'.join(reversed(freqs.split('+')))}"
    turned = MAKE[text](sensor(backwards))(frame(z[::-1], 0.01))
    assert np.array_equal(straight.range_m, turned.range_m)
    contrast = np.linspace(0.9, 0.5, z.shape[0])
    device = sensor(f"{text},contrast={'+'.join(map(str, contrast))}")
    less = frame(z * contrast[:, None])
    sigma = (0.01 * contrast)[:, None, None] * np.ones(less.values.shape)
    dimmed = MAKE[text](device)(Phasors(less.values, sigma.astype(np.float32)))
    same = np.abs(dimmed.range_m - straight.range_m) < 1e-4
    assert same.mean() > 0.99  # at equal noise; the walk's wraps and weak thresholds may differ


@both
def test_blocks_and_unknown_noise(text):
    n = BLOCK + 100
    z, _ = planted(text, n, noise=0.01, seed=9)
    whole = built(text)(frame(z, 0.01))
    ends = [built(text)(frame(z[:, part], 0.01)) for part in (slice(0, 300), slice(n - 300, n))]
    # Kernels round by the lane a pixel is in: an ulp of float32.
    assert np.allclose(whole.range_m[:, :300], ends[0].range_m, rtol=3e-7)
    assert np.allclose(whole.range_m[:, -300:], ends[1].range_m, rtol=3e-7)
    sigma = np.full(z[:, None, :50].shape, 0.01, np.float32)
    sigma[0, 0, 10], sigma[1, 0, 20] = 0.0, np.nan
    depth = built(text)(Phasors(z[:, None, :50].astype(np.complex64), sigma))
    assert np.isfinite(depth.range_m).all()
    assert np.flatnonzero(np.isnan(depth.sigma_m[0])).tolist() == [10, 20]


def test_close_returns_are_not_separated():
    """The figures of the headers: what is left at 1 % of noise, 0.3 m apart."""
    for text, at_least_mm in ((RATIO, 50), (CAUCHY, 90)):
        z, first = planted(text, 3000, apart=(0.3, 0.3), ratios=(0.5, 0.5), noise=0.01, seed=10)
        off = built(text)(frame(z, 0.01)).range_m[0] - first
        assert 1e3 * np.median(np.abs(off)) > at_least_mm


@pytest.mark.parametrize(
    ("make", "freqs", "got"),
    [
        (ratio.godbaz2012_ratio, "40e6+70e6", r"ratio 2:1, got \[40000000.0, 70000000.0\] Hz"),
        (ratio.godbaz2012_ratio, "20e6+40e6+60e6", "frequencies in the ratio 2:1, got 3;"),
        (cauchy.godbaz2012_cauchy, "20e6+40e6", "four equispaced frequencies, got 2;"),
        (cauchy.godbaz2012_cauchy, "20e6+40e6+60e6+90e6", r"got \[20000000.0, .*90000000.0\] Hz"),
        (cauchy.godbaz2012_cauchy, "20e6+20e6+20e6+20e6", "got"),
    ],
)
def test_other_frequencies_are_refused(make, freqs, got):
    with pytest.raises(ValueError, match=got):
        make(sensor(f"deeptof:freqs={freqs}"))


@both
@pytest.mark.parametrize(
    "params", [{"first_share": 1.0}, {"false_alarm": 0.0}, {"assumed_noise": -1.0}]
)
def test_parameters_out_of_range_are_refused(text, params):
    with pytest.raises(ValueError, match=f"{next(iter(params))} must"):
        MAKE[text](sensor(text), **params)
