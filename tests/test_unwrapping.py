"""Unwrapping: kernels against slow twins, noise against bounds, published check values."""

import os
from pathlib import Path

import numpy as np
import pytest
import reference_unwrapping as reference
from reference_unwrapping import planted

from toftools._turns import turns
from toftools.correct._wraps import plan, search
from toftools.correct.crt import crt
from toftools.correct.kde import kde
from toftools.correct.residual_voting import residual_voting
from toftools.correct.single import single
from toftools.crlb import crlb_multi_range_m, crlb_range_m
from toftools.io.open import open_capture
from toftools.phasor import demodulate
from toftools.sensors import sensor as preset
from toftools.sim.noise import clean_taps, expose
from toftools.types import Phasors
from toftools.units import ambiguity_m, joint_ambiguity_m, phase_to_range, range_to_phase

KINECT = "kinect2_nominal"
# Multiples of 20 MHz by square roots: the phases do not meet within 10 000 turns.
NEVER = "opt8241:freqs=20e6+28284271+34641016+44721360+52915026"
FOUR_FREQS = "opt8241:freqs=20e6+50e6+70e6+110e6"


def test_polynomial_angle_is_the_angle():
    rng = np.random.default_rng(0)
    exact = np.concatenate([rng.uniform(0, 1, 2000), np.arange(8) / 8])
    z = (10 ** rng.uniform(-3, 5, exact.size) * np.exp(2j * np.pi * exact)).astype(np.complex64)
    have = np.array([turns(v.real, v.imag) for v in z])
    want = np.mod(np.angle(z.astype(np.complex128)) / (2 * np.pi), 1)
    # Two units in the last place of 1.0: the reductions 1 - a, 1/2 - a and 1/4 - a each round.
    assert np.abs(np.mod(have - want + 0.5, 1) - 0.5).max() < 1.2e-7
    assert turns(np.float32(0), np.float32(0)) == 0


@pytest.mark.parametrize("text", ["deeptof", "opt8241", "pmd", "kinect2", "adtf3175", FOUR_FREQS])
@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
@pytest.mark.parametrize("share", [1.0, 0.55])
def test_walk_finds_what_the_exhaustive_search_finds(text, known, share):
    freqs = preset(text).modulation.freqs_hz
    longest = share * joint_ambiguity_m(freqs)
    walk = plan(preset(text), longest, least_freqs=1, method="x")
    truth = np.random.default_rng(1).uniform(0, longest, (2, 15))
    truth[0, :4] = (0.0, 0.01, longest - 0.01, longest)  # noise carries these over the ends
    frame = planted(text, truth, snr=12.0, known=known, seed=2)
    found = search(frame, walk, top=1)
    for at in np.ndindex(truth.shape):
        sigma = None if frame.sigma is None else frame.sigma[:, *at]
        range_m, cost = reference.exhaustive(frame.values[:, *at], sigma, freqs, longest)
        # float32: 2e-7 of the joint ambiguity, and phases of 6e-8 turns times the SNR in the cost.
        assert abs(found.range_m[0][at] - range_m) < 2e-5
        assert abs(found.cost[0][at] - cost) < 1e-3 * (1 + cost)


def test_walk_is_the_numpy_walk_pixel_by_pixel():
    truth = np.random.default_rng(3).uniform(0.1, 18.6, (40, 70))  # not a multiple of the block
    frame = planted(KINECT, truth, snr=3.0)
    longest = joint_ambiguity_m(preset(KINECT).modulation.freqs_hz)
    want = reference.numpy_crt(
        frame.values, frame.sigma, preset(KINECT).modulation.freqs_hz, longest
    )
    have = crt(preset(KINECT))(frame).range_m
    off = np.abs(have - want) > 1e-4
    # At such noise two candidates can tie within the rounding of float32; nothing else differs.
    assert off.mean() < 1e-3


def test_runner_up_is_the_next_wrap_of_the_highest_frequency():
    frame = planted("opt8241", np.full((1, 1), 5.0), snr=1e4)
    found = search(frame, plan(preset("opt8241"), 0, least_freqs=1, method="x"), top=8)
    assert (np.diff(found.cost[:, 0, 0]) >= 0).all()
    assert found.range_m[0, 0, 0] == pytest.approx(5.0, abs=1e-3)
    assert np.unique(np.round(found.range_m[:7, 0, 0], 1)).size == 7


