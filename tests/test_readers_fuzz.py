"""Hostile files: every reader answers with a capture or one sentence, whatever the bytes are.

Base files are the small ones of foreign_files, so this runs without anybody's data. Damage is
drawn by hypothesis with a fixed derandomised seed.
"""

import shutil
import struct
import tempfile
import tracemalloc
from pathlib import Path

import foreign_files as foreign
import hostile_files
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from toftools.io.open import open_capture
from toftools.registry import READERS
from toftools.types import Capture

FUZZ = settings(max_examples=150, derandomize=True, deadline=None, database=None)
SMALL = 32 << 20  # bytes a reader may hold for a file of a few kilobytes


@pytest.fixture(scope="module", params=list(READERS))
def base(request):
    """Format, its forcing text, a path to write damaged bytes to, and the whole bytes."""
    folder = Path(tempfile.mkdtemp())
    path = foreign.MAKERS[request.param](folder)
    yield request.param, foreign.FORCED.get(request.param, request.param), path, path.read_bytes()
    shutil.rmtree(folder)


def answer(path, text=None):
    """The capture, or None after an error that is one whole sentence."""
    try:
        capture = open_capture(path, text)
    except ValueError as error:
        message = str(error)
        assert message.strip()
        assert "\n" not in message
        assert "Traceback" not in message
        return None
    assert isinstance(capture, Capture)
    return capture


def content(capture):
    parts = [capture.taps and capture.taps.values, capture.phasors and capture.phasors.values,
             capture.depth and capture.depth.range_m, capture.depth and capture.depth.amplitude,
             capture.truth and capture.truth.range_m]  # fmt: skip
    return [part.tobytes() for part in parts if part is not None]


def test_a_cut_file_is_refused_or_holds_the_same(base):
    _, text, path, whole = base
    path.write_bytes(whole)
    expected = content(open_capture(path, text))

    @FUZZ
    @given(st.integers(0, len(whole) - 1))
    def check(length):
        path.write_bytes(whole[:length])
        capture = answer(path, text)
        # What lies behind the first frame of a recording may be missing; nothing else.
        assert capture is None or content(capture) == expected
        answer(path)

    check()


def test_flipped_bytes(base):
    _, text, path, whole = base
    flips = st.lists(st.tuples(st.integers(0, len(whole) - 1), st.integers(1, 255)), min_size=1,
                     max_size=8)  # fmt: skip

    @FUZZ
    @given(flips)
    def check(places):
        damaged = bytearray(whole)
        for place, bits in places:
            damaged[place] ^= bits
        path.write_bytes(damaged)
        answer(path, text)
        answer(path)

    check()


def test_flipped_header_bytes(base):
    """Headers are a small part of the file, so they get their own draw."""
    _, text, path, whole = base
    first = st.lists(st.tuples(st.integers(0, min(len(whole), 256) - 1), st.integers(0, 255)),
                     min_size=1, max_size=4)  # fmt: skip

    @FUZZ
    @given(first)
    def check(places):
        damaged = bytearray(whole)
        for place, value in places:
            damaged[place] = value
        path.write_bytes(damaged)
        answer(path, text)

    check()


def test_every_single_flipped_bit_of_a_png_is_noticed(tmp_path):
    """Each chunk carries a checksum, so that nothing but an error can come of it."""
    path = foreign.depth_png(tmp_path)
    whole = path.read_bytes()
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        assert answer(path, "depth_png") is None, place


def test_random_bytes_after_the_right_mark(base):
    _, text, path, whole = base

    @FUZZ
    @given(st.sampled_from([4, 8, 48, 132, 512]), st.binary(max_size=300))
    def check(kept, rest):
        path.write_bytes(whole[:kept] + rest)
        answer(path, text)
        answer(path)

    check()


def test_bytes_put_in_and_taken_out(base):
    _, text, path, whole = base
    place = st.integers(0, len(whole) - 1)

    @FUZZ
    @given(place, st.integers(0, 64), st.binary(max_size=64))
    def check(at, gone, put):
        path.write_bytes(whole[:at] + put + whole[at + gone :])
        answer(path, text)

    check()


def test_an_empty_file_and_a_file_of_another_format(base, tmp_path):
    name, text, path, _ = base
    path.write_bytes(b"")
    assert answer(path, text) is None
    for other in READERS:
        if other == name:
            continue
        folder = tmp_path / other
        folder.mkdir()
        path.write_bytes(foreign.MAKERS[other](folder).read_bytes())
        assert answer(path, text) is None, other


# sizes that a header claims


@pytest.mark.parametrize("claim", hostile_files.CLAIMS, ids=lambda claim: claim.__name__)
def test_a_claimed_size_is_not_allocated(claim, tmp_path):
    path, text = claim(tmp_path)
    import av  # noqa: F401 - imported here so that its own memory is not counted
    import cv2  # noqa: F401
    import h5py  # noqa: F401

    tracemalloc.start()
    try:
        assert answer(path, text) is None
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < SMALL


