"""The lens: planted cameras come back within honest uncertainties, boards are found where a person
sees them, and what cannot work is refused by name."""

import importlib
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from toftools.calib import _lens_fit, _lens_saddle
from toftools.calib._corners import find_board
from toftools.calib._lens_choice import chosen, starts, trial, without_outliers
from toftools.calib._lens_model import Corners, projected, unknowns
from toftools.calib._lens_notes import board_notes
from toftools.calib._lens_views import trouble
from toftools.calib.board import parse_board
from toftools.calib.lens import View, fit_lens, lens, lens_fisheye, read_view
from toftools.camera import rays
from toftools.conditions import Conditions, with_conditions
from toftools.sensors import sensor
from toftools.types import Camera, Capture, Phasors
from toftools.units import range_to_phase

BOARD = parse_board("chessboard:columns=8,rows=5,square_m=0.03")
K = np.array([[233.0, 0, 163.9], [0, 232.4, 117.8], [0, 0, 1]])
PINHOLE = Camera(320, 240, K, np.array([-0.12, 0.05, 8e-4, -6e-4, 0.0]))
FISHEYE = Camera(320, 240, K, np.array([0.03, -0.01, 0.002, 0.0]), "fisheye")
REAL = os.environ.get("TOFTOOLS_DATA")


@pytest.fixture(scope="module")
def views():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
        yield importlib.import_module("lens_views")


@pytest.fixture(scope="module")
def pictures(views):
    """Six noisy views of one camera, with their poses."""
    rng = np.random.default_rng(5)
    field = views.camera_rays(PINHOLE)
    poses = views.poses(rng, 6, PINHOLE, BOARD)
    return [
        (views.view(rng, f"{i}.h5", views.image(field, pose, BOARD)), pose)
        for i, pose in enumerate(poses)
    ]


def flat(camera, size):
    return Camera(camera.width, camera.height, [[300, 0, 160], [0, 300, 120], [0, 0, 1]],
                  np.zeros(size), camera.model)  # fmt: skip


