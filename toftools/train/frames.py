"""Frames of a data set as training wants them: phasors without noise, and true ranges.

Captures are compressed and hold much that training does not read, so that the first run writes
what it needs beside them, one array per capture (`DIR/frames`), which later runs map to memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftools.dataset.manifest import Entry, file_of, present
from toftools.io.atomic import atomic_path
from toftools.io.native import read_capture
from toftools.sensors import sensor
from toftools.types import C64, F32, Capture, Sensor


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame.

    Parameters
    ----------
    id, group : str
        Capture, and the scene that it shows.
    sensor : Sensor
        With all frequencies that were simulated.
    values : ndarray, (F, H, W)
        Phasors without noise, complex64.
    range_m : ndarray, (H, W)
        True range, m; NaN where there is none.
    """

    id: str
    group: str
    sensor: Sensor
    values: C64
    range_m: F32


def read_frames(folder: Path, split: str, wanted_hz: Sequence[float]) -> list[Frame]:
    """Frames of one part of a data set.

    Parameters
    ----------
    folder : Path
        Made by ``toftools dataset make``.
    split : {"train", "validation", "test"}
        Part.
    wanted_hz : sequence of float
        Frequencies that must all be there, Hz.

    Returns
    -------
    list of Frame
        In the order of their ids; captures of sensors without these frequencies are left out.

    Raises
    ------
    ValueError
        If there is no data set, or no frame of this part with these frequencies.
    """
    entries = sorted(present(folder).values(), key=lambda entry: str(entry["id"]))
    if not entries:
        msg = f"found no data set in {folder}; make one with toftools dataset make"
        raise ValueError(msg)
    sensors: dict[str, Sensor] = {}
    found = []
    for entry in entries:
        if entry["split"] != split:
            continue
        device = sensors.setdefault(entry["sensor"], sensor(entry["sensor"]))
        if all(_index(device, freq) is not None for freq in wanted_hz):
            values, range_m = _arrays(folder, entry)
            found.append(Frame(entry["id"], entry["group"], device, values, range_m))
    if not found:
        asked = ", ".join(f"{freq / 1e6:g}" for freq in wanted_hz)
        msg = f"{folder} has no {split} captures with all of {asked} MHz; make a set that has"
        raise ValueError(msg)
    return found


def _arrays(folder: Path, entry: Entry) -> tuple[C64, F32]:
    """Phasors and range, from the quick copy of this very file if it is whole, else from it."""
    name, mark = entry["id"], str(entry.get("sha256", ""))[:12]
    quick = folder / "frames" / f"{name}-{mark}.npy"
    try:
        both = np.load(quick, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        quick.parent.mkdir(exist_ok=True)
        both = _whole(read_capture(file_of(folder, name)), name)
        with atomic_path(quick) as path, path.open("wb") as file:
            np.save(file, both, allow_pickle=False)
    return both[:-1], both[-1].real


def _whole(capture: Capture, name: str) -> C64:
    truth = capture.truth
    if truth is None or truth.direct is None or truth.one_bounce is None or truth.rest is None:
        msg = f"the capture {name} has no true phasors to learn from; make the data set anew"
        raise ValueError(msg)
    light = truth.direct + truth.one_bounce + truth.rest
    return np.concatenate([light, truth.range_m[None].astype(np.complex64)])


def _index(device: Sensor, freq_hz: float) -> int | None:
    near = np.flatnonzero(np.isclose(device.modulation.freqs_hz, freq_hz, rtol=1e-6))
    return int(near[0]) if near.size else None


def indices(device: Sensor, freqs_hz: Sequence[float]) -> list[int]:
    """Where frequencies stand in a sensor's list.

    Parameters
    ----------
    device : Sensor
        The sensor.
    freqs_hz : sequence of float
        Frequencies it has, Hz.

    Returns
    -------
    list of int
        Indices.
    """
    found = [_index(device, freq) for freq in freqs_hz]
    if None in found:
        msg = f"got a sensor of {device.modulation.freqs_hz} Hz, wanted {list(freqs_hz)}"
        raise ValueError(msg)
    return [index for index in found if index is not None]
