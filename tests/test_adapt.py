"""Other renderers' tensors as captures: every convention planted and found again.

Tensors in the layouts of mitransient and FLAT are made here from the closed form; none of those
programs is needed. What mitransient 1.3.1 itself gave through this road is in the docstring of
`test_a_wall_rendered_from_the_near_plane_reads_its_distance`.
"""

import json
from dataclasses import replace
from pathlib import Path

import foreign_files as foreign
import numpy as np
import pytest

from toftools.camera import pinhole, rays
from toftools.io.layouts import from_array, from_phasors, from_sparse, near_path_m, with_near_clip
from toftools.io.native import read_capture, write_capture
from toftools.io.open import detect, open_capture
from toftools.io.transients import read_transient, write_transient
from toftools.phasor import wrapped_range_m
from toftools.sensors import sensor
from toftools.sim.adapt import (
    mitransient_histogram,
    mitransient_phasors,
    phasor_capture,
    transient_capture,
)
from toftools.sim.analytic import analytic
from toftools.sim.shapes import wall
from toftools.sim.transients import histogram, progressive
from toftools.transient import Samples, Transient, phasors
from toftools.types import Modulation, Noise, Scene, Sensor, Shot
from toftools.units import C_M_S, ambiguity_m, path_to_phase, time_to_path

FREQS = np.array([20e6, 50e6])
CAMERA = pinhole(16, 12, hfov_deg=50.0)
DEVICE = Sensor(CAMERA, Modulation(FREQS), Noise(contrast=0.8, signal_e=2e4))
RANGE_M = 2 / rays(CAMERA)[..., 2]
INTENSITY = 7.0
RADIANCE = INTENSITY / np.pi * 0.5 * rays(CAMERA)[..., 2] / RANGE_M**2


def wall_samples(extra_m=0.0):
    """The wall at 2 m as one contribution per pixel."""
    path_m = 2 * RANGE_M.ravel() + np.ravel(extra_m)
    return Samples(np.arange(RANGE_M.size), path_m, RADIANCE.ravel())


def binned(samples, bin_m=0.01, n_bins=600, start_m=0.0):
    return histogram([samples], shape=CAMERA.shape, bin_m=bin_m, n_bins=n_bins, start_m=start_m)


def turns_off(capture, range_m=RANGE_M):
    """Difference from a range in turns, whatever the wrap."""
    freqs = capture.sensor.modulation.freqs_hz
    turns = (wrapped_range_m(capture.phasors.values, freqs) - range_m) / ambiguity_m(
        freqs[:, None, None]
    )
    return turns - np.round(turns)


def range_off(capture, range_m=RANGE_M):
    freqs = capture.sensor.modulation.freqs_hz
    return turns_off(capture, range_m) * ambiguity_m(freqs[:, None, None])


# transients become captures


def test_a_wall_is_the_capture_of_the_closed_form():
    """In the limit of fine bins, charges and all: same sensor, same numbers."""
    exact = wall(CAMERA, range=2.0, albedo=0.5)
    light = exact.phasor(0.0, None).real.ravel()
    one = Samples(np.arange(light.size), 2 * exact.range_m.ravel(), light)
    made = transient_capture(binned(one, 0.0005, 12_000), DEVICE, seed=None)
    expected = analytic(Scene("wall", {"range": 2.0, "albedo": 0.5}))(Shot(DEVICE, noisy=False))
    # A quarter of a bin in range, 1.25e-4 m: at 50 MHz 2.6e-4 rad of the amplitude, 0.8 offsets.
    worst = 0.8 * 2.7e-4 * made.taps.values.max()
    np.testing.assert_allclose(made.taps.values, expected.taps.values, atol=worst)
    np.testing.assert_allclose(made.truth.range_m, RANGE_M, atol=1.3e-4)
    assert made.provenance["engine"] == "transient"


