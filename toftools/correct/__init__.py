"""Corrections: one method per file, ``make(sensor, *, params) -> run(phasors) -> DepthMap``.

Every correction says per pixel why there is no answer, in ``info["status"]``: an (H, W) uint8
array of the codes below.
"""

from collections.abc import Callable

import numpy as np

from toftools._arrays import kernel_input as kernel_input
from toftools.types import DepthMap, Phasors, Sensor

OK = 0
"""The pixel has a range."""
INVALID = 1
"""The input was invalid or without signal: saturated, missing, zero amplitude."""
REJECTED = 2
"""The method looked at the pixel and trusts none of its answers."""


def refuse_emitter_offset(sensor: Sensor) -> None:
    """Refuse a sensor whose light does not sit at the camera: no correction can use that.

    Parameters
    ----------
    sensor : Sensor
        Sensor of a correction.

    Raises
    ------
    ValueError
        If the emitter is off the camera centre.
    """
    if any(sensor.emitter_offset_m):
        msg = (
            f"got an emitter {sensor.emitter_offset_m} m off the camera, wanted it at the camera: "
            "corrections take half the path for the range; set emitter_offset_m to zero to accept "
            "the error"
        )
        raise ValueError(msg)


def warm_up(run: Callable[[Phasors], DepthMap], n_freqs: int) -> None:
    """Call a correction on one pixel, with and without sigma: compiling belongs to making.

    Parameters
    ----------
    run : callable
        The correction.
    n_freqs : int
        Frequencies of its sensor.
    """
    pixel = np.ones((n_freqs, 1, 1), np.complex64)
    for sigma in (None, np.ones(pixel.shape, np.float32)):
        run(Phasors(pixel, sigma))
