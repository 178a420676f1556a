"""Metrics against closed forms, slow twins, scipy and published figures."""

import os
from pathlib import Path

import numpy as np
import pytest
import reference_metrics as reference
from scipy.spatial.distance import jensenshannon
from scipy.stats import halfnorm, pearsonr

from toftools.metrics import statistics
from toftools.metrics.coverage import coverage_curve
from toftools.metrics.distributions import DISTRIBUTIONS, histogram
from toftools.registry import METRICS
from toftools.types import DepthMap, Truth

LN2_ROOT = np.sqrt(np.log(2))


def score(name, truth_m, answer_m, **params):
    return METRICS[name].build(Truth(truth_m), **params)(DepthMap(answer_m))


def scene(rng, shape=(22, 26)):
    """A rough two-plane scene with unknown pixels, a noisy answer with missing ones, a mask."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    truth = 1.5 + 0.03 * u + 0.02 * v + np.where(u > shape[1] // 2, 1.0, 0.0)
    answer = truth + 0.05 * rng.standard_normal(shape) + np.where(rng.random(shape) < 0.05, 1.9, 0)
    truth[rng.random(shape) < 0.05] = np.nan
    answer[rng.random(shape) < 0.1] = np.nan
    return truth.astype(np.float32), answer.astype(np.float32), rng.random(shape) < 0.9


# Errors


def test_planted_bias():
    truth = np.linspace(1, 5, 600).reshape(20, 30)
    answer = truth + 0.03
    # float32 holds 5 m to 2.4e-7 m.
    for name in ("bias_m", "mae_m", "rmse_m", "median_m", "p25_m", "p95_m"):
        assert score(name, truth, answer) == pytest.approx(0.03, abs=5e-7)
    assert score("bias_m", truth, truth - 0.03) == pytest.approx(-0.03, abs=5e-7)
    assert (score("under_2cm", truth, answer), score("under_5cm", truth, answer)) == (0.0, 1.0)
    assert score("r2", truth, answer) == pytest.approx(1 - 0.03**2 / np.var(truth), abs=1e-7)


def test_gaussian_errors_by_z_test():
    sigma, shape = 0.03, (240, 320)
    answer = 3.0 + sigma * np.random.default_rng(7).standard_normal(shape)
    truth, n, law = np.full(shape, 3.0), 240 * 320, halfnorm(scale=sigma)
    expected = {
        "bias_m": (0.0, sigma / np.sqrt(n)),
        "mae_m": (law.mean(), law.std() / np.sqrt(n)),
        "rmse_m": (sigma, sigma / np.sqrt(2 * n)),
    }
    for name, q in (("p25_m", 0.25), ("median_m", 0.5), ("p75_m", 0.75), ("p95_m", 0.95)):
        expected[name] = law.ppf(q), np.sqrt(q * (1 - q) / n) / law.pdf(law.ppf(q))
    for name, limit in (("under_1cm", 0.01), ("under_2cm", 0.02), ("under_5cm", 0.05)):
        p = law.cdf(limit)
        expected[name] = p, np.sqrt(p * (1 - p) / n)
    for name, (mean, error) in expected.items():
        # Ten scores: |z| < 4 fails by chance once in 1600 seeds.
        assert abs(score(name, truth, answer) - mean) < 4 * error, name


def test_answer_rounded_to_two_centimetres():
    truth = np.linspace(1.0, 1.8, 4001)[None, :-1]
    answer = np.round(truth / 0.02) * 0.02
    # 4000 ranges sample the uniform rounding error to (2e-4 m)^2 / 12 of its variance.
    assert score("mae_m", truth, answer) == pytest.approx(0.02 / 4, abs=2e-7)
    assert score("rmse_m", truth, answer) == pytest.approx(0.02 / np.sqrt(12), abs=2e-6)


def test_wrapped_pixels():
    truth = np.full((1, 8), 2.0)
    answer = np.array([[2.0, 2.49, 2.51, 4.5, 1.4, 0.0, np.nan, 2.0]])
    assert score("wrap_share", truth, answer) == pytest.approx(4 / 7)
    assert score("wrap_share", truth, answer, ambiguity_m=3.8) == pytest.approx(2 / 7)


def test_r2_needs_a_spread_of_truth():
    # 2.1 is not exact in binary; the mean of equal numbers may differ from them by rounding.
    assert np.isnan(score("r2", np.full((7, 9), 2.1), np.full((7, 9), 2.2)))
    truth = np.array([[1.0, 2.0, 3.0]])
    assert score("r2", truth, np.full((1, 3), 2.0)) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_errors_equal_their_slow_twins(seed):
    truth, answer, mask = scene(np.random.default_rng(seed))
    for name, value in reference.scores(truth, answer, mask).items():
        # Sums in another order: a few ulp.
        assert score(name, truth, answer, mask=mask) == pytest.approx(value, rel=1e-12), name


# Depth statistics


@pytest.mark.parametrize("distribution", list(DISTRIBUTIONS))
@pytest.mark.parametrize("seed", range(3))
def test_histograms_equal_their_slow_twins(distribution, seed):
    _, answer, mask = scene(np.random.default_rng(seed))
    twin = reference.histogram(answer, distribution, mask)
    np.testing.assert_allclose(histogram(answer, distribution, mask), twin, rtol=1e-12, atol=0)


def test_values_beyond_the_base_fall_in_the_outermost_bins():
    p = histogram(np.array([[0.0, 0.001, 60.0, 500.0]]), "range")
    assert (p[0], p[-1], p.sum()) == (0.5, 0.5, 1.0)
    p = histogram(np.array([[0.002, 900.0, 0.002]]), "gradient_h")
    assert (p[0], p[-1]) == (0.5, 0.5)


def test_a_plane_of_constant_ratio_has_one_gradient():
    x = 0.05 * np.arange(12)
    image = np.exp(np.tile(x, (10, 1)))
    along, across = histogram(image, "gradient_h"), histogram(image, "gradient_v")
    # asinh(0.05 / 0.01) / 0.2 = 11.6: twelve bins above the middle one, number 27 of 55.
    assert np.flatnonzero(along).tolist() == [39] and along.size == 55
    assert np.flatnonzero(across).tolist() == [27]
    mirrored = histogram(image[:, ::-1], "gradient_h")
    np.testing.assert_array_equal(mirrored, along[::-1])


def test_haar_of_one_hand_made_window():
    step = 0.3

    def bin_of(d):
        return round(float(np.arcsinh(d / 0.01)) / 0.4) + 14  # the middle one of 29 per axis

    image = 2.0 * np.exp(np.array([[0.0, step], [0.0, step]]))  # changes along the row only
    # a - b + c - d = -2 step, halved; vertical and diagonal responses are zero.
    for name in ("haar_hv", "haar_hd"):
        assert np.argwhere(histogram(image, name)).tolist() == [[bin_of(-step), 14]]
    assert np.argwhere(histogram(image.T, "haar_hv")).tolist() == [[14, bin_of(-step)]]
    saddle = 2.0 * np.exp(np.array([[step, 0.0], [0.0, step]]))
    assert np.argwhere(histogram(saddle, "haar_hd")).tolist() == [[14, bin_of(step)]]


def test_statistics_of_differences_ignore_scale():
    _, answer, _ = scene(np.random.default_rng(1))
    for name in ("gradient_h", "gradient_v", "haar_hv", "haar_hd"):
        # Doubling is exact, but ln(2 r) and ln(r) round apart: a value may change bins.
        difference = histogram(answer, name) - histogram(2 * answer, name)
        assert np.abs(difference).sum() < 0.01


def test_a_set_of_images_pools_its_windows():
    rng = np.random.default_rng(5)
    images = [scene(rng)[1], scene(rng, (30, 18))[1]]
    masks = [rng.random(image.shape) < 0.8 for image in images]
    count = [int((np.isfinite(i) & m).sum()) for i, m in zip(images, masks, strict=True)]
    parts = [histogram(i, "range", m) * n for i, m, n in zip(images, masks, count, strict=True)]
    np.testing.assert_allclose(histogram(images, "range", masks), sum(parts) / sum(count))
    assert statistics.compare(histogram(images), histogram(images[::-1]))["js"] < 1e-8
    with pytest.raises(ValueError, match="one per image"):
        histogram(images, "range", masks[0])
    assert not histogram([], "haar_hv").any()


def test_comparisons_by_hand():
    p, q = np.array([0.5, 0.5]), np.array([0.25, 0.75])
    assert statistics.chi2_error(p, q) == pytest.approx(0.5 * (0.0625 / 0.75 + 0.0625 / 1.25))
    middle = (p + q) / 2
    expected = np.sqrt((np.sum(p * np.log(p / middle)) + np.sum(q * np.log(q / middle))) / 2)
    assert statistics.js_distance(p, q) == pytest.approx(expected, rel=1e-12)
    assert statistics.pearson_correlation(q, 1 - q) == pytest.approx(-1.0)


def test_comparisons_at_their_ends():
    p, q = np.array([0.3, 0.7, 0, 0]), np.array([0, 0, 0.6, 0.4])
    assert statistics.js_distance(p, q) == pytest.approx(LN2_ROOT, rel=1e-15)
    assert round(LN2_ROOT, 3) == 0.833  # as the thesis prints it
    assert statistics.chi2_error(p, q) == pytest.approx(1.0)
    assert statistics.compare(p, p) == pytest.approx({"chi2": 0, "js": 0, "pearson": 1})
    assert all(np.isnan(x) for x in statistics.compare(p, 0 * p).values())
    with pytest.raises(ValueError, match="same bins"):
        statistics.compare(p, q[:3])


@pytest.mark.parametrize("seed", range(5))
def test_comparisons_against_scipy_and_each_other(seed):
    rng = np.random.default_rng(seed)
    p, q = (rng.random((6, 8)) * (rng.random((6, 8)) < 0.6) for _ in range(2))
    p, q = p / p.sum(), q / q.sum()
    assert statistics.js_distance(p, q) == pytest.approx(jensenshannon(p.ravel(), q.ravel()))
    wanted = pearsonr(p.ravel(), q.ravel()).statistic
    assert statistics.pearson_correlation(p, q) == pytest.approx(wanted)
    chi2, js = statistics.chi2_error(p, q), statistics.js_distance(p, q)
    assert chi2 / 2 <= js**2 <= np.log(2) * chi2
    assert statistics.compare(p, q) == pytest.approx(statistics.compare(q, p))


def test_printed_pairs_of_the_thesis_fix_the_form_of_chi2():
    printed = [(0.032, 0.129), (0.051, 0.162), (0.028, 0.118), (0.094, 0.245), (0.152, 0.314),
               (0.172, 0.336)]  # fmt: skip
    half = 5e-4  # both are rounded to three digits
    chi2, js = np.array(printed).T

    def fits(factor):
        """Can factor * sum (p - q)^2 / (p + q) have given all printed pairs?"""
        low = (chi2 - half) / factor / 4 <= (js + half) ** 2
        high = (js - half) ** 2 <= np.log(2) / 2 * (chi2 + half) / factor
        return bool((low & high).all())

    assert [fits(f) for f in (0.25, 0.5, 1.0, 2.0)] == [False, True, False, False]


# Coverage


@pytest.mark.parametrize("seed", range(3))
def test_coverage_equals_its_slow_twin(seed):
    rng = np.random.default_rng(seed)
    truth, answer, _ = scene(rng, (9, 11))
    trust = np.round(rng.random(truth.shape), 1).astype(np.float32)  # many ties
    curve = coverage_curve(Truth(truth), DepthMap(answer, confidence=trust), limit_m=0.06)
    twin = reference.coverage(truth, answer, trust, 0.06)
    ours = [curve.coverage, curve.mae_m, curve.rmse_m, curve.inlier_share, curve.outlier_share,
            curve.threshold]  # fmt: skip
    np.testing.assert_allclose(ours, twin, rtol=1e-12)


def test_coverage_ends_at_the_valid_share_and_the_plain_errors():
    truth, answer, mask = scene(np.random.default_rng(2))
    sigma = np.abs(answer - truth)
    sigma[3] = np.nan  # unknown trust comes last, but comes
    depth = DepthMap(answer, sigma_m=sigma)
    curve = coverage_curve(Truth(truth), depth, mask=mask, limit_m=0.05, max_points=10)
    assert curve.coverage.size == 10
    assert curve.coverage[-1] == score("valid_share", truth, answer, mask=mask)
    assert curve.mae_m[-1] == pytest.approx(score("mae_m", truth, answer, mask=mask))
    assert curve.rmse_m[-1] == pytest.approx(score("rmse_m", truth, answer, mask=mask))
    assert curve.inlier_share[-1] == score("under_5cm", truth, answer, mask=mask)
    np.testing.assert_allclose(curve.inlier_share + curve.outlier_share, curve.coverage)
    # Sigma is the error itself: trusting more pixels can only make the mean worse.
    assert (np.diff(curve.mae_m) > 0).all() and (np.diff(curve.coverage) > 0).all()


def test_coverage_without_an_order_is_one_point_and_without_answers_none():
    truth = Truth(np.full((3, 4), 2.0))
    answer = np.full((3, 4), 2.1)
    answer[0] = np.nan
    curve = coverage_curve(truth, DepthMap(answer))
    assert curve.coverage.tolist() == [8 / 12] and curve.mae_m == pytest.approx([0.1], abs=3e-7)
    assert coverage_curve(truth, DepthMap(np.full((3, 4), np.nan))).coverage.size == 0
    with pytest.raises(ValueError, match="positive"):
        coverage_curve(truth, DepthMap(answer), limit_m=0.0)


# Published figures


@pytest.mark.parametrize(
    ("frame", "mae_cm", "rmse_cm"), [(1, 4.49, 14.65), (2, 1.67, 3.04), (3, 3.11, 5.31)]
)
def test_errors_of_a_published_network_output(frame, mae_cm, rmse_cm):
    folder = os.environ.get("TOFTOOLS_DATA")
    if not folder:
        pytest.skip("needs the su2018 renderings: set TOFTOOLS_DATA")
    from scipy.io import loadmat

    root = Path(folder) / "su2018_synth_40_70MHz"
    pair = loadmat(root / f"im_pair_00000{frame}.mat")["im_pair"]
    answer = 10 * loadmat(root / f"tofnet_output_00000{frame}.mat")["x"][0]
    truth = Truth(10 * pair[0, :, 320:])
    mask = np.isfinite(pair[:4, :, :320]).all(axis=0)
    mask &= (truth.range_m > 0.1) & (truth.range_m < 9.9)
    for name, expected_cm in (("mae_m", mae_cm), ("rmse_m", rmse_cm)):
        value = METRICS[name].build(truth, mask=mask)(DepthMap(answer))
        assert 100 * value == pytest.approx(expected_cm, abs=0.005), name  # printed to 0.01 cm