@pytest.mark.parametrize("truth", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_planted_camera_within_its_standard_deviations(views, truth):
    z = []
    for seed in range(30):
        data = views.corners(np.random.default_rng(seed), 10, truth, BOARD, 0.1)
        fit = _lens_fit.fit_camera(data, flat(truth, truth.dist.size))
        step, spread = _lens_fit.covariance(fit, data)
        sigma = np.sqrt(np.diag(spread))
        assert (np.abs(step) < 0.02 * sigma).all()  # it stands still at the solution
        z.append((unknowns(fit.camera) - unknowns(truth)) / sigma)
    z = np.array(z)
    # 30 x 9 draws: the rms of a unit normal is 1 +- 0.08 for 30 independent ones of a kind.
    assert np.sqrt((z**2).mean()) == pytest.approx(1, abs=0.15)
    assert 0.90 < (np.abs(z) < 1.96).mean() < 0.985
    assert np.abs(z).max() < 4.5


def test_bundle_adjustment_agrees_with_opencv(views):
    data = views.corners(np.random.default_rng(1), 8, PINHOLE, BOARD, 0.2)
    fit = _lens_fit.fit_camera(data, flat(PINHOLE, 5))
    _, spread = _lens_fit.covariance(fit, data)
    theirs = cv2.calibrateCameraExtended(
        [v.points.astype(np.float32) for v in data], [v.pixels.astype(np.float32) for v in data],
        (320, 240), None, None,
    )  # fmt: skip
    assert fit.rms_px == pytest.approx(theirs[0], rel=1e-4)
    K_ = theirs[1]
    both = unknowns(fit.camera)[:4], np.array([K_[0, 0], K_[1, 1], K_[0, 2], K_[1, 2]])
    np.testing.assert_allclose(*both, atol=2e-3)
    ratio = np.sqrt(np.diag(spread)) / np.ravel(theirs[5])[:9]
    assert ratio.min() > 0.999  # never less, and more where views disagree
    assert ratio.max() < 2


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_derivatives_are_those_of_differences(views, camera):
    pose, points = views.poses(np.random.default_rng(0), 1, camera, BOARD)[0], BOARD.points()
    _, by_camera, by_pose = projected(camera, pose, points)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ahead, behind = (projected(camera, pose + s, points)[0] for s in (step, -step))
        np.testing.assert_allclose(by_pose[:, k], (ahead - behind).ravel() / 2e-6, atol=1e-3)
    for k in range(4 + camera.dist.size):
        step = np.zeros(4 + camera.dist.size)
        step[k] = 1e-6
        ahead, behind = (
            projected(_lens_fit.with_unknowns(camera, unknowns(camera) + s), pose, points)[0]
            for s in (step, -step)
        )
        np.testing.assert_allclose(by_camera[:, k], (ahead - behind).ravel() / 2e-6, atol=1e-3)


def test_the_crossing_is_found_to_hundredths_of_a_pixel(views, pictures):
    error, classic = [], []
    for view, pose in pictures:
        truth = projected(PINHOLE, pose, BOARD.points())[0]
        seen = find_board(view, BOARD)
        assert len(seen.ids) >= 38
        error.append(((seen.corners - truth[seen.ids]) ** 2).sum(axis=1))
        light = np.sqrt(view.image)
        start = truth.astype(np.float32).reshape(-1, 1, 2)
        plain = cv2.cornerSubPix(light, start.copy(), (5, 5), (-1, -1), (3, 60, 1e-4))
        classic.append(((plain.reshape(-1, 2) - truth) ** 2).sum(axis=1))
    ours, theirs = (np.sqrt(np.median(np.concatenate(e))) for e in (error, classic))
    assert ours < 0.05
    assert ours < 0.7 * theirs  # cornerSubPix starts at the truth here


def test_a_monotone_change_of_brightness_moves_no_corner(views):
    pose = views.poses(np.random.default_rng(3), 1, PINHOLE, BOARD)[0]
    image = views.image(views.camera_rays(PINHOLE, 4), pose, BOARD, sub=4)
    truth = projected(PINHOLE, pose, BOARD.points())[0]
    grid = truth.reshape(5, 8, 2)
    along = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], 2).reshape(-1, 2, 2)
    for power in (0.3, 0.5, 1.0, 1.5):
        found, good = _lens_saddle.crossing(image**power, truth + 0.3, along)
        assert good.all()
        assert np.abs(found - truth).max() < 0.06


@pytest.mark.parametrize("board", [
    "chessboard:columns=8,rows=5,square_m=0.03",
    "chessboard:columns=7,rows=7,square_m=0.03",  # looks the same from four sides
    "charuco:columns=8,rows=6,square_m=0.03,marker_m=0.023,dictionary=DICT_4X4_50",
    "charuco:columns=8,rows=6,square_m=0.03,marker_m=0.023,dictionary=DICT_4X4_50,legacy=true",
])  # fmt: skip
def test_boards_are_found_dark_small_uneven_and_noisy(views, board):
    board = parse_board(board)
    small = 1 if board.kind == "chessboard" else 2
    intrinsics = np.diag([small, small, 1]) @ [[115, 0, 80], [0, 115, 60], [0, 0, 1]]
    camera = Camera(160 * small, 120 * small, intrinsics)
    rng, field = np.random.default_rng(2), views.camera_rays(camera)
    fade = np.linspace(0.05, 1, camera.width)  # twenty times darker on one side
    for pose in views.poses(rng, 2, camera, board, fill=(0.5, 0.8), tilt_deg=(5, 40)):
        plain = views.image(field, pose, board)
        for image, white in ((plain, 400.0), (plain * fade, 3000.0), (plain**2.2, 3000.0)):
            seen = find_board(views.view(rng, "x", image, white_e=white), board)
            assert seen is not None
            assert len(seen.ids) >= 0.6 * len(board.points())
            truth = projected(camera, pose, board.points())[0]
            if board.columns == board.rows:
                apart = np.linalg.norm(seen.corners[:, None] - truth[None], axis=2).min(axis=1)
            else:
                apart = np.linalg.norm(seen.corners - truth[seen.ids], axis=1)
            assert np.median(apart) < 0.25
            assert apart.max() < 1.5