def test_range_ends_as_documented():
    whole, short = crt(preset("opt8241")), crt(preset("opt8241"), max_range_m=5.0)
    longest = joint_ambiguity_m(preset("opt8241").modulation.freqs_hz)
    before_zero = planted("opt8241", np.full((1, 1), -0.02), snr=1e5)
    assert whole(before_zero).range_m[0, 0] == pytest.approx(longest - 0.02, abs=1e-4)
    assert short(before_zero).range_m[0, 0] == 0
    beyond = planted("opt8241", np.full((1, 1), 5.01), snr=1e5)
    assert short(beyond).range_m[0, 0] == 5
    far = planted("opt8241", np.full((1, 1), 14.0), snr=20.0)
    assert whole(far).range_m[0, 0] == pytest.approx(14.0, abs=0.1)
    assert short(far).info["residual"][0, 0] > 100  # nothing within 5 m explains it, and it says so


@pytest.mark.parametrize("freqs", ["100e6+101e6", "60e6+61e6", "50.5e6+100e6"])
@pytest.mark.parametrize("max_range_m", [0.0, 10.0, 100.0, 1000.0])
def test_frequencies_close_together_reach_as_far_as_their_beat(freqs, max_range_m):
    text = f"opt8241:freqs={freqs}"
    truth = np.linspace(0.01, min(max_range_m or 149.0, 149.0), 300).reshape(10, 30)
    depth = crt(preset(text), max_range_m=max_range_m)(planted(text, truth, snr=1e6))
    # float32 of 149 m is 8e-6 m, and noise of 1e-6 far less.
    assert np.abs(depth.range_m - truth).max() < 1e-4


def test_a_given_limit_is_cut_only_by_an_exact_repetition():
    near, exact = preset("kinect2"), preset(KINECT)  # repeat nearly at 18.67, exactly at 18.74 m
    assert plan(near, 25.0, least_freqs=1, method="x").max_range_m == 25.0
    assert plan(near, 0.0, least_freqs=1, method="x").max_range_m == pytest.approx(18.67, abs=0.01)
    assert plan(exact, 25.0, least_freqs=1, method="x").max_range_m == pytest.approx(
        18.737, abs=1e-3
    )
    truth = np.linspace(0.1, 24.9, 100).reshape(10, 10)
    depth = crt(near, max_range_m=25.0)(planted("kinect2", truth, snr=1000.0))
    assert np.abs(depth.range_m - truth).max() < 0.01


# --- Noise against bounds -----------------------------------------------------------------------


def exposed(text, charge_e, n=20_000):
    """Truth and noisy phasors of lone returns whose phases are uniform at every frequency."""
    sensor = preset(f"{text},width={n // 100},height=100")
    freqs = sensor.modulation.freqs_hz
    longest = joint_ambiguity_m(freqs)
    truth = (np.arange(n).reshape(sensor.camera.shape) + 0.5) / n * longest
    light = lambda f: charge_e * np.exp(1j * range_to_phase(truth, f))  # noqa: E731
    taps = expose(clean_taps(light, 0.0, sensor), sensor, np.random.default_rng(5))
    return sensor, truth, demodulate(taps, sensor)


def circular_std(error_m, period_m):
    off = np.mod(error_m + period_m / 2, period_m) - period_m / 2
    assert abs(off.mean()) < 4 * off.std() / np.sqrt(off.size)  # no bias
    return off.std()


SCHEMES = {3: "three_step", 4: "four_step", 8: "eight_step"}
# The standard error of a standard deviation of n is 1 / sqrt(2 n): 0.5 % here, so the 3 % asked
# for are six of them.


@pytest.mark.parametrize("contrast", [0.2, 0.8])
@pytest.mark.parametrize("n_taps", [3, 4, 8])
def test_demodulation_reaches_the_bound(contrast, n_taps):
    text = f"mlx75027:steps={SCHEMES[n_taps]},contrast={contrast},read_e=20"
    sensor, truth, phasors = exposed(text, 5000.0)
    freq = float(sensor.modulation.freqs_hz[0])
    measured = phase_to_range(np.angle(phasors.values[0]), freq)
    bound = crlb_range_m(freq, contrast * 5000, 5000, read_e=20.0, n_taps=n_taps)
    assert circular_std(measured - truth, ambiguity_m(freq)) == pytest.approx(bound, rel=0.03)


