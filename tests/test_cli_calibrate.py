"""``toftools calibrate``, ``correct --calib`` and ``inspect CAL.json`` as a user meets them."""

import json
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from toftools.calib.store import load_chain
from toftools.cli import main
from toftools.conditions import Conditions
from toftools.io.conditions import write_conditions
from toftools.io.native import read_capture, write_capture
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.sim.rig import Errors
from toftools.sim.rig import rig as rig_of
from toftools.sim.waveform import with_waveform
from toftools.types import PixelMaps, Scene, Shot

NOMINAL = sensor("opt8241:width=24,height=18")
SHAPE = (2, 18, 24)
PATTERN = np.random.default_rng(3).normal(0, 0.01, SHAPE)
COMMON = np.array([0.11, -0.2])[:, None, None]
DRIFT = np.array([0.002, 0.0035])[:, None, None]


def call(capsys, *args):
    with pytest.raises(SystemExit) as caught:
        main([str(a) for a in args])
    out = capsys.readouterr()
    return caught.value.code, out.out, out.err


def seen(distance_m, *, seed, sensor_c=30.0):
    """A wall as a camera with wiggling, pattern, constant and drift sees it."""
    phase = COMMON + PATTERN + DRIFT * (sensor_c - 30)
    maps = PixelMaps(np.ones((1, *SHAPE[1:])), np.zeros((1, *SHAPE[1:])), phase)
    planted = replace(with_waveform(NOMINAL, "square"), maps=maps)
    taken = analytic(Scene("wall", {"range": distance_m}))(Shot(planted, seed=seed))
    return replace(taken, sensor=NOMINAL, truth=None)


