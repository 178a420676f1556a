"""Flying pixels out: ranges between or beside two surfaces, on which no neighbour lies.

A pixel that sees two surfaces at a depth edge measures a mixture of their phasors, whose range is
that of neither. A pixel is kept if one of two things holds, each within ``gap_m`` and
``noise_sigmas`` standard deviations:

- at least ``least_neighbours`` of its eight neighbours have its z;
- it lies on the surface as at least ``least_neighbours + 2`` of the eight see it, each drawn from
  a neighbour and the pixel behind that. Over the image of a plane 1/z is affine, so that
  ``w_p = 2 w_1 - w_2``, w = 1/z, on planes of any tilt.

Where fewer than eight can be asked (image border, pixels without an answer), shares of eight count.
All others become NaN with status REJECTED. Where sigma is unknown, z is taken to be equally noisy
everywhere, as the median second difference along the rows says.

Reference: ours. The usual filter by the angle between ray and surface, whose idea ShadowPoints of
the Point Cloud Library has, cannot tell a flying pixel from a steep wall. Input: a depth map,
better with sigma_m, and the sensor's optics. Amplitude is not used.

Measured on three furnished rooms and a prism, path traced with antialias=4 for 160 x 120 pixels at
40/70 MHz with sensor noise (sigma 9 to 23 mm), range by crt, 1611 flying pixels more than 3 cm from
all that they see, 74 486 pixels that see one surface (benchmarks/flying_pixels.py):

    least_neighbours                  2       3       4       5
    flying pixels removed            47      72      83      90 %
    those off by more than 10 cm     62      87      93      96 %
    pixels of one surface lost      0.3     1.0     2.8     5.3 %
    the same away from edges        0.2     0.6     1.4     3.1 %

The angle filter at 2, 5, 10 degrees: 54, 85, 96 % removed and 2.6, 4.2, 6.4 % lost, so it gains
only where much may be lost; and 5 degrees take half of a wall tilted by 85, of which this filter
loses no pixel. After `smooth` more goes of both: 80 and 1.7 % at 3 neighbours.

Fails on wires and leaves thinner than three pixels, which are lost where they bend or tilt; where
flying pixels lie side by side along an edge and agree by chance; and, if sigma is unknown, where
the noise is well above that of most of the image (dark and far pixels) and above `gap_m`.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange

from toftools.camera import rays
from toftools.correct import INVALID, OK, REJECTED, kernel_input
from toftools.types import F32, Bool, DepthMap, Phasors, Sensor

STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
NEAREST_M = np.float32(1e-3)
"""Least z that is told from zero."""
SECOND_DIFFERENCE = np.sqrt(6.0) * 0.6745
"""Median modulus of ``x1 - 2 x2 + x3`` for noise of standard deviation 1."""
MOST_M = np.float32(1e6)
"""No sigma is larger; squares of sigma / z^2 stay finite."""


def flying_pixels(
    sensor: Sensor, *, least_neighbours: int = 3, gap_m: float = 0.01, noise_sigmas: float = 2.0
) -> Callable[[DepthMap, Phasors], DepthMap]:
    """Reject pixels on whose surface too few neighbours lie.

    Parameters
    ----------
    sensor : Sensor
        Gives the optics.
    least_neighbours : int
        Neighbours wanted at the same z, 1 to 6; two more must see the same surface otherwise.
    gap_m : float
        Difference of z that is none, m.
    noise_sigmas : float
        The same in standard deviations of the difference, on top; 0 ignores noise.

    Returns
    -------
    callable
        ``run(DepthMap, Phasors) -> DepthMap``: NaN and status REJECTED where rejected, all else
        as it was; ``info["flying"]`` (H, W) says which pixels that were.

    Raises
    ------
    ValueError
        If a parameter is out of range; when called, if the depth map is not of the sensor's size.

    References
    ----------
    Point Cloud Library, filters/shadowpoints.h, for the idea by angles; the criterion is ours.

    Examples
    --------
    >>> from toftools.camera import z_to_range
    >>> from toftools.sensors import sensor
    >>> camera = sensor("opt8241:width=8,height=8")
    >>> z_m = np.full((8, 8), 1.0)
    >>> z_m[:, 5:], z_m[3, 4] = 2.0, 1.6  # an edge, and a pixel half over it
    >>> depth = DepthMap(z_to_range(camera.camera, z_m))
    >>> depth = flying_pixels(camera)(depth, Phasors(np.ones((2, 8, 8))))
    >>> np.argwhere(np.isnan(depth.range_m)).tolist()
    [[3, 4]]
    """
    if not 1 <= least_neighbours <= 6 or gap_m < 0 or noise_sigmas < 0:
        msg = (
            "flying_pixels wants least_neighbours of 1..6 and no negative gap_m or noise_sigmas, "
            f"got {least_neighbours}, {gap_m:g} and {noise_sigmas:g}"
        )
        raise ValueError(msg)
    forward = rays(sensor.camera)[..., 2].astype(np.float32)
    if (forward <= 0).any():
        msg = "flying_pixels compares 1 / z, and this fisheye also looks sideways or back; crop it"
        raise ValueError(msg)

    def run(depth: DepthMap, phasors: Phasors) -> DepthMap:
        if depth.range_m.shape != forward.shape:
            msg = (
                f"flying_pixels got a depth map of {depth.range_m.shape} pixels, wanted the "
                f"sensor's {forward.shape}"
            )
            raise ValueError(msg)
        w = 1 / np.maximum(depth.range_m * forward, NEAREST_M)
        noise = _noise(w, depth, forward) * np.float32(noise_sigmas)
        flying = np.zeros(w.shape, np.bool_)
        _judge(kernel_input(w), noise * noise, np.float32(gap_m), least_neighbours, flying)
        return _without(depth, flying)

    tiny = np.ones((1, 1), np.float32)  # compiling belongs to making
    _judge(kernel_input(tiny), tiny, np.float32(gap_m), least_neighbours, tiny > 1)
    return run


def _noise(w: F32, depth: DepthMap, forward: F32) -> F32:
    """Standard deviation of w = 1/z; alike everywhere in z where the depth map tells none."""
    if depth.sigma_m is None:
        bend = np.abs(w[:, :-2] - 2 * w[:, 1:-1] + w[:, 2:]) / w[:, 1:-1] ** 2
        known = bend[np.isfinite(bend)]
        sigma_z_m = np.median(known) / SECOND_DIFFERENCE if known.size else 0.0
        return np.asarray(np.float32(sigma_z_m) * w * w)
    known = np.isfinite(depth.sigma_m)
    sigma_m = np.where(known, np.minimum(depth.sigma_m, MOST_M), np.float32(0))
    return np.asarray(sigma_m * forward * w * w)


def _without(depth: DepthMap, flying: Bool) -> DepthMap:
    """The depth map with pixels rejected."""

    def cleared(values: F32 | None, otherwise: float) -> F32 | None:
        return None if values is None else np.where(flying, np.float32(otherwise), values)

    status = depth.info.get("status")
    if not isinstance(status, np.ndarray) or status.shape != flying.shape:
        status = np.where(np.isfinite(depth.range_m), np.uint8(OK), np.uint8(INVALID))
    return DepthMap(
        range_m=np.where(flying, np.float32(np.nan), depth.range_m),
        sigma_m=cleared(depth.sigma_m, np.nan),
        confidence=cleared(depth.confidence, 0.0),
        amplitude=depth.amplitude,
        info={
            **depth.info,
            "status": np.where(flying, np.uint8(REJECTED), status),
            "flying": flying,
        },
    )


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _enough(count: int, asked: int, wanted: int) -> bool:
    """Whether as many agree as wanted of eight."""
    return 8 * count >= wanted * asked


@njit(cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _flies(w: F32, variance: F32, y: int, x: int, gap: np.float32, wanted: int) -> bool:
    """Whether too few neighbours agree with a pixel, as a level or as a plane."""
    height, width = w.shape
    here, own = w[y, x], variance[y, x]
    tolerance = gap * here * here
    beside = beside_of = behind = behind_of = 0
    for dy, dx in STEPS:
        y1, x1, y2, x2 = y + dy, x + dx, y + 2 * dy, x + 2 * dx
        if not (0 <= y1 < height and 0 <= x1 < width and np.isfinite(w[y1, x1])):
            continue
        beside_of += 1
        level = abs(here - w[y1, x1])
        beside += level <= tolerance + np.sqrt(own + variance[y1, x1])
        if not (0 <= y2 < height and 0 <= x2 < width and np.isfinite(w[y2, x2])):
            continue
        behind_of += 1
        plane = abs(here - 2 * w[y1, x1] + w[y2, x2])
        behind += plane <= tolerance + np.sqrt(own + 4 * variance[y1, x1] + variance[y2, x2])
    return not (_enough(beside, beside_of, wanted) or _enough(behind, behind_of, wanted + 2))


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _judge(w: F32, variance: F32, gap: np.float32, wanted: int, flying: Bool) -> None:
    """Mark every flying pixel of an image of w = 1/z and its variance."""
    height, width = w.shape
    for row in prange(height):
        y = np.int64(row)  # the index of prange is unsigned
        for x in range(width):
            flying[y, x] = np.isfinite(w[y, x]) and _flies(w, variance, y, x, gap, wanted)
