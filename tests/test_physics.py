"""Simulation against closed forms and published figures; noise against its own statistics."""

import numpy as np
import pytest

from toftools.crlb import crlb_multi_range_m, crlb_range_m, crlb_returns_m, fisher_phase_exact
from toftools.phasor import demodulate, modulate, phase, wrapped_range_m
from toftools.sensors import sensor
from toftools.sim.analytic import SCENES, analytic
from toftools.sim.dihedral import Wall, _gather, one_bounce
from toftools.sim.shapes import cavity_bounce
from toftools.types import Scene, Shot, Taps
from toftools.units import ambiguity_m, path_to_phase

TINY = "deeptof:width=8,height=6"


def shoot(scene, text=TINY, *, noisy=False, seed=0, max_bounces=None, **params):
    shot = Shot(sensor(text), seed=seed, noisy=noisy, max_bounces=max_bounces)
    return analytic(Scene(scene, params))(shot)


@pytest.mark.parametrize(
    ("albedo", "freq_mhz", "range_m"),
    [(0.3, 20, 2.33019), (0.3, 50, 2.01688), (0.3, 100, 0.51194),
     (0.8, 20, 2.92484), (0.8, 50, 2.03599), (0.8, 100, 0.53269)],
)  # fmt: skip
def test_sphere_cavity_reads_the_ranges_of_the_closed_form(albedo, freq_mhz, range_m):
    # Figures computed independently for research/simulators.md 3.1 and met by another renderer.
    capture = shoot("cavity", f"{TINY},freqs={freq_mhz}e6", radius=2.0, albedo=albedo)
    measured = wrapped_range_m(capture.phasors.values, [freq_mhz * 1e6])
    assert np.abs(measured - range_m).max() < 1e-5


def test_cavity_bounce_is_the_integral_over_chords():
    for freq_hz in (1e3, 1e5, 20e6, 120e6):
        chord = np.linspace(0, 4.0, 200_001)
        turn = np.exp(1j * path_to_phase(chord, freq_hz))
        numeric = np.trapezoid(chord / 8.0 * turn, chord)
        assert abs(cavity_bounce(2.0, freq_hz) - numeric) < 1e-8


def test_cavity_bounces_sum_to_the_whole():
    whole = shoot("cavity", albedo=0.5).phasors.values
    parts = [shoot("cavity", albedo=0.5, max_bounces=n).phasors.values for n in (0, 5, 40)]
    errors = [np.abs(part - whole).max() / np.abs(whole).max() for part in parts]
    assert errors[0] > 0.1 > 0.02 > errors[1]
    assert errors[2] < 1e-6  # float32
    direct = shoot("cavity", albedo=0.5).truth.direct
    assert np.allclose(direct, parts[0], rtol=1e-5)


def howell_perpendicular(s, half_height, size):
    """Form factor of an element at `s` from the edge to a perpendicular rectangle, both halves."""
    x, y = s / half_height, size / half_height
    root = np.hypot(x, y)
    return (np.arctan(1 / x) - x / root * np.arctan(1 / root)) / np.pi


@pytest.mark.parametrize("s", [1e-3, 0.1, 0.5, 1.0, 1.9])
def test_corner_quadrature_gives_howells_form_factor(s):
    walls = [Wall.open(side, 2.0, 90.0, 2.0, 3.0) for side in (1, -1)]
    at = (walls[0].origin + s * walls[0].out)[None]
    factor = _gather(at, *walls, lambda p: np.ones(p.shape[:-1]), 0.0)[0]
    assert factor.imag == 0
    assert factor.real == pytest.approx(howell_perpendicular(s, 1.5, 2.0), rel=1e-8)