def test_noise_is_the_sensors_and_seeded():
    made = binned(wall_samples())
    noisy = [transient_capture(made, DEVICE, seed=seed).taps.values for seed in (1, 1, 2)]
    clean = transient_capture(made, DEVICE, seed=None).taps.values
    assert (noisy[0] == noisy[1]).all()
    assert (noisy[0] != noisy[2]).any()
    z = (noisy[0] - clean) / np.sqrt(clean)
    assert abs(z.std() - 1) < 4 / np.sqrt(2 * z.size)


def test_ambient_light_and_harmonics_go_through_the_sensor_model():
    made = binned(wall_samples())
    dark, lit = (
        transient_capture(made, DEVICE, ambient_e=e, seed=None).taps.values for e in (0.0, 500.0)
    )
    np.testing.assert_allclose(lit - dark, 500, rtol=1e-4)
    square = replace(DEVICE, modulation=sensor("deeptof:waveform=square,freqs=20e6").modulation)
    wiggled = transient_capture(made, square, seed=None)
    # Four taps of a square wave: up to 84.8 mm of wiggling at 20 MHz, and not nothing.
    assert 0.01 < np.abs(range_off(wiggled)).max() < 0.0875


def test_electrons_are_taken_as_they_are():
    relative = binned(wall_samples())
    electrons = Transient(relative.values * np.float32(2e4), relative.bin_m, unit="e-")
    both = [transient_capture(one, DEVICE, seed=None).taps.values for one in (relative, electrons)]
    np.testing.assert_allclose(*both, rtol=1e-6)


def test_a_kernel_estimate_reads_the_same_range():
    passes = [wall_samples()] * 3
    made = progressive(passes, shape=CAMERA.shape, bin_m=0.01, n_bins=600, bandwidth_m=0.3)
    capture = transient_capture(made, DEVICE, seed=None)
    # Symmetric kernels move nothing; a bin of 1 cm is smooth light for a kernel of 30 cm.
    assert np.abs(range_off(capture)).max() < 2e-5
    assert capture.provenance["bandwidths_m"] == made.info["bandwidths_m"]


def test_truth_given_wins_and_an_emitter_elsewhere_leaves_none():
    made = binned(wall_samples())
    given = transient_capture(made, DEVICE, truth_range_m=np.full(CAMERA.shape, 3.0))
    assert (given.truth.range_m == 3).all()
    assert transient_capture(made, DEVICE, apart=1.1).truth is None
    beside = replace(DEVICE, emitter_offset_m=(0.1, 0.0, 0.0))
    assert transient_capture(made, beside).truth is None


def test_captures_of_transients_survive_the_capture_file(tmp_path):
    write_capture(tmp_path / "c.h5", transient_capture(binned(wall_samples()), DEVICE, seed=3))
    again = read_capture(tmp_path / "c.h5")
    assert again.provenance["method"] == "histogram"
    assert again.provenance["seed"] == 3


# mitransient


