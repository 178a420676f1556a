"""The path engine of this project, beside its peers: a whole capture is what is timed."""

import numpy as np

from toftools.sim.path import path
from toftools.types import Shot


def make(scene, sensor, *, max_bounces, **params):
    """Function ``render(samples, seed) -> phasors (F, H, W), range (H, W)``; white at 1 m is 1."""
    run = path(scene, **params)
    unit = sensor.noise.signal_e * sensor.noise.contrast

    def render(samples, seed):
        shot = Shot(sensor, samples=samples, max_bounces=max_bounces, noisy=False, seed=seed)
        capture = run(shot)
        return np.asarray(capture.phasors.values / unit, np.complex64), capture.truth.range_m

    return render
