"""Colours for ToF pixels, ranges for colour pixels: beside slow twins, in a scene of two planes."""

import cv2
import numpy as np
import pytest

from toftools.calib._register_kernel import cover, pick
from toftools.calib.extrinsics import Extrinsics
from toftools.calib.register import (
    COLOURED,
    HIDDEN,
    NO_RANGE,
    OUTSIDE,
    colours_of,
    register_depth,
)
from toftools.camera import pinhole, points, project, range_to_z, rays, undistorted
from toftools.types import Camera

TOF = pinhole(160, 120, hfov_deg=70)
COLOUR = pinhole(640, 480, hfov_deg=80)
R = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
T = np.array([-0.06, 0.004, 0.003])
HERE = (np.eye(3), np.zeros(3))
RECTANGLE = np.array([[-0.3, -0.2], [0.25, 0.22]])


def on_rectangle(centre, way):
    """Length of rays to the plane z = 1, and whether they meet the rectangle on it."""
    length = (1 - centre[2]) / way[..., 2]
    at = centre[:2] + length[..., None] * way[..., :2]
    return length, ((at > RECTANGLE[0]) & (at < RECTANGLE[1])).all(-1)


def two_planes(camera, pose):
    """Range to a rectangle at 1 m before a wall at 2 m, and where the rectangle is."""
    turn, shift = pose
    way, centre = rays(camera) @ turn, -turn.T @ shift
    length, front = on_rectangle(centre, way)
    return np.where(front, length, (2 - centre[2]) / way[..., 2]), front


def rig(colour=COLOUR):
    range_m, front = two_planes(TOF, HERE)
    _, seen = two_planes(colour, (R, T))
    image = np.stack([seen, ~seen, np.zeros_like(seen)], axis=-1).astype(np.float32)
    centre = -R.T @ T
    _, behind = on_rectangle(centre, points(TOF, range_m) - centre)
    return Extrinsics(R, T, colour), range_m, front, image, behind & ~front


def shares(colours, status, front, hidden):
    """Share of pixels with a wrong colour, and of those that lost theirs."""
    wrong = (status == COLOURED) & (np.abs(colours[..., 0] - front) > 0.5)
    return wrong.mean(), ((status != COLOURED) & ~hidden).mean()


def test_hidden_pixels_get_no_colour_and_the_foreground_does_not_bleed():
    extrinsics, range_m, front, image, hidden = rig()
    u, v = (np.rint(x).astype(int) for x in project(COLOUR, points(TOF, range_m) @ R.T + T))
    plain = (image[v, u, 0] != front).mean()
    wrong, lost = shares(*colours_of(extrinsics, TOF, range_m, image), front, hidden)
    assert hidden.mean() > 0.008
    assert plain > 0.008
    assert wrong < 0.001
    assert lost < 0.003


def test_beside_opencv():
    if not hasattr(cv2, "registerDepth"):
        pytest.skip("this OpenCV has no registerDepth")
    extrinsics, range_m, front, image, hidden = rig()
    place = points(TOF, range_m) @ R.T + T
    u, v = (np.rint(x).astype(int) for x in project(COLOUR, place))
    motion = np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]])
    z = cv2.registerDepth(TOF.K, COLOUR.K, np.zeros(5), motion, range_to_z(TOF, range_m),
                          (640, 480), depthDilation=True)[v, u]  # fmt: skip
    behind = np.isfinite(z) & (z > 0) & (place[..., 2] - z > 0.1)
    theirs = ((image[v, u, 0] != front) & ~behind).mean()
    wrong, _ = shares(*colours_of(extrinsics, TOF, range_m, image), front, hidden)
    assert wrong < theirs / 5


def test_noise_that_is_known_tears_no_surface():
    extrinsics, range_m, front, image, hidden = rig()
    noisy = range_m + np.random.default_rng(0).normal(0, 0.03, range_m.shape)
    _, torn = shares(*colours_of(extrinsics, TOF, noisy, image), front, hidden)
    wrong, lost = shares(*colours_of(extrinsics, TOF, noisy, image, sigma_m=0.03), front, hidden)
    sigma_m = np.full(range_m.shape, 0.03, np.float32)
    sigma_m[0, 0] = np.nan
    mapped = shares(*colours_of(extrinsics, TOF, noisy, image, sigma_m=sigma_m), front, hidden)
    assert wrong < 0.0025  # a quarter of what plain projection gets wrong without noise
    assert lost < 0.003 < torn
    assert mapped == pytest.approx((wrong, lost), abs=1e-3)