@pytest.mark.parametrize("near_clip", [1e-4, 0.01, 0.1])
@pytest.mark.parametrize("unit_m", [1.0, 0.25])
def test_a_wall_rendered_from_the_near_plane_reads_its_distance(near_clip, unit_m):
    """Both films, whose paths start on the near plane.

    Rendered by mitransient 1.3.1 itself (Mitsuba 3.9.1, LLVM, 32 x 24 px, hfov 40 degrees, 64
    samples, phasor film and 1000 bins of 9 mm), mean z of a wall at 2 m as it comes and through
    this road: 2.00002 and 2.00007 m at near_clip 1e-4, 1.99507 and 2.00007 at 0.01, 1.95007 and
    2.00007 at 0.1 (the mean over a pixel's area lies 0.07 mm behind its centre); mean charge
    0.99989 of albedo cos / range^2. Its Cornell box, phasors of 300 / 1000 / 4096 bins of 30 m
    against its own phasor film at 50 MHz: 5.4 / 0.52 / 0.056 mm rms of range. All by
    benchmarks/adapt_mitransient.py.
    """
    short = -near_path_m(CAMERA, near_clip, CAMERA.shape)
    one = wall_samples(short)
    film = {"start_opl": 1.5 / unit_m, "near_clip": near_clip / unit_m, "camera": CAMERA,
            "intensity": INTENSITY * unit_m**-2, "unit_m": unit_m}  # fmt: skip
    # Radiance does not know of metres: with distances in units, intensity is in units squared.
    bins = binned(one, 0.002, 2500, start_m=1.5).values.transpose(1, 2, 0)[..., None]
    made = mitransient_histogram(bins, bin_width_opl=0.002 / unit_m, **film)
    histogram_capture = transient_capture(made, DEVICE, seed=None)
    assert np.abs(range_off(histogram_capture)).max() < 0.002 / 4 + 1e-6

    path = (one.path_m - 1.5).reshape(CAMERA.shape)
    z = RADIANCE * np.exp(-1j * path_to_phase(path, FREQS[:, None, None]))
    tensor = np.stack([z.real, z.imag], axis=-1).transpose(1, 2, 0, 3).astype(np.float32)
    steady = RADIANCE[..., None].astype(np.float32)
    values, freqs = mitransient_phasors(
        tensor, steady, freqs_per_unit=FREQS * unit_m / C_M_S, **film
    )
    capture = phasor_capture(values, freqs, DEVICE, seed=None)
    assert np.abs(range_off(capture)).max() < 2e-6  # float32 phasors
    exact = 2e4 * 0.5 * rays(CAMERA)[..., 2] / RANGE_M**2
    for one in (histogram_capture, capture):
        np.testing.assert_allclose(one.taps.values.mean(axis=1)[0], exact, rtol=1e-5)
    amplitude = np.abs(capture.phasors.values)
    np.testing.assert_allclose(amplitude, np.broadcast_to(0.8 * exact, amplitude.shape), rtol=1e-5)


def test_the_near_plane_is_reached_where_its_depth_says():
    ends = near_path_m(CAMERA, 0.1, CAMERA.shape)[..., None] * rays(CAMERA)
    np.testing.assert_allclose(ends[..., 2], 0.1)


def test_forgetting_the_near_plane_shortens_the_range():
    """What the correction corrects: half the missing way, 5 mm at Mitsuba's default."""
    short = -near_path_m(CAMERA, 0.01, CAMERA.shape)
    capture = transient_capture(binned(wall_samples(short), 0.001, 6000), DEVICE, seed=None)
    np.testing.assert_allclose(range_off(capture), np.broadcast_to(short / 2, (2, 12, 16)),
                               atol=3e-4)  # fmt: skip


def test_phasors_at_other_frequencies_are_refused():
    z = np.ones((2, *CAMERA.shape), complex)
    with pytest.raises(ValueError, match=r"needs light at 0 MHz, got 20, 50 MHz.*steady image"):
        phasor_capture(z, FREQS, DEVICE)
    with pytest.raises(ValueError, match="needs light at 50 MHz, got 0, 20 MHz"):
        phasor_capture(z, [0, 20e6], DEVICE)
    with pytest.raises(ValueError, match=r"need phasors of shape \(F, H, W\)"):
        phasor_capture(z, [0, 20e6, 50e6], DEVICE)
    with pytest.raises(ValueError, match="must be finite"):
        phasor_capture(np.full((3, *CAMERA.shape), np.nan), [0, *FREQS], DEVICE)
    with pytest.raises(ValueError, match="sensor's size"):
        phasor_capture(np.ones((3, 2, 2), complex), [0, *FREQS], DEVICE)


# layouts


def test_axes_may_stand_in_any_order():
    values = np.random.default_rng(0).random((5, 2, 3, 4)).astype(np.float32)  # t h w c
    for axes in ("thwc", "hwtc", "cwht", "wcth"):
        turned = values.transpose(["thwc".index(letter) for letter in axes])
        made = from_array(turned, axes=axes, bin_m=0.1, channel=2)
        assert (made.values == values[..., 2]).all()
    made = from_array(values[..., 0].transpose(2, 1, 0), axes="wht", bin_m=0.1)
    assert (made.values == values[..., 0]).all()


