"""Clouds to look at: what is in the picture, the page and the file is the cloud that went in."""

import base64
import io
import json
import logging
import re
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from toftools.camera import pinhole, points
from toftools.cli.cloud import command
from toftools.io.export import write_npz
from toftools.io.native import write_capture
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Capture, DepthMap, Phasors, Scene, Shot, Truth
from toftools.viz import _process
from toftools.viz._view import oblique
from toftools.viz.cloud import cloud_png, show
from toftools.viz.web import MAX_POINTS, cloud_html

CAMERA = pinhole(64, 48, hfov_deg=70)


def wall(seed: int = 0) -> np.ndarray:
    """A wall at z = 2 m with a nearer box, noise, and a corner without answer."""
    z = np.full(CAMERA.shape, 2.0)
    z[16:32, 24:40] = 1.5
    z += np.random.default_rng(seed).normal(0, 0.004, z.shape)
    z[:8, :8] = np.nan
    x, y = np.meshgrid(np.arange(64) - 31.5, np.arange(48) - 23.5)
    return (z * np.sqrt(1 + (x**2 + y**2) / CAMERA.K[0, 0] ** 2)).astype(np.float32)


def failing(*_args):
    msg = "forced by the test"
    raise RuntimeError(msg)


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def coloured(image: np.ndarray) -> np.ndarray:
    """Where the cloud was drawn: not white, not grey text, left of the colour bar."""
    return (np.ptp(image, axis=2) > 30)[:, : image.shape[1] - 96]


# --- picture -----------------------------------------------------------------------------------


def headless_open3d() -> bool:
    view = oblique(points(CAMERA, wall())[20], (64, 48))
    try:
        _process.draw(np.zeros((1, 3)), np.zeros((1, 3)), view, 5.0)
    except RuntimeError as error:
        return "empty picture" in str(error)  # it drew; the one point lies outside
    return True


@pytest.mark.parametrize("renderer", ["Open3D", "matplotlib"])
def test_both_renderers_draw_the_cloud_where_the_view_puts_it(renderer, monkeypatch, caplog):
    if renderer == "matplotlib":
        monkeypatch.setattr(_process, "draw", failing)
    elif not headless_open3d():
        pytest.skip("Open3D cannot draw on this machine (no EGL), which toftools doctor tells")
    range_m = wall()
    xyz = points(CAMERA, range_m)
    with caplog.at_level(logging.INFO, logger="toftools"):
        image = pixels(cloud_png(xyz, range_m, size=(700, 500), title="wall"))
    assert f"with {renderer}" in caplog.text
    assert image.shape == (500, 700, 3)
    assert (image[-1, :5] == 255).all()  # the ground is white
    drawn = coloured(image)
    assert 0.15 < drawn.mean() < 0.8

    known = np.isfinite(range_m)
    view = oblique(xyz[known].astype(float), (700 - 96, 500 - 40))
    pixel, depth = view.project(xyz[known].astype(float))
    assert (depth > 0).all()
    u, v = np.round(pixel).astype(int).T
    inside = (u >= 0) & (u < 604) & (v >= 0) & (v < 460)
    assert inside.mean() > 0.97
    # A dot of several pixels covers the rounded centre of every point in the picture.
    assert drawn[40 + v[inside], u[inside]].mean() > 0.995


@pytest.mark.parametrize("renderer", ["Open3D", "matplotlib"])
@pytest.mark.parametrize("near_first", [True, False])
def test_nearer_points_hide_farther_ones(renderer, near_first, monkeypatch):
    if renderer == "matplotlib":
        monkeypatch.setattr(_process, "draw", failing)
    elif not headless_open3d():
        pytest.skip("Open3D cannot draw on this machine (no EGL), which toftools doctor tells")
    right, down, forward = oblique(np.eye(3), (100, 100)).extrinsic[:3, :3]
    frame = [x * right + y * down for x in (-1, 1) for y in (-1, 1)]
    pair = [-0.4 * forward, 0.4 * forward]  # one behind the other, on the axis of the view
    order = slice(None) if near_first else slice(None, None, -1)
    values = np.r_[0, 0, 1, 1, [0.0, 1.0][order]]
    image = pixels(cloud_png(np.array(frame + pair[order]), values, size=(496, 412)))
    np.testing.assert_allclose(image[212, 200], [68, 1, 84], atol=3)  # the low end of viridis


def test_the_view_is_from_the_right_and_above():
    view = oblique(points(CAMERA, wall())[np.isfinite(wall())].astype(float), (600, 400))
    eye = -view.extrinsic[:3, :3].T @ view.extrinsic[:3, 3]
    centre = np.array([0, 0, 1.9])
    assert eye[0] > 0.5  # x right
    assert eye[1] < -0.3  # y down
    assert np.linalg.norm(eye - centre) > 2
    np.testing.assert_allclose(view.extrinsic[:3, :3] @ view.extrinsic[:3, :3].T, np.eye(3),
                               atol=1e-12)  # fmt: skip


