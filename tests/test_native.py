"""The capture file holds everything, and a damaged one is refused in one sentence."""

import json

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toftools.camera import pinhole
from toftools.io.native import is_capture, read_capture, write_capture
from toftools.sensors import sensor
from toftools.types import (
    Camera,
    Capture,
    Defects,
    DepthMap,
    Modulation,
    Noise,
    Phasors,
    PixelMaps,
    Sensor,
    Taps,
    Timing,
    Truth,
)

FUZZ = settings(max_examples=200, derandomize=True, deadline=None, database=None)
SHAPE = (5, 7)


def whole_capture():
    rng = np.random.default_rng(7)
    K = np.array([[90.0, 0.5, 3.2], [0, 91.0, 2.1], [0, 0, 1]])
    harmonics = np.array([[1, 0, 0.1j], [1, 0, -0.2]])
    sensor = Sensor(
        Camera(7, 5, K, np.array([0.1, -0.2, 1e-3, 2e-3, 0.05])),
        Modulation(np.array([40e6, 70e6]), np.arange(8).reshape(2, 4) / 2, harmonics),
        Noise(read_e=12.0, full_well_e=1e5, dn_per_e=0.25, contrast=0.7, signal_e=3e4),
        (0.01, -0.02, 0.003),
        "mine",
        maps=PixelMaps(np.ones((1, *SHAPE)), np.zeros((1, *SHAPE)), np.zeros((2, *SHAPE))),
    )
    valid = rng.random(SHAPE) > 0.2
    z = rng.normal(size=(2, *SHAPE)) + 1j * rng.normal(size=(2, *SHAPE))
    range_m = rng.random(SHAPE)
    range_m[1, 1] = np.nan
    return Capture(
        sensor,
        taps=Taps(np.round(1000 * rng.random((2, 4, *SHAPE))), "DN", valid),
        phasors=Phasors(z, sigma=rng.random((2, *SHAPE)), valid=valid),
        depth=DepthMap(range_m, rng.random(SHAPE), rng.random(SHAPE), rng.random(SHAPE)),
        truth=Truth(range_m, z),
        reported={"other": range_m},
        provenance={"source": "test", "nested": {"a": [1, 2.5, None, "x"]}},
    )


def arrays(capture):
    return {
        "taps": capture.taps.values,
        "taps valid": capture.taps.valid,
        "phasors": capture.phasors.values,
        "sigma": capture.phasors.sigma,
        "valid": capture.phasors.valid,
        "range": capture.depth.range_m,
        "range sigma": capture.depth.sigma_m,
        "confidence": capture.depth.confidence,
        "amplitude": capture.depth.amplitude,
        "truth": capture.truth.range_m,
        "direct": capture.truth.direct,
        "other": capture.reported["other"],
        "K": capture.sensor.camera.K,
        "dist": capture.sensor.camera.dist,
        "freqs": capture.sensor.modulation.freqs_hz,
        "steps": capture.sensor.modulation.steps_rad,
        "harmonics": capture.sensor.modulation.harmonics,
    }


def test_everything_comes_back_bit_for_bit(tmp_path):
    capture = whole_capture()
    write_capture(tmp_path / "c.h5", capture)
    again = read_capture(tmp_path / "c.h5")
    for (name, before), after in zip(arrays(capture).items(), arrays(again).values(), strict=True):
        assert before.dtype == after.dtype, name
        assert np.array_equal(before, after, equal_nan=before.dtype != bool), name
    assert vars(again.sensor.noise) == vars(capture.sensor.noise)
    assert again.sensor.name == capture.sensor.name
    assert again.sensor.emitter_offset_m == capture.sensor.emitter_offset_m
    assert again.taps.unit == "DN"
    assert dict(again.provenance) == dict(capture.provenance)