@pytest.mark.parametrize("contrast", [0.2, 0.8])
@pytest.mark.parametrize("n_taps", [3, 4, 8])
def test_crt_reaches_the_bound(contrast, n_taps):
    text = f"{KINECT}:steps={SCHEMES[n_taps]},contrast={contrast},read_e=20"
    sensor, truth, phasors = exposed(text, 20_000.0)
    freqs = sensor.modulation.freqs_hz
    variance = 2 * (20_000 + 20**2) / n_taps
    bound = crlb_multi_range_m(freqs, np.full(3, contrast * 20_000 / np.sqrt(variance)))
    depth = crt(sensor)(phasors)
    error = circular_std(depth.range_m - truth, joint_ambiguity_m(freqs))
    assert error == pytest.approx(bound, rel=0.03)
    # What it says about itself: the mean variance, for it follows each pixel's own shot noise.
    assert np.sqrt(np.mean(depth.sigma_m**2)) == pytest.approx(bound, rel=0.03)
    # Chi-squared of F - 1 = 2 degrees of freedom; its mean is uncertain by 2 / sqrt(n).
    assert depth.info["residual"].mean() == pytest.approx(2.0, rel=0.03)


def test_crt_says_the_bound_of_every_pixel():
    truth = np.linspace(0.5, 18.0, 60).reshape(6, 10)
    frame = planted(KINECT, truth, snr=50.0)
    freqs = preset(KINECT).modulation.freqs_hz
    bound = crlb_multi_range_m(freqs, np.abs(frame.values) / frame.sigma)
    assert np.allclose(crt(preset(KINECT))(frame).sigma_m, bound, rtol=1e-5)  # float32 sums


@pytest.mark.parametrize(("amplitude_e", "figure_mm"), [(400, 31.7), (1600, 7.88)])
def test_noise_is_that_of_an_independent_simulation(amplitude_e, figure_mm):
    # 60 MHz, 4 taps, B = 2000 electrons, no read noise; formula 31.4 and 7.86 mm.
    text = f"mlx75027:contrast={amplitude_e / 2000},read_e=0"
    _, truth, phasors = exposed(text, 2000.0)
    measured = phase_to_range(np.angle(phasors.values[0]), 60e6)
    spread_mm = 1e3 * circular_std(measured - truth, ambiguity_m(60e6))
    assert spread_mm == pytest.approx(figure_mm, rel=0.03)
    assert 1e3 * crlb_range_m(60e6, amplitude_e, 2000) == pytest.approx(figure_mm, rel=0.012)