def rig(folder, *, checks=True, warm=True):
    """A folder of recordings and its table."""
    told = {}

    def add(name, distance_m, kind, **more):
        write_capture(folder / name, seen(distance_m, seed=len(told),
                                          sensor_c=more.get("sensor_c", 30.0)))  # fmt: skip
        told[name] = Conditions(kind, distance_m=distance_m, **more)

    base = {"sensor_c": 30.0, "light_c": 33.0} if warm else {}
    for n, distance_m in enumerate(np.linspace(0.6, 4.3, 16)):
        add(f"rail{n:02d}.h5", float(distance_m), "rail", **base)
    for n in range(3):
        add(f"wall{n}.h5", 1.0 + 0.1 * n, "wall", **base)
    if warm:
        for n in range(6):
            add(f"warm{n}.h5", 1.0, "warmup", sensor_c=25.0 + 4 * n, light_c=30.0 + 3 * (n % 3))
    if checks:
        for n in range(4):
            add(f"check{n}.h5", 0.9 + 0.5 * n, "check", **base)
    write_conditions(folder, told)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return rig(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """A calibration of everything but the temperature, with its report."""
    out = tmp_path_factory.mktemp("whole")
    made = [out / "cal.json", out / "report.html"]
    with pytest.raises(SystemExit) as caught:
        main(["calibrate", "all", str(folder), "--out", str(made[0]), "--report", str(made[1])])
    assert caught.value.code == 0
    return made


def test_all_fits_what_the_folder_allows_and_judges_it(capsys, folder, tmp_path):
    out = tmp_path / "cal.json"
    code, said, err = call(capsys, "calibrate", "all", folder, "--out", out, "--json")
    assert (code, err) == (0, "")
    found = json.loads(said)
    stages = [row["stage"] for row in found["stages"]]
    assert stages[:3] == ["wiggling", "common_phase", "fixed_pattern"]
    assert "capture 15 to 30 views of a printed board" in found["skipped"]["lens"]
    judged = found["verdict"]
    assert judged["word"] == "GOOD", judged
    assert [row["name"] for row in judged["after"]] == ["40 MHz", "70 MHz", "together"]
    together = judged["after"][-1]
    assert together["rms_mm"] < 1.1 * together["noise_mm"]
    assert judged["before"][-1]["rms_mm"] > 3 * together["rms_mm"]
    assert sorted(spot["name"] for spot in judged["captures"]) == [f"check{n}.h5" for n in range(4)]


def test_all_says_plan_residuals_and_verdict(capsys, folder, tmp_path):
    code, said, _ = call(capsys, "calibrate", "all", folder, "--out", tmp_path / "c.json", "--skip",
                         "temperature", "--stage", "wiggling_spline:knots=0")  # fmt: skip
    assert code == 0
    lines = said.splitlines()
    assert lines[0] == "plan"
    assert "  wiggling       16 rail by wiggling_spline:knots=0" in lines
    assert "  temperature    skipped: left out by --skip" in lines
    assert "  held out       4 captures of kind check" in lines
    assert any(line.startswith("GOOD: ") and "x the noise floor" in line for line in lines)
    assert lines[-1] == f"wrote {tmp_path / 'c.json'}"


def test_the_report_stands_alone(whole):
    page = whole[1].read_text(encoding="utf-8")
    assert "GOOD: " in page
    assert page.count("data:image/webp;base64,") >= 5
    assert not [s for s in ("http://", "https://", "<script", "src=\"/", "nan") if s in
                page.replace("data:image/webp;base64,", "")[:4000]]  # fmt: skip
    for what in ("range error over distance", "cyclic error", "fixed pattern", "check3.h5"):
        assert what in page


def test_without_a_check_the_rail_gives_some_positions_away(capsys, tmp_path):
    rig(tmp_path, checks=False, warm=False)
    code, said, _ = call(
        capsys, "calibrate", "all", tmp_path, "--out", tmp_path / "c.json", "--json"
    )
    assert code == 0
    found = json.loads(said)
    held = [spot["name"] for spot in found["verdict"]["captures"]]
    assert sorted(held) == ["rail02.h5", "rail07.h5", "rail12.h5"]
    assert found["verdict"]["word"] == "GOOD"


def test_stages_one_by_one_in_order(capsys, folder, tmp_path):
    out = tmp_path / "cal.json"
    rail, walls = sorted(folder.glob("rail*.h5")), sorted(folder.glob("wall*.h5"))
    code, said, err = call(capsys, "calibrate", "wiggling:harmonics=4", *rail, "--out", out)
    assert code == 0, err
    assert "wrote" in said
    assert "which holds wiggling" in said
    code, said, err = call(capsys, "calibrate", "fixed_pattern", *walls, "--out", out)
    assert code == 0, err
    before = out.read_bytes()
    code, _, err = call(capsys, "calibrate", "common_phase", *walls, "--out", out)
    assert code == 2
    assert "got common_phase after fixed_pattern, which was fitted without it" in err
    assert out.read_bytes() == before
    code, said, err = call(capsys, "calibrate", "fixed_pattern", *walls, "--out", out)
    assert code == 0, err  # the last one may be fitted again
    assert "which holds wiggling, fixed_pattern" in said


def test_a_missing_earlier_stage_is_a_warning(capsys, folder, tmp_path, caplog):
    wall = folder / "wall0.h5"
    code, _, _ = call(capsys, "calibrate", "fixed_pattern", wall, "--out", tmp_path / "c.json")
    assert code == 0
    assert "fixed_pattern is fitted without lens, wiggling and common_phase" in caplog.text


def test_a_table_elsewhere_and_a_calibration_to_start_from(capsys, folder, tmp_path):
    table = tmp_path / "mine.csv"
    table.write_text("file,kind,distance_m\nwall0.h5,wall,1.0\nwall1.h5,wall,1.1\n")
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    code, said, err = call(capsys, "calibrate", "common_phase", folder, "--conditions", table,
                           "--out", first)  # fmt: skip
    assert code == 0, err
    before = first.read_bytes()
    code, said, err = call(capsys, "calibrate", "fixed_pattern", folder, "--from", first, "--out",
                           second)  # fmt: skip
    assert code == 0, err
    assert "fixed_pattern takes 3 wall out of " in said
    assert "which holds common_phase, fixed_pattern" in said
    assert first.read_bytes() == before
    code, said, err = call(capsys, "calibrate", "all", folder, "--from", second, "--out",
                           tmp_path / "third.json", "--skip", "wiggling", "--skip", "common_phase",
                           "--skip", "fixed_pattern")  # fmt: skip
    assert code == 0, err
    assert "  common_phase   stays as it was" in said


def test_a_new_warm_up_leaves_other_stages_as_they_were(capsys, tmp_path):
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    whole, later = tmp_path / "whole", tmp_path / "later"
    whole.mkdir(), later.mkdir()
    rig(whole)
    code, _, err = call(capsys, "calibrate", "all", whole, "--out", first)
    assert code == 0, err
    rig(later)
    table = (later / "conditions.csv").read_text().splitlines()
    kept = [table[0], *(line for line in table if "warmup" in line or "check" in line)]
    (later / "conditions.csv").write_text("\n".join(kept) + "\n")
    for other in [*later.glob("rail*.h5"), *later.glob("wall*.h5")]:
        other.unlink()
    code, said, err = call(capsys, "calibrate", "all", later, "--from", first, "--out", second)
    assert code == 0, err
    assert "  wiggling       stays as it was" in said
    old, new = load_chain(first), load_chain(second)
    for slot in ("wiggling", "common_phase", "fixed_pattern"):
        before, after = old.stage(slot), new.stage(slot)
        grid = np.ones((2, *SHAPE[1:]))
        np.testing.assert_array_equal(before.error_rad(grid, grid), after.error_rad(grid, grid))


def test_stages_in_the_wrong_order_are_no_success(capsys, tmp_path):
    rig(tmp_path)
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    code, _, err = call(capsys, "calibrate", "all", tmp_path, "--out", first)
    assert code == 0, err
    code, _, err = call(capsys, "calibrate", "all", tmp_path, "--from", first, "--out", second)
    assert code == 2
    assert "fitted without it" in err
    assert not second.exists()


@pytest.mark.parametrize("entry", ["wiggling:harmonic=3", "wiggling:harmonics=999"])
def test_a_mistyped_stage_is_not_left_out_quietly(capsys, tmp_path, entry):
    rig(tmp_path)
    out = tmp_path / "c.json"
    code, _, err = call(capsys, "calibrate", "all", tmp_path, "--stage", entry, "--out", out)
    assert code == 2
    assert "harmonic" in err
    assert not out.exists()


def test_a_check_without_temperature_is_told_first(capsys, tmp_path):
    rig(tmp_path)
    table = (tmp_path / "conditions.csv").read_text()
    header, *lines = table.splitlines()
    columns = header.split(",")
    cold = []
    for line in lines:
        cells = dict(zip(columns, line.split(","), strict=True))
        if cells["kind"] == "check":
            cells |= {"sensor_c": "", "light_c": ""}
        cold.append(",".join(cells[name] for name in columns))
    (tmp_path / "conditions.csv").write_text("\n".join([header, *cold]) + "\n")
    code, _, err = call(capsys, "calibrate", "all", tmp_path, "--out", tmp_path / "c.json")
    assert code == 2
    assert "conditions.csv" in err and "temperature" in err


def test_options_stand_in_for_the_table(capsys, tmp_path):
    write_capture(tmp_path / "one.h5", seen(1.0, seed=1))
    write_capture(tmp_path / "two.h5", seen(1.0, seed=2))
    files = [tmp_path / "one.h5", tmp_path / "two.h5"]
    out = tmp_path / "c.json"
    code, _, err = call(capsys, "calibrate", "common_phase", *files, "--out", out)
    assert code == 2
    assert "one.h5 does not say how far its target was" in err
    assert not out.exists()
    code, said, err = call(capsys, "calibrate", "common_phase", *files, "--distance-m", "1.0",
                           "--out", out, "--json")  # fmt: skip
    assert code == 0, err
    assert json.loads(said)["stages"][0]["stage"] == "common_phase"


BAD = {
    "wall1.h5 has 12 x 9 px": lambda c: analytic(Scene("wall", {"range": 1.1}))(
        Shot(sensor("opt8241:width=12,height=9"))),
    "wall1.h5 was taken at 20 + 70 MHz": lambda c: analytic(Scene("wall", {"range": 1.1}))(
        Shot(sensor("opt8241:width=24,height=18,freqs=20e6+70e6"))),
    "wall1.h5 has no valid pixel: saturated": lambda c: replace(
        c, taps=None, phasors=replace(c.phasors, valid=np.zeros(SHAPE[1:], bool))),
    "wall1.h5 is black": lambda c: replace(
        c, taps=None, phasors=replace(c.phasors, values=np.zeros(SHAPE, np.complex64))),
}  # fmt: skip


@pytest.mark.parametrize("complaint", BAD)
def test_a_bad_file_is_named_and_nothing_is_written(capsys, tmp_path, complaint):
    rig(tmp_path, warm=False)
    write_capture(tmp_path / "wall1.h5", BAD[complaint](read_capture(tmp_path / "wall1.h5")))
    out, page = tmp_path / "out.json", tmp_path / "out.html"
    code, _, err = call(capsys, "calibrate", "all", tmp_path, "--out", out, "--report", page)
    assert code == 2
    assert complaint in err
    assert err.count("\n") == 1
    assert not list(tmp_path.glob("*out*"))


def test_a_truncated_file_and_an_empty_folder_are_refused(capsys, tmp_path):
    code, _, err = call(capsys, "calibrate", "all", tmp_path, "--out", tmp_path / "o.json")
    assert (code, "holds neither conditions.csv nor capture files" in err) == (2, True)
    write_capture(tmp_path / "a.h5", seen(1.0, seed=1))
    data = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "a.h5").write_bytes(data[: len(data) // 2])
    code, _, err = call(capsys, "calibrate", "common_phase", tmp_path / "a.h5", "--distance-m", 1,
                        "--out", tmp_path / "o.json")  # fmt: skip
    assert (code, "a.h5" in err) == (2, True)
    assert not (tmp_path / "o.json").exists()


@pytest.mark.parametrize(
    ("args", "complaint"),
    [
        (["--out", "o.txt"], "a calibration is written as .json"),
        (["--out", "nowhere/o.json"], "cannot write"),
        (["--out", "o.json", "--report", "o.json"], "a report is written as .html"),
        (["--out", "o.json", "--skip", "lense"], "there is no stage 'lense'"),
        (["--out", "o.json", "--stage", "wigglin"], "unknown name 'wigglin'"),
        (["--out", "o.json", "--from", "no.json"], "cannot read the calibration"),
    ],
)
def test_bad_options_of_all(capsys, folder, tmp_path, monkeypatch, args, complaint):
    monkeypatch.chdir(tmp_path)
    code, _, err = call(capsys, "calibrate", "all", folder, *args)
    assert (code, complaint in err) == (2, True), err
    assert not list(tmp_path.iterdir())


def test_correct_applies_a_calibration_and_says_which(capsys, folder, whole, tmp_path):
    check, answer = folder / "check1.h5", tmp_path / "a.npz"
    warm = ["--sensor-c", "30", "--light-c", "33"]
    code, said, err = call(capsys, "correct", check, "--calib", whole[0], *warm, "--method", "crt",
                           "--out", answer)  # fmt: skip
    assert code == 0, err
    assert "wiggling, common_phase, fixed_pattern" in said
    with np.load(answer) as found:
        z = found["z_m"]
    assert abs(np.nanmedian(z) - 1.4) < 0.002
    code, said, _ = call(capsys, "correct", check, "--calib", whole[0], *warm, "--skip",
                         "common_phase", "--out", answer, "--json")  # fmt: skip
    assert "common_phase" not in json.loads(said)["calibration"]["stages"]
    with np.load(answer) as found:
        assert abs(np.nanmedian(found["z_m"]) - 1.4) > 0.02


def test_correct_refuses_what_a_calibration_does_not_fit(capsys, folder, whole, tmp_path):
    other = analytic(Scene("wall"))(Shot(sensor("opt8241:width=12,height=9")))
    write_capture(tmp_path / "other.h5", other)
    out = tmp_path / "a.h5"
    code, _, err = call(capsys, "correct", tmp_path / "other.h5", "--calib", whole[0], "--out", out)
    assert (code, "other.h5 is of 12 x 9 px" in err) == (2, True), err
    code, _, err = call(capsys, "correct", folder / "check0.h5", "--skip", "lens", "--out", out)
    assert (code, "give --calib too" in err) == (2, True)
    assert not out.exists()
    warm = ["--sensor-c", "30", "--light-c", "33"]
    call(capsys, "correct", folder / "check0.h5", "--calib", whole[0], *warm, "--out", out)
    code, _, err = call(capsys, "correct", out, "--calib", whole[0], *warm, "--out",
                        tmp_path / "b.npz")  # fmt: skip
    assert (code, "a.h5 is calibrated already" in err) == (2, True), err


def test_inspect_reads_a_calibration(capsys, whole):
    code, said, _ = call(capsys, "inspect", whole[0])
    assert code == 0
    assert "24 x 18 px at 40 + 70 MHz" in said
    assert "wiggling" in said
    found = json.loads(call(capsys, "inspect", whole[0], "--json")[1])
    assert found["stages"][0]["stage"] == "wiggling"
    code, _, err = call(capsys, "inspect", whole[0], "--intrinsics", "ros")
    assert (code, "has no lens stage" in err) == (2, True)


OWN = '''
"""A stage of a user's own."""
from dataclasses import dataclass, field
from typing import ClassVar
import numpy as np
from toftools.calib.stage import Residual

@dataclass(frozen=True, eq=False)
class Mine:
    slot: ClassVar[str] = "common_phase"
    turn_rad: float
    residual: Residual = field(default_factory=Residual)
    def error_rad(self, phase_rad, amplitude):
        return np.full((2, 1, 1), self.turn_rad)
    def __call__(self, phasors):
        from dataclasses import replace
        return replace(phasors, values=phasors.values * np.exp(-1j * self.turn_rad))

def make(captures, *, turn_rad: float = 0.25) -> Mine:
    return Mine(turn_rad)
'''


def test_a_stage_of_your_own_needs_no_registration(capsys, folder, tmp_path, monkeypatch):
    (tmp_path / "own_stage.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    out, wall = tmp_path / "cal.json", folder / "wall0.h5"
    code, said, err = call(capsys, "calibrate", "own_stage:make:turn_rad=0.5", wall, "--out", out)
    assert code == 0, err
    assert "common_phase" in said
    code, _, err = call(capsys, "correct", wall, "--calib", out, "--out", tmp_path / "a.npz")
    assert (code, "trust" in err) == (2, True), err
    code, said, err = call(capsys, "correct", wall, "--calib", out, "--trust", "own_stage", "--out",
                           tmp_path / "a.npz")  # fmt: skip
    assert code == 0, err
    assert "calibrated by" in said


@pytest.fixture(scope="module")
def boards():
    """Captures of a board by a camera whose lens is not as its maker says."""
    made = rig_of(sensor("opt8241:width=64,height=48"), Errors(), plan="small", frames=4)
    return [capture for _, capture in made if capture.provenance["conditions"]["kind"] == "board"]


def test_the_lens_from_pictures_of_a_board(capsys, tmp_path, boards):
    for n, capture in enumerate(boards):
        amplitude = np.abs(capture.phasors.values[0])
        gray = (60_000 * amplitude / amplitude.max()).astype(np.uint16)
        Image.fromarray(gray).save(tmp_path / f"board{n}.png")
    out, files = tmp_path / "cal.json", sorted(tmp_path.glob("board*.png"))
    code, _, err = call(capsys, "calibrate", "lens", *files, "--out", out)
    assert (code, "give --sensor" in err) == (2, True), err
    code, _, err = call(capsys, "calibrate", "lens", *files, "--out", out, "--sensor",
                        "opt8241:width=32,height=24")  # fmt: skip
    assert (code, "board0.png has 64 x 48 px, the camera 32 x 24" in err) == (2, True), err
    assert not out.exists()
    few = "lens:distortion=4,hold_out=2"
    code, said, err = call(capsys, "calibrate", few, *files, "--out", out,
                           "--sensor", "opt8241:width=64,height=48", "--json")  # fmt: skip
    assert code == 0, err
    assert json.loads(said)["stages"][0]["after"] < 0.15
    code, said, _ = call(capsys, "inspect", out, "--intrinsics", "opencv")
    camera = json.loads(said)["camera_matrix"]["data"]
    assert code == 0
    assert camera[0] == pytest.approx(46.69, rel=0.02)  # 46.00 times 1.015


def test_the_tables_of_a_vendor(capsys, tmp_path):
    image = struct.pack("<4H", 40, 30, 0, 0)
    (tmp_path / "odd.bin").write_bytes(image)
    out = tmp_path / "cal.json"
    code, _, err = call(capsys, "calibrate", "factory:ti", tmp_path / "odd.bin", "--out", out)
    assert (code, "odd.bin is not readable as TI phase offsets" in err) == (2, True), err
    code, _, err = call(capsys, "calibrate", "factory:to", tmp_path / "odd.bin", "--out", out)
    assert (code, "unknown name 'to'; known: kinect2, ti, adi" in err) == (2, True), err
    assert not out.exists()
    data = os.environ.get("TOFTOOLS_DATA")
    if data is None:
        pytest.skip("TOFTOOLS_DATA names no folder of vendors' tables")
    code, said, err = call(capsys, "calibrate", "factory:kinect2",
                           f"{data}/kinect2_tables", "--out", out, "--json")  # fmt: skip
    assert code == 0, err
    found = json.loads(said)
    assert [row["stage"] for row in found["stages"]][-2:] == ["common_phase", "fixed_pattern"]
    code, said, _ = call(capsys, "inspect", out)
    assert "calibration of kinect2, 512 x 424 px" in said
