"""Capture files: write, read in any HDF5 viewer, export depth, cloud and intrinsics.

Run: python examples/03_capture_files.py
"""

import tempfile
from pathlib import Path

import h5py
import numpy as np

from toftools import Scene, Shot
from toftools.correct.crt import crt
from toftools.io.export import write_answer
from toftools.io.native import read_capture, write_capture
from toftools.sensors import sensor
from toftools.sim.analytic import analytic

folder = Path(tempfile.mkdtemp())
device = sensor("pmd:width=60,height=45")
capture = analytic(Scene("tilted", {"range": 2.0, "tilt": 20.0}))(Shot(device, seed=2))
write_capture(folder / "tilted.h5", capture)

with h5py.File(folder / "tilted.h5") as file:
    print("datasets:", ", ".join(file), "| taps", file["taps"].shape, file["taps"].attrs["unit"])

again = read_capture(folder / "tilted.h5")
assert np.array_equal(again.taps.values, capture.taps.values)

depth = crt(again.sensor)(again.phasors)
for suffix in (".npz", ".png", ".ply"):
    write_answer(folder / f"tilted{suffix}", depth, again)
    print(f"wrote tilted{suffix}: {(folder / f'tilted{suffix}').stat().st_size} bytes")
with np.load(folder / "tilted.npz") as answer:
    assert np.nanmax(np.abs(answer["range_m"] - capture.truth.range_m)) < 0.1