def test_what_becomes_of_every_pixel():
    extrinsics, range_m, _, image, hidden = rig()
    range_m[5:9, 3] = [np.nan, 0, -1, np.inf]
    colours, status = colours_of(extrinsics, TOF, range_m, image)
    assert (status[5:9, 3] == NO_RANGE).all()
    assert (np.isnan(colours).all(-1) == (status != COLOURED)).all()
    assert (status[hidden] == HIDDEN).mean() > 0.9
    assert (status != OUTSIDE).all()
    narrow = Extrinsics(R, T, pinhole(640, 480, hfov_deg=30))
    _, status = colours_of(narrow, TOF, range_m, image)
    u, v = project(
        narrow.colour,
        points(TOF, np.where(np.isfinite(range_m) & (range_m > 0), range_m, np.nan)) @ R.T + T,
    )
    away = (u < -0.5) | (u > 639.5) | (v < -0.5) | (v > 479.5)
    np.testing.assert_array_equal(status == OUTSIDE, away)
    behind = Extrinsics(np.diag([-1.0, 1, -1]), T, COLOUR)
    _, status = colours_of(behind, TOF, range_m, image)
    assert set(status.ravel()) == {OUTSIDE, NO_RANGE}


BENT = Camera(640, 480, COLOUR.K, np.array([0.1, -0.08, 1e-3, -1e-3, 0.01]))
ROUND = Camera(640, 480, COLOUR.K, np.array([0.02, -0.004, 3e-4, 0]), "fisheye")


@pytest.mark.parametrize("colour", [COLOUR, BENT, ROUND], ids=["pinhole", "distorted", "fisheye"])
def test_a_tilted_wall_arrives_in_the_other_camera(colour):
    normal = np.array([0.4, -0.2, -1.0])
    range_m = -1.5 / (rays(TOF) @ normal)
    z_m = register_depth(Extrinsics(R, T, colour), TOF, range_m)
    own = rays(colour)
    way = own @ R
    length = (-1.5 - normal @ (-R.T @ T)) / (way @ normal)
    known = np.isfinite(z_m)
    np.testing.assert_allclose(z_m[known], (own[..., 2] * length)[known], atol=5e-4)
    u, v = project(TOF, (own * length[..., None] - T) @ R)
    seen = (u > 0) & (u < 159) & (v > 0) & (v < 119)
    assert seen.mean() > 0.3
    assert known[seen].all()


def test_the_same_camera_sees_the_same_picture():
    still = Extrinsics(*HERE, TOF)
    range_m, _ = two_planes(TOF, HERE)
    image = np.random.default_rng(1).random((120, 160, 3), np.float32)
    colours, status = colours_of(still, TOF, range_m, image)
    assert (status == COLOURED).all()
    np.testing.assert_allclose(colours, image, atol=1e-5)
    z_m = register_depth(still, TOF, range_m)
    np.testing.assert_allclose(z_m, range_to_z(TOF, range_m), rtol=2e-5)


@pytest.mark.parametrize("camera", [
    Camera(160, 120, TOF.K, np.array([-0.25, 0.08, 1e-3, 0.0, 0.0])),
    Camera(160, 120, TOF.K * [[0.5], [0.5], [1]] + [[0, 0, 40], [0, 0, 30], [0, 0, 0]],
           np.array([0.02, -0.004, 3e-4, 0]), "fisheye"),
], ids=["distorted", "fisheye"])  # fmt: skip
def test_a_range_image_without_its_distortion(camera):
    plain = undistorted(camera, most_deg=60)
    assert plain.dist.size == 0
    assert plain.model == "pinhole"
    u, v = project(plain, rays(camera)[rays(camera)[..., 2] > np.cos(np.radians(60))])
    assert u.min() == pytest.approx(0, abs=1e-6)
    assert v.max() == pytest.approx(119, abs=1e-6)
    range_m = 1.5 / (rays(camera) @ [0.2, 0.1, 1.0])
    z_m = register_depth(Extrinsics(*HERE, plain), camera, range_m)
    wanted = range_to_z(plain, 1.5 / (rays(plain) @ [0.2, 0.1, 1.0]))
    known = np.isfinite(z_m)
    assert known[5:-5, 5:-5].mean() > 0.9
    np.testing.assert_allclose(z_m[known], wanted[known], rtol=5e-4)


def test_a_pinhole_of_no_angle_is_refused():
    with pytest.raises(ValueError, match="between 0 and 90"):
        undistorted(TOF, most_deg=90)


def test_a_noisy_wall_stays_one_surface():
    range_m = 1.5 / rays(TOF)[..., 2] + np.random.default_rng(6).normal(0, 0.04, TOF.shape)
    extrinsics = Extrinsics(R, T, COLOUR)
    whole = register_depth(extrinsics, TOF, range_m, sigma_m=0.04)[60:-60, 80:-80]
    torn = register_depth(extrinsics, TOF, range_m)[60:-60, 80:-80]
    jumps = [np.mean(np.abs(np.diff(z, axis=1)) > 0.05) for z in (whole, torn)]
    assert jumps[0] < 0.001 < 0.03 < jumps[1]


