"""What furnished scenes share: ground on which things stand, and paints that can be changed."""

from dataclasses import dataclass, field

import numpy as np

from toftools.sim import solids
from toftools.sim.solids import Entry, turned
from toftools.types import F64

CLEAR_M = 1e-4
"""What stands hovers this much: two faces in one plane would be hit at random."""
TRIES = 500
ALBEDOS = (0.3, 0.8)


@dataclass(frozen=True, eq=False)
class Ground:
    """A rectangle on which things stand, and the circles (x, z, radius) already taken, in m."""

    centre: F64
    yaw_deg: float
    half: F64
    taken: list[tuple[float, float, float]] = field(default_factory=list)

    def place(self, rng: np.random.Generator, radius: float) -> F64 | None:
        """Free spot for a circle, in the frame of the room; None if none is found."""
        room = self.half - radius
        for x, z in rng.uniform(-1, 1, (TRIES, 2)) * room if (room > 0).all() else ():
            if all(np.hypot(x - u, z - v) > radius + r for u, v, r in self.taken):
                self.taken.append((x, z, radius))
                return np.asarray(self.centre + turned(self.yaw_deg) @ [x, -CLEAR_M, z])
        return None


def painted(shapes: dict[str, Entry], brush: np.random.Generator | None) -> dict[str, Entry]:
    """The same shapes with materials in place of pairs of a name and an albedo.

    Parameters
    ----------
    shapes : dict
        Shapes whose ``bsdf`` is such a pair; those with the same pair share their paint.
    brush : Generator or None
        Draws another albedo for every paint.

    Returns
    -------
    dict
        Entries as scenes have them.
    """
    paints = dict.fromkeys(entry["bsdf"] for entry in shapes.values())
    for name, albedo in paints:
        shade = albedo if brush is None else brush.uniform(*ALBEDOS)
        paints[name, albedo] = solids.material(name, shade, allowed=solids.SOLID)
    return {name: {**entry, "bsdf": paints[entry["bsdf"]]} for name, entry in shapes.items()}