@pytest.mark.parametrize(
    ("way", "at", "start_m", "bin_m", "expected"),
    [
        ("round", 0.5, 0.0, 0.1, 0.25),
        ("round", 0.5, 3.0, 0.1, 3.25),
        ("round", 0.0, 3.0, 0.1, 3.20),
        ("round", 1.0, 3.0, 0.1, 3.30),
        ("one", 0.5, 3.0, 0.1, 6.50),
        ("one", 0.0, 3.0, 0.1, 6.40),
    ],
)
def test_the_third_bin_lies_where_the_conventions_say(way, at, start_m, bin_m, expected):
    values = np.zeros((4, 1, 1), np.float32)
    values[2] = 1
    made = from_array(values, axes="thw", bin_m=bin_m, start_m=start_m, way=way, at=at)
    assert np.angle(phasors(made, 10e6))[0, 0, 0] == pytest.approx(path_to_phase(expected, 10e6))


def test_flat_lists_stand_for_dense_bins():
    rng = np.random.default_rng(1)
    index = np.stack([rng.integers(0, n, 60) for n in (3, 4, 9)])
    index[2] += 50
    values = rng.random(60)
    bin_m = float(time_to_path(33e-12))
    made = from_sparse(index, values, shape=(3, 4), bin_m=bin_m)
    assert made.values.sum() == pytest.approx(values.sum())
    path = index[2] * bin_m  # bin t stands at t times its width
    for row, column in ((0, 0), (2, 3)):
        mine = (index[0] == row) & (index[1] == column)
        exact = (values[mine] * np.exp(1j * path_to_phase(path[mine], 100e6))).sum()
        box = np.sinc(path_to_phase(bin_m, 100e6) / (2 * np.pi))
        np.testing.assert_allclose(phasors(made, 100e6)[0, row, column] * box, exact, rtol=1e-6)
    turned = from_sparse(index.T, values, shape=(3, 4), bin_m=bin_m)
    assert (turned.values == made.values).all()


@pytest.mark.parametrize(
    ("sign", "axes"), [(1, "fhwp"), (-1, "hwfp"), (-1, "pwhf"), (1, "fhw"), (-1, "hwf")]
)
def test_phasor_tensors_turn_into_ours(sign, axes):
    path = np.random.default_rng(2).uniform(1, 5, (3, 4))
    z = np.exp(1j * sign * path_to_phase(path - 0.5, FREQS[:, None, None]))
    tensor = np.stack([z.real, z.imag], axis=-1) if "p" in axes else z
    tensor = tensor.transpose(["fhwp".index(letter) for letter in axes])
    made = from_phasors(tensor, FREQS, axes=axes, sign=sign, start_m=0.5, scale=3.0)
    np.testing.assert_allclose(made, 3 * np.exp(1j * path_to_phase(path, FREQS[:, None, None])))


VALUES = np.ones((5, 2, 3), np.float32)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": "hw"}, "one letter per axis"),
        ({"axes": "thwc"}, "one letter per axis"),
        ({"axes": "tth"}, "one letter per axis"),
        ({"values": VALUES + 1j}, "real numbers, got complex64"),
        ({"values": -VALUES}, "light of 0 or more"),
        ({"values": VALUES * np.nan}, "light of 0 or more"),
        ({"values": np.full((5, 2, 3), 1e300)}, "light of 0 or more"),
        ({"bin_m": 0.0}, "bin_m must be positive"),
        ({"bin_m": -1.0}, "bin_m must be positive"),
        ({"start_m": np.inf}, "start_m must be finite"),
        ({"way": "two"}, "way must be one of round, one"),
        ({"at": 2.0}, "at 0..1"),
        ({"scale": 0.0}, "scale must be a positive number"),
        ({"values": VALUES[..., None], "axes": "thwc", "channel": 1}, "channel=1, the array has 1"),
    ],
)
def test_layouts_that_make_no_sense_are_refused(change, words):
    given = {"values": VALUES, "axes": "thw", "bin_m": 0.1, **change}
    with pytest.raises(ValueError, match=words) as caught:
        from_array(given.pop("values"), **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("index", "values", "words"),
    [
        ([[0, 2], [0, 0], [1, 1]], [1, 1], "beyond the image"),
        ([[0, 0], [0, -1], [1, 1]], [1, 1], "beyond the image"),
        ([[0, 0], [0, 0], [-1, 1]], [1, 1], "beyond the image"),
        ([[0, 0], [0, 0], [0, 1 << 40]], [1, 1], "too much room"),
        ([[0.5], [0], [1]], [1], "whole index"),
        ([[0], [0]], [1], "whole index"),
        ([[0], [0], [1]], [1, 1], "whole index"),
        (np.zeros((3, 0), int), [], "whole index"),
        ([[0], [0], [1]], [np.nan], "light of 0 or more"),
    ],
)
def test_lists_that_make_no_sense_are_refused(index, values, words):
    with pytest.raises(ValueError, match=words):
        from_sparse(np.array(index), np.array(values, float), shape=(2, 2), bin_m=0.1)


