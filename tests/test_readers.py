"""Every foreign format yields the planted numbers; its convention is explicit."""

import importlib
import json
import re
import struct

import foreign_files as foreign
import numpy as np
import pytest
from foreign_files import AMPLITUDE, HEIGHT, RANGE_M, WIDTH

from toftools.camera import range_to_z, z_to_range
from toftools.io.open import detect, open_capture
from toftools.io.readers import _mat5, _npy
from toftools.phasor import demodulate, phasors_of, wrapped_range_m
from toftools.registry import READERS
from toftools.units import ambiguity_m

# float32 of a few metres, half a spacing with one rounding more.
CLOSE = {"rtol": 3e-7, "atol": 0}


@pytest.mark.parametrize("name", READERS)
def test_each_format_is_recognised_and_says_its_convention(name, tmp_path):
    path = foreign.MAKERS[name](
        tmp_path, **({"width": 512, "height": 512} if name == "adi_bin" else {})
    )
    assert detect(path) == name
    capture = open_capture(path)
    assert capture.provenance["format"] == name
    assert isinstance(capture.provenance["convention"], dict)
    assert json.dumps(dict(capture.provenance))
    assert str(tmp_path) not in json.dumps(dict(capture.provenance))


@pytest.mark.parametrize("name", READERS)
def test_forcing_the_format_gives_the_same(name, tmp_path):
    path = foreign.MAKERS[name](tmp_path)
    capture = open_capture(path, foreign.FORCED.get(name, name))
    assert capture.sensor.camera.shape == (HEIGHT, WIDTH)


# su2018


def test_su2018_channels_are_both_i_then_both_q(tmp_path):
    capture = open_capture(foreign.su2018(tmp_path, tofnet_m=RANGE_M + 0.1))
    turns = (wrapped_range_m(capture.phasors.values, [40e6, 70e6]) - RANGE_M) / ambiguity_m(
        [40e6, 70e6]
    )[:, None, None]
    # complex64 phase is good to about 1e-7 rad, 1e-7 turns after the division.
    assert np.abs(turns - np.round(turns)).max() < 2e-7
    np.testing.assert_allclose(capture.depth.amplitude, AMPLITUDE / AMPLITUDE.max(), rtol=1e-6)
    both = np.broadcast_to(capture.depth.amplitude, capture.phasors.values.shape)
    np.testing.assert_allclose(np.abs(capture.phasors.values), both, rtol=1e-6)
    np.testing.assert_allclose(capture.truth.range_m, RANGE_M, **CLOSE)
    np.testing.assert_allclose(capture.reported["tofnet"], RANGE_M + 0.1, rtol=1e-6)


def test_su2018_right_half_is_the_cameras_when_it_is_quantised_to_2_cm(tmp_path):
    quantised = np.round(RANGE_M / 0.02) * 0.02
    path = foreign.su2018(tmp_path, right_m=quantised)
    capture = open_capture(path)
    assert capture.provenance["convention"]["right"] == "camera"
    assert capture.truth is None
    np.testing.assert_allclose(capture.depth.range_m, quantised, **CLOSE)
    as_truth = open_capture(path, "su2018:right=truth")
    assert as_truth.provenance["convention"]["right_decided_by"] == "caller"
    np.testing.assert_allclose(as_truth.truth.range_m, quantised, **CLOSE)


def test_su2018_lost_pixels_are_invalid_and_infinite_truth_unknown(tmp_path):
    right = RANGE_M.copy()
    right[2, 3], right[2, 4] = np.inf, 0
    capture = open_capture(foreign.su2018(tmp_path, right_m=right, lost=[(0, 1)]))
    expected = np.ones((HEIGHT, WIDTH), bool)
    expected[0, 1] = False
    assert (capture.phasors.valid == expected).all()
    assert np.isnan(capture.truth.range_m[2, 3:5]).all()


def test_su2018_network_output_alone_is_a_depth_capture(tmp_path):
    foreign.su2018(tmp_path, tofnet_m=RANGE_M)
    capture = open_capture(tmp_path / "tofnet_output_000009.mat")
    np.testing.assert_allclose(capture.depth.range_m, RANGE_M, rtol=1e-6)
    assert phasors_of(capture).values.shape == (1, HEIGHT, WIDTH)


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("dtype", ["f8", "f4", "i2", "u1", "i8"])
def test_mat5_reader_agrees_with_scipy(dtype, compress, tmp_path):
    from scipy.io import loadmat, savemat

    array = np.arange(24).reshape(2, 3, 4).astype(dtype)
    path = tmp_path / "a.mat"
    others = {f"other{n}": np.arange(n) for n in range(1, 9)}  # packed sizes that need padding
    savemat(path, {"text": "x", **others, "wanted": array}, do_compression=compress)
    name, got = _mat5.read_array(path.read_bytes(), "wanted")
    assert name == "wanted"
    assert (got == loadmat(path)["wanted"]).all()
    assert _mat5.first_name(path.read_bytes()) == "text"