def test_corner_quadrature_against_monte_carlo():
    # z-test with a fixed seed: uniform points on the source wall are an unbiased estimate.
    walls = [Wall.open(side, 2.0, 75.0, 2.0, 3.0) for side in (1, -1)]
    at = (walls[0].origin + 0.8 * walls[0].out)[None] + np.array([0, 0.4, 0])
    exact = one_bounce(at, *walls, 0.6, 70e6)[0]
    rng = np.random.default_rng(3)
    n, source = 400_000, walls[1]
    v = source.origin + rng.uniform(0, 2, (n, 1)) * source.out
    v[:, 1] += rng.uniform(-1.5, 1.5, n)
    away = v - at
    r = np.linalg.norm(away, axis=1)
    squared = (v**2).sum(1)
    emitted = 0.6 * (-v @ source.normal) / squared**1.5
    kernel = (away @ walls[0].normal) * -(away @ source.normal) / (np.pi * r**4)
    path = np.sqrt(squared) + r + np.linalg.norm(at)
    sample = 6.0 * emitted * kernel * np.exp(1j * path_to_phase(path, 70e6))
    for part in (np.real, np.imag):
        z = (part(sample).mean() - part(exact)) / (part(sample).std() / np.sqrt(n))
        assert abs(z) < 4


def test_corner_is_symmetric_and_direct_light_is_the_truth():
    capture = shoot("corner", "deeptof:width=24,height=12", range=2.0, angle=100.0)
    truth, z = capture.truth.range_m, capture.phasors.values[0]
    assert np.allclose(truth, truth[:, ::-1], equal_nan=True, atol=1e-6)
    assert np.allclose(z, z[:, ::-1], rtol=1e-5)
    direct = wrapped_range_m(capture.truth.direct, [20e6])[0]
    assert np.nanmax(np.abs(direct - truth)) < 2e-6
    assert np.nanmin(wrapped_range_m(z[None], [20e6])[0] - truth) > 0.01  # corners read too far
    no_bounce = shoot("corner", "deeptof:width=24,height=12", range=2.0, angle=100.0, max_bounces=0)
    assert np.allclose(no_bounce.phasors.values, capture.truth.direct, rtol=1e-4)


def test_two_returns_add_as_phasors():
    capture = shoot("two_returns", range=2.0, extra=0.7, ratio=0.3)
    ratio = capture.phasors.values / capture.truth.direct
    assert np.allclose(ratio, 1 + 0.3 * np.exp(1j * path_to_phase(1.4, 20e6)), rtol=1e-5)


def test_returns_are_a_geometric_sum():
    capture = shoot("returns", count=4, range=2.0, extra=0.7, ratio=0.3)
    later = 0.3 * np.exp(1j * path_to_phase(1.4, 20e6))
    ratio = capture.phasors.values / capture.truth.direct
    assert np.allclose(ratio, (1 - later**4) / (1 - later), rtol=1e-5)
    assert np.allclose(capture.truth.one_bounce / capture.truth.direct, later, rtol=1e-4)
    two = shoot("returns", count=2, range=2.0, extra=0.7, ratio=0.3)
    same = shoot("two_returns", range=2.0, extra=0.7, ratio=0.3)
    assert np.array_equal(two.phasors.values, same.phasors.values)


@pytest.mark.parametrize(
    ("scheme", "peak_deg"),
    [("four_step", 4.0746), ("three_step", 1.1170), ("eight_step", 0.4595)],
)
def test_square_waves_wiggle_as_published(scheme, peak_deg):
    text = f"deeptof:width=1,height=1,hfov_deg=1,steps={scheme},waveform=square"
    error = []
    for range_m in np.linspace(0.5, 0.5 + ambiguity_m(20e6) / 4, 241):
        capture = shoot("wall", text, range=float(range_m))
        exact = path_to_phase(2 * capture.truth.range_m, 20e6)
        error.append(np.angle(np.exp(1j * (phase(capture.phasors.values)[0] - exact)))[0, 0])
    assert np.degrees(np.abs(error).max()) == pytest.approx(peak_deg, abs=0.01)