def test_cameras_that_do_not_fit_are_refused():
    made = Transient(VALUES, 0.1)
    with pytest.raises(ValueError, match=r"size of the image \(2, 3\), got \(12, 16\)"):
        with_near_clip(made, CAMERA, 0.1)
    with pytest.raises(ValueError, match="0 or more metres"):
        with_near_clip(made, pinhole(3, 2, hfov_deg=40), -0.1)
    with pytest.raises(ValueError, match=r"sensor's size \(12, 16\), got \(2, 3\)"):
        transient_capture(made, DEVICE)
    with pytest.raises(ValueError, match="intensity and unit_m"):
        mitransient_histogram(VALUES[..., None], bin_width_opl=0.1, start_opl=0, near_clip=0,
                              camera=CAMERA, intensity=0.0)  # fmt: skip
    with pytest.raises(ValueError, match="got axes='fhw' and sign=0"):
        from_phasors(VALUES + 0j, np.arange(1, 6), axes="fhw", sign=0)
    with pytest.raises(ValueError, match="2 frequencies need a tensor of as many"):
        from_phasors(VALUES + 0j, FREQS, axes="fhw", sign=1)


def test_light_beyond_the_axis_is_refused_unless_asked_for():
    made = binned(wall_samples(), n_bins=425)  # corners of the wall lie at 4.4 m of path
    with pytest.raises(ValueError, match=r"leaves out about \d.* % of the light.*cut=1"):
        transient_capture(made, DEVICE)
    assert transient_capture(made, DEVICE, cut=1.0).provenance["cut_share"] > 0.01


# files


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_transient_files_hold_all_of_a_transient(suffix, tmp_path):
    start_m = np.full((2, 3), 0.25)
    missed = np.ones((2, 3), np.float32)
    made = Transient(VALUES, 0.1, start_m, 0.05, "e-", missed, {"bandwidths_m": [1.0, 0.9]})
    path = tmp_path / f"t{suffix}"
    write_transient(path, made)
    again = read_transient(path)
    assert (again.values == made.values).all()
    assert (again.start_m == start_m).all()
    assert (again.missed == missed).all()
    assert (again.bin_m, again.box_m, again.unit) == (0.1, 0.05, "e-")
    assert dict(again.info) == {"bandwidths_m": [1.0, 0.9]}
    before = path.read_bytes()
    write_transient(path, again)
    if suffix == ".npz":  # HDF5 stamps nothing either, but does not promise the same layout
        assert path.read_bytes() == before
        assert (np.load(path)["values"] == VALUES).all()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert detect(path) == "transient"
    with pytest.raises(ValueError, match=r"named \*.npz or \*.h5"):
        write_transient(tmp_path / "t.mat", made)


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_reader_gives_the_phasors_of_the_sensor_without_noise(suffix, tmp_path):
    path = foreign.transient(tmp_path, suffix=suffix)
    capture = open_capture(path, "transient:freqs=20e6+50e6,hfov_deg=50")
    made = Transient(foreign.transient_bins(), foreign.TRANSIENT_BIN_M)
    noise = capture.sensor.noise
    expected = noise.signal_e * noise.contrast * phasors(made, [20e6, 50e6])
    np.testing.assert_allclose(capture.phasors.values, expected, rtol=1e-6)
    assert capture.taps is None
    # Half a bin of path is a quarter of it in range.
    np.testing.assert_allclose(capture.truth.range_m, foreign.RANGE_M, atol=0.05 / 4 + 1e-6)
    near = open_capture(path, "transient:freqs=20e6+50e6,hfov_deg=50,near_clip_m=0.1")
    longer = near_path_m(near.sensor.camera, 0.1, (foreign.HEIGHT, foreign.WIDTH)) / 2
    np.testing.assert_allclose(near.truth.range_m - capture.truth.range_m, longer, atol=1e-6)
    assert open_capture(path, "transient:apart=1.5").truth is None
    assert open_capture(path, "transient:sensor=mlx75027").sensor.modulation.freqs_hz[0] == 60e6


