"""A camera that moves slowly through a room: how much the correction jumps from frame to frame."""

from dataclasses import replace

import numpy as np

from toftools.registry import CORRECTIONS, find
from toftools.sensors import sensor
from toftools.sim.radiosity import radiosity
from toftools.sim.scenes import world_of
from toftools.types import Scene, Shot

FRAMES, STEP_M = 8, 0.02
ROOM = {"seed": 9100, "boxes": 6, "balls": 2}
DEVICE = "deeptof:width=160,height=120,hfov_deg=70,freqs=40e6+70e6"


def sequence(log):
    """Captures of a camera that goes 2 cm to the right and 2 cm ahead from frame to frame."""
    world, device = world_of(Scene("room", ROOM)), sensor(DEVICE)
    for number in range(FRAMES):
        log(f"sequence: frame {number + 1}")
        pose = np.array(world.to_world)
        pose[:3, 3] += number * STEP_M * (pose[:3, 0] + pose[:3, 2])
        shot = Shot(device, seed=number, tol_m=2e-3)
        yield radiosity(replace(world, to_world=pose))(shot)


def measure(names, log):
    """Standard deviation from frame to frame of what is left of the error, per method.

    The camera moves, so that pixels see other places: what is compared is the error, range minus
    truth, whose slow part is bias and whose change from frame to frame is flicker.
    """
    frames = list(sequence(log))
    found = {}
    for label, name in names:
        run = find(CORRECTIONS, name).build(frames[0].sensor)
        errors = np.stack([run(f.phasors).range_m - f.truth.range_m for f in frames])
        change = np.diff(errors, axis=0)
        # Pixels that cross an edge between two frames see two things: the median leaves them out.
        found[label] = {
            "bias_m": float(np.nanmedian(errors)),
            "mae_m": float(np.nanmean(np.abs(errors))),
            "flicker_m": float(1.4826 * np.nanmedian(np.abs(change))),
        }
    return found
