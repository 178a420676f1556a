"""Accuracy against milliseconds over a grid of widths, in floats and in eight bits."""

import time
from statistics import median

import numpy as np

from toftools.correct._net_engine import engine
from toftools.correct._net_file import read_card
from toftools.correct._net_inputs import channels, seen, view_of
from toftools.correct.network import network
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import range_to_phase

SIZES = ((256, 256), (480, 640))
REPEATS = 25


def measure(networks, log):
    """Milliseconds of the network alone and of the whole correction, per file and size."""
    found = {}
    for path in sorted(networks.glob("*.onnx")):
        card, data = read_card(path)
        if card.input != "phasors":
            continue
        log(f"speed: {path.stem}")
        run_net = engine(data, path.stem)
        full, coarse = channels(len(card.freqs_hz))
        found[path.stem] = {"bytes": len(data)}
        for height, width in SIZES:
            freqs = "+".join(f"{freq:.0f}" for freq in card.freqs_hz)
            device = sensor(f"deeptof:width={width},height={height},hfov_deg=70,freqs={freqs}")
            values = _room(device)
            shapes = {"full": (full, height, width), "coarse": (coarse, height // 4, width // 4)}
            inputs = {name: np.zeros((1, *shape), np.float32) for name, shape in shapes.items()}
            view = view_of(device, 1.0, 0.0)
            whole = network(device, model=str(path))
            parts = {
                "network": lambda a=inputs, r=run_net: r(a),
                "input": lambda v=view, p=values: seen(p, v),
                "whole": lambda w=whole, p=values: w(p),
            }
            found[path.stem][f"{width}x{height}"] = {name: _ms(f) for name, f in parts.items()}
    return found


def _room(device):
    """Phasors of something like a room: a corner with noise."""
    height, width = device.camera.shape
    aside = np.abs(np.arange(width) / width - 0.5)
    range_m = 2.5 - 1.2 * aside + 0.3 * np.arange(height)[:, None] / height
    k = range_to_phase(1.0, device.modulation.freqs_hz)[:, None, None]
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((2, k.size, height, width))
    values = np.exp(1j * k * range_m) / range_m**2 + 0.01 * (noise[0] + 1j * noise[1])
    return Phasors(values.astype(np.complex64))


def _ms(run):
    """Median of many, after two calls that do not count."""
    run(), run()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - begin))
    return round(median(times), 3)