def test_the_layout_is_the_documented_one(tmp_path):
    write_capture(tmp_path / "c.h5", whole_capture())
    with h5py.File(tmp_path / "c.h5") as file:
        assert (file.attrs["format"], file.attrs["version"]) == ("toftools-capture", 1)
        assert json.loads(file.attrs["provenance"])["source"] == "test"
        assert file["taps"].dtype == np.uint16  # whole digital numbers
        assert file["taps"].attrs["unit"] == "DN"
        assert file["phasors"].dtype == np.complex64
        assert file["sensor"].attrs["K"].shape == (3, 3)
        assert {"width", "height", "dist", "freqs_hz", "steps_rad"} <= set(file["sensor"].attrs)
        for name in ("sigma", "valid", "depth/range_m", "truth/range_m", "truth/direct"):
            assert name in file
        assert file["taps"].compression == "gzip"


def test_minimal_file_of_another_program(tmp_path):
    """Only what the layout demands, written with h5py alone."""
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.attrs.update(format="toftools-capture", version=1)
        file.create_group("sensor").attrs.update(
            width=7, height=5, K=np.diag([50.0, 50, 1]), freqs_hz=[20e6],
            steps_rad=np.arange(4) * np.pi / 2,
        )  # fmt: skip
        file["taps"] = np.ones((1, 4, *SHAPE), np.uint16)
    capture = read_capture(tmp_path / "c.h5")
    assert capture.taps.valid.all()
    assert capture.taps.values.dtype == np.float32


