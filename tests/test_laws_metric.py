"""Laws that every metric of the registry obeys."""

import numpy as np
import pytest
from reference_metrics import WINDOWS

from toftools.registry import METRICS
from toftools.types import DepthMap, Truth

ALL = sorted(METRICS)
STATISTICS = [name for name in ALL if name.startswith(tuple(WINDOWS))]
ERRORS = [name for name in ALL if name not in STATISTICS]
IDEAL = {"zero": 0.0, "lower": 0.0, "higher": 1.0}
SHAPE = (40, 56)


@pytest.fixture(name="truth")
def _truth() -> Truth:
    """Two tilted planes a step apart, with unknown pixels inside and at the border."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    range_m = 1.5 + 0.02 * u + 0.01 * v + np.where(u > 30, 1.0, 0.0)
    # Multiples of 1/256 m are exact in float16 below 8 m: every float type holds the same truth.
    range_m = np.round(range_m * 256) / 256
    range_m[5:9, 10:14] = np.nan
    range_m[:, -1] = np.nan
    return Truth(range_m)


def noisy(truth: Truth, sigma_m: float, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.maximum(truth.range_m + sigma_m * rng.standard_normal(SHAPE), 0.0)


def plausible(truth: Truth) -> DepthMap:
    """A noisy answer with some pixels missing."""
    range_m = noisy(truth, 0.05)
    range_m[20:22] = np.nan
    return DepthMap(range_m)


@pytest.mark.parametrize("name", ALL)
def test_unit_and_direction_are_declared(name):
    assert METRICS[name].unit == ("m" if name.endswith("_m") else "")
    assert METRICS[name].better in IDEAL


@pytest.mark.parametrize("name", ALL)
def test_docstring_tells_parameters_and_result(name):
    text = METRICS[name].load().__doc__
    assert text.strip().splitlines()[0].endswith(".")
    for section in ("Parameters", "Returns"):
        assert f"    {section}\n    ---" in text
    assert ("References\n    ---" in text) or name not in STATISTICS


@pytest.mark.parametrize("name", ALL)
def test_truth_itself_scores_ideal(name, truth):
    value = METRICS[name].build(truth)(DepthMap(truth.range_m))
    assert isinstance(value, float)
    # Only the mean inside a correlation rounds.
    assert value == pytest.approx(IDEAL[METRICS[name].better], abs=1e-12)


@pytest.mark.parametrize("name", ALL)
def test_float_type_of_the_answer_does_not_matter(name, truth):
    answer = np.round(noisy(truth, 0.05) * 256) / 256
    run = METRICS[name].build(truth)
    values = {run(DepthMap(answer.astype(t))) for t in (np.float16, np.float32, np.float64)}
    assert len(values) == 1


@pytest.mark.parametrize("name", [n for n in ALL if METRICS[n].unit == "m"])
def test_metres_scale_with_the_scene(name, truth):
    answer = plausible(truth)
    once = METRICS[name].build(truth)(answer)
    twice = METRICS[name].build(Truth(2 * truth.range_m))(DepthMap(2 * answer.range_m))
    # Doubling is exact in binary.
    assert twice == 2 * once


# Not asked: bias of the statistics, since a shift moves a histogram without changing its shape,
# and noise of bias_m, since it has mean zero.
# A constant offset leaves coherence at 1 by its purpose: it tests uncalibrated captures.
WORSE = [(name, "bias") for name in ERRORS if name != "coherence"]
WORSE += [(name, "noise") for name in ALL if name != "bias_m"]


@pytest.mark.parametrize(("name", "kind"), WORSE)
def test_a_worse_answer_never_scores_better(name, kind, truth):
    run = METRICS[name].build(truth)
    sizes = (0.0, 0.005, 0.015, 0.04, 0.3, 1.2) if kind == "bias" else (0.0, 0.01, 0.05, 0.4)
    make = {"bias": lambda s: truth.range_m + s, "noise": lambda s: noisy(truth, s)}[kind]
    values = np.array([run(DepthMap(make(size))) for size in sizes])
    worse = -np.diff(values) if METRICS[name].better == "higher" else np.diff(values)
    assert (worse >= 0).all(), values
    # Only the share of answers has no opinion on their quality.
    assert (worse > 0).any() or name == "valid_share", values


@pytest.mark.parametrize("name", ALL)
def test_answers_where_truth_is_unknown_or_masked_do_not_count(name, truth):
    mask = np.zeros(SHAPE, dtype=bool)
    mask[:30, 5:50] = True
    run = METRICS[name].build(truth, mask=mask)
    clean = plausible(truth).range_m
    out = ~mask | np.isnan(truth.range_m)
    expected = run(DepthMap(clean))
    for filling in (0.0, 9.0, np.nan):
        assert run(DepthMap(np.where(out, filling, clean))) == expected
    masked_truth = Truth(np.where(mask, truth.range_m, np.nan))
    assert METRICS[name].build(masked_truth)(DepthMap(clean)) == expected


@pytest.mark.parametrize("name", ALL)
def test_no_answer_at_all_is_never_ideal(name, truth):
    value = METRICS[name].build(truth)(DepthMap(np.full(SHAPE, np.nan)))
    assert value != IDEAL[METRICS[name].better]
    assert np.isnan(value) or name in ("valid_share", "under_1cm", "under_2cm", "under_5cm")


@pytest.mark.parametrize("name", ["valid_share", "under_1cm", "under_2cm", "under_5cm"])
def test_missing_answers_are_counted(name, truth):
    known = np.flatnonzero(np.isfinite(truth.range_m))
    answer = truth.range_m.copy()
    answer.ravel()[known[: known.size // 4]] = np.nan
    share = METRICS[name].build(truth)(DepthMap(answer))
    assert share == pytest.approx(1 - (known.size // 4) / known.size, abs=1e-15)


@pytest.mark.parametrize("name", [n for n in STATISTICS if not n.endswith("pearson")])
def test_leaving_out_a_surface_shows_in_the_statistics(name, truth):
    answer = truth.range_m.copy()
    answer[:, 20:] = np.nan
    full, partly = (METRICS[name].build(truth)(DepthMap(a)) for a in (truth.range_m, answer))
    assert partly > full + 0.01


@pytest.mark.parametrize("name", ALL)
def test_input_is_untouched_and_the_value_repeats(name, truth):
    answer = plausible(truth)
    before = answer.range_m.tobytes(), truth.range_m.tobytes()
    run = METRICS[name].build(truth)
    first = run(answer)
    run(DepthMap(noisy(truth, 1.0)))
    assert first == run(answer) == METRICS[name].build(truth)(answer)
    assert before == (answer.range_m.tobytes(), truth.range_m.tobytes())


@pytest.mark.parametrize("name", ALL)
def test_no_pixel_gives_no_number(name, truth):
    nothing = np.zeros(SHAPE, dtype=bool)
    assert np.isnan(METRICS[name].build(truth, mask=nothing)(plausible(truth)))
    unknown = Truth(np.full(SHAPE, np.nan))
    assert np.isnan(METRICS[name].build(unknown)(plausible(truth)))


@pytest.mark.parametrize("name", ALL)
def test_one_pixel_raises_nothing(name):
    value = METRICS[name].build(Truth([[2.0]]))(DepthMap([[2.5]]))
    assert isinstance(value, float)


@pytest.mark.parametrize("name", ALL)
def test_bad_requests_are_refused(name, truth):
    with pytest.raises(ValueError, match=r"no parameter 'sigma'.*mask"):
        METRICS[name].build(truth, sigma=1)
    with pytest.raises(ValueError, match="shape of the truth"):
        METRICS[name].build(truth)(DepthMap(np.ones((3, 4))))
    with pytest.raises(ValueError, match="mask must be bool"):
        METRICS[name].build(truth, mask=np.ones((3, 4), dtype=bool))
    with pytest.raises(ValueError, match="mask must be bool"):
        METRICS[name].build(truth, mask=np.ones(SHAPE))


@pytest.mark.parametrize(
    ("name", "params", "text"),
    [
        ("median_m", {"q": 101}, "percentile"),
        ("under_1cm", {"limit_m": 0.0}, "limit_m"),
        ("wrap_share", {"ambiguity_m": float("nan")}, "ambiguity_m"),
        ("range_js", {"distribution": "fourier"}, r"one of range, gradient_h.*fourier"),
    ],
)
def test_bad_values_are_refused(name, params, text, truth):
    with pytest.raises(ValueError, match=text):
        METRICS[name].build(truth, **params)
