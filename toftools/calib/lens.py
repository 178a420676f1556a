"""The lens: focal lengths, principal point and distortion from views of a flat printed board.

Model: a corner X of the board appears at ``project(K, dist, R X + t) + noise``; K and dist are
common to all views, R and t are of each view. All is solved together (least squares, once outlying
views and corners are gone); the size of the distortion model is chosen by views held out.
Paper: Z. Zhang, A flexible new technique for camera calibration, PAMI 22(11), 2000; distortion as
in OpenCV (pinhole: Brown-Conrady and its rational form; fisheye: Kannala and Brandt, PAMI 28(8),
2006). Input: captures of kind ``board``, 10 to 40, tilted by 20 to 50 degrees in different
directions, near the edges too. Fails where all views are parallel (refused), where squares are
under about 5 px, and where the board is bent (told). Measured: docs/calibration/lens.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from toftools._arrays import F64, expect_shape, frozen, set_fields
from toftools.calib._lens_checks import (
    LEAST,
    boards_in,
    check_observable,
    distinct,
    tilt_deg,
)
from toftools.calib._lens_choice import chosen, starts, trial, without_outliers
from toftools.calib._lens_fit import covariance
from toftools.calib._lens_model import Corners
from toftools.calib._lens_notes import board_notes, coverage_map
from toftools.calib._lens_told import (
    check_agreed,
    choice_notes,
    found_notes,
    nominal_px,
    range_notes,
    reach_notes,
)
from toftools.calib._lens_views import View as View
from toftools.calib._lens_views import read_view as read_view
from toftools.calib._lens_views import view_of as view_of
from toftools.calib.board import DEFAULT, Board, parse_board
from toftools.calib.residuals import same_sensor
from toftools.calib.stage import Residual
from toftools.conditions import conditions_of
from toftools.types import Camera, Capture, Phasors

SIZES = (0, 4, 5, 8)
"""Distortion coefficients to choose from: none; k1 k2 p1 p2; and k3; and the rational k4 k5 k6."""
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


@dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated lens.

    Parameters
    ----------
    camera : Camera
        Intrinsics and distortion.
    sigma : ndarray, (4 + n,)
        Standard deviations of fx, fy, cx, cy (px) and of the n distortion coefficients.
    board : str
        The board, as `toftools.calib.board.parse_board` reads it.
    views : tuple of str
        Views that were used.
    view_rms_px : ndarray, (V,)
        Root mean square distance of the corners of each from the model, px.
    rejected : tuple of str
        Views that showed the board but disagree with the others.
    coverage : ndarray, (6, 8)
        Corners in each part of the image.
    corners_px, errors_px : ndarray, (N, 2)
        All corners used, and measured minus modelled, px.
    rms_px, held_out_px : float
        The same over all corners, and over views that a fit has not seen (but for their pose), px.
    tilt_deg : float
        Largest angle between the board in any two views, degrees.
    residual : Residual
        Before (nominal optics), after and held out, px, with notes.
    """

    camera: Camera
    sigma: F64
    board: str
    views: tuple[str, ...]
    view_rms_px: F64
    rejected: tuple[str, ...]
    coverage: F64
    corners_px: F64
    errors_px: F64
    rms_px: float
    held_out_px: float
    tilt_deg: float
    residual: Residual

    slot: ClassVar[str] = "lens"

    def __post_init__(self) -> None:
        ranks = {"sigma": 1, "view_rms_px": 1, "coverage": 2, "corners_px": 2, "errors_px": 2}
        for name, rank in ranks.items():
            value = frozen(getattr(self, name), np.float64, f"lens {name}", rank)
            if not np.isfinite(value).all():
                msg = f"lens {name} must be finite numbers"
                raise ValueError(msg)
            set_fields(self, **{name: value})
        expect_shape("lens sigma", self.sigma, (4 + self.camera.dist.size,))
        expect_shape("lens view_rms_px", self.view_rms_px, (len(self.views),))
        expect_shape("lens corners_px", self.corners_px, (len(self.corners_px), 2))
        expect_shape("lens errors_px", self.errors_px, self.corners_px.shape)
        set_fields(self, views=tuple(self.views), rejected=tuple(self.rejected))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers that `sigma` belongs to."""
        known = FISHEYE_NAMES if self.camera.model == "fisheye" else NAMES
        return known[: len(self.sigma)]

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors as they are: a lens changes where a pixel looks, not what it measures.

        `toftools.calib.chain.applied` puts `camera` into the sensor of the capture.

        Parameters
        ----------
        phasors : Phasors
            Any phasors.

        Returns
        -------
        Phasors
            The same.
        """
        return phasors


