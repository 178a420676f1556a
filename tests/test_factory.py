"""Factory tables as chains: miniatures written here, and the real files where they are at hand."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from toftools.calib.chain import applied
from toftools.calib.factory import adi, kinect2, ti
from toftools.calib.fused import fused
from toftools.calib.store import load_chain, save_chain
from toftools.camera import rays, rays_at
from toftools.registry import FACTORY, find, parameters_of
from toftools.sensors import sensor
from toftools.sim.companding import kinect2_codes
from toftools.types import Camera, Capture, Modulation, Phasors, Sensor, Taps
from toftools.units import range_to_phase

DATA = Path(os.environ.get("TOFTOOLS_DATA", "/nowhere"))
real = pytest.mark.skipif(not DATA.is_dir(), reason="TOFTOOLS_DATA is not set")
KINECT = (424, 512)
LENS = Camera(
    512, 424, np.array([[367.3, 0, 254.6], [0, 367.1, 211.3], [0, 0, 1]]),
    np.array([0.09, -0.27, 1e-3, -5e-4, 0.09]),
)  # fmt: skip


def wall(camera, freqs_hz, error_rad, range_m=1.7):
    """Phasors of a wall `range_m` away along every ray, with an error on their phase."""
    true = range_to_phase(range_m, np.asarray(freqs_hz))[:, None, None]
    z = 100 * np.exp(1j * (true + error_rad))
    return Phasors(np.complex64(z)), true


def left_over_rad(chain, error_rad):
    """Largest phase error of a wall after the chain, over the pixels that stay valid."""
    camera = Camera(chain.width, chain.height, np.array([[300.0, 0, 10], [0, 300, 10], [0, 0, 1]]))
    phasors, true = wall(camera, chain.freqs_hz, error_rad)
    device = Sensor(camera, Modulation(chain.freqs_hz))
    after = applied(chain, Capture(device, phasors=phasors)).phasors
    fast = fused(chain)(phasors)
    assert np.abs(fast.values - after.values)[:, after.valid].max() < 0.01  # of 100
    wrong = np.angle(after.values * np.exp(-1j * true))
    return float(np.abs(wrong[:, after.valid]).max()), after.valid


def refused(load, path, match):
    with pytest.raises(ValueError, match=match) as caught:
        load(path)
    assert "\n" not in str(caught.value)


# Kinect v2


@pytest.fixture(scope="module")
def kinect(tmp_path_factory):
    """Tables of a made-up unit: smooth offsets, alternating rows, a known lens."""
    folder = tmp_path_factory.mktemp("kinect2")
    v, u = np.mgrid[0:424, 0:512]
    smooth = np.stack([m + s * np.cos(u / 170 + v / 140) for m, s in (
        (10_000, 800), (1100, 200), (28_000, 1200))])  # fmt: skip
    odd = np.where(v < 212, v % 2 == 0, v % 2 == 1)
    counts = np.uint16((smooth + 32_768 * odd) % 65_536)
    counts.astype("<u2").tofile(folder / "p0tables_x.dat")
    seen = rays(LENS)
    x, z = 8192 * seen[..., 0] / seen[..., 2], 6250 / 3 * seen[..., 2]
    z[0, 0] = 0
    x.astype("<f4").tofile(folder / "xTable.bin")
    z.astype("<f4").tofile(folder / "zTable.bin")
    half = np.array(kinect2_codes())
    table = np.r_[half, 32_767, -half[1:]]
    table.astype("<i2").tofile(folder / "11to16.bin")
    return folder, counts


@pytest.mark.parametrize("sign", [1, -1])
def test_kinect_offsets_are_taken_off(kinect, sign):
    folder, counts = kinect
    chain = kinect2.load(folder, sign=sign)
    assert [s.slot for s in chain.stages] == ["lens", "response", "common_phase", "fixed_pattern"]
    worst, valid = left_over_rad(chain, -sign * 0.000031 * np.pi * counts)
    assert worst < 1e-5
    assert not valid[0, 0]  # no ray
    assert valid.sum() == valid.size - 1
    assert left_over_rad(chain, sign * 0.000031 * np.pi * counts)[0] > 0.1
    pattern = np.exp(2j * chain.stage("fixed_pattern").map_rad[:, valid])
    assert np.abs(np.angle(pattern.mean(axis=1))).max() < 1e-6


def test_kinect_rows_that_are_in_step_keep_their_half_turns(kinect):
    folder, counts = kinect
    chain = kinect2.load(folder, rows="even")
    ramp = counts.astype(float) - 32_768 * (
        counts.astype(float) > [[[25_000]], [[16_000]], [[44_000]]]
    )
    unit = 0.000031 * np.pi
    wrong = left_over_rad(chain, -unit * (ramp % 32_768))[0] % np.pi
    assert min(wrong, np.pi - wrong) < 2e-5
    assert np.nanmax(np.abs(chain.stage("fixed_pattern").map_rad)) < 0.24  # 2 x 1200 counts
    full = kinect2.load(folder, counts_per_turn=65_536)
    assert left_over_rad(full, -2 * np.pi / 65_536 * counts)[0] < 1e-5


def test_kinect_lens_gives_the_rays_back(kinect):
    chain = kinect2.load(kinect[0])
    lens = chain.stage("lens")
    turned = np.degrees(np.arccos(np.clip((rays(lens.camera) * rays(LENS)).sum(-1), -1, 1)))
    assert turned.max() < 0.002  # a pixel sees 0.16 degrees
    assert np.allclose(lens.camera.K, LENS.K, atol=0.01)
    assert lens.residual.after < 0.002
    assert lens.residual.held_out < 0.002


def test_kinect_codes_become_numbers(kinect):
    stage = kinect2.load(kinect[0]).stage("response")
    codes = np.tile(np.arange(9, dtype=np.float32).reshape(1, 9, 1, 1), (1, 1, *KINECT))
    codes[0, 0, 0, :5] = (0, 255, 1023, 1025, 2047)
    codes[0, 3, 7, 7], codes[0, 4, 8, 8], codes[0, 4, 9, 9] = 1024, 2048, -1
    after = stage.on_taps(Taps(codes, "DN"))
    assert after.values[0, 0, 0, :5].tolist() == [0, 255, 16_320, -1, -16_320]
    assert not after.valid[[7, 8, 9], [7, 8, 9]].any()
    assert after.valid.sum() == after.valid.size - 3
    assert kinect2.load(kinect[0], taps="numbers").stage("response") is None


def test_kinect_files_that_are_none_are_refused(kinect, tmp_path):
    refused(kinect2.load, tmp_path, "must hold one p0tables.*got none of them")
    (tmp_path / "p0.dat").write_bytes(b"\0" * 100)
    refused(kinect2.load, tmp_path / "p0.dat", "it has 100 bytes, wanted 1302528")
    (tmp_path / "xTable.bin").write_bytes((kinect[0] / "xTable.bin").read_bytes())
    refused(kinect2.load, tmp_path, "xTable.bin with zTable.bin")
    (tmp_path / "zTable.bin").write_bytes((kinect[0] / "xTable.bin").read_bytes())
    refused(kinect2.load, tmp_path, "are no ray tables")
    (tmp_path / "zTable.bin").write_bytes((kinect[0] / "zTable.bin").read_bytes())
    (tmp_path / "11to16.bin").write_bytes(bytes(4096))
    refused(kinect2.load, tmp_path, "11to16.bin is no companding table")
    refused(lambda p: kinect2.load(p, sign=0), kinect[0], "sign must be 1 or -1, got 0")
    refused(lambda p: kinect2.load(p, rows="odd"), kinect[0], "rows must be alternate or even")
    refused(lambda p: kinect2.load(p, sensor="opt8241"), kinect[0], "the sensor opt8241 is not")
    refused(kinect2.load, tmp_path / "nothing.dat", "no such file")


# Texas Instruments


def ti_file(path, width=320, height=240):
    v, u = np.mgrid[0:height, 0:width]
    codes = np.int16(-80 + 60 * np.sin(u / 50) + v / 4)
    path.write_bytes(struct.pack("<HH", width, height) + codes.astype("<i2").tobytes())
    return codes


def test_ti_offsets_are_taken_off(tmp_path):
    codes = ti_file(tmp_path / "a.bin")
    chain = ti.load(tmp_path / "a.bin", freq=70e6)
    assert chain.freqs_hz.tolist() == [70e6]
    assert left_over_rad(chain, codes[None] * 2 * np.pi / 4096)[0] < 1e-5
    assert abs(chain.stage("fixed_pattern").map_rad.mean()) < 1e-3
    assert "70 MHz: the file does not say" in chain.stage("fixed_pattern").residual.notes[0]
    flipped = ti.load(tmp_path / "a.bin", sign=-1)
    assert left_over_rad(flipped, -codes[None] * 2 * np.pi / 4096)[0] < 1e-5


def test_ti_files_that_are_none_are_refused(tmp_path):
    path = tmp_path / "a.bin"
    ti_file(path)
    path.write_bytes(path.read_bytes()[:-2])
    refused(ti.load, path, "a.bin is not readable as .* 153604 bytes, got 153602")
    path.write_bytes(b"ab")
    refused(ti.load, path, "a.bin is not readable as TI phase offsets")
    path.write_bytes(struct.pack("<HH", 320, 240) + b"\xff\x7f" * (320 * 240))
    refused(ti.load, path, "reach 32767 codes, a turn has 4096")
    ti_file(path, 20, 10)
    refused(ti.load, path, "a.bin is of 20 x 10 px, the sensor opt8241 of 320 x 240")


# Analog Devices

GEOMETRY = (505.0, 505.2, 520.3, 517.5, -1e-3, 2e-4, 0.237, -0.018, 1.7e-3, 0.574, -4.5e-3, 1.6e-3,
            4.8e-5, -8e-7)  # fmt: skip
FREQS = (19_800, 18_900, 5400)
BINS = (2, 2, 1, 1, 1, 1, 1, 1)


def p0(freq, n=64):
    row = np.float32(1e-5 * freq * np.linspace(0.5, -1, n) ** 2)
    column = np.float32(2e-4 * freq * np.linspace(1, -1, n))
    return row, column


def block(kind, body, calib=12_007):
    head = struct.pack(
        "<BBHIIIHBBBBBB", kind, 4, calib, 24 + len(body), 0, 0, 2019, 3, 22, 1, 2, 3, 1
    )
    return head + body


def ccb_bytes(n=64, higher=0.0):
    header = struct.pack("<HHHH", 5, 1, 1024, 1024) + bytes(128) + b"1909-test".ljust(32, b"\0")
    parts = [block(255, header), block(65, bytes(12))]
    parts.append(block(71, struct.pack("<HHHHBBHI14f", 1024, 1024, 0, 0, 3, 0, 0, 2, *GEOMETRY)))
    for i, freq in enumerate(FREQS, start=1):
        row, column = p0(freq, n)
        coefs = np.zeros((n, 3), np.float32)
        coefs[:, 2], coefs[0, 0] = column, higher
        head = struct.pack("<BBHHBB8B4H", 7, i, freq, 0, 1, 3, *BINS, n, n, 448 // 2, 448 // 2)
        parts.append(block(80, head + row.tobytes() + coefs.tobytes()))
    parts.append(block(84, struct.pack("<4BHH16f", 7, 0, 1, 16, 0, 15_566, *np.arange(16.0))))
    size = 16 + sum(len(part) for part in parts)
    return struct.pack("<HHHHII", 771, 769, 240, 16, size, 0) + b"".join(parts)


def mat_file(path, n=64):
    from scipy.io import savemat

    blocks = np.empty(3, dtype=object)
    names = ("analogBin", "digitalBin", "subsampling", "softwareBin")
    bins = {
        f"{s}{a}": BINS[2 * i + j]
        for i, s in enumerate(names)
        for j, a in enumerate(("Rows", "Cols"))
    }
    for i, freq in enumerate(FREQS):
        row, column = p0(freq, n)
        blocks[i] = {
            "mode": 7, "freqIndex": i + 1, "freq": freq, "nRowCoefs": 1, "nColCoefs": 3,
            "nRows": n, "nCols": n, "offsetRows": 224, "offsetCols": 224,
            "P0RowCoefs": row[:, None],
            "P0ColCoefs": np.stack([0 * column, 0 * column, column], axis=1), **bins,
        }  # fmt: skip
    names = ("fx", "fy", "px", "py", "cx", "cy")
    lens = dict(zip(names, GEOMETRY[:6], strict=True))
    lens |= {
        "nRows": 1024,
        "nCols": 1024,
        "k": GEOMETRY[6:12],
        "tx": GEOMETRY[12],
        "ty": GEOMETRY[13],
    }
    heat = {
        "mode": 7, "freqIndex": 0, "captureNumber": 1, "laserIdentity": 16,
        "calibrationPhase": 15_566, "amplitudeCoefficients": np.arange(8.0),
        "phaseCoefficients": np.arange(8.0) + 8,
    }  # fmt: skip
    cal = {
        "header": {"serialNumber": "1909-test"}, "GeometricCalibration": lens,
        "ComplexDeprojection": blocks, "TemperatureCorrection": heat,
    }  # fmt: skip
    savemat(path, {"cal": cal}, do_compression=True)


@pytest.fixture(scope="module")
def ccb(tmp_path_factory):
    path = tmp_path_factory.mktemp("adi") / "unit.ccb"
    path.write_bytes(ccb_bytes())
    return path


def test_adi_offsets_are_taken_off_from_either_file(ccb):
    chain = adi.load(ccb)
    error = np.stack([r[:, None] + c for r, c in (p0(f) for f in FREQS)])
    assert chain.freqs_hz.tolist() == [198e6, 189e6, 54e6]
    assert left_over_rad(chain, error)[0] < 1e-5
    assert left_over_rad(adi.load(ccb, sign=-1), -error)[0] < 1e-5
    assert chain.notes["serial"] == "1909-test"
    kept = chain.notes["not_applied"]["temperature"]
    assert [k["phase"] for k in kept] == [list(range(8, 16))]
    mat = ccb.with_suffix(".mat")
    mat_file(mat)
    other = adi.load(mat)
    same = [
        (c.stage("fixed_pattern").map_rad, c.stage("common_phase").phase_rad)
        for c in (chain, other)
    ]
    assert all((a == b).all() for a, b in zip(*same, strict=True))
    assert np.allclose(other.stage("lens").camera.K, chain.stage("lens").camera.K, atol=1e-4)
    assert dict(other.notes) | {"file": ""} == dict(chain.notes) | {"file": ""}


def vendor_pixels(xy):
    """The lens of the block, spelled out: pixels of the binned, cut frame."""
    fx, fy, px, py, cx, cy, k1, k2, k3, k4, k5, k6, tx, ty = GEOMETRY
    x, y = xy[..., 0] - cx, xy[..., 1] - cy
    s = x**2 + y**2
    radial = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    u = (x * radial + tx * (s + 2 * x**2) + 2 * ty * x * y + cx) * fx + px
    v = (y * radial + ty * (s + 2 * y**2) + 2 * tx * x * y + cy) * fy + py
    return (u + 0.5) / 2 - 0.5 - 224, (v + 0.5) / 2 - 0.5 - 224


def test_adi_lens_stands_for_that_of_the_block(ccb):
    lens = adi.load(ccb).stage("lens")
    v, u = np.mgrid[2:60:7, 2:60:7].astype(float)
    seen = rays_at(lens.camera, u, v)
    back_u, back_v = vendor_pixels(seen[..., :2] / seen[..., 2:])
    assert max(np.abs(back_u - u).max(), np.abs(back_v - v).max()) < 0.01
    assert lens.residual.after < 0.01


def test_adi_files_that_are_none_are_refused(tmp_path):
    path, good = tmp_path / "a.ccb", ccb_bytes()
    cases = [
        (good[:-4], r"a.ccb is not readable as an ADI calibration block: its head says"),
        (good[:9], "not readable as an ADI"),
        (good[:20] + b"\xff\xff\xff\xff" + good[24:], "a block of 4294967295 bytes does not fit"),
        (ccb_bytes(higher=1.0), "not a finite constant per row and column"),
        (b"MATLAB 5.0 MAT-file" + bytes(200), "no MATLAB level-5 file"),
    ]
    for data, match in cases:
        path.write_bytes(data)
        refused(adi.load, path, match)
    path.write_bytes(good)
    refused(lambda p: adi.load(p, mode=3), path, "P0 for the modes 7; wanted a lens and mode 3")


def test_hostile_mat_files_are_refused(tmp_path):
    import zlib

    path = tmp_path / "a.mat"
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"

    def element(kind, data):
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    cells = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<ii", 1 << 30, 4))
    packed = zlib.compress(element(14, cells + element(1, b"cal")))
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    refused(adi.load, path, "claims .* elements in")
    bomb = zlib.compress(bytes(1 << 26))
    path.write_bytes(head + struct.pack("<II", 15, len(bomb)) + bomb)
    refused(adi.load, path, "unpacks to more than 32 MiB")
    path.write_bytes(head + element(14, element(6, bytes(8)))[:-2])
    refused(adi.load, path, "a.mat is not readable as an ADI calibration block")
    mat_file(path)
    data = bytearray(path.read_bytes())
    for at in range(140, len(data), 97):  # damage here and there: a sentence, or the right answer
        damaged = data.copy()
        damaged[at] ^= 0x5A
        path.write_bytes(damaged)
        try:
            adi.load(path)
        except ValueError as error:
            assert str(error).startswith("a.mat")


def test_loaders_are_found_by_name_and_their_chains_are_saved(ccb, tmp_path):
    assert set(FACTORY) == {"kinect2", "ti", "adi"}
    for name, spec in FACTORY.items():
        assert "sign" in parameters_of(spec.load()), name
    chain = find(FACTORY, "adi:sign=-1").build(ccb)
    save_chain(tmp_path / "cal.json", chain)
    again = load_chain(tmp_path / "cal.json")
    assert (again.stage("fixed_pattern").map_rad == chain.stage("fixed_pattern").map_rad).all()
    assert (again.stage("lens").camera.dist == chain.stage("lens").camera.dist).all()
    assert again.notes["serial"] == "1909-test"


# Real files


@real
def test_real_kinect_tables():
    folder = DATA / "kinect2_tables"
    chain = kinect2.load(folder)
    counts = np.fromfile(next(folder.glob("p0*.dat")), "<u2").reshape(3, *KINECT)
    worst, valid = left_over_rad(chain, -0.000031 * np.pi * counts)
    assert worst < 1e-5
    assert valid.mean() > 0.99999
    lens = chain.stage("lens")
    assert lens.residual.held_out < 0.001
    assert np.abs(lens.camera.dist[2:4]).max() < 1e-6  # the tables were made without
    assert lens.camera.K[0, 0] == pytest.approx(lens.camera.K[1, 1], abs=0.001)
    spread = kinect2.load(folder, rows="even").stage("fixed_pattern").map_rad
    assert np.nanstd(spread, axis=(1, 2)) == pytest.approx([0.078, 0.021, 0.115], abs=0.001)


@real
def test_real_ti_offsets():
    path = DATA / "ti_phase_offset" / "TintinCDK_TintinCDKCameraPhaseOffset.bin"
    codes = np.fromfile(path, "<i2")[2:].reshape(240, 320)
    chain = ti.load(path)
    assert left_over_rad(chain, codes[None] * 2 * np.pi / 4096)[0] < 1e-5
    assert chain.stage("common_phase").phase_rad[0] == pytest.approx(-0.117, abs=0.001)


@real
def test_real_adi_block_is_the_same_in_both_forms():
    folder = DATA / "adi_adtf3175"
    (binary,), (mat,) = folder.glob("*0240034.ccb"), folder.glob("*0240034.mat")
    one, two = adi.load(binary), adi.load(mat)
    assert one.freqs_hz.tolist() == [198e6, 189e6, 54e6]
    assert (one.stage("fixed_pattern").map_rad == two.stage("fixed_pattern").map_rad).all()
    assert dict(one.notes) | {"file": ""} == dict(two.notes) | {"file": ""}
    assert one.stage("lens").residual.after < 0.06 < one.stage("lens").residual.before
    preset = sensor("adtf3175").camera
    assert np.allclose(one.stage("lens").camera.K, preset.K, atol=0.3)
    common, pattern = one.stage("common_phase").phase_rad, one.stage("fixed_pattern").map_rad
    assert left_over_rad(one, common[:, None, None] + pattern)[0] < 1e-5
    lone = next(folder.glob("*0180039.ccb"))
    refused(adi.load, lone, "it holds no lens and P0 for the modes none")
