"""Slow readable twins of the SRA kernels: the program by HiGHS, the look-up and the fit plainly."""

import numpy as np
from scipy.optimize import least_squares, linprog

from toftools.correct._returns import GUARD_M
from toftools.correct._sra_grid import SIDES, TIE
from toftools.correct._sra_lookup import SAME_M
from toftools.units import range_to_phase


def columns(atoms, turn, weights):
    """Columns of the linear program, (2 F + 1, N + residual and slack), and unit costs but the tie.

    Rows are real and imaginary part per frequency and the share in the gauge.
    """
    n_freqs, n_cells = atoms.shape
    turned = atoms * turn[:, None]
    whole = np.zeros((2 * n_freqs + 1, n_cells + n_freqs * SIDES + 1))
    corners = np.exp(2j * np.pi * np.arange(SIDES) / SIDES)
    for f in range(n_freqs):
        own = slice(n_cells + f * SIDES, n_cells + (f + 1) * SIDES)
        whole[2 * f, :n_cells], whole[2 * f + 1, :n_cells] = turned[f].real, turned[f].imag
        whole[2 * f, own], whole[2 * f + 1, own], whole[-1, own] = (
            corners.real, corners.imag, weights[f],
        )  # fmt: skip
    whole[-1, -1] = 1.0
    return whole


def solve(atoms, window, unit, turn, weights, epsilon):
    """Amplitudes and unit costs of the grid cells, or None if nothing satisfies the bound."""
    whole, n_cells = columns(atoms, turn, weights), atoms.shape[1]
    agreement = unit @ (atoms * turn[:, None]).real / unit.sum()
    cost = np.zeros(whole.shape[1])
    cost[:n_cells] = 1 - TIE * agreement**2
    use = np.r_[np.arange(*window), np.arange(n_cells, whole.shape[1])]
    goal = np.r_[np.stack([unit, 0 * unit], axis=1).ravel(), epsilon * weights @ unit]
    solution = linprog(cost[use], A_eq=whole[:, use], b_eq=goal, method="highs")
    if not solution.success:
        return None
    amounts = np.zeros(n_cells)
    amounts[window[0] : window[1]] = solution.x[: window[1] - window[0]]
    return amounts, cost[:n_cells]


def look_up(z0, z1, table, first_share):
    """Ranges and amplitudes of one pixel's returns, nearest first."""
    moved_m, phase = canonical(z0, z1, table)
    s = 0 if np.isinf(table.window_m) else int(moved_m / table.window_m)
    windows, ratios, phases = table.share.shape[:3]
    s = min(s, windows - 1)
    x = np.arctan2(abs(z1), abs(z0)) / (np.pi / 2) * (ratios - 1)
    y = min(phase / table.span_rad, 1.0) * (phases - 1)
    range_m, share = table.range_m[s], table.share[s]
    node = (round(x), round(y))
    found = []
    for at, strength in zip(range_m[node], share[node], strict=True):
        at_m = unwrapped(float(at) + moved_m, table)
        if strength > 0 and -GUARD_M <= at_m <= table.limit_m:
            shift = interpolated(range_m, share, x, y, float(at))
            found.append((max(at_m + shift, 0.0), strength * max(abs(z0), abs(z1))))
    strongest = max((strength for _, strength in found), default=0.0)
    return sorted(pair for pair in found if pair[1] >= first_share * strongest)


def canonical(z0, z1, table):
    phase0 = np.angle(z0) % (2 * np.pi)
    phases = (np.angle(z1) - table.ratio * phase0 - table.turn_phase_rad) % (2 * np.pi)
    turns = int(np.argmin(phases))
    return (phase0 / (2 * np.pi) + turns) * table.turn_m, phases[turns]


def unwrapped(range_m, table):
    if table.period_m > 0:
        return (range_m + GUARD_M) % table.period_m - GUARD_M
    return range_m


def interpolated(range_m, share, x, y, node_m):
    """Mean change of the return over the nodes around (x, y), by bilinear weights."""
    a, b = min(int(x), share.shape[0] - 2), min(int(y), share.shape[1] - 2)
    change = 0.0
    for i in (a, a + 1):
        for j in (b, b + 1):
            weight = (1 - abs(x - i)) * (1 - abs(y - j))
            there = range_m[i, j][share[i, j] > 0] - node_m
            closest = there[np.argmin(np.abs(there))] if there.size else np.inf
            if weight > 0 and abs(closest) > SAME_M:
                return 0.0
            change += weight * closest if weight > 0 else 0.0
    return change


def fit(z, sigma, freqs_hz, ranges_m, amplitudes):
    """Ranges of a pixel's returns by scipy's least squares, from a start."""
    n = len(ranges_m)

    def residual(x):
        turn = np.exp(1j * range_to_phase(x[n:], freqs_hz[:, None]))
        rest = (z - turn @ x[:n]) / sigma
        return np.r_[rest.real, rest.imag]

    start = np.r_[amplitudes, ranges_m]
    return least_squares(residual, start, method="lm", xtol=1e-12, ftol=1e-12).x[n:]