def test_order_starts_at_the_dark_first_square_whichever_way_it_lies(views):
    field = views.camera_rays(PINHOLE, 2)
    rng = np.random.default_rng(0)
    for spin in (0.0, 1.6, 3.1, -1.5):
        rotation = cv2.Rodrigues(np.array([0.2, 0.1, 0.0]))[0] @ cv2.Rodrigues(
            np.array([0, 0, spin]))[0]  # fmt: skip
        shift = np.array([0, 0, 0.5]) - rotation @ BOARD.points().mean(axis=0)
        pose = np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), shift])
        image = views.image(field, pose, BOARD, sub=2)
        seen = find_board(views.view(rng, "x", image), BOARD)
        truth = projected(PINHOLE, pose, BOARD.points())[0][seen.ids]
        assert np.linalg.norm(seen.corners - truth, axis=1).max() < 0.5


def test_fit_from_pictures(pictures):
    found = fit_lens([view for view, _ in pictures], BOARD, flat(PINHOLE, 0))
    z = (unknowns(found.camera) - unknowns(replace(PINHOLE, dist=PINHOLE.dist[:4]))) / found.sigma
    assert np.abs(z).max() < 3.5
    assert found.camera.dist.size == 4  # the fifth is 0
    assert found.rms_px < 0.06
    assert found.residual.before > 5 * found.residual.after
    assert found.held_out_px == pytest.approx(found.rms_px, rel=0.3)
    assert found.coverage.sum() == len(found.corners_px)
    assert found.names == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    phasors = Phasors(np.ones((1, 4, 4), np.complex64))
    assert found(phasors) is phasors


def test_size_of_the_distortion_is_what_the_data_need(views):
    rng = np.random.default_rng(0)
    k3 = replace(PINHOLE, dist=np.array([-0.25, 0.15, 1e-3, -1e-3, -0.06]))
    for truth, size in ((replace(PINHOLE, dist=np.zeros(0)), 0), (k3, 5)):
        data = views.corners(rng, 14, truth, BOARD, 0.02)
        kept = without_outliers(data, starts(truth, (240, 320), "pinhole"), 8)
        trials = [trial(kept.views, kept.fit, terms, 5) for terms in (0, 4, 5, 8)]
        assert chosen(trials).terms == size


def test_outliers_do_not_move_the_camera(views):
    data = views.corners(np.random.default_rng(4), 12, PINHOLE, BOARD, 0.1)
    spoilt = list(data)
    bad = data[3].pixels + np.random.default_rng(0).normal(size=data[3].pixels.shape) * 3
    spoilt[3] = replace(data[3], pixels=bad)
    lone = np.array(data[7].pixels)
    lone[11] += 4
    spoilt[7] = replace(data[7], pixels=lone)
    kept = without_outliers(spoilt, starts(None, (240, 320), "pinhole"), 5)
    assert kept.rejected == ("3.h5",)
    assert kept.dropped == 1
    clean = _lens_fit.fit_camera([d for i, d in enumerate(data) if i != 3], flat(PINHOLE, 5))
    np.testing.assert_allclose(unknowns(kept.fit.camera)[:4], unknowns(clean.camera)[:4], atol=0.1)


def test_a_bent_and_a_stretched_board_are_told(views):
    rng = np.random.default_rng(6)
    poses = views.poses(rng, 15, PINHOLE, BOARD)
    points = BOARD.points()
    x = points[:, 0] / points[:, 0].mean() - 1

    def told(shape):
        data = [Corners(str(i), points, projected(PINHOLE, p, shape)[0]
                        + 0.05 * rng.normal(size=(len(points), 2)))
                for i, p in enumerate(poses)]  # fmt: skip
        return board_notes(_lens_fit.fit_camera(data, flat(PINHOLE, 5)), data, BOARD)

    assert told(points) == []
    bent = told(points + np.outer(x**2, [0, 0, 2e-3]))
    assert len(bent) == 1
    height_mm = float(bent[0].split("by ")[1].split(" mm")[0])
    assert height_mm == pytest.approx(2e3 * np.ptp(x**2) / 1e3, rel=0.15)
    wide = told(points * [1.01, 1, 1])
    assert len(wide) == 1
    assert float(wide[0].split("seem ")[1].split(" %")[0]) == pytest.approx(1, abs=0.1)
    assert "wider" in wide[0]


