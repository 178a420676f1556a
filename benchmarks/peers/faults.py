"""Where the time origin and ambient light go wrong: a wall at 2 m, read by both engines.

The wall must read 2 m whatever the near plane is and whatever unmodulated light shines on it.
"""

from dataclasses import replace

import numpy as np

from toftools.sensors import sensor as preset
from toftools.sim.scenes import world_of
from toftools.types import Scene
from toftools.units import phase_to_range

SENSOR = "deeptof:width=9,height=9,hfov_deg=5"
SAMPLES = 256
NEAR_M = (1e-4, 1e-2, 1e-1)  # the peer's default is the second
LAMPS = {
    "constant": {"type": "constant", "radiance": 0.1},
    "directional": {"type": "directional", "direction": [0.0, 0.0, 1.0], "irradiance": 0.1},
    "area": {
        "type": "rectangle",
        # Half a metre square, 1 m above the line of sight and 1 m before the wall, facing down.
        "to_world": np.array(
            [[0.5, 0, 0, 0], [0, 0, 1.0, -1], [0, 0.5, 0, 1], [0, 0, 0, 1.0]]
        ),
        "emitter": {"type": "area", "radiance": 1.0},
    },
}  # fmt: skip


def jobs():
    """(what, world, options of the peer), one reading each."""
    wall = world_of(Scene("wall", {"range": 2.0}))
    plain = [(f"near_clip {near:g} m", wall, {"near_m": near, "mend": False}) for near in NEAR_M]
    lit = [
        (f"{name} ambient light",
         replace(wall, description={**wall.description, "lamp": lamp}, lamp_gain=1.0),
         {"lamps": True})
        for name, lamp in LAMPS.items()
    ]  # fmt: skip
    return plain + lit


def readings(theirs, ours):
    """List of (what, range of the peer in m, ours in m); both are ``make`` functions."""
    sensor = preset(SENSOR)
    rows = []
    for what, world, options in jobs():
        peer = theirs(world, sensor, max_bounces=0, **options)
        mine = ours(world, sensor, max_bounces=0)
        rows.append((what, *(_middle_m(render, sensor) for render in (peer, mine))))
    return rows


def _middle_m(render, sensor):
    """Range of the middle pixel, mean over its neighbours at the same distance to 0.01 mm."""
    phasors = render(SAMPLES, 1)[0][0]
    height, width = phasors.shape
    middle = phasors[height // 2, width // 2]
    return float(phase_to_range(np.angle(middle) % (2 * np.pi), sensor.modulation.freqs_hz[0]))


def make(scene=None, sensor=None, max_bounces=0):
    """The readings as an engine of `worker`: both engines in a process of their own."""
    from peers import mitransient_peer, ours

    rows = readings(mitransient_peer.make, ours.make)
    return lambda _samples, _seed: (rows, None)