@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
def test_crt_confidence_ranks_wrong_wraps_last(known):
    truth = np.random.default_rng(6).uniform(0.5, 18.0, (80, 100))
    snr = np.geomspace(1.0, 20.0, 100)  # per column
    frame = planted(KINECT, truth, snr=snr, known=False, seed=7)
    sigma = np.broadcast_to(1 / snr, frame.values.shape).astype(np.float32)
    depth = crt(preset(KINECT))(Phasors(frame.values, sigma if known else None))
    wrong = (np.abs(depth.range_m - truth) > 0.3).reshape(-1)
    order = np.argsort(-depth.confidence.reshape(-1))
    best_half = wrong[order[: order.size // 2]].mean()
    assert 0.1 < wrong.mean() < 0.6
    # Chance would leave the overall rate in the better half.
    assert best_half < (0.1 if known else 0.4) * wrong.mean()


def test_crt_confidence_ranks_multipath_by_its_residual():
    text, shape = KINECT, (60, 80)
    freqs, rng = preset(text).modulation.freqs_hz[:, None, None], np.random.default_rng(13)
    truth, extra, ratio = (rng.uniform(lo, hi, shape) for lo, hi in ((0.5, 9), (0.3, 3), (0, 0.6)))
    frame = planted(text, truth, snr=20.0)
    second = ratio * np.exp(1j * range_to_phase(truth + extra, freqs))
    frame = Phasors((frame.values + second).astype(np.complex64), frame.sigma)
    depth = crt(preset(text))(frame)
    error = np.abs(depth.range_m - truth).reshape(-1)

    def area(trust):
        return (np.cumsum(error[np.argsort(-trust)]) / np.arange(1, error.size + 1)).mean()

    found = search(frame, plan(preset(text), 0, least_freqs=1, method="x"), top=2)
    margin = (found.cost[1] - found.cost[0]).reshape(-1)
    chance = area(rng.random(error.size))
    assert area(depth.confidence.reshape(-1)) < 0.9 * area(margin) < 0.9 * chance


def test_one_frequency_stays_below_its_ambiguity():
    # A phase of minus nothing is a whole turn in float32; the interval is half open.
    almost = np.exp(-1j * np.geomspace(1e-9, 1e-6, 20)).astype(np.complex64)
    depth = single(preset("deeptof"))(Phasors(almost[None, None]))
    assert (depth.range_m < ambiguity_m(20e6)).all()
    assert depth.range_m.max() > ambiguity_m(20e6) - 1e-5


# --- Published frames ---------------------------------------------------------------------------


def su2018(name):
    folder = os.environ.get("TOFTOOLS_DATA")
    if not folder:
        pytest.skip("needs the su2018 frames: set TOFTOOLS_DATA")
    path = Path(folder) / name
    if not path.exists():
        pytest.skip(f"TOFTOOLS_DATA has no {name}")
    return open_capture(path)


PUBLISHED_CM = {"000001": 11.32, "000002": 3.13, "000003": 41.24}


@pytest.mark.parametrize("frame", PUBLISHED_CM)
def test_published_unwrapping_error(frame):
    capture = su2018(f"su2018_synth_40_70MHz/im_pair_{frame}.mat")
    truth = capture.truth.range_m
    used = (truth > 0.1) & (truth < 9.9) & capture.phasors.valid
    with np.errstate(invalid="ignore"):
        plain = reference.plain_crt(capture.phasors.values, [40e6, 70e6], (3, 5))
    assert 100 * np.abs(plain - truth)[used].mean() == pytest.approx(PUBLISHED_CM[frame], abs=0.006)
    depth = crt(capture.sensor, max_range_m=10.7)(capture.phasors)
    # The published search counts wraps, 3 and 5; ours confines the range to five wraps at 70 MHz.
    # In 20 of 76 800 pixels of frame 3 that decides for other wraps: 0.1 cm of its 41.
    mae_cm = 100 * np.abs(depth.range_m - truth)[used].mean()
    assert mae_cm == pytest.approx(PUBLISHED_CM[frame], abs=0.1)


@pytest.mark.parametrize("name", ["0122_pix2pix_test_real_4", "0714_pix2pix_test_real_0"])
def test_camera_distance_is_reproduced(name):
    capture = su2018(f"su2018_tintin_40_70MHz/im_pair_{name}.mat")
    camera = capture.depth.range_m
    used = (camera > 0.1) & (camera < 9.9) & capture.phasors.valid
    error = np.abs(crt(capture.sensor, max_range_m=10.7)(capture.phasors).range_m - camera)[used]
    assert np.median(error) == pytest.approx(0.005, abs=3e-4)  # the camera rounds to 2 cm
    assert (error > 0.5).mean() < 1e-3


# --- Bad parameters -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "params", "text"),
    [
        (crt, {"max_range_m": -1.0}, "opt8241"),
        (crt, {"max_range_m": np.inf}, "opt8241"),
        (crt, {"max_range_m": 0.0}, NEVER),
        (kde, {"window_px": 4}, KINECT),
        (kde, {"hypotheses": 0}, KINECT),
        (kde, {"bandwidth_m": 0.0}, KINECT),
        (kde, {"threshold": 1.5}, KINECT),
        (residual_voting, {"lax_rad": -0.1}, KINECT),
        (residual_voting, {}, "opt8241:freqs=20e6+20e6+50e6"),
    ],
)
def test_bad_parameters_are_one_sentence(make, params, text):
    with pytest.raises(ValueError, match=r"wanted|must|needs|takes|be positive") as caught:
        make(preset(text), **params)
    assert "\n" not in str(caught.value)


def test_incommensurate_frequencies_work_up_to_a_given_range():
    truth = np.linspace(0.1, 9.9, 100).reshape(10, 10)
    depth = crt(preset(NEVER), max_range_m=10.0)(planted(NEVER, truth, snr=100.0))
    assert np.abs(depth.range_m - truth).max() < 0.05