def test_only_captures_are_captures(tmp_path):
    write_capture(tmp_path / "c.h5", whole_capture())
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    (tmp_path / "text.h5").write_text("not HDF5")
    assert is_capture(tmp_path / "c.h5")
    for name in ("other.h5", "text.h5", "missing.h5"):
        assert not is_capture(tmp_path / name)
        with pytest.raises(ValueError, match=name) as caught:
            read_capture(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "c.h5"
    write_capture(target, whole_capture())
    before = target.read_bytes()
    capture = whole_capture()
    looped = {}
    looped["self"] = looped  # JSON cannot hold it, which shows in the middle of writing
    broken = Capture(capture.sensor, phasors=capture.phasors, provenance=looped)
    with pytest.raises(ValueError, match="Circular"):
        write_capture(target, broken)
    assert target.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["c.h5"]
    with pytest.raises(ValueError, match="writable folder"):
        write_capture(tmp_path / "no" / "c.h5", capture)


def attribute(key, value, group="sensor"):
    return lambda file: (file[group] if group else file).attrs.__setitem__(key, value)


def without(*keys):
    def change(file):
        for key in keys:
            del file[key]

    return change


def instead(key, value):
    def change(file):
        del file[key]
        if value is None:
            file.create_group(key)
        else:
            file[key] = value

    return change


def pixel(key, value):
    return lambda file: file[key].__setitem__((0, 0), value)


SPOILED = {
    "version": attribute("version", 2, None),
    "no sensor": without("sensor"),
    "no K": lambda file: file["sensor"].attrs.__delitem__("K"),
    "endless width": attribute("width", np.inf),
    "broken width": attribute("width", 5.5),
    "two widths": attribute("width", [5, 5]),
    "endless version": attribute("version", np.inf, None),
    "no version": attribute("version", h5py.Empty("f"), None),
    "endless emitter": attribute("extra", '{"emitter_offset_m": [1e400, 0, 0]}'),
    "huge emitter": attribute("extra", '{"emitter_offset_m": [1%s, 0, 0]}' % ("0" * 400)),
    "huge harmonics": attribute(
        "extra", '{"harmonics_re": [[1, 1%s]], "harmonics_im": [[0, 0]]}' % ("0" * 400)
    ),
    "endless harmonics": attribute(
        "extra", '{"harmonics_re": [[1, 1e999], [1, 0]], "harmonics_im": [[0, 0], [0, 0]]}'
    ),
    "harmonics without im": attribute("extra", '{"harmonics_re": [[1], [1]]}'),
    "noise list": attribute("extra", '{"noise": [1]}'),
    "noise nan": attribute("extra", '{"noise": {"signal_e": NaN}}'),
    "defects list": attribute("extra", '{"defects": [1]}'),
    "defects of other layers": attribute("extra", '{"defects": {"fppn_rad": [1, 2, 3]}}'),
    "ragged defects": attribute("extra", '{"defects": {"fppn_rad": [1, [2]]}}'),
    "endless defects": attribute("extra", '{"defects": {"temperature_c": 1e999}}'),
    "huge unit": attribute("extra", '{"defects": {"unit": 1%s}}' % ("0" * 400)),
    "timing text": attribute("extra", '{"timing": {"tap_interval_s": "now"}}'),
    "two-tap steps": attribute("extra", '{"timing": {"taps_per_exposure": 2}}'),
    "falling codes": attribute("extra", '{"noise": {"codes_dn": [0, 2, 1]}}'),
    "one code": attribute("extra", '{"noise": {"codes_dn": 0}}'),
    "codes and bits": attribute("extra", '{"noise": {"codes_dn": [0, 1], "adc_bits": 8}}'),
    "gain without phase": without("sensor/phase_rad"),
    "gain of another shape": instead("sensor/gain", np.ones((2, *SHAPE))),
    "negative gain": pixel("sensor/gain", -1),
    "complex dark map": instead("sensor/dark_e", np.ones((1, *SHAPE), complex)),
    "phasors of other layers": instead("phasors", np.ones((3, *SHAPE))),
    "sigma of another shape": instead("sigma", np.ones(SHAPE)),
    "depth of another shape": instead("depth/range_m", np.ones((7, 5))),
    "complex valid": instead("valid", np.ones(SHAPE, complex)),
    "text depth": instead("depth/range_m", [["a"] * 7] * 5),
    "external link": instead("phasors", h5py.ExternalLink("other.h5", "phasors")),
    "format array": attribute("format", np.arange(900), None),
    "text width": attribute("width", "wide"),
    "huge width": attribute("width", 10**9),
    "extra": attribute("extra", "{"),
    "extra list": attribute("extra", "[]"),
    "extra noise": attribute("extra", '{"noise": {"read_e": "a"}}'),
    "extra ragged": attribute("extra", '{"harmonics_re": [[1], [1, 2]], "harmonics_im": [[0]]}'),
    "provenance": attribute("provenance", "[1]", None),
    "deep provenance": attribute("provenance", "[" * 50_000, None),
    "nothing": without("taps", "phasors", "depth"),
    "taps group": instead("taps", None),
    "text taps": instead("taps", [[[["a"]]]]),
    "wrong shape": instead("taps", np.ones((2, 4, 5, 8))),
    "complex range": instead("depth/range_m", np.ones(SHAPE, complex)),
    "infinite range": pixel("depth/range_m", np.inf),
    "negative range": pixel("depth/range_m", -1),
    "scalar phasors": instead("phasors", 1.0),
    "unit": attribute("unit", "V", "taps"),
    "reported dataset": instead("reported", np.ones(SHAPE)),
}


@pytest.mark.parametrize("name", SPOILED)
def test_an_inconsistent_file_is_refused(name, tmp_path):
    path = tmp_path / "c.h5"
    write_capture(path, whole_capture())
    with h5py.File(path, "r+") as file:
        SPOILED[name](file)
    with pytest.raises(ValueError, match=r"c\.h5 is not a readable toftools capture") as caught:
        read_capture(path)
    assert "\n" not in str(caught.value)


def refused_or_read(path):
    try:
        read_capture(path)
    except ValueError as error:
        assert "\n" not in str(error)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    path = tmp_path_factory.mktemp("native") / "c.h5"
    write_capture(path, whole_capture())
    return path, path.read_bytes()


def test_a_cut_file_is_refused(base):
    path, whole = base

    @FUZZ
    @given(st.integers(0, len(whole) - 1))
    def check(length):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="capture") as caught:
            read_capture(path)
        assert "\n" not in str(caught.value)

    check()


