"""Captures for the learned corrections: some of a data set's frequencies, and errors."""

from dataclasses import replace

import numpy as np

from toftools.dataset.manifest import file_of, present
from toftools.io.native import read_capture
from toftools.phasor import phasors_of
from toftools.types import Modulation, Phasors

WRONG_M = 0.5
SHARES = (25, 50, 75, 95)


def captures(folder, split, families=None):
    """Entries and captures of one part of a data set, in the order of their ids."""
    for name, entry in sorted(present(folder).items()):
        if entry["split"] == split and (families is None or entry["family"] in families):
            yield entry, read_capture(file_of(folder, name))


def at(capture, freqs_hz):
    """Sensor and measured phasors of some of the frequencies."""
    own = capture.sensor.modulation.freqs_hz
    pick = [int(np.argmin(np.abs(own - freq))) for freq in freqs_hz]
    if not np.allclose(own[pick], freqs_hz, rtol=1e-6):
        raise ValueError(f"the capture has {own / 1e6} MHz, wanted {np.array(freqs_hz) / 1e6}")
    whole = phasors_of(capture)
    sigma = None if whole.sigma is None else whole.sigma[pick]
    sensor = replace(capture.sensor, modulation=Modulation(own[pick]), maps=None)
    return sensor, Phasors(whole.values[pick], sigma, whole.valid)


def errors_of(range_m, truth_m, longest_m):
    """Absolute errors of the pixels that have a truth within reach, m; NaN without an answer."""
    with np.errstate(invalid="ignore"):
        known = np.isfinite(truth_m) & (truth_m > 0.05) & (truth_m < longest_m)
    return np.abs(range_m.astype(np.float64) - truth_m)[known]


def figures(errors_m):
    """What is told of absolute errors."""
    given = errors_m[np.isfinite(errors_m)]
    low, middle, high, most = np.percentile(given, SHARES)
    return {
        "mae_m": float(given.mean()), "p25_m": float(low), "median_m": float(middle),
        "p75_m": float(high), "p95_m": float(most), "wrong": float((given > WRONG_M).mean()),
        "valid": float(np.isfinite(errors_m).mean()), "pixels": int(given.size),
    }  # fmt: skip
