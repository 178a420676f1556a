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
    name = f"{view.name}-{width}x{height}-{view.bounces}b-{view.samples}"
    file = folder / f"{name.lower().replace(' ', '-')}.npz"
    images, seconds, smooth = _read(file)
    render = None
    if smooth is None:
        smooth = smooth_pixels(view)
    while len(images) < view.runs:
        render = render or _render(view, preset(view.sensor()), view.bounces)
        begin = time.perf_counter()
        images.append(render(view.samples, FIRST_SEED + len(images))[0][0])
        seconds += time.perf_counter() - begin
        _write(file, images=np.stack(images), seconds=seconds, smooth=smooth)
        log(f"{view.name}, reference: run {len(images)} of {view.runs}, {seconds:.0f} s so far")
    stack = np.asarray(images, np.complex128)
    found = measure.Reference(stack, view.samples * len(stack), float(seconds))
    return found, smooth & (np.abs(found.mean) > 0)


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


def _read(file):
    if not file.is_file():
        return [], 0.0, None
    with np.load(file) as found:
        return list(found["images"]), float(found["seconds"]), found["smooth"]


def _write(file, **arrays):
    part = file.with_suffix(".part.npz")
    np.savez(part, **arrays)
    part.replace(file)