def lens(
    captures: Sequence[Capture],
    *,
    board: str = DEFAULT,
    distortion: int | None = None,
    hold_out: int = 5,
) -> Lens:
    """Pinhole camera with OpenCV distortion from captures of a board.

    Parameters
    ----------
    captures : sequence of Capture
        Captures, of which those of kind ``board`` count.
    board : str
        The board, such as ``chessboard:columns=8,rows=5,square_m=0.03`` (inner corners) or
        ``charuco:columns=9,rows=6,square_m=0.03,marker_m=0.023,dictionary=DICT_4X4_50`` (squares).
    distortion : int or None
        Coefficients: 0, 4, 5 or 8; None takes the fewest that held-out views do not object to.
    hold_out : int
        Parts that the views are held out in, one after another.

    Returns
    -------
    Lens
        The stage.

    Raises
    ------
    ValueError
        If a parameter or capture is unfit, too few views show the board, or all are parallel.
    """
    if distortion is not None and distortion not in SIZES:
        msg = f"lens got distortion={distortion}; wanted one of {', '.join(map(str, SIZES))}"
        raise ValueError(msg)
    sizes = SIZES if distortion is None else (distortion,)
    return _from_captures(captures, board, "pinhole", sizes, hold_out)


def lens_fisheye(captures: Sequence[Capture], *, board: str = DEFAULT, hold_out: int = 5) -> Lens:
    """Fisheye camera (OpenCV's four coefficients) from captures of a board.

    Parameters
    ----------
    captures : sequence of Capture
        Captures, of which those of kind ``board`` count.
    board : str
        The board, as for `lens`.
    hold_out : int
        Parts that the views are held out in, one after another.

    Returns
    -------
    Lens
        The stage; its camera has the model ``fisheye``.

    Raises
    ------
    ValueError
        As for `lens`.
    """
    return _from_captures(captures, board, "fisheye", (4,), hold_out)


def _from_captures(
    captures: Sequence[Capture], board: str, model: str, sizes: Sequence[int], hold_out: int
) -> Lens:
    shown = [c for c in captures if conditions_of(c).kind == "board"]
    if not shown:
        msg = (
            f"got {len(captures)} captures, none of kind board; wanted at least {LEAST} of a board"
        )
        raise ValueError(msg)
    same_sensor(shown)
    sensor = shown[0].sensor
    views = [view_of(capture) for capture in shown]
    freqs, parsed = sensor.modulation.freqs_hz, parse_board(board)
    return fit_lens(
        views, parsed, sensor.camera, freqs, model=model, sizes=sizes, hold_out=hold_out
    )


def fit_lens(
    views: Sequence[View],
    board: Board,
    nominal: Camera | None = None,
    freqs_hz: F64 | None = None,
    *,
    model: str = "pinhole",
    sizes: Sequence[int] = SIZES,
    hold_out: int = 5,
) -> Lens:
    """Camera from images of a board; `lens` and `lens_fisheye` do the same for captures.

    Parameters
    ----------
    views : sequence of View
        Images; see `read_view` for files.
    board : Board
        The board.
    nominal : Camera or None
        Where to start, and what ``residual.before`` is about.
    freqs_hz : ndarray (F,) or None
        Frequencies of the phasors of the views, for the check of square_m against range, Hz.
    model : {"pinhole", "fisheye"}
        Lens model.
    sizes : sequence of int
        Numbers of distortion coefficients to choose from, rising.
    hold_out : int
        As for `lens`.

    Returns
    -------
    Lens
        The stage.

    Raises
    ------
    ValueError
        As for `lens`.
    """
    if hold_out < 2:
        msg = f"hold_out must be 2 or more parts, got {hold_out}"
        raise ValueError(msg)
    views = distinct(views)
    seen, missed = boards_in(views, board)
    points = board.points()
    data = [Corners(s.name, points[s.ids], s.corners) for s in seen]
    shape = views[0].image.shape
    kept = without_outliers(data, starts(nominal, (shape[0], shape[1]), model), max(sizes))
    check_agreed(kept, len(data), board)
    trials = [trial(kept.views, kept.fit, terms, hold_out) for terms in sizes]
    best = chosen(trials)
    spread = np.sqrt(np.maximum(np.diag(covariance(best.fit, kept.views)[1]), 0.0))
    names = [view.name for view in kept.views]
    check_observable(best.fit, spread, names, board)
    counts = coverage_map([view.pixels for view in kept.views], (shape[0], shape[1]))
    notes = [
        *found_notes(kept, missed, views),
        *choice_notes(best, trials),
        *reach_notes(best, spread, counts),
        *board_notes(best.fit, kept.views, board),
        *range_notes(best.fit, views, seen, board, freqs_hz, names),
    ]
    errors, rms_px, held_out_px = np.concatenate(best.fit.errors), best.fit.rms_px, best.held_out_px
    before, n = nominal_px(nominal, kept), len(errors)
    residual = Residual("px", before, rms_px, held_out_px, n=n, notes=tuple(notes))
    return Lens(
        camera=best.fit.camera,
        sigma=spread,
        board=board.text(),
        views=tuple(names),
        view_rms_px=best.fit.view_rms(),
        rejected=kept.rejected,
        coverage=counts,
        corners_px=np.concatenate([view.pixels for view in kept.views]),
        errors_px=errors,
        rms_px=rms_px,
        held_out_px=held_out_px,
        tilt_deg=tilt_deg(best.fit),
        residual=residual,
    )
