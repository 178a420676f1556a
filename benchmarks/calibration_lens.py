"""Lens calibration against truth, beside plain OpenCV: docs/calibration/lens.md and its picture.

    python benchmarks/calibration_lens.py [--out docs/calibration] [--seeds 10]

One camera of 320 x 240 px with planted distortion sees a chessboard 8, 20 or 40 times, ten times
over with other poses and noise. Two runs: true corners plus normal noise, where only the fit
differs; and images (vignetting, shot and read noise; see lens_views.py), where the corners differ
as well. Plain OpenCV is findChessboardCorners, cornerSubPix and calibrateCamera with their usual
settings (window of 5 px, five coefficients), told of every view in which it finds the board.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import lens_views
import numpy as np

from toftools.calib._lens_choice import chosen, starts, trial, without_outliers
from toftools.calib._lens_fit import covariance
from toftools.calib._lens_model import unknowns
from toftools.calib.board import parse_board
from toftools.calib.lens import SIZES, fit_lens
from toftools.camera import project, rays
from toftools.types import Camera
from toftools.viz._axes import log_axis
from toftools.viz._series import Chart, Series, draw

BOARD = parse_board("chessboard:columns=8,rows=5,square_m=0.03")
K = np.array([[233.4, 0, 163.8], [0, 232.7, 117.8], [0, 0, 1]])
TRUTH = Camera(320, 240, K, np.array([-0.12, 0.05, 8e-4, -6e-4, 0.0]))
COUNTS = (8, 20, 40)
NOISE_PX = 0.1
WINDOW = 5


@dataclass(frozen=True)
class Score:
    """How far a camera is from the truth."""

    focal: float  # share, mean of fx and fy
    centre_px: float
    ray_mrad: float  # rms over the field, turned to fit best as a pose would
    ray_px: float
    held_ms: float = 0.0
    inside: float = float("nan")  # share of the unknowns within 1.96 standard deviations


def scored(camera, wall_ms=0.0, sigma=None):
    """A camera against `TRUTH`; rays are compared after the rotation that a pose would absorb."""
    focal = np.abs(np.diag(camera.K)[:2] / np.diag(K)[:2] - 1).mean()
    centre = float(np.linalg.norm(camera.K[:2, 2] - K[:2, 2]))
    true, found = (rays(c)[::4, ::4].reshape(-1, 3) for c in (TRUTH, camera))
    good = np.isfinite(found).all(axis=1)
    u, _, v = np.linalg.svd(found[good].T @ true[good])
    turned = found[good] @ (u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v)
    angle = np.linalg.norm(turned - true[good], axis=1)
    pixels = np.stack(project(TRUTH, turned), axis=-1) - np.stack(
        project(TRUTH, true[good]), axis=-1
    )
    inside = float("nan")
    if sigma is not None:
        size = len(sigma) if len(sigma) <= 9 else 4  # rational coefficients are other numbers
        error = unknowns(camera)[:size] - unknowns(TRUTH)[:size]
        inside = float((np.abs(error) <= 1.96 * sigma[:size]).mean())
    rms = (float(np.sqrt((x**2).mean() * d)) for x, d in ((angle, 1), (pixels, 2)))
    ray_rad, ray_px = rms
    return Score(float(focal), centre, 1e3 * ray_rad, ray_px, wall_ms, inside)


def opencv(points, pixels):
    """Plain calibrateCamera."""
    start = time.process_time()
    _, matrix, dist, _, _ = cv2.calibrateCamera(
        [p.astype(np.float32) for p in points], [p.astype(np.float32) for p in pixels],
        (TRUTH.width, TRUTH.height), None, None,
    )  # fmt: skip
    wall = 1e3 * (time.process_time() - start)
    return scored(Camera(TRUTH.width, TRUTH.height, matrix, np.ravel(dist)[:5]), wall)


def from_corners(seed, count):
    """Both on the same noisy corners."""
    rng = np.random.default_rng((seed, count))
    views = lens_views.corners(rng, count, TRUTH, BOARD, NOISE_PX)
    start = time.process_time()
    kept = without_outliers(views, starts(None, TRUTH.shape, "pinhole"), max(SIZES))
    best = chosen([trial(kept.views, kept.fit, terms, 5) for terms in SIZES])
    sigma = np.sqrt(np.diag(covariance(best.fit, kept.views)[1]))
    ours = scored(best.fit.camera, 1e3 * (time.process_time() - start), sigma)
    return ours, opencv([v.points for v in views], [v.pixels for v in views])


def from_images(seed, count, field):
    """Both on the same images."""
    rng = np.random.default_rng((seed, count, 1))
    poses = lens_views.poses(rng, count, TRUTH, BOARD)
    shown = [lens_views.view(rng, f"{i}.h5", lens_views.image(field, pose, BOARD))
             for i, pose in enumerate(poses)]  # fmt: skip
    start = time.process_time()
    found = fit_lens(shown, BOARD)
    ours = scored(found.camera, 1e3 * (time.process_time() - start), found.sigma)
    plain = [corners for view in shown if (corners := plain_corners(view.image)) is not None]
    return ours, opencv([BOARD.points()] * len(plain), plain), (len(found.views), len(plain))


def plain_corners(image):
    """What a tutorial does: 8 bits, the classic detector, cornerSubPix."""
    grey = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    found, corners = cv2.findChessboardCorners(grey, BOARD.corners)
    if not found:
        return None
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-3)
    corners = cv2.cornerSubPix(grey, np.asarray(corners), (WINDOW, WINDOW), (-1, -1), stop)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def median(scores, name):
    return float(np.median([getattr(s, name) for s in scores]))


def row(what, count, scores):
    values = (100 * median(scores, "focal"), median(scores, "centre_px"))
    rest = (median(scores, "ray_mrad"), median(scores, "ray_px"), median(scores, "held_ms"))
    inside = np.mean([s.inside for s in scores])
    told = f"{inside:.0%}" if np.isfinite(inside) else ""
    return (f"| {what} | {count} | {values[0]:.3f} | {values[1]:.3f} | {rest[0]:.3f} | "
            f"{rest[1]:.4f} | {rest[2]:.0f} | {told} |")  # fmt: skip


HEAD = (
    "| method | views | focal error, % | principal point, px | rays, mrad rms | rays, px rms | "
    "CPU, ms | truth inside 95 % |\n|---|---|---|---|---|---|---|---|"
)


def chart(runs):
    """Ray error against views, one curve per method."""
    curves = {
        "lens, from images": [median(runs["images"][n][0], "ray_px") for n in COUNTS],
        "OpenCV, from images": [median(runs["images"][n][1], "ray_px") for n in COUNTS],
        f"lens, corners +- {NOISE_PX} px": [
            median(runs["corners"][n][0], "ray_px") for n in COUNTS
        ],
        f"OpenCV, corners +- {NOISE_PX} px": [
            median(runs["corners"][n][1], "ray_px") for n in COUNTS
        ],
    }
    x = log_axis(np.array(COUNTS, float), name="views", horizontal=True)
    y = log_axis(np.array(list(curves.values())).ravel(), name="ray error, px rms over the field")
    series = [
        Series(name, np.column_stack([x(np.array(COUNTS, float)), y(np.array(values))]),
               [f"{n} views: {v:.3g} px" for n, v in zip(COUNTS, values, strict=True)], look)
        for look, (name, values) in enumerate(curves.items())
    ]  # fmt: skip
    return draw(Chart("Lens calibration against truth, 320 x 240 px", "", x, y, series))


def page(runs, found, seeds):
    lines = [
        "# Lens calibration against truth",
        "",
        f"Made by `python benchmarks/calibration_lens.py`, OpenCV {cv2.__version__}. One camera "
        f"of 320 x 240 px, f = 233 px, k1 = -0.12, k2 = 0.05; a chessboard of 8 x 5 inner corners "
        f"of 30 mm, tilted by 10 to 45 degrees; medians over {seeds} seeds. Rays are compared over "
        "the whole field after the rotation that a pose would absorb. CPU is that of the fit; from "
        "images, that of `lens` includes the search for the board and five-fold hold-out of four "
        "models.",
        "",
        "![ray error against views](lens.svg)",
        "",
        "## From images: vignetting, shot noise of 1500 electrons, read noise of 15",
        "",
        HEAD,
    ]
    for n in COUNTS:
        lines += [row("lens", n, runs["images"][n][0]), row("OpenCV", n, runs["images"][n][1])]
    used = "Views used, lens (outliers left out) against plain OpenCV (where it finds the board): "
    lines += ["", used + ", ".join(
        f"{sum(a for a, _ in found[n])} and {sum(b for _, b in found[n])} of {n * seeds}"
        for n in COUNTS) + ".", ""]  # fmt: skip
    lines += [f"## The same corners, truth plus normal noise of {NOISE_PX} px", "", HEAD]
    for n in COUNTS:
        lines += [row("lens", n, runs["corners"][n][0]), row("OpenCV", n, runs["corners"][n][1])]
    lines += ["", NOTES]
    return "\n".join(lines) + "\n"


NOTES = """\
With the same corners both solve the same least-squares problem; what is left is that `lens` fits
no coefficient that held-out views do not ask for (here the fifth is 0). From images most of the
gain is that of the corners: `lens` fits two crossing blurred edges to the pixels around each, in
the square root of the amplitude, where `cornerSubPix` balances gradients of an 8-bit picture.
"Truth inside 95 %" is the share of all planted numbers within 1.96 of the standard deviations that
the stage reports.