def test_bytes_are_colours_too():
    extrinsics, range_m, _, image, _ = rig()
    plain, status = colours_of(extrinsics, TOF, range_m, 200 * image)
    whole, same = colours_of(extrinsics, TOF, range_m, (200 * image).astype(np.uint8))
    np.testing.assert_array_equal(status, same)
    np.testing.assert_allclose(whole, plain, atol=1e-3)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e9, 1e30])
def test_absurd_ranges_break_nothing(scale):
    extrinsics, range_m, _, image, _ = rig()
    absurd = range_m * scale ** np.random.default_rng(5).random(range_m.shape)
    _, status = colours_of(extrinsics, TOF, absurd, image)
    z_m = register_depth(extrinsics, TOF, absurd)
    assert status.max() <= HIDDEN
    assert not (z_m <= 0).any()


def test_wrong_sizes_are_refused():
    extrinsics, range_m, _, image, _ = rig()
    with pytest.raises(ValueError, match="got ranges of"):
        register_depth(extrinsics, TOF, range_m[1:])
    for wrong in (image[1:], image[..., 0]):
        with pytest.raises(ValueError, match="got a picture of shape"):
            colours_of(extrinsics, TOF, range_m, wrong)


def slow_cover(u, v, w, nearest):
    for quad in range(len(u)):
        for corners in ((0, 1, 2), (0, 2, 3)):
            triangle = np.array([u[quad][list(corners)], v[quad][list(corners)], [1.0, 1, 1]])
            if np.isnan(triangle).any() or abs(np.linalg.det(triangle)) < 1e-12:
                continue
            for y in range(nearest.shape[0]):
                for x in range(nearest.shape[1]):
                    share = np.linalg.solve(triangle, [x, y, 1.0])
                    if (share >= 0).all():
                        here = share @ w[quad][list(corners)]
                        nearest[y, x] = max(nearest[y, x], here)


def test_covering_beside_its_slow_twin():
    rng = np.random.default_rng(2)
    u, v = rng.uniform(-4, 14, (2, 30, 4))
    w = rng.uniform(0.2, 2, (30, 4))
    u[3, 1], v[5] = np.nan, 4.0
    fast, slow = np.zeros((9, 11)), np.zeros((9, 11))
    cover(u, v, w, fast)
    slow_cover(u, v, w, slow)
    np.testing.assert_allclose(fast, slow, rtol=1e-9)
    assert (fast > 0).any()


def slow_pick(place, lax, nearest, image):
    height, width, channels = image.shape
    colours, status = np.full((len(lax), channels), np.nan), np.zeros(len(lax), int)
    for n, (u, v, w) in enumerate(zip(*place, strict=True)):
        if np.isnan(w):
            status[n] = NO_RANGE
            continue
        if w == 0 or abs(u - (width - 1) / 2) > width / 2 or abs(v - (height - 1) / 2) > height / 2:
            status[n] = OUTSIDE
            continue
        weights, found, hidden = [], [], False
        for y in (np.floor(v), np.floor(v) + 1):
            for x in (np.floor(u), np.floor(u) + 1):
                share = (1 - abs(u - x)) * (1 - abs(v - y))
                at = int(np.clip(y, 0, height - 1)), int(np.clip(x, 0, width - 1))
                gap = 1 / w - 1 / nearest[at] if nearest[at] else 0
                hidden |= gap > lax[n] and share > 0
                if abs(gap) <= lax[n]:
                    weights.append(share)
                    found.append(image[at])
        if sum(weights) > 1e-6:
            colours[n] = np.average(found, axis=0, weights=weights)
        else:
            status[n] = HIDDEN if hidden else OUTSIDE
    return colours, status


def test_picking_beside_its_slow_twin():
    rng = np.random.default_rng(3)
    image = rng.random((6, 7, 3)).astype(np.float32)
    nearest = rng.choice([0.0, 0.5, 1.0], (6, 7), p=[0.1, 0.3, 0.6])
    place = rng.uniform(-1, 7, 200), rng.uniform(-1, 6, 200), rng.choice([0.5, 1, 0, np.nan], 200)
    lax = np.full(200, 0.3)
    colours, status = np.zeros((200, 3), np.float32), np.zeros(200, np.uint8)
    pick(place, lax, nearest, image, colours, status)
    slow = slow_pick(place, lax, nearest, image)
    np.testing.assert_array_equal(status, slow[1])
    np.testing.assert_allclose(colours, slow[0], atol=1e-5)
    assert set(status) == {COLOURED, NO_RANGE, OUTSIDE, HIDDEN}