def test_mat5_of_a_big_endian_machine():
    numbers = np.arange(6.0).reshape(2, 3)
    pairs = [(6, struct.pack(">II", 6, 0)), (5, struct.pack(">2i", 2, 3)), (1, b"wanted"),
             (9, numbers.astype(">f8").tobytes(order="F"))]  # fmt: skip
    body = b"".join(
        struct.pack(">II", kind, len(part)) + part + bytes(-len(part) % 8) for kind, part in pairs
    )
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    _, got = _mat5.read_array(head + struct.pack(">II", 14, len(body)) + body, "wanted")
    assert (got == numbers).all()


# melexis


@pytest.mark.parametrize(("sign", "offset_m"), [(1, 0.0), (1, -1.1), (-1, 0.4)])
def test_melexis_convention_undoes_sign_and_offset_in_the_tap_steps(sign, offset_m, tmp_path):
    path = foreign.melexis_npy(tmp_path, sign=sign, offset_m=offset_m)
    capture = open_capture(path, f"melexis_npy:sign={sign},offset_m={offset_m}")
    error = (wrapped_range_m(capture.phasors.values, [60e6])[0] - RANGE_M) / ambiguity_m(60e6)
    # float32 taps of up to 250 DN are good to 1.5e-5 DN, against 50 DN: 3e-7 rad and the sum.
    assert np.abs(error - np.round(error)).max() < 1e-6
    np.testing.assert_allclose(2 * np.abs(capture.phasors.values[0]), AMPLITUDE, rtol=2e-6)
    again = demodulate(capture.taps, capture.sensor)
    assert (again.values == capture.phasors.values).all()


def test_melexis_taps_stay_raw_and_dark_pixels_are_invalid(tmp_path):
    path = foreign.melexis_npy(tmp_path)
    capture = open_capture(path, "melexis_npy:min_amplitude=200")
    assert (capture.phasors.valid == (AMPLITUDE > 200)).all()
    assert (np.isfinite(capture.depth.range_m) == (AMPLITUDE > 200)).all()
    raw = np.load(tmp_path / "Scene_phase180_avg.npy").astype(np.float32)
    assert (capture.taps.values[0, 2] == raw).all()
    np.testing.assert_allclose(
        np.degrees(capture.sensor.modulation.steps_rad[0]), [0, 90, 180, 270]
    )


def test_melexis_set_goes_by_folder_prefix_or_any_member(tmp_path):
    foreign.melexis_npy(tmp_path)
    ways = [tmp_path, tmp_path / "Scene", tmp_path / "Scene_dist_avg.npy"]
    assert {detect(way) for way in ways} == {"melexis_npy"}
    assert len({open_capture(way).taps.values.tobytes() for way in ways}) == 1


def test_melexis_without_vendor_files_has_no_depth(tmp_path):
    capture = open_capture(foreign.melexis_npy(tmp_path, vendor=False))
    assert capture.depth is None
    assert capture.phasors.valid.all()


def test_npy_reader_agrees_with_numpy(tmp_path):
    for array in (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6, dtype=">i2")
                  .reshape(2, 3)), np.ones((2, 2), np.complex64), np.eye(2) > 0):  # fmt: skip
        np.save(tmp_path / "a.npy", array)
        with (tmp_path / "a.npy").open("rb") as file:
            got = _npy.read_npy(file, (tmp_path / "a.npy").stat().st_size)
        assert got.dtype == array.dtype
        assert (got == array).all()


# azure


def test_azure_depth_is_big_endian_z_and_becomes_range_through_the_factory_camera(tmp_path):
    z_mm = np.arange(640 * 576).reshape(576, 640) % 4000
    path = foreign.azure_mkv(tmp_path, width=640, height=576, z_mm=z_mm)
    capture = open_capture(path)
    camera = capture.sensor.camera
    known = foreign.AZURE
    # Normalised to the 1024 px sensor, outer-corner origin; crop (192, 180); centres at integers.
    np.testing.assert_allclose(camera.K[0, 2], known["cx"] * 1024 - 192 - 0.5)
    np.testing.assert_allclose(camera.K[1, 2], known["cy"] * 1024 - 180 - 0.5)
    np.testing.assert_allclose(camera.K[0, 0], known["fx"] * 1024)
    k = known["k"]
    np.testing.assert_allclose(camera.dist, [k[0], k[1], known["p1"], known["p2"], *k[2:]])
    z_m = range_to_z(camera, capture.depth.range_m)
    assert (np.isnan(z_m) == (z_mm == 0)).all()
    # Two float32 roundings of metres: relative 1.2e-7.
    np.testing.assert_allclose(z_m[z_mm > 0], z_mm[z_mm > 0] / 1000, rtol=2e-7)
    assert (capture.depth.amplitude == 2 * z_mm).all()
    second = open_capture(path, "azure_mkv:frame=1")
    assert np.isfinite(second.depth.range_m[z_mm == 0]).all()


