"""Every term of the sensor model against a slow twin, a closed form or its own definition."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toftools.io.native import read_capture, write_capture
from toftools.phasor import SCHEMES, demodulate
from toftools.sensors import KEYS, sensor
from toftools.sim.analytic import analytic
from toftools.sim.companding import codes_of_file, companded, kinect2_codes
from toftools.sim.defects import pixel_maps
from toftools.sim.noise import (
    capture_moving,
    capture_taps,
    clean_taps,
    contrasts,
    expose,
    light_freqs_hz,
    tap_times_s,
    true_phasors,
)
from toftools.sim.scatter import scattered
from toftools.types import Defects, Modulation, Noise, PixelMaps, Scene, Shot, Timing
from toftools.units import range_to_phase

SMALL = "opt8241:width=12,height=9"
SHAPE = (9, 12)


def scene(seed=0, shape=SHAPE):
    """Light of one return per pixel, and ambient light."""
    rng = np.random.default_rng(seed)
    charge, range_m = rng.uniform(2000, 9000, shape), rng.uniform(0.5, 3.0, shape)

    def light(freq_hz):
        return charge * np.exp(1j * range_to_phase(range_m, freq_hz))

    return light, rng.uniform(0, 3000, shape)


def slow_taps(light, ambient, device):
    """Slow twin of light to electrons: every tap of every pixel by the formula of docs."""
    mod, noise, defects = device.modulation, device.noise, device.defects
    maps, nodes = pixel_maps(device), device.timing.taps_per_exposure
    warm = defects.temperature_c - defects.reference_c
    emitted = 1 + defects.drift_gain_per_k * warm
    top = mod.freqs_hz.max()
    taps = np.empty((mod.n_freqs, mod.n_taps, *device.camera.shape))
    for (i, k, row, column), _ in np.ndenumerate(taps):
        freq = mod.freqs_hz[i]
        drift = np.broadcast_to(defects.drift_rad_per_k, mod.n_freqs)[i] * warm
        if np.size(defects.drift_rad_per_k) == 1:
            drift *= freq / top
        value = 1.0
        for m, weight in enumerate(mod.harmonics[i], start=1):
            z = light(m * freq)[row, column] / light(0.0).real[row, column]
            turned = np.angle(z) + m * (maps.phase_rad[i, row, column] + drift)
            contrast = np.broadcast_to(noise.contrast, mod.n_freqs)[i]
            turned -= m * mod.steps_rad[i, k]
            value += contrast * abs(weight * z) * np.cos(turned + np.angle(weight))
        charge = emitted * light(0.0).real[row, column] * value + ambient[row, column]
        response = maps.gain[k % nodes, row, column]
        if k % nodes == 1:
            response *= 1 + defects.ab_gain
        taps[i, k, row, column] = response * charge + maps.dark_e[k % nodes, row, column]
    return taps


ALL = (
    "waveform=trapezoid,contrast=0.7+0.6,prnu=0.05,dsnu_e=30,dark_e=200,fppn_rad=0.2,ab_gain=0.03,"
    "steps=ab_three_step,taps_per_exposure=2,temperature_c=41,drift_rad_per_k=0.003+0.001,"
    "drift_gain_per_k=-0.004,unit=7"
)


@pytest.mark.parametrize(
    "keys",
    ["", "waveform=square", "prnu=0.1", "fppn_rad=0.1", "fppn_rad=0.1+0.3", "dark_e=50,dsnu_e=90",
     "temperature_c=10,drift_rad_per_k=0.01", ALL],
)  # fmt: skip
def test_taps_are_those_of_the_slow_twin(keys):
    device = sensor(f"{SMALL},{keys}" if keys else SMALL)
    light, ambient = scene()
    found = capture_taps(light, ambient, device, seed=None).values
    assert np.allclose(found, slow_taps(light, ambient, device), rtol=2e-7)  # float32


def test_every_term_is_off_by_default():
    device, (light, ambient) = sensor(SMALL), scene()
    assert device.defects.light_gain == 1
    maps = pixel_maps(device)
    assert (maps.gain == 1).all()
    assert not maps.dark_e.any()
    assert not maps.phase_rad.any()
    z = demodulate(capture_taps(light, ambient, device, seed=None), device).values
    assert np.allclose(z, true_phasors(light, device), rtol=3e-6)


def test_a_camera_keeps_its_patterns_and_another_has_its_own():
    text = "kinect2:prnu=0.02,dsnu_e=20,dark_e=200,fppn_rad=0.1"
    one, again, other = (pixel_maps(sensor(t)) for t in (text, text, f"{text},unit=1"))
    for name in ("gain", "dark_e", "phase_rad"):
        assert (getattr(one, name) == getattr(again, name)).all()
        assert (getattr(one, name) != getattr(other, name)).mean() > 0.99
    same = (
        "kinect2:fppn_rad=0.1,width=64,height=48,hfov_deg=1,read_e=0,signal_e=1e6,full_well_e=1e9"
    )
    shots = [analytic(Scene("wall"))(Shot(sensor(same), seed=s)).phasors for s in (1, 2)]
    offset = [np.angle(s.values / true_phasors_of_wall(same)) for s in shots]
    assert np.corrcoef(offset[0][0].ravel(), offset[1][0].ravel())[0, 1] > 0.99
    assert (shots[0].values != shots[1].values).all()


def true_phasors_of_wall(text):
    return analytic(Scene("wall"))(Shot(sensor(text), noisy=False)).truth.direct


def test_phase_offsets_are_a_delay_unless_given_per_frequency():
    delay = pixel_maps(sensor("kinect2:fppn_rad=0.11")).phase_rad
    freqs = sensor("kinect2").modulation.freqs_hz
    assert np.allclose(delay.std(axis=(1, 2)), 0.11 * freqs / freqs.max())
    assert np.allclose(delay.mean(axis=(1, 2)), 0, atol=1e-12)
    own = pixel_maps(sensor("kinect2:fppn_rad=0.08+0.02+0.11")).phase_rad
    assert np.allclose(own.std(axis=(1, 2)), [0.08, 0.02, 0.11])
    # Smooth over the image but for a small white part: neighbours differ by 0.02 of 0.08 rad.
    step = np.median(np.abs(np.diff(own[0], axis=1)))
    assert 0.01 < step < 0.03
    with pytest.raises(ValueError, match=r"fppn_rad must be one number or one per frequency \(3\)"):
        sensor("kinect2:fppn_rad=0.1+0.2")


def test_measured_maps_take_the_place_of_drawn_ones(tmp_path):
    device, (light, ambient) = sensor(f"{SMALL},prnu=0.5"), scene()
    rng = np.random.default_rng(3)
    maps = PixelMaps(
        gain=rng.uniform(0.9, 1.1, (1, *SHAPE)),
        dark_e=rng.uniform(0, 50, (1, *SHAPE)),
        phase_rad=rng.normal(0, 0.1, (2, *SHAPE)),
    )
    device = replace(device, maps=maps)
    taps = capture_taps(light, ambient, device, seed=None)
    assert np.allclose(taps.values, slow_taps(light, ambient, device), rtol=2e-7)
    capture = analytic(Scene("wall"))(Shot(device))
    write_capture(tmp_path / "c.h5", capture)
    again = read_capture(tmp_path / "c.h5").sensor
    for name in ("gain", "dark_e", "phase_rad"):
        assert (getattr(again.maps, name) == getattr(maps, name)).all()
    with pytest.raises(ValueError, match="phase map must have shape"):
        replace(device, maps=replace(maps, phase_rad=np.zeros((1, *SHAPE))))
    with pytest.raises(ValueError, match="gain and dark_e not negative"):
        replace(maps, gain=-maps.gain)


def test_warmth_turns_the_phase_and_dims_the_light():
    plain = sensor(SMALL)
    hot = sensor(f"{SMALL},temperature_c=45,drift_rad_per_k=0.002+0.003,drift_gain_per_k=-0.005")
    light, ambient = scene()
    cold, warm = (
        demodulate(capture_taps(light, ambient, device, seed=None), device)
        for device in (plain, hot)
    )
    ratio = warm.values / cold.values
    assert np.allclose(np.abs(ratio), 1 - 20 * 0.005, rtol=1e-5)
    assert np.allclose(np.angle(ratio), np.array([0.04, 0.06])[:, None, None], atol=1e-5)
    with pytest.raises(ValueError, match="leaves no light"):
        sensor(f"{SMALL},temperature_c=225,drift_gain_per_k=-0.005")


def mirrored(image, sigma_px):
    """Slow twin: Gaussian sums over the image and its mirror images, pixel by pixel."""
    wide = np.pad(image, [(2 * n, 2 * n) for n in image.shape], mode="symmetric")
    out = np.empty_like(image)
    y, x = np.mgrid[: wide.shape[0], : wide.shape[1]]
    for row, column in np.ndindex(image.shape):
        away2 = (y - row - 2 * image.shape[0]) ** 2 + (x - column - 2 * image.shape[1]) ** 2
        kernel = np.exp(-away2 / (2 * sigma_px**2)) / (2 * np.pi * sigma_px**2)
        out[row, column] = (kernel * wide).sum()
    return out


@pytest.mark.parametrize("sigma_px", [2.0, 3.5])
def test_scatter_is_a_mirrored_gaussian(sigma_px):
    rng = np.random.default_rng(1)
    image = rng.normal(size=SHAPE) + 1j * rng.normal(size=SHAPE)
    slow = 0.7 * image + 0.3 * mirrored(image, sigma_px)
    fast = scattered(image, Defects(scatter=0.3, scatter_px=sigma_px))
    # A sampled Gaussian of 2 px has exp(-2 pi^2) = 3e-9 left at the edge of its spectrum.
    assert np.abs(fast - slow).max() < 5e-8
    assert np.isclose(fast.sum(), image.sum(), rtol=1e-12)
    assert scattered(image, Defects()) is image


def test_scatter_drags_dark_pixels_towards_a_bright_object():
    device = sensor("deeptof:width=40,height=30,scatter=0.05,scatter_px=10")
    near = np.zeros((30, 40), bool)
    near[10:20, 15:25] = True
    range_m, charge = np.where(near, 0.5, 4.0), np.where(near, 50_000, 300)

    def light(freq_hz):
        return charge * np.exp(1j * range_to_phase(range_m, freq_hz))

    taps = capture_taps(light, 0.0, device, seed=None)
    phase = np.angle(demodulate(taps, device).values[0] / true_phasors(light, device)[0])
    assert (phase[~near] < 0).all()  # all read too near
    assert phase[9, 20] < -0.5 < -0.1 < phase[0, 0]
    lamp = np.where(near, 9000.0, 0.0)
    lit = clean_taps(light, lamp, device) - clean_taps(light, 0.0, device)
    assert np.allclose(lit, scattered(lamp, device.defects), atol=1e-6)
    whole, kept = clean_taps(light, 0.0, sensor("deeptof:width=40,height=30")), taps.values
    assert np.allclose(whole.sum(axis=(2, 3)), kept.sum(axis=(2, 3), dtype=float), rtol=1e-6)


def test_two_nodes_of_unequal_gain_bend_the_phase_until_they_change_places():
    light, ambient = scene()
    two = "deeptof:width=12,height=9,taps_per_exposure=2,ab_gain=0.04"
    short = sensor(f"{two},steps=four_step_0_180_90_270")
    swapped = sensor(f"{two},steps=ab_four_step")
    z = demodulate(capture_taps(light, ambient, short, seed=None), short).values[0]
    # A - B of both exposures: (1.02 z) - 0.02 (1 + j) B, the offset leaking in.
    offset = light(0.0).real + ambient
    expected = 1.02 * true_phasors(light, short)[0] - 0.02 * (1 + 1j) * offset
    assert np.allclose(z, expected, rtol=1e-5)
    z = demodulate(capture_taps(light, ambient, swapped, seed=None), swapped).values[0]
    assert np.allclose(z, 1.02 * true_phasors(light, swapped)[0], rtol=1e-5)
    for bad in ("steps=four_step", "steps=three_step"):
        with pytest.raises(ValueError, match=r"taps of this timing step by|an even number of taps"):
            sensor(f"{two},{bad}")


def test_nodes_have_patterns_of_their_own():
    device = sensor(f"{SMALL},taps_per_exposure=2,steps=ab_four_step,prnu=0.1,dsnu_e=9,dark_e=99")
    maps = pixel_maps(device)
    assert maps.gain.shape == maps.dark_e.shape == (2, *SHAPE)
    assert (maps.gain[0] != maps.gain[1]).all()


@pytest.mark.parametrize("n_taps", [4, 5])
def test_heterodyne_taps_average_over_their_exposure(n_taps):
    steps = "+".join(map(str, np.arange(n_taps) * 2 * np.pi / n_taps))
    device = sensor(f"deeptof:width=12,height=9,steps={steps},waveform=square")
    device = replace(
        device, timing=Timing(tap_interval_s=1 / (n_taps * 30), exposure_s=0.005, beat_hz=30)
    )
    light, ambient = scene()
    # Slow twin: homodyne taps at the step of every moment of the exposure, averaged.
    moments = (np.arange(2000) + 0.5) / 2000 * 0.005 - 0.0025
    small = (slice(0, 1), slice(0, 2))
    slow = np.empty((n_taps, 1, 2))
    for k in range(n_taps):
        turn = 2 * np.pi * 30 * (k / (n_taps * 30) + moments)
        value = np.ones((moments.size, 1, 2))
        for m, weight in enumerate(device.modulation.harmonics[0], start=1):
            z = light(m * 20e6)[small] / light(0.0).real[small]
            value += 0.8 * (weight * z * np.exp(-1j * m * turn[:, None, None])).real
        slow[k] = light(0.0).real[small] * value.mean(axis=0) + ambient[small]
    fast = clean_taps(light, ambient, device)[0][:, *small]
    assert np.allclose(fast, slow, rtol=1e-6)  # midpoint rule over 2000 moments
    assert contrasts(device)[0] == pytest.approx(0.8 * np.sinc(30 * 0.005))


def test_heterodyne_by_text_covers_one_beat():
    device = sensor("deeptof:beat_hz=40")
    assert device.timing.tap_interval_s == device.timing.exposure_s == 1 / 160
    assert np.allclose(device.modulation.steps_rad[0], SCHEMES["four_step"])
    assert contrasts(device)[0] == pytest.approx(0.8 * np.sinc(0.25))
    two = sensor("kinect2:steps=ab_three_step,taps_per_exposure=2,beat_hz=10")
    assert tap_times_s(two)[1].tolist() == pytest.approx(np.repeat([3, 4, 5], 2) / 30)
    quarter = sensor("deeptof:taps_per_exposure=2,beat_hz=25")  # half a beat later, all is told
    assert quarter.timing.tap_interval_s == 1 / 100
    assert np.allclose(quarter.modulation.steps_rad[0], np.pi * np.array([0, 1, 0.5, 1.5]))
    with pytest.raises(ValueError, match="taps of this timing step by"):
        sensor("deeptof:beat_hz=40,steps=four_step,tap_interval_s=0.001")
    with pytest.raises(ValueError, match="0 < exposure_s <= tap_interval_s"):
        sensor("deeptof:beat_hz=40,tap_interval_s=0.001,exposure_s=0.002")


def test_taps_of_a_still_scene_do_not_care_when_they_are_taken():
    light, ambient = scene()
    plain, timed = (sensor(f"{SMALL}{keys}") for keys in ("", ",tap_interval_s=0.002"))
    still = capture_taps(light, ambient, timed, seed=4)
    assert (still.values == capture_taps(light, ambient, plain, seed=4).values).all()
    asked = []

    def frame_at(time_s):
        asked.append(time_s)
        return light, ambient

    assert (capture_moving(frame_at, timed, seed=4).values == still.values).all()
    assert np.allclose(asked, np.arange(8) * 0.002)
    asked.clear()
    capture_moving(frame_at, plain, seed=4)
    assert asked == [0.0]


def test_a_moving_camera_sees_each_tap_from_elsewhere():
    text = f"{SMALL},tap_interval_s=0.01"
    moving = analytic(Scene("wall", {"range": 2.0, "velocity_mps": 1.5}))
    capture = moving(Shot(sensor(text), noisy=False))
    for (i, k), time_s in np.ndenumerate(tap_times_s(sensor(text))):
        still = analytic(Scene("wall", {"range": 2.0 - 1.5 * time_s}))
        assert np.allclose(capture.taps.values[i, k],
                           still(Shot(sensor(text), noisy=False)).taps.values[i, k])  # fmt: skip
    first = analytic(Scene("wall", {"range": 2.0}))(Shot(sensor(text), noisy=False))
    assert (capture.truth.range_m == first.truth.range_m).all()
    with pytest.raises(ValueError, match="no closed form for a camera moving in cavity"):
        analytic(Scene("cavity", {"velocity_mps": 1.0}))
    with pytest.raises(ValueError, match="range must be a positive number"):
        analytic(Scene("wall", {"velocity_mps": 300.0}))(Shot(sensor(text)))


def test_contrast_may_differ_by_frequency():
    light, ambient = scene()
    device = sensor(f"{SMALL},contrast=0.9+0.5")
    z = demodulate(capture_taps(light, ambient, device, seed=None), device).values
    expected = np.array([0.9, 0.5])[:, None, None] * light(0.0).real
    assert np.allclose(np.abs(z), expected, rtol=1e-5)
    with pytest.raises(ValueError, match="contrast must be one number or one per frequency"):
        sensor(f"{SMALL},contrast=0.9+0.5+0.4")


def test_the_converter_rounds_ends_and_marks_what_is_saturated():
    device = sensor("deeptof:width=12,height=9,full_well_e=10000,adc_bits=6,read_e=0")
    assert device.noise.gain_dn_per_e == 63 / 10_000
    charge = np.broadcast_to(np.linspace(0, 10_500, 108).reshape(SHAPE), (1, 4, *SHAPE))
    taps = expose(charge.copy(), device, None)
    assert taps.unit == "DN"
    assert (taps.values == np.minimum(np.round(charge * 63 / 10_000), 63)).all()
    assert (taps.valid == (np.round(charge[0, 0] * 63 / 10_000) < 63)).all()
    own_gain = sensor("deeptof:width=12,height=9,adc_bits=6,dn_per_e=0.1")
    low = expose(charge / 12, own_gain, None)  # up to 875 electrons, so 63 is reached by rounding
    assert low.values.max() == 63
    assert (low.valid == (np.round(charge[0, 0] / 120) < 63)).all()
    with pytest.raises(ValueError, match="a converter needs full_well_e or dn_per_e"):
        Noise(adc_bits=8)


def test_one_saturated_tap_spoils_its_pixel_only():
    device = sensor("deeptof:width=12,height=9,full_well_e=10000")
    charge = np.full((1, 4, *SHAPE), 5000.0)
    charge[0, 2, 3, 4] = 12_000
    taps = expose(charge, device, None)
    assert np.argwhere(~taps.valid).tolist() == [[3, 4]]
    assert taps.values[0, 2, 3, 4] == 10_000


def test_companded_numbers_are_the_nearest_of_the_table():
    codes = np.array(kinect2_codes())
    noise = Noise(full_well_e=40_000, codes_dn=tuple(codes))
    assert noise.gain_dn_per_e == 16_320 / 40_000
    numbers = np.random.default_rng(2).uniform(-17_000, 17_000, 3000)
    found = companded(numbers, noise)
    nearest = np.abs(codes - np.abs(numbers)[:, None]).min(axis=1)  # slow twin
    assert np.allclose(np.abs(np.abs(found) - np.abs(numbers)), nearest, atol=1e-9)
    assert (np.sign(found) == np.sign(numbers))[np.abs(numbers) > 1].all()
    assert (companded(found, noise) == found).all()
    assert np.isin(np.abs(found), codes).all()
    # Steps stay near the shot noise of a well of 40 000 electrons.
    middle = codes[300:-1]
    shot_dn = np.sqrt(middle * noise.gain_dn_per_e)
    assert (np.diff(codes)[300:] < 1.3 * shot_dn).all()
    device = sensor("deeptof:width=12,height=9,full_well_e=40000,companding=kinect2")
    charge = np.linspace(0, 41_000, 108).reshape(1, 1, *SHAPE).repeat(4, axis=1)
    taps = expose(charge, device, None)
    assert np.isin(taps.values, codes).all()
    assert (taps.valid == (taps.values[0, 0] < 16_320)).all()


def test_the_table_of_a_kinect2_is_the_formula(tmp_path):
    data = os.environ.get("TOFTOOLS_DATA")
    path = Path(data or "none") / "kinect2_tables" / "11to16.bin"
    if not path.is_file():
        pytest.skip("needs the table kinect2_tables/11to16.bin: set TOFTOOLS_DATA")
    assert codes_of_file(path) == kinect2_codes()
    assert sensor(f"kinect2:companding={path}").noise.codes_dn == kinect2_codes()


def test_a_users_table_is_checked(tmp_path):
    half = np.r_[np.arange(1000) * 7, np.full(24, 32_767)].astype("<i2")
    half[1001:] = 0
    (tmp_path / "t.bin").write_bytes(np.r_[half, -half].astype("<i2").tobytes())
    with pytest.raises(ValueError, match="do not rise from 0"):
        codes_of_file(tmp_path / "t.bin")
    (tmp_path / "t.bin").write_bytes(bytes(100))
    with pytest.raises(ValueError, match="got 100 bytes, wanted 2048 int16"):
        codes_of_file(tmp_path / "t.bin")
    with pytest.raises(ValueError, match=r"none\.bin is no companding table: got no such file"):
        sensor("kinect2:companding=none.bin")


@pytest.mark.parametrize("freqs", ["0", "-20e6", "nan", "inf", "20", "1e12", "20e6+0", "20e6+nan"])
def test_frequencies_that_no_camera_has_are_refused_in_one_sentence(freqs):
    with pytest.raises(ValueError, match=r"^[^\n]{10,300}$"):
        sensor(f"deeptof:freqs={freqs}")
    if freqs not in ("nan", "inf", "20e6+nan"):
        with pytest.raises(ValueError, match="give Hz, not MHz"):
            Modulation(np.array([float(f) for f in freqs.split("+")]))


REFUSED = [
    "dark_e=-1", "adc_bits=0", "adc_bits=40", "adc_bits=2.5", "adc_bits=12,full_well_e=inf",
    "adc_bits=12,companding=kinect2", "contrast=0", "contrast=1.1", "contrast=0.5+2",
    "prnu=-0.1", "dsnu_e=-1", "fppn_rad=-0.1", "unit=-1", "unit=1.5", "ab_gain=-2", "scatter=1",
    "scatter=-0.1", "scatter_px=0", "scatter_px=1e6", "temperature_c=nan", "temperature_c=hot",
    "tap_interval_s=-1", "exposure_s=-1", "taps_per_exposure=3", "taps_per_exposure=0",
    "taps_per_exposure=2", "ab_gain=0.1", "beat_hz=30,exposure_s=0", "beat_hz=nan",
    "emitter=1", "emitter=1+2",
    "emitter=1+2+nan", "emitter=1+2+x", "beam_deg=0", "beam_deg=400", "beam_deg=70,beam=x.csv",
    "beam=none.csv", "companding=none", "waveform=none.csv", "waveform=3", "waveform=sine,rise=0.1",
]  # fmt: skip


@pytest.mark.parametrize("keys", REFUSED)
def test_values_that_make_no_sense_are_refused_in_one_sentence(keys):
    with pytest.raises(ValueError, match=r"^[^\n]{10,600}$"):
        sensor(f"deeptof:{keys}")


def test_emitters_by_text():
    assert sensor("deeptof:emitter=0.02+-0.01+0").emitter_offset_m == (0.02, -0.01, 0.0)
    assert sensor("deeptof:emitter=0.02+0+0").emitters == ()
    lit = sensor("deeptof:emitter=0.02+0+0,beam_deg=70")
    assert lit.emitters[0].offset_m == lit.emitter_offset_m == (0.02, 0, 0)
    angle, intensity = lit.emitters[0].beam.T
    # Flat to 28 degrees, then half a cosine down to 0 at 35; linear in between.
    at = np.interp([0, 20, 28, 31.5, 35], angle, intensity)
    assert np.allclose(at, [1, 1, 1, 0.5, 0], atol=1e-12)
    exact = (1 + np.cos(np.pi * (np.linspace(28, 35, 500) - 28) / 7)) / 2
    assert np.abs(np.interp(np.linspace(28, 35, 500), angle, intensity) - exact).max() < 2e-3


def test_a_measured_beam_comes_from_a_file(tmp_path):
    (tmp_path / "beam.csv").write_text("angle_deg,intensity\n0,1\n20,0.9\n40,0.1\n")
    lit = sensor(f"deeptof:beam={tmp_path / 'beam.csv'}")
    assert lit.emitters[0].beam.tolist() == [[0, 1], [20, 0.9], [40, 0.1]]
    (tmp_path / "beam.csv").write_text("10,1\n5,0.9\n")
    with pytest.raises(ValueError, match="beam must hold angles rising from 0"):
        sensor(f"deeptof:beam={tmp_path / 'beam.csv'}")


EVERY = (
    "kinect2:width=12,height=9,read_e=11,full_well_e=5e4,contrast=0.8+0.7+0.6,signal_e=1e4,"
    "dark_e=40,companding=kinect2,prnu=0.01,dsnu_e=3,fppn_rad=0.05,ab_gain=0.01,temperature_c=40,"
    "reference_c=20,drift_rad_per_k=0.001+0.002+0.003,drift_gain_per_k=-0.001,scatter=0.02,"
    "scatter_px=4,unit=3,taps_per_exposure=2,steps=ab_three_step,tap_interval_s=0.002,"
    "exposure_s=0.001,waveform=trapezoid,rise=0.2,duty=0.4"
)


def test_every_term_survives_the_capture_file(tmp_path):
    made = sensor(EVERY)
    write_capture(tmp_path / "c.h5", analytic(Scene("wall"))(Shot(made, seed=2)))
    again = read_capture(tmp_path / "c.h5")
    for part in ("noise", "defects", "timing"):
        assert vars(getattr(again.sensor, part)) == vars(getattr(made, part))
    taps = analytic(Scene("wall"))(Shot(again.sensor, seed=2)).taps
    assert (taps.values == again.taps.values).all()


def test_every_key_of_a_sensor_is_used_by_some_field():
    fields = {*vars(Noise()), *vars(Defects()), *vars(Timing())} - {"codes_dn"}
    assert fields <= set(KEYS)
    assert light_freqs_hz(sensor(EVERY)).size > 4


def test_same_seed_same_bits_and_terms_do_not_disturb_shot_noise():
    light, ambient = scene()
    plain = capture_taps(light, ambient, sensor(SMALL), seed=5).values
    assert (capture_taps(light, ambient, sensor(SMALL), seed=5).values == plain).all()
    assert (capture_taps(light, ambient, sensor(SMALL), seed=6).values != plain).any()
    unit = capture_taps(light, ambient, sensor(f"{SMALL},unit=9"), seed=5).values
    assert (unit == plain).all()  # a serial number alone changes nothing