def save(folder, name, array, **more):
    path = Path(folder) / name
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, values=array, **more)
    else:
        import h5py

        with h5py.File(path, "w") as file:
            file["values"] = array
            file.update(more)
    return path


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5"])
def test_arrays_of_other_programs_are_read_by_their_conventions(suffix, tmp_path):
    bins = foreign.transient_bins()
    path = save(tmp_path, f"a{suffix}", bins.transpose(1, 2, 0)[..., None])
    expected = open_capture(foreign.transient(tmp_path)).phasors.values
    made = open_capture(path, "transient:axes=hwtc,bin_m=0.05")
    assert (made.phasors.values == expected).all()
    assert made.provenance["convention"]["axes"] == "hwtc"
    assert json.dumps(dict(made.provenance))
    nanoseconds = foreign.TRANSIENT_BIN_M / C_M_S
    made = open_capture(path, f"transient:axes=hwtc,bin_s={nanoseconds!r},scale=2")
    np.testing.assert_allclose(made.phasors.values, 2 * expected, rtol=1e-6)
    made = open_capture(path, "transient:axes=hwtc,bin_m=0.025,way=one")
    assert (made.phasors.values == expected).all()


def test_truth_beside_the_array_wins(tmp_path):
    truth = np.full((foreign.HEIGHT, foreign.WIDTH), 1.5)
    path = save(tmp_path, "a.npz", foreign.transient_bins(), truth_range_m=truth)
    made = open_capture(path, "transient:axes=thw,bin_m=0.05")
    assert (made.truth.range_m == 1.5).all()


def test_flat_lists_are_read_by_their_conventions(tmp_path):
    bins = foreign.transient_bins()
    t, rows, columns = np.nonzero(bins)
    path = tmp_path / "flat.npz"
    np.savez(path, index=np.stack([rows, columns, t]), values=bins[t, rows, columns])
    size = f"width={foreign.WIDTH},height={foreign.HEIGHT}"
    made = open_capture(path, f"transient:axes=sparse,bin_m=0.05,{size},cut=1")
    expected = open_capture(foreign.transient(tmp_path)).phasors.values
    np.testing.assert_allclose(made.phasors.values, expected, rtol=1e-6)
    with pytest.raises(ValueError, match="width= and height="):
        open_capture(path, "transient:axes=sparse,bin_m=0.05")
    with pytest.raises(ValueError, match="leave out start_m"):
        open_capture(path, f"transient:axes=sparse,bin_m=0.05,start_m=1,{size}")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("transient", "does not say its axes; give axes="),
        ("transient:axes=hwt", "how wide a bin is"),
        ("transient:axes=hwt,bin_m=-1", "how wide a bin is"),
        ("transient:axes=hwt,bin_m=1,bin_s=1", "give one of them"),
        ("transient:axes=hwt,bin_m=0.05,key=other", "no array 'other'"),
        ("transient:axes=thwc,bin_m=0.05", "one letter per axis"),
        ("transient:axes=thw,bin_m=8", "half a wavelength"),
        ("transient:axes=thw,bin_m=0.05,sensor=nope", "unknown sensor 'nope'"),
        ("transient:axes=thw,bin_m=0.05,freqs=20", "Hz, not MHz"),
        ("transient:axes=thw,bin_m=0.05,near_clip_m=-1", "near_clip_m must be 0 or more"),
        ("transient:axes=thw,bin_m=0.05,hfov_deg=200", "hfov_deg"),
    ],
)
def test_missing_and_senseless_conventions_are_named(text, words, tmp_path):
    path = save(tmp_path, "a.npz", foreign.transient_bins())
    with pytest.raises(ValueError, match=words) as caught:
        open_capture(path, text)
    assert "\n" not in str(caught.value)