# numbers that make no sense


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, 1e-300])
def test_senseless_numbers_are_invalid_pixels_or_refused(value, tmp_path):
    shape = (foreign.HEIGHT, foreign.WIDTH)
    filled = np.full(shape, value)
    capture = answer(foreign.npz(tmp_path, range_m=filled))
    assert np.isnan(capture.depth.range_m).all()

    (tmp_path / "p").mkdir()
    answer(foreign.npz(tmp_path / "p", phasors=filled[None] + 0j, freqs_hz=[20e6], K=np.eye(3)))
    answer(foreign.npz(tmp_path / "p", range_m=filled, K=np.diag([value, 1, 1]), dist=[value] * 5))
    answer(foreign.npz(tmp_path / "p", taps=filled[None, None].repeat(4, 1), freqs_hz=[20e6],
                       steps_rad=[value, 1, 2, 3]))  # fmt: skip

    melexis = foreign.melexis_npy(tmp_path)
    for name in ("phase180", "dist", "amp"):
        np.save(tmp_path / f"Scene_{name}_avg.npy", filled)
        answer(melexis)

    (tmp_path / "s").mkdir()
    with np.errstate(all="ignore"):
        answer(foreign.su2018(tmp_path / "s", range_m=filled))
        capture = answer(foreign.su2018(tmp_path / "s", right_m=filled, tofnet_m=filled))
    assert np.isnan(capture.truth.range_m).all()


def test_amplitudes_of_any_float_do_not_break_espros(tmp_path):
    import h5py

    path = foreign.espros_h5(tmp_path)
    with h5py.File(path, "r+") as file:
        file["frames_0"][0, 0] = [np.nan, np.inf, -np.inf, 1e300, -1, 0, 5, 6]
    capture = answer(path)
    assert np.isnan(capture.depth.amplitude[0, :4]).all()


@pytest.mark.parametrize("name", ["frames_0 group", "text", "no freq", "freq text", "freq nan"])
def test_espros_files_of_another_make(name, tmp_path):
    import h5py

    path = foreign.espros_h5(tmp_path)
    with h5py.File(path, "r+") as file:
        if name in ("frames_0 group", "text"):
            del file["frames_0"]
        if name == "frames_0 group":
            file.create_group("frames_0")
        elif name == "text":
            file["frames_0"] = [[["a"]]]
        elif name == "no freq":
            del file.attrs["mod_frequency"]
        else:
            file.attrs["mod_frequency"] = "fast" if name == "freq text" else np.nan
    assert answer(path, "espros_h5") is None


@pytest.mark.parametrize(
    "text",
    [b"", b"{}", b"[]", b"\xff\xfe", b"[" * 100_000, b'{"Cameras": [{"Purpose": 3}]}', b"null",
     b'{"Cameras": [{"Purpose": "XPurposeDepth", "Intrinsics": {"ModelParameters": [1, 2]}}]}',
     b'{"Cameras": [{"Purpose": "XPurposeDepth", "Intrinsics": {"ModelParameters": ["a"]}}]}'],
)  # fmt: skip
def test_azure_calibrations_of_another_make(text, tmp_path):
    path = foreign.azure_mkv(tmp_path, width=320, height=288, attach=False)
    (tmp_path / "calibration.json").write_bytes(text)
    assert answer(path) is None


@pytest.mark.parametrize(
    "meta", ["[" * 100_000, "{", "[]", '{"DistanceResolution": "a"}', '{"DistanceResolution": NaN}']
)
def test_ifm_headers_of_another_make(meta, tmp_path):
    path = tmp_path / "frame.data"
    text = meta.encode() + b"\0"
    size = foreign.WIDTH * foreign.HEIGHT * 2
    fields = (100, 48 + len(text) + size, 48 + len(text), 3, foreign.WIDTH, foreign.HEIGHT)
    path.write_bytes(b"0000star" + struct.pack("<12I", *fields, 2, 0, 7, 0, 0, 0) + text
                     + bytes(size) + b"stop\r\n")  # fmt: skip
    assert answer(path) is None


# the command


@pytest.mark.parametrize("name", READERS)
def test_convert_leaves_nothing_behind_when_it_refuses(name, tmp_path):
    from toftools.cli.convert import command

    path = foreign.MAKERS[name](tmp_path)
    path.write_bytes(path.read_bytes()[:100])
    out = tmp_path / "out" / "c.h5"
    out.parent.mkdir()
    result = CliRunner().invoke(command, [str(path), "--out", str(out), "--format", name])
    assert isinstance(result.exception, ValueError)
    assert list(out.parent.iterdir()) == []


def test_convert_exits_with_2_and_one_line(tmp_path, capsys):
    from toftools.cli import main

    path = foreign.depth_png(tmp_path)
    path.write_bytes(path.read_bytes()[:-5])
    out = tmp_path / "c.h5"
    with pytest.raises(SystemExit) as caught:
        main(["convert", str(path), "--out", str(out)])
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("name", READERS)
def test_convert_and_read_back(name, tmp_path):
    from toftools.cli.convert import command

    path = foreign.MAKERS[name](tmp_path)
    out, text = tmp_path / "c.h5", foreign.FORCED.get(name, name)
    result = CliRunner().invoke(command, [str(path), "--out", str(out), "--format", text])
    assert result.exit_code == 0, result.output
    assert content(open_capture(out)) == content(open_capture(path, text))
