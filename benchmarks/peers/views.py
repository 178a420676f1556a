"""The views on which error is held against time: scene, camera, bounces, and their references."""

import os
from dataclasses import dataclass
from pathlib import Path

# The file's camera stands 17 mm before a wall: 0.6 m forward. Lamps are off, since the peer would
# take them for modulated (as in benchmarks/transport.py).
POSE = "lamps=0,camera=4.53+0.776+-2.16,target=3.57+0.85+-1.897"
ROOMS = range(1, 11)
CORNELL, LIVING, ROOM = "Cornell box", "Living room", "Room"


@dataclass(frozen=True)
class View:
    """A scene and a camera; its reference are `runs` pictures of `samples` paths per pixel.

    `solved` says that an engine that solves for all bounces is not asked for a number of them;
    `bounces` is then so many that the rest moves range by far less than 1 mm.
    """

    name: str
    scene: str
    camera: str
    size: tuple[int, int]
    bounces: int
    samples: int
    runs: int
    solved: bool = False

    def sensor(self, finer=1):
        width, height = (finer * n for n in self.size)
        return f"deeptof:{self.camera},width={width},height={height}"


def views(*, quick):
    """The views that are there, and sentences about those that are not."""
    box, room = "hfov_deg=39.3077", "hfov_deg=70"
    if quick:
        found = [
            View(CORNELL, "cornell", box, (64, 48), 8, 64, 4),
            View(f"{ROOM} 1", "room:seed=1", room, (48, 36), 8, 64, 4),
        ]
        return found, ["the living room is left out of a quick run"]
    found = [View(CORNELL, "cornell", box, (320, 240), 8, 256, 6)]
    rooms = [View(f"{ROOM} {n}", f"room:seed={n}", room, (160, 120), 8, 512, 4) for n in ROOMS]
    file = Path(os.environ.get("TOFTOOLS_DATA", "")).parent / "scenes/living-room/scene.xml"
    if not file.is_file():
        return [*found, *rooms], ["the living room is left out: it is not beside TOFTOOLS_DATA"]
    living = View(LIVING, f"{file}:{POSE}", room, (160, 120), 24, 768, 4, solved=True)
    return [*found, living, *rooms], []
