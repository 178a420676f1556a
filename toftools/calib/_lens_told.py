"""The notes of a lens calibration, a sentence each."""

from collections.abc import Sequence

import numpy as np

from toftools._arrays import F64
from toftools.calib._corners import Seen
from toftools.calib._lens_checks import LEAST, WIDE_SPREAD, listed, tilt_deg
from toftools.calib._lens_choice import Kept, Trial
from toftools.calib._lens_fit import Fit, fit_poses
from toftools.calib._lens_notes import coverage_note, range_note
from toftools.calib._lens_views import View
from toftools.calib.board import Board
from toftools.types import Camera


def found_notes(kept: Kept, missed: Sequence[str], views: Sequence[View]) -> list[str]:
    """Which views were not used, and why."""
    notes = []
    if missed:
        notes.append(f"no board was found in {listed(missed)}")
    clipped = [v.name for v in views if v.saturated.mean() > 0.01 and v.name not in missed]
    if clipped:
        notes.append(f"{listed(clipped)} are partly saturated; the board was found all the same")
    if kept.rejected:
        notes.append(f"{listed(kept.rejected)} disagree with the other views and were left out")
    if kept.dropped:
        notes.append(f"{kept.dropped} single corners lie far off and were left out")
    if len(kept.views) < 8:
        notes.append(f"{len(kept.views)} views are few; 20 give about half the uncertainty")
    return notes


def choice_notes(best: Trial, trials: Sequence[Trial]) -> list[str]:
    """Which distortion model was chosen, and whether it holds over the image."""
    notes = []
    if len(trials) > 1:
        told = ", ".join(
            f"{t.terms}: {t.held_out_px:.3g} px{' (turns back)' if t.folds else ''}" for t in trials
        )
        notes.append(f"chose {best.terms} distortion coefficients by views held out ({told})")
    if best.folds:
        notes.append(
            "the distortion polynomial turns back within the image, so that some pixels have no "
            "ray; fit fewer coefficients or add views near the edges"
        )
    return notes


def reach_notes(best: Trial, sigma: F64, counts: F64) -> list[str]:
    """How well the focal length is known, and where corners are missing."""
    notes = []
    spread = float((sigma[:2] / np.diag(best.fit.camera.K)[:2]).max())
    if spread > WIDE_SPREAD:
        notes.append(
            f"the focal length is known to {100 * spread:.2g} % only (standard deviation), as the "
            f"board is tilted by at most {tilt_deg(best.fit):.0f} degrees between views: add views "
            "tilted by 20 to 50 degrees in different directions"
        )
    if note := coverage_note(counts):
        notes.append(note)
    return notes


def range_notes(
    fit: Fit,
    views: Sequence[View],
    seen: Sequence[Seen],
    board: Board,
    freqs_hz: F64 | None,
    names: Sequence[str],
) -> list[str]:
    """Whether range and board disagree about the scale; wiggling hides it at one frequency."""
    if freqs_hz is None or len(freqs_hz) < 2:
        return []
    view_by, seen_by = {v.name: v for v in views}, {s.name: s for s in seen}
    used = [view_by[name] for name in names], [seen_by[name] for name in names]
    note = range_note(fit, *used, board, freqs_hz)
    return [note] if note else []


def check_agreed(kept: Kept, seen: int, board: Board) -> None:
    """Refuse views of which too few agree on one camera."""
    if len(kept.views) < max(LEAST, (seen + 1) // 2):
        msg = (
            f"only {len(kept.views)} of {seen} views agree on one camera, against {board.text()}: "
            f"{listed(kept.rejected)} do not; is it one camera at one zoom and one flat board?"
        )
        raise ValueError(msg)


def nominal_px(nominal: Camera | None, kept: Kept) -> float:
    """Error with the optics that the captures came with, poses fitted, px."""
    return float("nan") if nominal is None else fit_poses(kept.views, nominal).rms_px