def test_taps_have_shot_plus_read_noise():
    # Photon transfer: variance against mean is a line of slope 1 with the read noise as offset.
    text = "deeptof:width=64,height=64,hfov_deg=1,read_e=30"
    shots = [shoot("wall", text, noisy=True, seed=s).taps.values.astype(float) for s in range(8)]
    clean = shoot("wall", text).taps.values.astype(float)
    residual = np.stack(shots) - clean
    for k in range(4):
        expected = clean[0, k].mean() + 30.0**2
        n = residual[:, 0, k].size
        z = (residual[:, 0, k].var() / expected - 1) / np.sqrt(2 / n)
        assert abs(z) < 4
        assert abs(residual[:, 0, k].mean()) < 4 * np.sqrt(expected / n)


def test_phasor_sigma_is_what_the_noise_does():
    text = "opt8241:width=64,height=48,hfov_deg=1,read_e=30"
    shots = [shoot("wall", text, noisy=True, seed=s, range=1.5).phasors for s in range(12)]
    stack = np.stack([s.values for s in shots])
    spread = (stack - stack.mean(0)).astype(np.complex128)
    for part in (np.real, np.imag):
        measured = (part(spread) ** 2).sum(0) / 11
        ratio = measured.mean(axis=(1, 2)) / (shots[0].sigma.astype(float) ** 2).mean(axis=(1, 2))
        assert np.abs(ratio - 1).max() < 4 * np.sqrt(2 / (11 * 64 * 48))


EIGHT_UNEVEN = "0+0.7+1.5+2.4+3.1+4.0+4.4+5.9"


@pytest.mark.parametrize(
    ("steps", "n_degrees"), [("three_step", 24), ("four_step", 9), (EIGHT_UNEVEN, 24)]
)
def test_sigma_is_the_scatter_across_the_phasor(steps, n_degrees):
    device = sensor(f"deeptof:width=20000,height=1,steps={steps},read_e=20")
    modulation, rng = device.modulation, np.random.default_rng(11)
    for angle in np.arange(n_degrees) * (2 * np.pi / n_degrees):
        z = np.full((1, 1, 20_000), 1600 * np.exp(1j * angle))
        clean = modulate(z, 2000.0, modulation.steps_rad)
        noisy = rng.poisson(clean) + 20 * rng.standard_normal(clean.shape)
        predicted = demodulate(Taps(clean), device).sigma[0, 0, 0]
        found = demodulate(Taps(noisy), device)
        across = (found.values[0, 0] * np.exp(-1j * angle)).imag.astype(float)
        # The standard error of a variance of n is sqrt(2 / n); 57 draws, so 4 of them.
        assert abs((across**2).mean() / predicted**2 - 1) < 4 * np.sqrt(2 / across.size)
        # Each pixel's own noisy taps predict it as well: unbiased but for terms of 1 / A^2.
        own = (found.sigma.astype(float) ** 2).mean() / predicted**2 - 1
        assert abs(own) < 0.003


def test_sigma_of_three_taps_is_the_closed_form():
    device = sensor("deeptof:width=60,height=1,steps=three_step,read_e=20")
    angle = np.arange(60) * (2 * np.pi / 60)
    taps = Taps(
        modulate(1600 * np.exp(1j * angle)[None, None], 2000.0, device.modulation.steps_rad)
    )
    expected = 2 / 3 * (2000 + 20**2 - 800 * np.cos(3 * angle))
    assert np.allclose(demodulate(taps, device).sigma[0, 0] ** 2, expected, rtol=2e-6)
    dark = Taps(np.array([-5.0, np.inf, np.nan, 0.0] * 45).reshape(1, 3, 1, 60))
    assert demodulate(dark, device).sigma.shape == (1, 1, 60)


