"""Converged pictures out of the path engine, made once and kept: independent runs of each view.

Runs are saved one by one, so that a broken-off job goes on where it was. The products of the two
halves of the runs free every error of the reference's own noise (`measure.mean_square_m2`).
"""

import time

import numpy as np

from toftools.registry import parse_entry
from toftools.sensors import sensor as preset
from toftools.types import Scene

from . import measure, ours

FIRST_SEED = 5000  # no measured frame has it
FINER = 4


def kept(view, folder, log):
    """Reference of a view, and its lit pixels away from depth edges; what is missing is made."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height = view.size
    name = f"{view.name}-{width}x{height}-{view.bounces}b".lower().replace(" ", "-")
    render = None

    def image(number):
        nonlocal render
        render = render or _render(view, preset(view.sensor()), view.bounces)
        log(f"{view.name}, reference: run {number + 1} of {view.runs}")
        return render(view.samples, FIRST_SEED + number)[0][0]

    stack, seconds = images(folder / f"{name}-{view.samples}.npz", view.runs, image)
    [smooth], _ = images(folder / f"{name}-smooth.npz", 1, lambda _: smooth_pixels(view))
    found = measure.Reference(stack, view.samples * len(stack), seconds)
    return found, smooth.astype(bool) & (np.abs(found.mean) > 0)


def images(file, runs, image):
    """The first `runs` images of a file, (runs, H, W), and the seconds that its images took.

    Missing ones are made as ``image(number)`` and saved one by one.
    """
    found, seconds = [], 0.0
    if file.is_file():
        with np.load(file) as kept_before:
            found, seconds = list(kept_before["images"]), float(kept_before["seconds"])
    while len(found) < runs:
        begin = time.perf_counter()
        found.append(image(len(found)))
        seconds += time.perf_counter() - begin
        part = file.with_suffix(".part.npz")
        np.savez(part, images=np.stack(found), seconds=seconds)
        part.replace(file)
    return np.asarray(found[:runs], np.complex128), seconds


def smooth_pixels(view):
    """Pixels without a depth edge, seen on a finer grid: what is thinner than a pixel is one too.

    That grid is an image of its own, so its rim, the outermost pixels, is left out.
    """
    finer = preset(view.sensor(FINER))
    range_m = _render(view, finer, 0)(1, 0)[1]
    width, height = view.size
    smooth = measure.away_from_edges(finer.camera, range_m)
    return smooth.reshape(height, FINER, width, FINER).all(axis=(1, 3))


def _render(view, sensor, bounces):
    return ours.make(Scene(*parse_entry(view.scene)), sensor, max_bounces=bounces)
