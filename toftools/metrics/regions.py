"""Where methods differ: depth edges, concave corners, dark and far pixels of a capture.

Geometry is read off the truth by w = 1/z, which over the image of a plane is affine in the pixel
coordinates, so slope never counts as an edge and a straight line through w is the plane itself.
Distortion bends w a little: with k1 = -0.3 no plane is marked up to 52 degrees off the axis; at
58 degrees, up to 0.4 % of the pixels of grazing planes are taken for corners.

Edges. The lines through the two pixels before and the two pixels after a gap of one pixel are
drawn across the gap. Where they cross inside it, the surface folds but is continuous: a crease.
Where they do not, the surfaces are apart by at least the smaller of the two misses: a jump if it
is above `EDGE_JUMP_M`. The gap pixel may be a mixture of both surfaces, as in antialiased truth.

Corners. Three points one arm before, at and one arm after a pixel turn by more than
`CORNER_TURN_RAD`, away from the camera in the middle (w below its chord), with no jump and no
unknown pixel between them. The arm is `CORNER_ARM_M` long, and at least two pixels: multipath
lives on a scale of metres, and a fixed number of pixels would turn rounding into corners.

Both tolerate truth rounded to 2 cm: drawn across the gap, three rounding errors make at most three
steps, 6 cm; and a jump too small for an edge turns the arms by less than a corner does.
Blind within two pixels (edges) or an arm (corners) of the image border and of unknown truth.
"""

import numpy as np

from toftools.camera import rays
from toftools.metrics.error import scored_pixels
from toftools.phasor import demodulate
from toftools.types import F64, Bool, Camera, Capture, Phasors

EDGE_JUMP_M = 0.06
CORNER_ARM_M = 0.15
CORNER_TURN_RAD = np.pi / 6
DARK_PERCENTILE = 20.0
FAR_PERCENTILE = 80.0


def regions(
    capture: Capture, *, min_range_m: float = 0.0, max_range_m: float = float("inf")
) -> dict[str, Bool]:
    """Pixel masks of a capture to score apart; they may overlap and may be empty.

    Parameters
    ----------
    capture : Capture
        Needs truth; phasors, taps or a depth amplitude for the dark region.
    min_range_m, max_range_m : float
        Limits of the truth that is scored, m.

    Returns
    -------
    dict of str to ndarray of bool, (H, W)
        ``all``: truth known and within the limits, measurement valid. The others lie within it.
        ``edges``: within two pixels of a depth jump. ``corners``: on a concave crease.
        ``dark``: amplitude below its 20th percentile; empty if no amplitude is known.
        ``far``: range above its 80th percentile.

    Raises
    ------
    ValueError
        If the capture has no truth or the limits are not in order.
    """
    if capture.truth is None:
        msg = "got a capture without truth; wanted truth to define regions; score it without them"
        raise ValueError(msg)
    if not 0 <= min_range_m < max_range_m:
        msg = f"range limits must be 0 <= min < max metres, got {min_range_m} and {max_range_m}"
        raise ValueError(msg)
    range_m = capture.truth.range_m.astype(np.float64)
    scored = scored_pixels(capture.truth) & (range_m >= min_range_m) & (range_m <= max_range_m)
    phasors = _phasors(capture)
    if phasors is not None:
        scored &= phasors.valid
    camera = capture.sensor.camera
    z_m = np.where(range_m > 0, range_m, np.nan) * rays(camera)[..., 2]
    z_m = np.where(z_m > 0, z_m, np.nan)  # a fisheye may look back
    amplitude = _amplitude(capture, phasors, scored)
    return {
        "all": scored,
        "edges": find_edges(z_m) & scored,
        "corners": find_corners(camera, z_m) & scored,
        "dark": _beyond(-amplitude, scored, 100.0 - DARK_PERCENTILE),
        "far": _beyond(range_m, scored, FAR_PERCENTILE),
    }


def _phasors(capture: Capture) -> Phasors | None:
    """Phasors as given, or those of the taps."""
    if capture.phasors is None and capture.taps is not None:
        return demodulate(capture.taps, capture.sensor)
    return capture.phasors


