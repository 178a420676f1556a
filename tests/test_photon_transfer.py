"""Noise against its own statistics: photon transfer as EMVA 1288 does it, sigma, bounds."""

import numpy as np
import pytest

from toftools.crlb import (
    crlb_taps_range_m,
    demodulation_efficiency,
    fisher_phase_exact,
)
from toftools.phasor import SCHEMES, demodulate, wrapped_range_m
from toftools.sensors import sensor
from toftools.sim.noise import capture_taps, expose
from toftools.units import ambiguity_m

SIDE = 64


def pairs(device, levels_e, seed):
    """Mean and temporal variance at each level from two images: patterns drop out of differences.

    As EMVA Standard 1288, Release 4.0 Linear, measures temporal noise.
    """
    rng, shape = np.random.default_rng(seed), (1, device.modulation.n_taps, SIDE, SIDE)
    mean, variance = [], []
    for level in levels_e:
        one, two = (expose(np.full(shape, level), device, rng).values.astype(float) for _ in "ab")
        mean.append((one.mean() + two.mean()) / 2)
        variance.append(np.mean((one - two) ** 2) / 2 - (one.mean() - two.mean()) ** 2 / 2)
    return np.array(mean), np.array(variance), int(np.prod(shape))


def line(x, y, y_error):
    """Weighted straight line: (slope, intercept) and their standard errors."""
    basis = np.stack([x, np.ones_like(x)], axis=1) / y_error[:, None]
    covariance = np.linalg.inv(basis.T @ basis)
    return covariance @ basis.T @ (y / y_error), np.sqrt(np.diag(covariance))


@pytest.mark.parametrize(
    ("keys", "gain", "read_e", "step"),
    [
        ("read_e=20", 1.0, 20.0, 0),
        ("read_e=20,dn_per_e=0.05", 0.05, 20.0, 1),
        ("read_e=12,full_well_e=40000,adc_bits=10", 1023 / 40000, 12.0, 1),
        ("read_e=15,dark_e=800,dn_per_e=0.1", 0.1, 15.0, 1),
        ("read_e=15,dn_per_e=0.1,prnu=0.05,dsnu_e=40,dark_e=400,fppn_rad=0.3", 0.1, 15.0, 1),
    ],
    ids=["electrons", "numbers", "adc", "dark", "patterns"],
)
def test_variance_against_mean_is_a_line_with_the_gain_as_slope(keys, gain, read_e, step):
    device = sensor(f"deeptof:width={SIDE},height={SIDE},{keys}")
    mean, variance, n = pairs(device, np.linspace(200, 20_000, 15), seed=1)
    expected = gain * mean + (gain * read_e) ** 2 + step / 12
    error = expected * np.sqrt(2 / n)
    assert np.sum(((variance - expected) / error) ** 2) < 15 + 4 * np.sqrt(2 * 15)  # chi squared
    (slope, offset), (slope_error, offset_error) = line(mean, variance, error)
    assert abs(slope - gain) < 4 * slope_error < 0.02 * gain
    assert abs(offset - (gain * read_e) ** 2 - step / 12) < 4 * offset_error


def test_the_dark_image_has_the_noise_of_the_dark_charge():
    device = sensor(f"deeptof:width={SIDE},height={SIDE},read_e=10,dark_e=300,dn_per_e=0.2")
    mean, variance, n = pairs(device, [0.0], seed=2)
    expected = 0.2**2 * (10**2 + 300) + 1 / 12
    assert abs(variance[0] / expected - 1) < 4 * np.sqrt(2 / n)
    assert abs(mean[0] - 0.2 * 300) < 4 * np.sqrt(expected / (2 * n))


def test_saturation_bends_the_line_down():
    device = sensor(f"deeptof:width={SIDE},height={SIDE},read_e=5,full_well_e=10000,dn_per_e=0.1")
    mean, variance, n = pairs(device, [5000, 9000, 9950, 10_050, 12_000], seed=3)
    expected = 0.1 * mean + 0.5**2 + 1 / 12
    z = (variance / expected - 1) / np.sqrt(2 / n)
    assert (np.abs(z[:2]) < 4).all()
    assert (z[2:] < -20).all()
    assert variance[4] == pytest.approx(0.5**2 + 1 / 12, rel=4 * np.sqrt(2 / n))  # read noise only


def test_spatial_patterns_have_the_spread_they_claim():
    text = f"deeptof:width={SIDE},height={SIDE},prnu=0.02,dsnu_e=60,dark_e=500"
    device = sensor(text)
    shape = (1, 4, SIDE, SIDE)
    dark = expose(np.zeros(shape), device, None).values[0, 0]
    light = capture_taps(lambda _f: np.full((SIDE, SIDE), 1e4 + 0j), 0, device, seed=None)
    spread = (light.values[0].mean(0) - dark) / 1e4  # the four taps average to the offset
    se = np.sqrt(1 / (2 * SIDE**2))
    assert abs(spread.std() / 0.02 - 1) < 4 * se
    assert abs(dark.std() / 60 - 1) < 4 * se
    assert abs(spread.mean() - 1) < 4 * 0.02 / SIDE
    assert abs(dark.mean() - 500) < 4 * 60 / SIDE


