"""Channels of a network of phasors, written as they are meant: the slow twin."""

import numpy as np

from toftools.camera import rays
from toftools.correct._net_coarse import MOST, RANGE_M, SHIFT_M
from toftools.correct._net_inputs import RELATIVE_MAX
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


def ordered(candidates_m, values, lit, guide, around_m):
    """Mean phasors of the cells, and candidates with the one first that agrees with a cell near."""
    shape = values.shape[0], guide.rows.size - 1, guide.columns.size - 1
    cells, out = np.zeros(shape, complex), candidates_m.copy()
    for r in range(shape[1]):
        for c in range(shape[2]):
            rows = slice(guide.rows[r], guide.rows[r + 1])
            columns = slice(guide.columns[c], guide.columns[c + 1])
            inside = lit[rows, columns]
            if inside.any():
                cells[:, r, c] = values[:, rows, columns][:, inside].mean(axis=1)
            beside = [(r, c), (r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)]
            near = [around_m[a, b] for a, b in beside if 0 <= a < shape[1] and 0 <= b < shape[2]]
            for v in range(rows.start, rows.stop):
                for u in range(columns.start, columns.stop):
                    first = _first(candidates_m[:, v, u], near, guide.agrees_m)
                    others = np.delete(candidates_m[:, v, u], first)
                    out[:, v, u] = [candidates_m[first, v, u], *others]
    return cells, out


def _first(mine_m, near_m, agrees_m):
    """The likeliest that agrees with the own cell; or with one beside it; or the likeliest."""
    for some in (near_m[:1], near_m[1:]):
        for k, range_m in enumerate(mine_m):
            if any(abs(range_m - other) < agrees_m for other in some):
                return k
    return 0