def captures_of(pictures, freqs=(20e6, 60e6), scale=1.0, camera=None):
    """Captures of boards: amplitude as seen, range of the board's plane times `scale`."""
    nominal = sensor("opt8241")
    modulation = replace(nominal.modulation, freqs_hz=np.array(freqs), steps_rad=np.array(
        [0, np.pi / 2, np.pi, 1.5 * np.pi]), harmonics=None)  # fmt: skip
    nominal = replace(nominal, camera=camera or flat(PINHOLE, 0), modulation=modulation)
    field = rays(PINHOLE)
    made = []
    for view, pose in pictures:
        normal = cv2.Rodrigues(pose[:3])[0][:, 2]
        range_m = (pose[3:] @ normal) / (field @ normal) * scale
        phase = range_to_phase(np.maximum(range_m, 0.05), np.array(freqs)[:, None, None]) + 0.7
        phasors = Phasors((view.image * np.exp(1j * phase)).astype(np.complex64))
        capture = Capture(nominal, phasors=phasors)
        made.append(with_conditions(capture, Conditions("board"), file=view.name))
    return made


def test_a_wrong_square_shows_in_range(pictures):
    assert not any("square_m" in note for note in lens(captures_of(pictures)).residual.notes)
    off = lens(captures_of(pictures, scale=1.1), distortion=4).residual.notes
    told = next(note for note in off if "square_m" in note)
    assert "+10.0 %" in told
    assert "0.033" in told


@pytest.mark.parametrize("text", ["black", "saturated"])
def test_black_and_saturated_frames_are_named(pictures, text):
    shape = (240, 320)
    noise = np.random.default_rng(0).normal(size=shape)
    image = noise if text == "black" else np.full(shape, 4095.0)
    bad = View("night.png", image, image >= 4095)
    assert trouble(bad) == text
    with pytest.raises(ValueError, match=f"^night.png is {text}"):
        fit_lens([*(v for v, _ in pictures[:4]), bad], BOARD)


def test_too_few_views(pictures):
    with pytest.raises(ValueError, match=r"got 3 views of the board .* in 0.h5, 1.h5, 2.h5; want"):
        lens(captures_of(pictures[:3]))
    wall = [with_conditions(c, Conditions("wall", distance_m=1.0)) for c in captures_of(pictures)]
    with pytest.raises(ValueError, match="none of kind board"):
        lens(wall)


def test_parallel_views(views):
    rng = np.random.default_rng(0)
    camera = Camera(160, 120, [[115, 0, 80], [0, 115, 60], [0, 0, 1]])
    field = views.camera_rays(camera)
    poses = views.poses(rng, 6, camera, BOARD, tilt_deg=(0, 0.3), fill=(0.5, 0.7))
    flat_on = [views.view(rng, f"{i}.h5", views.image(field, p, BOARD))
               for i, p in enumerate(poses)]  # fmt: skip
    with pytest.raises(ValueError, match=r"0.h5, .*cannot tell the focal length.*tilted"):
        fit_lens(flat_on, BOARD)


@pytest.mark.parametrize("said, got", [
    ("chessboard:columns=7,rows=5,square_m=0.03", "8 x 5"),
    ("chessboard:columns=6,rows=4,square_m=0.03", "8 x 5"),
    ("chessboard:columns=9,rows=6,square_m=0.03", "8 x 5"),  # squares counted, not corners
])  # fmt: skip
def test_a_board_of_another_size(pictures, said, got):
    with pytest.raises(ValueError, match=f"[0-3].h5 shows a chessboard of {got} inner corners"):
        fit_lens([v for v, _ in pictures[:4]], parse_board(said))