def test_azure_modes_see_the_same_rays(tmp_path):
    """The binned mode is the same crop of the same lens: its pixel corners coincide."""
    from toftools.io.readers.azure_mkv import _camera

    full = _camera(640, 576, foreign.azure_calibration(), tmp_path)[0].K
    half = _camera(320, 288, foreign.azure_calibration(), tmp_path)[0].K
    np.testing.assert_allclose((half[:2, 2] + 0.5) * 2, full[:2, 2] + 0.5)
    np.testing.assert_allclose(half[0, 0] * 2, full[0, 0])


def test_azure_calibration_beside_the_file_serves_when_none_is_attached(tmp_path):
    path = foreign.azure_mkv(tmp_path, width=320, height=288, attach=False)
    assert "nominal" in open_capture(path).provenance["camera"]
    (tmp_path / "calibration.json").write_bytes(foreign.azure_calibration())
    assert "beside" in open_capture(path).provenance["camera"]


def test_video_without_a_depth_track_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no track titled DEPTH"):
        open_capture(foreign.azure_mkv(tmp_path, title="COLOR"))


# the other depth cameras


def test_adi_kind_decides_between_axial_and_radial(tmp_path):
    path = foreign.adi_bin(tmp_path)
    size = f"width={WIDTH},height={HEIGHT}"
    z, radial = (open_capture(path, f"adi_bin:{size},kind={kind}") for kind in ("z", "range"))
    stored = np.round(1000 * RANGE_M) / 1000
    np.testing.assert_allclose(radial.depth.range_m, stored, **CLOSE)
    expected = z_to_range(z.sensor.camera, stored.astype(np.float32))
    np.testing.assert_allclose(z.depth.range_m, expected, **CLOSE)
    assert (z.depth.amplitude == np.round(1000 * RANGE_M) // 2).all()
    with pytest.raises(ValueError, match="kind must be range"):
        open_capture(path, f"adi_bin:{size},kind=depth")


def test_ifm_scales_invalid_code_and_camera(tmp_path):
    capture = open_capture(foreign.ifm_o3r(tmp_path))
    expected = np.round(RANGE_M, 3)
    expected[0, 0] = np.nan
    np.testing.assert_allclose(capture.depth.range_m, expected, **CLOSE)
    np.testing.assert_allclose(capture.depth.amplitude, np.round(AMPLITUDE) * 0.5)
    assert np.isnan(capture.depth.sigma_m[0, 0])
    np.testing.assert_allclose(capture.depth.sigma_m[1], 0.003, rtol=1e-6)
    fx, _, mx, _, _, k1, k2, k3, k4, k5 = foreign.IFM_CAMERA
    camera = capture.sensor.camera
    np.testing.assert_allclose(camera.K[0], [fx, 0, mx - 0.5])
    np.testing.assert_allclose(camera.dist, np.float32([k1, k2, k3, k4, k5]))


def test_ifm_fisheye_model_is_not_taken_for_a_pinhole_one(tmp_path):
    capture = open_capture(foreign.ifm_o3r(tmp_path, model=3))
    assert "assumed" in capture.provenance["camera"]
    assert not capture.sensor.camera.dist.any()


def test_espros_counts_clipped_and_zero_pixels(tmp_path):
    capture = open_capture(foreign.espros_h5(tmp_path))
    assert capture.provenance["clipped_share"] == pytest.approx(1 / (WIDTH * HEIGHT))
    assert capture.provenance["zero_share"] == pytest.approx(1 / (WIDTH * HEIGHT))
    assert np.isnan(capture.depth.range_m).all()
    second = open_capture(tmp_path / "amplitude.h5", "espros_h5:frame=1")
    np.testing.assert_allclose(second.depth.amplitude, AMPLITUDE + 1, rtol=1e-6)
    assert second.sensor.modulation.freqs_hz.tolist() == [20e6]
    with pytest.raises(ValueError, match="frame=2"):
        open_capture(tmp_path / "amplitude.h5", "espros_h5:frame=2")


def test_png_scale_codes_and_camera(tmp_path):
    path = foreign.depth_png(tmp_path)
    code = round(1000 * RANGE_M[0, 3])
    text = f"depth_png:scale=5000,kind=range,invalid=0+{code},camera=7+7+3.5+2.5"
    capture = open_capture(path, text)
    expected = np.round(1000 * RANGE_M) / 5000
    expected[0, 0] = expected[0, 3] = np.nan
    np.testing.assert_allclose(capture.depth.range_m, expected, **CLOSE)
    assert capture.sensor.camera.K[0].tolist() == [7, 0, 3.5]


def test_npz_phasors_and_taps(tmp_path):
    freqs = np.array([40e6, 70e6])
    z = 9 * np.exp(1j * np.stack([foreign.phase(RANGE_M, f) for f in freqs]))
    phasors = open_capture(foreign.npz(tmp_path, phasors=z, freqs_hz=freqs, truth_range_m=RANGE_M))
    np.testing.assert_allclose(phasors.phasors.values, z, rtol=1e-6)
    np.testing.assert_allclose(phasors.truth.range_m, RANGE_M, **CLOSE)
    steps = np.radians([0, 120, 240])
    taps = 20 + (z[:, None] * np.exp(-1j * steps[:, None, None])).real
    path = foreign.npz(tmp_path, taps=taps, freqs_hz=freqs, steps_rad=steps)
    # float32 taps of 29 are good to 1e-6 of 9.
    np.testing.assert_allclose(open_capture(path).phasors.values, z, rtol=2e-6, atol=2e-6)
    assert open_capture(path, "npz:unit=e-").taps.unit == "e-"


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"other": np.eye(3)}, "wanted one of"),
        ({"phasors": np.ones((1, 2, 2), complex)}, "freqs_hz"),
        ({"taps": np.ones((1, 4, 2, 2)), "freqs_hz": [20e6]}, "steps_rad"),
        ({"range_m": np.ones(3)}, "dimensions"),
        ({"range_m": np.ones((2, 2)), "K": np.zeros((3, 3))}, "focal"),
        ({"range_m": np.ones((2, 2)), "sigma_m": np.ones((3, 3))}, "sigma_m"),
        ({"range_m": np.ones((2, 2), complex)}, "real"),
        ({"phasors": np.ones((1, 2, 2), complex), "freqs_hz": [20.0]}, "Hz, not MHz"),
    ],
)
def test_npz_says_what_is_missing(arrays, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        open_capture(foreign.npz(tmp_path, **arrays))


def test_npz_never_unpickles(tmp_path):
    path = foreign.npz(tmp_path, range_m=np.array([[{}]], dtype=object))
    with pytest.raises(ValueError, match="plain numbers"):
        open_capture(path)


# the one door


def test_missing_folder_empty_and_unknown_files_say_so(tmp_path):
    (tmp_path / "empty.png").touch()
    (tmp_path / "note.txt").write_text("a note")
    for name, words in [
        ("nothing.mat", "no such file"),
        (".", "is a folder"),
        ("empty.png", "is empty"),
        ("note.txt", "no reader recognises it.*su2018.*--format"),
    ]:
        with pytest.raises(ValueError, match=words):
            open_capture(tmp_path / name)


def test_a_file_that_two_formats_claim_is_refused(tmp_path):
    path = foreign.adi_bin(tmp_path, width=512, height=512)
    png = foreign.depth_png(tmp_path).read_bytes()
    path.write_bytes(png + bytes(2 * 512 * 512 - len(png)))
    with pytest.raises(ValueError, match=r"both adi_bin and depth_png claim it.*--format"):
        open_capture(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mp4", "unknown name"),
        ("depth_png:scale=big", "wanted a number such as 1000"),
        ("depth_png:scale=nan", "wanted a number such as 1000"),
        ("depth_png:scale=0", "scale must be positive"),
        ("depth_png:colour=1", "no parameter 'colour'"),
        ("depth_png:camera=1+2", r"fx\+fy\+cx\+cy"),
        ("depth_png:hfov_deg=200", "hfov_deg"),
        ("depth_png:freq=20", "Hz, not MHz"),
        ("depth_png:scale=2,kind", "key=value"),
        ("depth_png:kind", "got 'kind' in 'depth_png:kind'; wanted key=value"),
        ("depth_png:kind=z,kind=z", "twice"),
        ("no.such.module:read", "cannot load"),
    ],
)
def test_a_format_that_makes_no_sense_is_refused(text, words, tmp_path):
    with pytest.raises(ValueError, match=words) as caught:
        open_capture(foreign.depth_png(tmp_path), text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", READERS)
def test_the_first_sentence_of_a_reader_says_what_it_reads(name):
    """The docs cut it at the first full stop with a blank, so it must hold no abbreviation."""
    module = importlib.import_module(READERS[name].target.partition(":")[0])
    sentence = re.split(r"(?<=\.)\s", module.__doc__)[0]
    assert len(sentence.split()) > 5