TERMS = {
    "shot": "",
    "three taps": "steps=three_step",
    "read": "read_e=60",
    "dark": "dark_e=6000",
    "dsnu": "dark_e=2000,dsnu_e=600",
    "prnu": "prnu=0.2",
    "fppn": "fppn_rad=1",
    "drift": "temperature_c=60,drift_rad_per_k=0.02,drift_gain_per_k=-0.01",
    "quantised": "full_well_e=40000,adc_bits=8,read_e=10",
    # Bright enough that steps of the codes, N / 128 at most, add up to 1 / 4 of the variance.
    "companded": "full_well_e=160000,companding=kinect2,read_e=10,signal_e=120000",
    "scatter": "scatter=0.2,scatter_px=5",
    "two-tap": "steps=ab_four_step,taps_per_exposure=2,ab_gain=0.2",
    "heterodyne": "beat_hz=30",
    "square": "waveform=square,contrast=0.7",
    "low contrast": "contrast=0.2",
    "all": "steps=ab_three_step,taps_per_exposure=2,ab_gain=0.1,prnu=0.1,dark_e=500,dsnu_e=100,"
    "read_e=30,full_well_e=40000,adc_bits=9,scatter=0.1,fppn_rad=0.3,waveform=trapezoid",
}


@pytest.mark.parametrize("name", TERMS)
def test_sigma_is_the_scatter_whatever_the_term(name):
    device = sensor(f"deeptof:width={SIDE},height={SIDE},{TERMS[name]}")
    rng = np.random.default_rng(4)
    angle = rng.uniform(0, 2 * np.pi, (SIDE, SIDE))
    charge = rng.uniform(0.15, 0.5, (SIDE, SIDE)) * device.noise.signal_e
    shots = [
        demodulate(
            capture_taps(
                lambda f: charge * np.exp(1j * angle * f / 20e6), 2000.0, device, seed=seed
            ),
            device,
        )
        for seed in range(8)
    ]
    z = np.stack([shot.values[0] for shot in shots]).astype(np.complex128)
    assert all(shot.valid.all() for shot in shots)
    mean = z.mean(axis=0)
    across = ((z - mean) * np.exp(-1j * np.angle(mean))).imag
    variance = np.mean([shot.sigma[0].astype(float) ** 2 for shot in shots], axis=0)
    ratio = (across**2).sum(axis=0) / variance
    # Each pixel is chi squared of 7 degrees: relative variance 2 / 7.
    n = 7 * SIDE**2
    assert abs(ratio.sum() / n - 1) < 4 * np.sqrt(2 / n)


@pytest.mark.parametrize("n_taps", [3, 4, 8])
@pytest.mark.parametrize("read_e", [0.0, 30.0])
def test_range_deviates_by_the_bound_over_the_root_of_the_efficiency(n_taps, read_e):
    steps = SCHEMES[{3: "three_step", 4: "four_step", 8: "eight_step"}[n_taps]]
    n, amplitude, offset = 20_000, 1600.0, 2000.0
    device = sensor(
        f"deeptof:freqs=60e6,width={n},height=1,read_e={read_e},contrast={amplitude / offset}"
        f",steps={'+'.join(map(str, steps))}"
    )
    for angle in (0.3, 1.2, 2.8, 4.0):
        light = np.full((1, n), offset * np.exp(1j * angle))
        taps = capture_taps(lambda f, z=light: z if f else np.abs(z), 0.0, device, seed=7)
        range_m = wrapped_range_m(demodulate(taps, device).values, [60e6])
        bound = crlb_taps_range_m(60e6, amplitude, offset, angle, steps, read_e=read_e)
        efficiency = demodulation_efficiency(amplitude, offset, angle, steps, read_e=read_e)
        expected = float(bound / np.sqrt(efficiency))
        # Terms of second order in 1 / SNR^2 = 4e-4 add to the standard error of the variance.
        assert abs(range_m.var() / expected**2 - 1) < 4 * np.sqrt(2 / n) + 2e-3
        wanted = angle / (2 * np.pi) * ambiguity_m(60e6)
        assert abs(range_m.mean() - wanted) < 4 * expected / np.sqrt(n) + 2e-5


def test_efficiency_meets_its_closed_forms():
    angle = np.linspace(0, 2 * np.pi, 25)
    three, four = SCHEMES["three_step"], SCHEMES["four_step"]
    for contrast in (0.2, 0.5, 0.8):
        own = [demodulation_efficiency(contrast * 2000, 2000, angle, s) for s in (three, four)]
        assert np.allclose(own[0], 1, rtol=1e-12)
        assert np.allclose(own[1], 1 - contrast**2 / 2 * np.sin(2 * angle) ** 2, rtol=1e-12)
        many = demodulation_efficiency(
            contrast * 2000, 2000, angle, np.arange(64) * (2 * np.pi / 64)
        )
        limit = 2000 * contrast**2 / 2 / fisher_phase_exact(contrast * 2000, 2000, n_taps=1)
        assert np.allclose(many, limit, rtol=1e-9)
