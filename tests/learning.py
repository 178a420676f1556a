"""A data set of planes whose bounced light is known, made in a second, for tests of training."""

import numpy as np

from toftools.camera import rays
from toftools.dataset import manifest
from toftools.io.native import write_capture
from toftools.sensors import sensor
from toftools.types import Capture, Taps, Truth
from toftools.units import path_to_phase

DEVICE = "deeptof:width=64,height=48,hfov_deg=70,freqs=20e6+35e6+40e6+70e6"
PARTS = ("train", "train", "train", "validation", "test")


def plane(number, *, device=DEVICE, extra_m=0.6, share=0.25):
    """Capture of a tilted wall; a quarter of its light comes 0.6 m later."""
    camera = sensor(device)
    way = rays(camera.camera)
    tilt = 0.1 * np.array([np.sin(number), np.cos(number), 10.0])
    range_m = (1.5 + 0.3 * number) / (way @ tilt)
    freqs = camera.modulation.freqs_hz[:, None, None]
    direct = 5000 * np.exp(2j * path_to_phase(range_m, freqs)) / range_m**2
    bounced = share * direct * np.exp(1j * path_to_phase(extra_m, freqs))
    truth = Truth(range_m, direct=direct, one_bounce=bounced, rest=0 * bounced)
    steps = camera.modulation.steps_rad[:, :, None, None]
    light = (direct + bounced)[:, None]
    taps = Taps(20_000 + (light * np.exp(-1j * steps)).real)
    return Capture(camera, taps=taps, truth=truth)


def planes(folder, *, device=DEVICE):
    """A data set of five such captures."""
    (folder / "captures").mkdir(parents=True)
    for number, part in enumerate(PARTS):
        name = f"plane-{number}"
        path = manifest.file_of(folder, name)
        write_capture(path, plane(number, device=device))
        entry = {"id": name, "group": name, "family": "planes", "scene": f"plane:paint={number}",
                 "split": part, "sensor": device, "bytes": path.stat().st_size}  # fmt: skip
        manifest.note(folder, entry)
    return folder
