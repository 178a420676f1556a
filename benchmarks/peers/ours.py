"""The engines of this project, beside their peers: a whole capture is what is timed."""

import numpy as np

from toftools.registry import SIMULATORS, find
from toftools.types import Shot


def make(scene, sensor, *, max_bounces, engine="path", by="samples", **params):
    """Function ``render(count, seed) -> phasors (F, H, W), range (H, W)``; white at 1 m is 1.

    `count` is a number of samples or, by "tol_mm", a tolerance.
    """
    run = find(SIMULATORS, engine).build(scene, **params)
    unit = sensor.noise.signal_e * sensor.noise.contrast

    def render(count, seed):
        wish = {"samples": count} if by == "samples" else {"tol_m": 1e-3 * count}
        capture = run(Shot(sensor, **wish, max_bounces=max_bounces, noisy=False, seed=seed))
        return np.asarray(capture.phasors.values / unit, np.complex64), capture.truth.range_m

    return render