def test_a_process_that_dies_is_a_runtime_error(monkeypatch):
    view = oblique(np.eye(3), (64, 48))
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with pytest.raises(RuntimeError, match="did not end well"):
        _process.draw(np.eye(3), np.eye(3), view, 2.0)
    monkeypatch.undo()
    with pytest.raises(RuntimeError, match="ended with 1: "):
        _process.draw(np.eye(3), np.eye(2), view, 2.0)  # colours that do not fit


@pytest.mark.parametrize(
    ("xyz", "values", "kind", "complaint"),
    [
        (np.full((4, 3), np.nan), np.ones(4), "range", "no point is finite"),
        (np.ones((4, 3)), np.ones(5), "range", "must have the shape of values"),
        (np.ones((4, 3)), np.ones(4), "phase", "got colour 'phase', wanted one of range"),
    ],
)
def test_bad_clouds_are_refused(xyz, values, kind, complaint):
    with pytest.raises(ValueError, match=complaint):
        cloud_png(xyz, values, kind=kind)
    with pytest.raises(ValueError, match=complaint):
        cloud_html(xyz, {kind: values})


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a display")
@pytest.mark.parametrize("display", [None, ":4711"])
def test_a_window_without_a_display_is_refused(monkeypatch, display):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(RuntimeError, match="needs a display, and there is none"):
        show(np.ones((4, 3)), np.ones(4))


# --- page --------------------------------------------------------------------------------------


def page_data(page: str) -> dict:
    return json.loads(re.search(r"const data = (\{.*\});", page).group(1))


def page_points(data: dict) -> np.ndarray:
    steps = np.frombuffer(base64.b64decode(data["xyz"]), "<u2").reshape(-1, 3)
    return np.array(data["low"]) + steps / 65_535 * np.array(data["span"])


def test_the_page_holds_the_cloud_and_needs_no_network():
    range_m = wall()
    xyz = points(CAMERA, range_m)
    page = cloud_html(xyz, {"range": range_m, "amplitude": 1 / range_m**2}, title="a <b> & c")
    assert not re.search(r"https?:|src=|@import|<link", page)
    assert "<title>a &lt;b&gt; &amp; c</title>" in page
    assert "__" not in re.sub(r"const data = .*", "", page)

    data = page_data(page)
    known = np.isfinite(range_m)
    # Half a 16-bit step of the bounding box, and float32 input.
    np.testing.assert_allclose(page_points(data), xyz[known], atol=max(data["span"]) / 131_000)
    codes = np.frombuffer(base64.b64decode(data["channels"]["range"]["values"]), np.uint8)
    assert codes.size == known.sum()
    assert codes.min() == 1  # 0 would mean unknown
    order = np.argsort(range_m[known])
    assert (np.diff(codes[order].astype(int)) >= 0).all()
    assert float(data["channels"]["range"]["ticks"][-1]) == pytest.approx(
        np.percentile(range_m[known], 1), rel=1e-3
    )


