"""Slow readable twins of the SRA kernels: the cell by HiGHS, the look-up in plain Python."""

import numpy as np
from scipy.optimize import linprog

from toftools.correct._sra_grid import GUARD_M, TIE
from toftools.correct._sra_simplex import residual_columns
from toftools.correct.sra import SAME_M


def turned_columns(atoms, phase_rad):
    """Columns of the linear program of one cell, (5, N + residual and slack)."""
    turned = atoms * np.exp(-1j * np.array([0.0, phase_rad]))[:, None]
    rows = [turned[0].real, turned[0].imag, turned[1].real, turned[1].imag, 0 * turned[0].real]
    return np.hstack([np.array(rows), residual_columns()])


def solve(columns, n_atoms, first, last, goal, epsilon):
    """Amplitudes and unit costs of the grid cells, or None if nothing satisfies the bound."""
    use = np.arange(columns.shape[1])
    use = np.flatnonzero((use >= n_atoms) | ((use >= first) & (use < last)))
    a, b = goal
    cost = np.zeros(columns.shape[1])
    cost[:n_atoms] = 1 - TIE * ((a * columns[0] + b * columns[2])[:n_atoms] / (a + b)) ** 2
    solution = linprog(
        cost[use],
        A_eq=columns[:, use],
        b_eq=[a, 0, b, 0, epsilon * (a + b)],
        method="highs",
    )
    if not solution.success:
        return None
    amounts = np.zeros(n_atoms)
    amounts[use[use < n_atoms]] = solution.x[use < n_atoms]
    return amounts, cost[:n_atoms]


def look_up(z0, z1, table, first_share):
    """Range, share of the first return and number of returns of one pixel."""
    moved_m, phase = canonical(z0, z1, table)
    s = 0 if np.isinf(table.window_m) else int(moved_m / table.window_m)
    windows, ratios, phases = table.share.shape[:3]
    s = min(s, windows - 1)
    x = np.arctan2(abs(z1), abs(z0)) / (np.pi / 2) * (ratios - 1)
    y = min(phase / table.span_rad, 1.0) * (phases - 1)
    range_m, share = table.range_m[s], table.share[s]
    node = (round(x), round(y))
    there = [k for k in range(4) if share[node][k] > 0]
    ranges = {k: unwrapped(float(range_m[node][k]) + moved_m, table) for k in there}
    inside = [k for k in there if -GUARD_M <= ranges[k] <= table.limit_m]
    if not inside:
        return np.nan, 0.0, 0
    strongest = max(share[node][k] for k in inside)
    strong = [k for k in inside if share[node][k] >= first_share * strongest]
    first = min(strong, key=lambda k: ranges[k])
    shift = interpolated(range_m, share, x, y, float(range_m[node][first]))
    return max(ranges[first] + shift, 0.0), share[node][first], len(strong)


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