def test_flipped_bytes(base):
    path, whole = base
    place = st.tuples(st.integers(0, len(whole) - 1), st.integers(1, 255))

    @FUZZ
    @given(st.lists(place, min_size=1, max_size=8))
    def check(places):
        damaged = bytearray(whole)
        for at, bits in places:
            damaged[at] ^= bits
        path.write_bytes(damaged)
        refused_or_read(path)
        is_capture(path)

    check()


def test_a_heap_on_which_the_library_would_run_forever_is_refused(base):
    """Free space of size 0: HDF5 2.0.0 walks it on the spot, which no time limit in here stops."""
    path, whole = base
    heap = whole.index(b"GCOL")
    first = heap + 16  # index 2 bytes, references 2, reserved 4, size 8
    damaged = bytearray(whole)
    damaged[first : first + 16] = bytes(16)
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match=f"heap at byte {heap} is damaged"):
        read_capture(path)
    assert not is_capture(path)


def test_heaps_within_heaps_take_no_time(tmp_path):
    """A megabyte of marks, each claiming the whole file: a walk of every one would be 5e8 steps."""
    mark = b"GCOL\x01\0\0\0" + (1 << 20).to_bytes(8, "little")
    around = b"\x01" + bytes(7) + len(mark).to_bytes(8, "little")  # an object that holds the mark
    (tmp_path / "c.h5").write_bytes((around + mark) * (1 << 15))
    with pytest.raises(ValueError, match="is damaged"):
        read_capture(tmp_path / "c.h5")


def test_another_file_is_not_read_through_a_capture(tmp_path):
    """Links, external storage and virtual datasets could show any file of this machine."""
    write_capture(tmp_path / "other.h5", whole_capture())
    path = tmp_path / "c.h5"
    for change in ("link", "external", "virtual"):
        write_capture(path, whole_capture())
        with h5py.File(path, "r+") as file:
            del file["depth/range_m"]
            if change == "link":
                file["depth/range_m"] = h5py.ExternalLink("other.h5", "depth/range_m")
            elif change == "external":
                (tmp_path / "raw").write_bytes(bytes(4 * 35))
                file.create_dataset("depth/range_m", SHAPE, "f4",
                                    external=[(str(tmp_path / "raw"), 0, 4 * 35)])  # fmt: skip
            else:
                layout = h5py.VirtualLayout(SHAPE, "f4")
                layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "depth/range_m", SHAPE)
                file.create_virtual_dataset("depth/range_m", layout)
        with pytest.raises(ValueError, match="must lie in the file itself"):
            read_capture(path)


KEYS = ["taps", "phasors", "sigma", "valid", "depth/range_m", "depth/sigma_m", "depth/confidence",
        "depth/amplitude", "truth/range_m", "truth/direct", "reported/other", "sensor/gain",
        "sensor/dark_e", "sensor/phase_rad"]  # fmt: skip
DTYPES = ["?", "i1", ">u2", "i8", "f2", ">f4", "f8", "c8", "c16", "S3"]
NUMBERS = st.one_of(
    st.floats(), st.integers(-(2**63), 2**63 - 1), st.sampled_from([0, 1, 5, 7, -1, 1e300])
)


def test_arrays_of_any_shape_and_dtype(base):
    path, whole = base
    shapes = st.one_of(
        st.sampled_from([SHAPE, (2, *SHAPE), (2, 4, *SHAPE), (7, 5)]),
        st.lists(st.integers(0, 8), max_size=5).map(tuple),
    )

    @FUZZ
    @given(st.sampled_from(KEYS), shapes, st.sampled_from(DTYPES), NUMBERS, st.booleans())
    def check(key, shape, dtype, number, chunked):
        path.write_bytes(whole)
        with np.errstate(all="ignore"), h5py.File(path, "r+") as file:
            del file[key]
            values = np.full(shape, number, dtype="f8").astype(dtype)
            packed = {"compression": "gzip"} if chunked and values.size and shape else {}
            file.create_dataset(key, data=values, **packed)
        refused_or_read(path)

    check()


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5)
    | st.sampled_from([0, -1, 2, 10**400, -(10**30)]),
    lambda inner: st.lists(inner, max_size=4), max_leaves=6,
)  # fmt: skip