def test_a_file_of_our_own_is_not_told_what_it_says(tmp_path):
    path = foreign.transient(tmp_path)
    with pytest.raises(ValueError, match="the file states bin_m itself; leave out bin_m, at"):
        open_capture(path, "transient:bin_m=1,at=0")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 1e300])
def test_senseless_light_is_refused(value, tmp_path):
    bins = foreign.transient_bins().astype(np.float64)
    bins[3, 2, 1] = value
    path = save(tmp_path, "a.npz", bins)
    with pytest.raises(ValueError, match="light of 0 or more"):
        open_capture(path, "transient:axes=thw,bin_m=0.05")


def test_an_axis_that_ends_too_early_is_refused(tmp_path):
    decay = np.exp(-np.arange(200) / 50)[:, None, None] * np.ones((1, 4, 4))
    path = save(tmp_path, "a.npz", decay)
    with pytest.raises(ValueError, match=r"leaves out about 1.83 % of the light.*cut=1"):
        open_capture(path, "transient:axes=thw,bin_m=0.05")
    assert open_capture(path, "transient:axes=thw,bin_m=0.05,cut=0.02").phasors.valid.all()


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_files_of_our_own_that_are_damaged_are_refused(suffix, tmp_path):
    path = foreign.transient(tmp_path, suffix=suffix)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged[: rng.integers(1, 3 * len(whole))])
        try:
            open_capture(path, "transient")
        except ValueError as error:
            assert str(error).strip()
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("name", "value"),
    [("format", "other"), ("version", 2), ("version", "x"), ("bin_m", "wide"), ("bin_m", -1.0),
     ("bin_m", np.nan), ("unit", "W"), ("info", "[]"), ("info", "{"), ("box_m", [1.0, 2.0])],
)  # fmt: skip
def test_attributes_that_make_no_sense_are_refused(name, value, tmp_path):
    import h5py

    path = foreign.transient(tmp_path, suffix=".h5")
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(ValueError, match=r"transient.h5 is not readable") as caught:
        read_transient(path)
    assert "\n" not in str(caught.value)


def test_datasets_that_lie_elsewhere_are_refused(tmp_path):
    import h5py

    path = foreign.transient(tmp_path, suffix=".h5")
    other = tmp_path / "other.h5"
    other.write_bytes(path.read_bytes())
    with h5py.File(path, "r+") as file:
        del file["values"]
        file["values"] = h5py.ExternalLink("other.h5", "values")
    with pytest.raises(ValueError, match="must lie in the file itself"):
        read_transient(path)
    with h5py.File(path, "r+") as file:
        del file["values"]
        file.create_group("values")
    with pytest.raises(ValueError, match="must be a dataset of numbers"):
        read_transient(path)


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_arrays_beyond_the_limit_are_refused(suffix, tmp_path, monkeypatch):
    from toftools.io import stored

    path = foreign.transient(tmp_path, suffix=suffix)
    size = foreign.transient_bins().nbytes
    monkeypatch.setattr(stored, "MAX_BYTES", size - 1)
    with pytest.raises(ValueError, match=rf"values claims \d+ bytes.*at most {size - 1} are read"):
        read_transient(path)


def test_the_command_converts_a_transient(tmp_path, capsys):
    from toftools.cli import main

    path = save(tmp_path, "a.npy", foreign.transient_bins())
    out = tmp_path / "c.h5"
    text = "transient:axes=thw,bin_m=0.05,sensor=opt8241"
    with pytest.raises(SystemExit) as caught:
        main(["convert", str(path), "--out", str(out), "--format", text])
    assert caught.value.code == 0
    assert "8 x 6 px, 40 + 70 MHz, phasors" in capsys.readouterr().out
    assert read_capture(out).provenance["convention"]["axes"] == "thw"