@pytest.mark.parametrize("scheme", ["four_step", "eight_step", "four_step_0_180_90_270"])
def test_sigma_of_equispaced_taps_is_that_of_either_part(scheme):
    device = sensor(f"opt8241:width=40,height=30,steps={scheme},read_e=20")
    n = device.modulation.n_taps
    taps = Taps(np.random.default_rng(12).poisson(3000, (2, n, 30, 40)))
    expected = np.sqrt(2 * (taps.values.astype(float).mean(axis=1) + 20**2) / n)
    assert np.allclose(demodulate(taps, device).sigma, expected, rtol=1e-6)


def test_saturated_pixels_are_invalid_and_dn_taps_are_whole_numbers():
    capture = shoot("wall", f"{TINY},full_well_e=2000,dn_per_e=0.1", noisy=True, range=0.7)
    assert not capture.taps.valid.any()
    capture = shoot("wall", f"{TINY},full_well_e=90000,dn_per_e=0.1", noisy=True, range=0.7)
    assert capture.taps.valid.all()
    assert capture.taps.unit == "DN"
    assert (capture.taps.values == np.round(capture.taps.values)).all()
    assert capture.phasors.sigma is not None
    unknown = shoot("wall", TINY, range=0.7)
    from dataclasses import replace

    assert demodulate(replace(unknown.taps, unit="DN"), unknown.sensor).sigma is None


def test_same_seed_same_bits_other_seed_other_noise():
    one, two, other = (shoot("wall", noisy=True, seed=s).taps.values for s in (5, 5, 6))
    assert (one == two).all()
    assert (one != other).any()


def test_light_is_linear_in_source_power():
    weak, strong = (shoot("corner", f"{TINY},signal_e={e}").phasors.values for e in (1000, 3000))
    assert np.allclose(strong, 3 * weak, rtol=1e-5)


def test_crlb_formulas_meet_the_figures_checked_by_simulation():
    # research/mpi.md 4.2: formula 7.86 mm and exact bound 7.03 mm at A = 1600, B = 2000, 60 MHz.
    assert 1e3 * crlb_range_m(60e6, 1600, 2000) == pytest.approx(7.86, abs=0.005)
    assert 1e3 * crlb_range_m(60e6, 400, 2000) == pytest.approx(31.4, abs=0.05)
    exact = 1 / np.sqrt(fisher_phase_exact(1600, 2000)) * ambiguity_m(60e6) / (2 * np.pi)
    assert 1e3 * exact == pytest.approx(7.03, abs=0.005)
    small = fisher_phase_exact(20, 2000) / (4 * 2000 * 0.01**2 / 2)
    assert small == pytest.approx(1, abs=1e-4)


def test_crlb_of_returns_meets_its_limits():
    freqs = [40e6, 55e6, 70e6]
    lone = crlb_returns_m(freqs, [2.0], [100.0], 1.0)
    assert lone[0] == pytest.approx(crlb_multi_range_m(freqs, [100.0] * 3), rel=1e-9)
    apart = [crlb_returns_m(freqs, [2.0, 2.0 + d], [100.0, 50.0], 1.0)[0] for d in (0.1, 0.2, 0.4)]
    assert apart[0] > apart[1] > apart[2] > lone[0]
    assert apart[0] / apart[1] > 3.5  # the bound blows up as returns merge
    assert np.isinf(crlb_returns_m(freqs, [2.0, 2.0], [1.0, 1.0], 1.0)).all()
    with pytest.raises(ValueError, match="3 returns need as many frequencies, got 2"):
        crlb_returns_m(freqs[:2], [1, 2, 3], [1, 1, 1], 1.0)


@pytest.mark.parametrize("name", SCENES)
def test_bad_scene_parameters_are_one_sentence(name):
    key = "radius" if name == "cavity" else "range"
    for params in ({key: -1.0}, {"albedo": 0.0}, {"colour": 3}, {"ambient_e": -2.0}):
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            shoot(name, **params)
    with pytest.raises(ValueError, match="max_bounces must be 0 or more"):
        shoot(name, max_bounces=-1)