def test_attributes_of_any_kind(base):
    path, whole = base
    names = [("sensor", name) for name in ("width", "height", "K", "dist", "freqs_hz",
                                           "steps_rad", "extra")]  # fmt: skip
    names += [("/", "format"), ("/", "version"), ("/", "provenance"), ("taps", "unit")]
    values = st.one_of(
        NUMBERS, st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9),
        st.binary(min_size=1, max_size=9).map(np.void),
        st.lists(st.floats(), max_size=9), st.just(h5py.Empty("f8")),
        st.lists(st.lists(st.floats(), min_size=3, max_size=3), min_size=1, max_size=3),
    )  # fmt: skip

    @FUZZ
    @given(st.sampled_from(names), values)
    def check(name, value):
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            file[name[0]].attrs[name[1]] = value
        refused_or_read(path)
        is_capture(path)

    check()


def test_extras_of_any_kind(base):
    path, whole = base
    keys = ["name", "emitter_offset_m", "emitters", "harmonics_re", "harmonics_im", "noise",
            "defects", "timing"]  # fmt: skip
    fields = [*vars(Noise()), *vars(Defects()), *vars(Timing())]
    noise = st.dictionaries(st.sampled_from(fields), JSON)

    @FUZZ
    @given(st.dictionaries(st.sampled_from(keys), JSON | noise))
    def check(extra):
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            file["sensor"].attrs["extra"] = json.dumps(extra)
        refused_or_read(path)

    check()


def test_amplitude_only_depth_survives(tmp_path):
    sensor = Sensor(pinhole(7, 5, hfov_deg=60), Modulation(np.array([20e6])))
    depth = DepthMap(np.full(SHAPE, np.nan), amplitude=np.ones(SHAPE))
    write_capture(tmp_path / "c.h5", Capture(sensor, depth=depth))
    again = read_capture(tmp_path / "c.h5")
    assert np.isnan(again.depth.range_m).all()
    assert (again.depth.amplitude == 1).all()


def test_emitters_and_every_part_of_the_truth_come_back(tmp_path):
    from dataclasses import replace

    from toftools.types import Emitter, Truth

    made = sensor("opt8241:width=4,height=3")
    beam = np.array([[0.0, 1.0], [30.0, 0.5]])
    made = replace(
        made,
        emitters=(
            Emitter((0.02, 0, 0), beam, delay_s=1e-10),
            Emitter(modulated=False, strength=2.0),
        ),
    )
    rng = np.random.default_rng(0)
    parts = {
        name: (rng.normal(size=(2, 3, 4)) + 1j).astype(np.complex64)
        for name in ("direct", "one_bounce", "rest")
    }
    truth = Truth(
        np.full((3, 4), 2.0, np.float32),
        **parts,
        normals=rng.normal(size=(3, 4, 3)),
        albedo=np.full((3, 4), 0.5),
    )
    capture = Capture(made, phasors=Phasors(parts["direct"]), truth=truth)
    write_capture(tmp_path / "c.h5", capture)
    back = read_capture(tmp_path / "c.h5")
    assert len(back.sensor.emitters) == 2
    assert np.array_equal(back.sensor.emitters[0].beam, beam)
    assert back.sensor.emitter_offset_m == (0.02, 0, 0)
    for old, new in zip(made.emitters, back.sensor.emitters, strict=True):
        assert (old.offset_m, old.strength, old.modulated, old.delay_s) == (
            new.offset_m, new.strength, new.modulated, new.delay_s
        )  # fmt: skip
    for name in (*parts, "normals", "albedo"):
        assert np.array_equal(getattr(truth, name), getattr(back.truth, name))