def test_a_charuco_board_of_another_kind(views):
    camera = Camera(320, 240, [[230, 0, 160], [0, 230, 120], [0, 0, 1]])
    true = parse_board(
        "charuco:columns=7,rows=5,square_m=0.04,marker_m=0.03,dictionary=DICT_4X4_50"
    )
    rng = np.random.default_rng(1)
    pose = views.poses(rng, 1, camera, true, fill=(0.7, 0.8))[0]
    shown = [views.view(rng, "a.png", views.image(views.camera_rays(camera), pose, true))] * 4
    for changed, words in (
        ({"dictionary": "DICT_5X5_100"}, "shows markers of DICT_4X4_50, not of DICT_5X5_100"),
        ({"columns": 5, "rows": 4}, "shows marker 16, where the board said has markers 0 to 9"),
        ({"columns": 9, "rows": 6}, "not where the board has them"),
    ):
        with pytest.raises(ValueError, match=words):
            fit_lens(shown, replace(true, **changed))


def test_mixed_resolutions_and_frequencies(pictures):
    good = captures_of(pictures[:4])
    other = Capture(sensor("opt8241:width=48,height=36"),
                    phasors=Phasors(np.ones((2, 36, 48), np.complex64)))  # fmt: skip
    other = with_conditions(other, Conditions("board"), file="small.h5")
    with pytest.raises(ValueError, match=r"small.h5 has 48 x 36 px"):
        lens([*good, other])
    with pytest.raises(ValueError, match=r"5.h5 was taken at 30 \+ 60 MHz"):
        lens([*good, captures_of(pictures[5:], freqs=(30e6, 60e6))[0]])
    with pytest.raises(ValueError, match="distortion=3"):
        lens(good, distortion=3)


def test_fisheye_from_pictures(views):
    rng, field = np.random.default_rng(8), views.camera_rays(FISHEYE)
    shown = [(views.view(rng, f"{i}.h5", views.image(field, p, BOARD)), p)
             for i, p in enumerate(views.poses(rng, 6, FISHEYE, BOARD))]  # fmt: skip
    found = lens_fisheye(captures_of(shown))
    assert found.camera.model == "fisheye"
    assert found.rms_px < 0.06
    z = (unknowns(found.camera) - unknowns(FISHEYE)) / found.sigma
    assert np.abs(z).max() < 4


def test_image_files(tmp_path, pictures):
    image = np.clip(pictures[0][0].image * 16, 0, 65535).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    np.testing.assert_array_equal(read_view(tmp_path / "a.png").image, image)
    (tmp_path / "b.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"b.png is no image"):
        read_view(tmp_path / "b.png")
    with pytest.raises(ValueError, match="not there"):
        read_view(tmp_path / "c.png")


@pytest.mark.skipif(not REAL, reason="TOFTOOLS_DATA is not set")
def test_all_real_boards_that_a_person_sees_are_found():
    folder = Path(REAL) / "poveryang_tof_calib" / "tof_images"
    board = parse_board("chessboard:columns=5,rows=4,square_m=0.04")
    shown = [read_view(folder / f"{i}.png") for i in range(15)]  # a person sees all 15
    shown = [View(v.name, v.image[1:]) for v in shown]  # the first row is no image
    found = fit_lens(shown, board)
    assert len(found.views) == 15
    assert not found.rejected
    assert found.rms_px < 0.06
    assert found.held_out_px < 0.07
    assert not np.isnan(rays(found.camera)).any()


@pytest.mark.skipif(not REAL, reason="TOFTOOLS_DATA is not set")
def test_real_charuco_boards_are_found():
    folder = Path(REAL) / "azure_calib_registration"
    plane = json.loads((folder / "plane.json").read_text())["shapes"][0]
    assert (plane["squares_x"], plane["squares_y"], plane["aruco_dict_name"]) == (14, 9, 6)
    board = parse_board(
        "charuco:columns=14,rows=9,square_m=0.04,marker_m=0.03,dictionary=DICT_5X5_250"
    )
    for name, least in (("ir-0.png", 100), ("color-0.jpg", 104)):
        assert len(find_board(read_view(folder / name), board).ids) >= least