def test_a_page_shows_a_fair_sample_of_a_large_cloud():
    n = 200_000
    xyz = np.random.default_rng(3).normal(size=(n, 3))
    page = cloud_html(xyz, {"range": np.r_[np.full(n // 2, 1.0), np.full(n // 2, np.nan)]})
    data = page_data(page)
    assert page_points(data).shape == (MAX_POINTS, 3)
    codes = np.frombuffer(base64.b64decode(data["channels"]["range"]["values"]), np.uint8)
    # Hypergeometric: half of the points have a value; sigma = sqrt(60000 / 4 * 0.7) = 102.
    assert abs((codes > 0).sum() - MAX_POINTS / 2) < 5 * 102
    assert len(page) < 700_000


def test_amplitude_is_coloured_by_its_logarithm():
    amplitude = np.r_[10.0, 100.0, 1000.0, 1e4, 1e5, 0.0, np.nan]
    amplitude = np.r_[amplitude, np.full(500, 10.0), np.full(500, 1e5)]  # the two percentiles
    channel = page_data(cloud_html(np.ones((1007, 3)), {"amplitude": amplitude}))["channels"]
    codes = np.frombuffer(base64.b64decode(channel["amplitude"]["values"]), np.uint8)
    # 254 steps over four decades, the first of them 1; zero at the low end, unknown is 0.
    np.testing.assert_allclose(codes[:5], 1 + 63.5 * np.arange(5), atol=0.51)
    assert codes[5:7].tolist() == [1, 0]
    assert channel["amplitude"]["ticks"] == ["100000", "10000", "1000", "100", "10"]


# --- command line ------------------------------------------------------------------------------


@pytest.fixture
def answer(tmp_path):
    path = tmp_path / "answer.npz"
    write_npz(path, DepthMap(wall(), amplitude=1 / wall() ** 2), CAMERA)
    return path


@pytest.fixture
def capture(tmp_path):
    """A capture without depth, but with truth."""
    range_m = wall()
    values = np.nan_to_num(100 / range_m**2)[None].astype(np.complex64)
    path = tmp_path / "capture.h5"
    kinect = sensor("opt8241:width=64,height=48,freqs=20e6")
    write_capture(path, Capture(kinect, phasors=Phasors(values), truth=Truth(range_m)))
    return path


def call(*arguments) -> str:
    done = CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def read_ply(path) -> tuple[list[str], np.ndarray]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = re.findall(r"property float (\w+)", head.decode())
    return names, np.frombuffer(body, "<f4").reshape(-1, len(names))


def test_ply_of_an_answer_reads_back(answer, tmp_path):
    out = tmp_path / "x.ply"
    text = json.loads(call(answer, "--out", out, "--json"))
    names, rows = read_ply(out)
    known = np.isfinite(wall())
    assert text == {"out": str(out), "points": int(known.sum()), "pixels": 64 * 48}
    assert names[:4] == ["x", "y", "z", "amplitude"]
    np.testing.assert_array_equal(rows[:, :3], points(CAMERA, wall())[known])


@pytest.mark.parametrize(("freqs", "method"), [("20e6", "single"), ("40e6+70e6", "crt")])
def test_a_capture_without_depth_is_unwrapped_and_says_so(freqs, method, tmp_path):
    """Taps alone, and no --capture: the file knows its camera."""
    shot = Shot(sensor(f"opt8241:width=64,height=48,freqs={freqs}"), noisy=False)
    made = analytic(Scene("tilted", {"range": 2.0}))(shot)
    path, out = tmp_path / "c.h5", tmp_path / "x.ply"
    write_capture(path, Capture(made.sensor, taps=made.taps))
    done = CliRunner().invoke(command, [str(path), "--out", str(out), "--colour", "amplitude"])
    assert done.stderr == f"no depth in the file: unwrapped with {method}\n"
    assert done.exit_code == 0
    names, rows = read_ply(out)
    expected = points(made.sensor.camera, made.truth.range_m).reshape(-1, 3)
    # Float32 phases of 1e-7 turns of at most 7.5 m, and float32 points.
    np.testing.assert_allclose(rows[:, :3], expected, atol=1e-5)
    strength = rows[:, names.index("amplitude")]
    np.testing.assert_allclose(strength, np.abs(made.phasors.values[0]).ravel(), rtol=1e-6)
    said = CliRunner().invoke(command, [str(path), "--out", str(out), "--json"])
    assert json.loads(said.stdout)["unwrapped_with"] == method


def test_truth_of_a_capture_is_shown_on_demand_only(capture, tmp_path):
    call(capture, "--truth", "--out", tmp_path / "x.ply")
    names, rows = read_ply(tmp_path / "x.ply")
    assert "amplitude" in names  # of the phasors
    assert len(rows) == np.isfinite(wall()).sum()


def test_picture_and_page_by_suffix(answer, tmp_path, monkeypatch):
    monkeypatch.setattr(_process, "draw", failing)
    call(answer, "--out", tmp_path / "x.png", "--colour", "amplitude")
    assert coloured(pixels((tmp_path / "x.png").read_bytes())).mean() > 0.1
    call(answer, "--out", tmp_path / "x.html", "--colour", "amplitude")
    data = page_data((tmp_path / "x.html").read_text("utf-8"))
    assert list(data["channels"]) == ["amplitude", "range"]


def test_an_answer_without_a_camera_asks_for_one(capture, tmp_path):
    bare = tmp_path / "bare.npz"
    np.savez(bare, range_m=wall())
    with pytest.raises(ValueError, match="holds no camera; give the capture"):
        call(bare, "--out", tmp_path / "x.ply")
    call(bare, "--capture", capture, "--out", tmp_path / "x.ply")
    assert len(read_ply(tmp_path / "x.ply")[1]) == np.isfinite(wall()).sum()
    np.savez(bare, range_m=wall()[:40])
    with pytest.raises(ValueError, match=r"has \(48, 64\) pixels, but bare.npz \(40, 64\)"):
        call(bare, "--capture", capture, "--out", tmp_path / "x.ply")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "nothing to do; give --out"),
        (["--out", "x.obj"], r"got the suffix '\.obj' in x\.obj; wanted \.ply"),
        (["--out", "x.ply", "--truth"], "holds no ground truth; leave out --truth"),
    ],
)
def test_wishes_that_cannot_be_met_are_refused(answer, arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        call(answer, *arguments)
