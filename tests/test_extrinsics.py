"""The pose of a second camera: planted, with strays, in files, and of real pairs."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from toftools.calib._pairing import matched
from toftools.calib._poses import Sight, board_poses, moved, seen_px
from toftools.calib._stereo import Pair, refined
from toftools.calib.board import dark_at, parse_board
from toftools.calib.chain import chain_for, extended
from toftools.calib.extrinsics import Extrinsics, extrinsics, extrinsics_of_pairs
from toftools.calib.store import load_chain, save_chain
from toftools.camera import rays_at
from toftools.conditions import Conditions, with_conditions
from toftools.io.intrinsics import opencv_json, ros_yaml, write_text
from toftools.types import Camera, Capture, Modulation, Phasors, Sensor

TOF = Camera(320, 240, np.array([[230.0, 0, 158], [0, 231, 119], [0, 0, 1]]),
             np.array([-0.2, 0.05, 1e-3, 0, 0]))  # fmt: skip
COLOUR = Camera(1280, 960, np.array([[1000.0, 0, 640], [0, 1002, 470], [0, 0, 1]]),
                np.array([0.1, -0.1, 1e-3, 0, 0.02]))  # fmt: skip
FISHEYE = Camera(1280, 960, np.array([[600.0, 0, 640], [0, 602, 470], [0, 0, 1]]),
                 np.array([0.02, -0.004, 3e-4, 0]), "fisheye")  # fmt: skip
R = cv2.Rodrigues(np.array([0.02, -0.05, 0.03]))[0]
T = np.array([-0.032, 0.002, 0.004])
BOARD = "chessboard:columns=8,rows=5,square_m=0.03"
CORNERS = parse_board(BOARD).points()
SCATTER = (0.08, 0.2)


def random_board(rng, tilt=0.4):
    turn = cv2.Rodrigues(rng.normal(0, tilt, 3))[0]
    middle = [rng.uniform(-0.25, 0.25), rng.uniform(-0.2, 0.2), rng.uniform(0.45, 1.0)]
    return turn, np.array(middle) - turn @ CORNERS.mean(0)


def inside(camera, px):
    return np.isfinite(px).all() and (px > 0).all() and (px < [camera.width, camera.height]).all()


def planted(seed, views, *, colour=COLOUR, tilt=0.4):
    """Views of a board by two cameras, corners scattered."""
    rng, pairs = np.random.default_rng(seed), []
    while len(pairs) < views:
        place = moved(random_board(rng, tilt), CORNERS)
        seen = seen_px(TOF, place), seen_px(colour, place @ R.T + T)
        if inside(TOF, seen[0]) and inside(colour, seen[1]):
            sights = [Sight(CORNERS, px + rng.normal(0, sigma, px.shape))
                      for px, sigma in zip(seen, SCATTER, strict=True)]  # fmt: skip
            pairs.append(Pair(f"view{len(pairs)}", *sights))
    return pairs


def missed(stage):
    """Errors of turn and shift."""
    return np.concatenate([cv2.Rodrigues(stage.rotation @ R.T)[0].ravel(), stage.translation_m - T])


@pytest.mark.parametrize("colour", [COLOUR, FISHEYE], ids=["pinhole", "fisheye"])
def test_planted_poses_lie_within_their_uncertainty(colour):
    scores = []
    for seed in range(6):
        stage = extrinsics_of_pairs(planted(seed, 6, colour=colour), (TOF, colour))
        scores.append(missed(stage) / stage.sigma)
        assert stage.outliers == ()
        np.testing.assert_allclose(stage.sigma_px, SCATTER, rtol=0.25)
    # 36 squares of which each turn and shift share a direction: a wide net for their mean.
    assert 0.3 < np.mean(np.square(scores)) < 2
    assert (np.abs(scores) < 1.96).mean() > 0.85


def test_the_residual_is_what_noise_explains():
    residual = extrinsics_of_pairs(planted(1, 9), (TOF, COLOUR)).residual
    assert residual.before > 20
    assert residual.after == pytest.approx(residual.noise, rel=0.15)
    assert residual.after < residual.held_out < 1.3 * residual.noise
    assert residual.n == 9 * 40
    assert len(residual.notes) == 2


def test_the_jacobian_is_that_of_differences():
    from toftools.calib._stereo import _joint_slope

    pairs = planted(3, 2)
    boards = [board_poses(TOF, pair.tof)[0] for pair in pairs]
    start = ((R, T), boards)
    x = np.random.default_rng(0).normal(0, 0.02, 18)
    analytic = _joint_slope(pairs, (TOF, COLOUR), start, SCATTER, x)

    def errors(change):
        both = []
        for k, (camera, side) in enumerate(((TOF, "tof"), (COLOUR, "colour"))):
            for n in range(2):
                own = change[6 * n + 6 : 6 * n + 12]
                place = CORNERS @ (cv2.Rodrigues(own[:3])[0] @ boards[n][0]).T
                place = place + boards[n][1] + own[3:]
                if side == "colour":
                    place = place @ (cv2.Rodrigues(change[:3])[0] @ R).T + T + change[3:6]
                both.append(seen_px(camera, place).ravel() / SCATTER[k])
        return np.concatenate(both)

    for column in range(18):
        step = np.zeros(18)
        step[column] = 1e-6
        slow = (errors(x + step) - errors(x - step)) / 2e-6
        np.testing.assert_allclose(analytic[:, column], slow, atol=1e-3 * np.abs(slow).max())


def test_views_that_contradict_the_others_are_named_and_left_out():
    pairs = planted(5, 8)
    turned = Pair("turned", pairs[3].tof, Sight(CORNERS, pairs[3].colour.px[::-1]))
    swapped = Pair("swapped", pairs[6].tof, pairs[2].colour)
    stage = extrinsics_of_pairs([*pairs[:3], turned, *pairs[4:6], swapped, pairs[7]], (TOF, COLOUR))
    assert stage.outliers == ("turned", "swapped")
    assert any("turned, swapped" in note for note in stage.residual.notes)
    assert (np.abs(missed(stage)) < 4 * stage.sigma).all()


def test_a_stray_corner_does_no_harm():
    pair = planted(7, 1)[0]
    px = np.array(pair.tof.px)
    px[11] += [4.0, -3.0]
    plain = extrinsics_of_pairs([pair], (TOF, COLOUR))
    stage = extrinsics_of_pairs([Pair("one", Sight(CORNERS, px), pair.colour)], (TOF, COLOUR))
    assert np.linalg.norm(stage.translation_m - plain.translation_m) < plain.sigma[3:].max()
    assert "Too few views to hold any out" in " ".join(stage.residual.notes)
    assert np.isnan(stage.residual.held_out)


def test_each_camera_may_see_other_corners():
    pairs = [Pair(p.name, Sight(CORNERS[:30], p.tof.px[:30]), Sight(CORNERS[8:], p.colour.px[8:]))
             for p in planted(8, 4)]  # fmt: skip
    stage = extrinsics_of_pairs(pairs, (TOF, COLOUR))
    assert (np.abs(missed(stage)) < 4 * stage.sigma).all()


def test_wrong_intrinsics_show_in_views_held_out():
    wrong = replace(TOF, K=TOF.K * [[1.02], [1.02], [1]])
    stage = extrinsics_of_pairs(planted(5, 10), (wrong, COLOUR))
    assert "intrinsics of one of the cameras are likely off" in " ".join(stage.residual.notes)


def test_parallel_boards_are_told():
    stage = extrinsics_of_pairs(planted(5, 4, tilt=0.02), (TOF, COLOUR))
    assert "nearly parallel" in " ".join(stage.residual.notes)


def test_more_views_know_the_pose_better():
    few, many = (extrinsics_of_pairs(planted(9, n), (TOF, COLOUR)) for n in (3, 12))
    assert (many.sigma < few.sigma).all()


def drawn(camera, pose, board, grid=3):
    """Picture of a board, `grid` by `grid` points a pixel."""
    v, u = np.mgrid[0 : camera.height * grid, 0 : camera.width * grid]
    way = rays_at(camera, (u + 0.5) / grid - 0.5, (v + 0.5) / grid - 0.5)
    turn, shift = pose
    reach = (turn[:, 2] @ shift) / (way @ turn[:, 2])
    at = (way * reach[..., None] - shift) @ turn
    light = np.where(dark_at(board, at[..., 0], at[..., 1]), 0.15, 0.9)
    light = light.reshape(camera.height, grid, camera.width, grid).mean((1, 3))
    return cv2.GaussianBlur(light, (0, 0), 0.6)


def written_set(folder, views=3):
    """Captures, and their pictures in a folder."""
    small = Camera(400, 300, COLOUR.K * [[0.3], [0.3], [1]])
    tof = Camera(160, 120, TOF.K * [[0.6], [0.6], [1]] - [[0, 0, 15], [0, 0, 12], [0, 0, 0]])
    board, rng, captures = parse_board(BOARD), np.random.default_rng(4), []
    sensor = Sensor(tof, Modulation(np.array([20e6])))
    while len(captures) < views:
        pose = random_board(rng, 0.25)
        place = moved(pose, CORNERS)
        if not (
            inside(tof, seen_px(tof, place)) and inside(small, seen_px(small, place @ R.T + T))
        ):
            continue
        name = f"view{len(captures)}"
        picture = drawn(small, (R @ pose[0], R @ pose[1] + T), board)
        cv2.imwrite(str(folder / f"{name}.png"), np.round(picture * 255).astype(np.uint8))
        capture = Capture(sensor, phasors=Phasors(1000 * drawn(tof, pose, board)[None] + 0j))
        captures.append(with_conditions(capture, Conditions("board"), file=f"{name}.h5"))
    write_text(folder / "colour.json", opencv_json(small))
    return captures, {"board": BOARD, "colour": str(folder),
                      "intrinsics": str(folder / "colour.json")}  # fmt: skip


def test_from_captures_and_pictures_to_a_saved_stage(tmp_path):
    captures, given = written_set(tmp_path)
    stage = extrinsics(captures, **given)
    assert np.linalg.norm(stage.translation_m - T) < 2e-3
    assert np.linalg.norm(missed(stage)[:3]) < 3e-3
    assert stage.residual.after < 0.5
    z = Phasors(np.ones((1, 4, 4), np.complex64))
    assert stage(z) is z
    save_chain(tmp_path / "cal.json", extended(chain_for(captures[0].sensor), stage))
    again = load_chain(tmp_path / "cal.json").stage("extrinsics")
    np.testing.assert_array_equal(again.rotation, stage.rotation)
    np.testing.assert_array_equal(again.colour.K, stage.colour.K)
    assert again.residual == stage.residual or np.isnan(stage.residual.held_out)


def test_one_sentence_for_what_does_not_fit_together(tmp_path):
    captures, given = written_set(tmp_path, views=1)
    wall = with_conditions(captures[0], Conditions("wall", distance_m=1.0))
    cases = [
        (([wall], given), "none of kind board"),
        ((captures, {**given, "colour": ""}), "give colour=FOLDER and intrinsics=FILE"),
        ((captures, {**given, "colour": str(tmp_path / "no")}), "got no picture in"),
        ((captures, {**given, "intrinsics": str(tmp_path / "no.json")}), "no.json is not there"),
    ]
    other = tmp_path / "large.yaml"
    write_text(other, ros_yaml(COLOUR))
    cases.append(((captures, {**given, "intrinsics": str(other)}), "view0.png has 400 x 300 px"))
    renamed = [with_conditions(captures[0], Conditions("board"), file=f"{x}.h5") for x in "ab"]
    cases.append(((renamed, given), "got 2 board captures and 1 pictures"))
    for (some, params), message in cases:
        with pytest.raises(ValueError, match=message) as caught:
            extrinsics(some, **params)
        assert "\n" not in str(caught.value)


def test_pictures_belong_to_captures_of_their_name(tmp_path):
    sensor = Sensor(TOF, Modulation(np.array([20e6])))
    bare = Capture(sensor, phasors=Phasors(np.ones((1, *TOF.shape), np.complex64)))
    a, b = (with_conditions(bare, Conditions("board"), file=f"{x}.h5") for x in "ab")
    images = [tmp_path / name for name in ("1.png", "a.jpg", "b.png")]
    assert matched([b, a], images) == [(b, images[2]), (a, images[1])]
    assert matched([b, a], images[:1] * 2) == [(a, images[0]), (b, images[0])]


def test_a_board_that_nobody_sees(tmp_path, monkeypatch):
    captures, given = written_set(tmp_path, views=1)
    monkeypatch.setattr("toftools.calib._pairing.find_board", lambda *_: None)
    with pytest.raises(ValueError, match=r"not found in view0\.h5, view0\.png; check its size"):
        extrinsics(captures, **given)


def test_a_broken_stage_is_refused():
    for change, message in (
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "orthonormal with determinant 1"),
        ({"rotation": np.eye(3) * 1.1}, "orthonormal"),
        ({"translation_m": np.array([0, np.nan, 0])}, "translation_m must be finite"),
        ({"translation_m": np.zeros(2)}, "shape"),
        ({"view_names": ("a",)}, "view_errors_px"),
        ({"colour": "colour"}, "must be a Camera"),
    ):
        with pytest.raises(ValueError, match=message):
            Extrinsics(**{"rotation": np.eye(3), "translation_m": T, "colour": COLOUR, **change})


def real(name):
    folder = Path(os.environ.get("TOFTOOLS_DATA", "")) / name
    if not os.environ.get("TOFTOOLS_DATA") or not folder.is_dir():
        pytest.skip(f"TOFTOOLS_DATA is not set, or has no {name}")
    return folder


def test_azure_kinect_pair():
    from toftools.calib._corners import find_board
    from toftools.calib._lens_views import read_view
    from toftools.io.intrinsics import read_intrinsics

    folder = real("azure_calib_registration")
    board = parse_board(
        "charuco:columns=14,rows=9,square_m=0.04,marker_m=0.03,dictionary=DICT_5X5_250"
    )
    cameras = tuple(read_intrinsics(folder / f"calib_{name}.yml") for name in ("ir", "color"))
    seen = [find_board(read_view(folder / name), board) for name in ("ir-0.png", "color-0.jpg")]
    assert min(len(found.ids) for found in seen) >= 100
    pair = Pair("0", *(Sight(board.points()[found.ids], found.corners) for found in seen))
    stage = extrinsics_of_pairs([pair], cameras)
    assert stage.view_errors_px[0, 0] < 0.3
    assert stage.view_errors_px[0, 1] < 0.4
    # The colour camera of this model sits about 32 mm beside the ToF camera (recalled).
    np.testing.assert_allclose(stage.translation_m, [-0.032, -0.001, 0.004], atol=3e-3)


def test_the_pose_that_the_authors_of_a_module_found():
    import json

    from toftools.io.intrinsics import read_intrinsics

    folder = real("poveryang_tof_calib")
    cameras = tuple(read_intrinsics(folder / name)
                    for name in ("tof_calib_rotated.json", "rgb_calib.json"))  # fmt: skip
    y, x = np.mgrid[0:4, 0:5].reshape(2, -1) * 0.04
    board = np.stack([x, y, 0 * x], axis=-1)
    pairs = []
    for n in range(15):
        found = [np.load(folder / f"{kind}/{n}_corners.npz")["corners"].reshape(-1, 2)
                 for kind in ("tof_corners_rotated", "rgb_corners")]  # fmt: skip
        pairs.append(Pair(str(n), *(Sight(board, px.astype(float)) for px in found)))
    stage = extrinsics_of_pairs(pairs, cameras)
    theirs = json.loads((folder / "stereo_extrinsics.json").read_text())
    apart_m = stage.translation_m - np.ravel(theirs["t"]) / 1e3
    assert (np.abs(apart_m) < stage.sigma[3:]).all()
    turn = cv2.Rodrigues(stage.rotation @ np.array(theirs["R"]).T)[0].ravel()
    assert (np.abs(turn) < stage.sigma[:3]).all()
    # They state 1.55 px; the boards were all parallel and the intrinsics over-fitted.
    assert stage.view_errors_px[:, 1].mean() < 1.0
    notes = " ".join(stage.residual.notes)
    assert "nearly parallel" in notes
    assert "likely off" in notes


def test_refinement_from_a_poor_start():
    pairs = planted(2, 4)
    boards = [board_poses(TOF, pair.tof)[0] for pair in pairs]
    off = cv2.Rodrigues(np.array([0.05, 0.05, -0.05]))[0] @ R, T + 0.05
    fit = refined(pairs, (TOF, COLOUR), (off, boards), SCATTER)
    near = refined(pairs, (TOF, COLOUR), ((R, T), boards), SCATTER)
    np.testing.assert_allclose(fit.pose[1], near.pose[1], atol=1e-6)