Limits: a flat board, no blur but that of the pixel, no motion, no saturation. On 15 real boards of
a sensor of 100 x 100 px (squares of 9 px, some under glare) the stage finds all 15 and leaves
0.053 px rms, 0.057 px in views held out, with four coefficients; the focal length is known to 16 %
only, because those boards are tilted by at most 12 degrees against each other; the stage says so.
The corners published with those pictures leave 0.166 px rms in calibrateCamera with five
coefficients, and lie half a pixel off ours, as if an enlarged image had been searched and its
coordinates only divided.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/calibration"))
    parser.add_argument("--seeds", type=int, default=10)
    args = parser.parse_args()
    field = lens_views.camera_rays(TRUTH)
    runs, found = {"corners": {}, "images": {}}, {}
    for n in COUNTS:
        runs["corners"][n] = list(
            zip(*[from_corners(s, n) for s in range(args.seeds)], strict=True)
        )
        seen = [from_images(s, n, field) for s in range(args.seeds)]
        runs["images"][n] = [[s[0] for s in seen], [s[1] for s in seen]]
        found[n] = [s[2] for s in seen]
        print(
            row("lens", n, runs["images"][n][0]), row("OpenCV", n, runs["images"][n][1]), sep="\n"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "lens.svg").write_text(chart(runs), encoding="utf-8")
    (args.out / "lens.md").write_text(page(runs, found, args.seeds), encoding="utf-8")


if __name__ == "__main__":
    main()
