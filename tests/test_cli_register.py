"""``toftools register`` from files to files."""

import json

import cv2
import numpy as np
import pytest

from toftools.calib.chain import chain_for, extended
from toftools.calib.extrinsics import Extrinsics
from toftools.calib.store import save_chain
from toftools.camera import pinhole
from toftools.cli import main
from toftools.io.export import write_answer
from toftools.io.native import write_capture
from toftools.io.picture import read_picture
from toftools.types import Capture, DepthMap, Modulation, Sensor

TOF, COLOUR = pinhole(40, 30, hfov_deg=60), pinhole(160, 120, hfov_deg=70)


def call(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return stop.value.code, out, err


@pytest.fixture
def files(tmp_path):
    """A capture with a depth, its answer, a calibration, and a picture: left red, right blue."""
    sensor = Sensor(TOF, Modulation(np.array([20e6])), name="small")
    range_m = np.full(TOF.shape, 2.0)
    range_m[10:20, 10:20], range_m[0, 0] = 1.0, np.nan
    depth = DepthMap(range_m, amplitude=np.ones(TOF.shape))
    capture = Capture(sensor, depth=depth)
    write_capture(tmp_path / "c.h5", capture)
    write_answer(tmp_path / "d.npz", depth, capture)
    stage = Extrinsics(np.eye(3), np.array([-0.05, 0, 0]), COLOUR)
    save_chain(tmp_path / "cal.json", extended(chain_for(sensor), stage))
    save_chain(tmp_path / "bare.json", chain_for(sensor))
    picture = np.zeros((120, 160, 3), np.uint8)
    picture[:, :80, 2], picture[:, 80:, 0] = 255, 255
    cv2.imwrite(str(tmp_path / "rgb.png"), picture)
    return tmp_path


@pytest.mark.parametrize("source", ["c.h5", "d.npz"])
def test_a_coloured_cloud(files, capsys, source):
    out = files / "x.ply"
    code, text, err = call(capsys, "register", files / source, "--calib", files / "cal.json",
                           "--image", files / "rgb.png", "--out", out, "--json")  # fmt: skip
    assert (code, err) == (0, "")
    told = json.loads(text)
    # The nearer square moves 0.87 px against the wall: one column of ten pixels, or none.
    assert told["hidden"] == pytest.approx(10 / 1200, abs=4 / 1200)
    assert told["no_range"] == 1 / 1200
    assert told["coloured"] + told["hidden"] == pytest.approx(1199 / 1200)
    from toftools._native import import_open3d

    cloud = import_open3d().t.io.read_point_cloud(str(out))
    place, colours = cloud.point["positions"].numpy(), cloud.point["colors"].numpy()
    assert len(place) == round(told["coloured"] * 1200)
    assert cloud.point["amplitude"].numpy().size == len(place)
    u = COLOUR.K[0, 0] * (place[:, 0] - 0.05) / place[:, 2] + COLOUR.K[0, 2]
    clear = np.abs(u - 79.5) > 1
    left = np.where((u < 79.5)[:, None], [255, 0, 0], [0, 0, 255])
    np.testing.assert_array_equal(colours[clear], left[clear])


def test_ranges_in_the_picture(files, capsys):
    for name in ("z.png", "both.npz"):
        code, _, _ = call(capsys, "register", files / "d.npz", "--calib", files / "cal.json",
                          "--image", files / "rgb.png", "--out", files / name)  # fmt: skip
        assert code == 0
    z_mm = cv2.imread(str(files / "z.png"), cv2.IMREAD_UNCHANGED)
    with np.load(files / "both.npz") as both:
        assert set(both) == {"range_m", "colours", "status", "z_m"}
        np.testing.assert_array_equal(z_mm, np.round(np.nan_to_num(both["z_m"]) * 1000.0))
    assert 1.8 < z_mm[60, 30] / 1000 < 2.0  # radial 2 m, off the axis
    assert (z_mm == 0).any()


@pytest.mark.parametrize(("given", "message"), [
    (("--calib", "cal.json", "--out", "x.ply"), "x.ply needs colours; give --image"),
    (("--calib", "cal.json", "--image", "rgb.png", "--out", "x.txt"), "got the suffix '.txt'"),
    (("--calib", "bare.json", "--out", "z.png"), "bare.json has no stage extrinsics"),
    (("--calib", "no.json", "--out", "z.png"), "no.json"),
    (("--calib", "cal.json", "--image", "no.png", "--out", "x.ply"), "no.png is not there"),
    (("--calib", "cal.json", "--image", "cal.json", "--out", "x.ply"), "cal.json is no image"),
    (("--calib", "cal.json", "--image", "large.png", "--out", "x.ply"), "large.png has 20 x 10 px"),
    (("--calib", "other.json", "--out", "z.png"), "the calibration of 50 x 30 px"),
])  # fmt: skip
def test_one_sentence_and_nothing_written(files, capsys, monkeypatch, given, message):
    monkeypatch.chdir(files)
    cv2.imwrite("large.png", np.zeros((10, 20, 3), np.uint8))
    sensor = Sensor(pinhole(50, 30, hfov_deg=60), Modulation(np.array([20e6])))
    stage = Extrinsics(np.eye(3), np.zeros(3), COLOUR)
    save_chain("other.json", extended(chain_for(sensor), stage))
    code, _, err = call(capsys, "register", "c.h5", *given)
    assert code == 2
    assert message in err
    assert err.count("\n") == 1
    assert not (files / given[-1]).exists()


def test_a_picture_is_red_green_blue(files):
    picture = read_picture(files / "rgb.png")
    assert picture.dtype == np.uint8
    assert picture[0, 0].tolist() == [255, 0, 0]