def _amplitude(capture: Capture, phasors: Phasors | None, scored: Bool) -> F64:
    """Mean amplitude over frequencies; the depth's own if phasors carry none; NaN if unknown."""
    if phasors is not None:
        amplitude = np.abs(phasors.values).mean(axis=0, dtype=np.float64)  # (H, W)
        some = amplitude[scored]
        # Phasors normalised to one length per pixel have forgotten how bright it was.
        if some.size and np.ptp(some) > 1e-3 * some.max():
            return np.asarray(amplitude)
    if capture.depth is not None and capture.depth.amplitude is not None:
        return capture.depth.amplitude.astype(np.float64)
    return np.full(scored.shape, np.nan)


def _beyond(values: F64, scored: Bool, percentile: float) -> Bool:
    """Scored pixels above a percentile of the scored values; none where all are equal."""
    known = scored & np.isfinite(values)
    if not known.any():
        return known
    return np.asarray(known & (values > np.percentile(values[known], percentile)))


def find_edges(z_m: F64) -> Bool:
    """Pixels within two of a depth jump.

    Parameters
    ----------
    z_m : ndarray, (H, W)
        Axial depth, m; NaN where unknown.

    Returns
    -------
    ndarray of bool, (H, W)
        The gap pixels of all jumps, along rows and columns, and their eight neighbours. A jump
        needs two known pixels on either side.
    """
    jump = _row_jumps(z_m) | _row_jumps(z_m.T).T
    padded = np.pad(jump, 1)
    height, width = jump.shape
    grown = np.zeros_like(jump)
    for dv in range(3):
        for du in range(3):
            grown |= padded[dv : dv + height, du : du + width]
    return grown


def _row_jumps(z_m: F64) -> Bool:
    """Gap pixels u of jumps between u - 1 and u + 1 along each row."""
    jump = np.zeros(z_m.shape, dtype=bool)
    if z_m.shape[1] < 5:
        return jump
    w = 1.0 / z_m
    far_left, left, right, far_right = w[:, :-4], w[:, 1:-3], w[:, 3:-1], w[:, 4:]
    miss_right = right - (3.0 * left - 2.0 * far_left)
    miss_left = (3.0 * right - 2.0 * far_right) - left
    apart = np.where(
        miss_left * miss_right > 0, np.minimum(np.abs(miss_left), np.abs(miss_right)), 0.0
    )
    # A difference of w times both depths is the difference of z.
    jump[:, 2:-2] = apart * z_m[:, 1:-3] * z_m[:, 3:-1] > EDGE_JUMP_M
    return jump


def find_corners(camera: Camera, z_m: F64) -> Bool:
    """Pixels on a concave crease.

    Parameters
    ----------
    camera : Camera
        Optics.
    z_m : ndarray, (H, W)
        Axial depth, m; NaN where unknown.

    Returns
    -------
    ndarray of bool, (H, W)
        Pixels where the surface, along the row or along the column, turns towards the camera by
        more than `CORNER_TURN_RAD` from one arm to the other: for a right angle, a band of about
        0.6 arms to either side.
    """
    directions = rays(camera)
    xyz = directions * (z_m / directions[..., 2])[..., None]  # (H, W, 3)
    rows = _row_creases(xyz, float(camera.K[0, 0]))
    columns = _row_creases(xyz.transpose(1, 0, 2), float(camera.K[1, 1]))
    return np.asarray(rows | columns.T)


def _row_creases(xyz: F64, focal_px: float) -> Bool:
    """Pixels where the polyline through the arms along each row has a concave elbow."""
    z_m = xyz[..., 2]
    width = z_m.shape[1]
    known = np.isfinite(z_m)
    arm_px = np.maximum(2, np.ceil(CORNER_ARM_M * focal_px / np.where(known, z_m, 1.0)))
    u = np.arange(width)
    inside = known & (u - arm_px >= 0) & (u + arm_px < width)
    arm_px = np.where(inside, arm_px, 0).astype(np.intp)
    start, end = u - arm_px, u + arm_px  # (H, W)

    blocked = np.cumsum(np.pad(_row_jumps(z_m) | ~known, ((0, 0), (1, 0))), axis=1)
    clear = np.take_along_axis(blocked, end + 1, 1) == np.take_along_axis(blocked, start, 1)
    before = xyz - np.take_along_axis(xyz, start[..., None], 1)
    after = np.take_along_axis(xyz, end[..., None], 1) - xyz
    dot = np.sum(before * after, axis=-1)
    lengths = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    w = 1.0 / z_m
    concave = 2 * w < np.take_along_axis(w, start, 1) + np.take_along_axis(w, end, 1)
    turned = dot < np.cos(CORNER_TURN_RAD) * lengths
    return np.asarray(inside & clear & concave & turned)
