"""Contestants in unwrapping: functions of phasors (F, H, W) to ranges (H, W), ours and others'.

Spatial unwrapping gets the phases of the highest frequency alone and adds whole turns so that
neighbours differ little; what turn the frame as a whole has, nobody can tell from them, so its best
multiple is taken away before its error is counted. Ours get all frequencies and no such help.
"""

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from toftools.registry import CORRECTIONS, find
from toftools.types import Phasors
from toftools.units import ambiguity_m, joint_ambiguity_m, phase_to_range

OURS = ("crt", "kde", "semi_global")
PLAIN, SKIMAGE, OPENCV = (
    "crt in plain numpy",
    "scikit-image unwrap_phase",
    "OpenCV phase_unwrapping",
)


@dataclass(frozen=True)
class Contestant:
    """One way to unwrap: `spatial` if the range it gives is known up to whole turns only."""

    name: str
    spatial: bool
    run: Callable[[Phasors], np.ndarray]


def contestants(sensor, plain):
    """Those that are installed, and one sentence on each that is not; `plain` is crt in numpy."""
    freqs = sensor.modulation.freqs_hz
    longest_m = joint_ambiguity_m(freqs)
    found = [
        Contestant(name, False, ranges_of(find(CORRECTIONS, name).build(sensor))) for name in OURS
    ]
    numpy_run = Contestant(PLAIN, False, lambda p: plain(p.values, p.sigma, freqs, longest_m))
    found.append(numpy_run)
    missing = []
    for name, package, make in (
        (SKIMAGE, "skimage", skimage_unwrap),
        (OPENCV, "cv2", opencv_unwrap),
    ):
        unwrap = make() if importlib.util.find_spec(package) else None
        if unwrap is None:
            missing.append(f"{name} is not installed and is left out")
        else:
            found.append(Contestant(name, True, spatial(unwrap, freqs)))
    return found, missing


def ranges_of(correct):
    return lambda phasors: correct(phasors).range_m


def spatial(unwrap, freqs_hz):
    """Ranges from the phases of the highest frequency."""
    top = int(np.argmax(freqs_hz))

    def run(phasors):
        return phase_to_range(unwrap(np.angle(phasors.values[top])), freqs_hz[top])

    return run


def skimage_unwrap():
    """Herraez et al. 2002, sorting by reliability, as scikit-image has it."""
    return importlib.import_module("skimage.restoration").unwrap_phase


def opencv_unwrap():
    """Lei et al. 2015, a histogram of reliabilities; None if this OpenCV lacks the module."""
    import cv2

    if not hasattr(cv2, "phase_unwrapping_HistogramPhaseUnwrapping_Params"):
        return None

    def unwrap(phase):
        params = cv2.phase_unwrapping_HistogramPhaseUnwrapping_Params()
        params.height, params.width = phase.shape
        # In a second frame of the same object a pixel comes out wrong (5.0.0): each has its own.
        own = cv2.phase_unwrapping.HistogramPhaseUnwrapping_create(params)
        return own.unwrapPhaseMap(np.ascontiguousarray(phase, np.float32))

    return unwrap


def error_m(range_m, truth_m, freqs_hz, *, free_turns):
    """Error of every pixel; with free turns, less the multiple of the ambiguity that fits best."""
    error = np.asarray(range_m, np.float64) - truth_m
    if not free_turns:
        return error
    turn_m = float(ambiguity_m(np.max(freqs_hz)))
    tried = np.unique(np.round(error[np.isfinite(error)] / turn_m))
    best = min(tried, key=lambda n: np.nanmean(np.abs(error - n * turn_m)), default=0.0)
    return error - best * turn_m
