"""Channels of a network of phasors, written as they are meant: the slow twin."""

import numpy as np

from toftools.camera import rays
from toftools.correct._net_coarse import RANGE_M, SHIFT_M
from toftools.correct._net_inputs import MOST, RELATIVE_MAX
from toftools.correct._scene import optics
from toftools.units import range_to_phase


def described(values, candidates_m, valid, device, metre):
    """(C, H, W): range, ray, reflectance, lit; residuals, misfits, other candidates."""
    n_freqs, height, width = values.shape
    way, flash = rays(device.camera), optics(device).flash.mean(axis=0)
    k = range_to_phase(1.0, device.modulation.freqs_hz)
    sampled = [
        np.log(np.abs(values[:, v, u]).mean() * candidates_m[0, v, u] ** 2 / flash[v, u])
        for v in range(0, height, 4) for u in range(0, width, 4) if valid[v, u]
    ]  # fmt: skip
    extra = candidates_m.shape[0] - 1
    out = np.zeros((5 + (n_freqs + 1 if extra else 0) + 2 * extra, height, width))
    for v in range(height):
        for u in range(width):
            out[1:3, v, u] = way[v, u, :2]
            if not valid[v, u]:
                continue
            first = candidates_m[0, v, u]
            bright = np.abs(values[:, v, u]).mean() * first**2 / flash[v, u]
            off = np.log(bright) - np.median(sampled)
            out[0, v, u] = first * metre / RANGE_M
            out[3, v, u] = np.clip(off, -RELATIVE_MAX, RELATIVE_MAX)
            out[4, v, u] = 1
            if not extra:
                continue
            for c, range_m in enumerate(candidates_m[:, v, u]):
                residual = np.angle(values[:, v, u] * np.exp(-1j * k * range_m))
                if c == 0:
                    shift = residual / k * metre / SHIFT_M
                    out[5 : 5 + n_freqs, v, u] = np.clip(shift, -MOST, MOST)
                else:
                    out[5 + n_freqs + extra + c, v, u] = (range_m - first) * metre / RANGE_M
                out[5 + n_freqs + c, v, u] = 8 * np.sqrt(np.mean((residual / (2 * np.pi)) ** 2))
    return out
