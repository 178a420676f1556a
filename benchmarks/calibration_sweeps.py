"""Stage sweeps of a Kinect v2 (Tanaka et al., CVPR 2017): one cyclic error for 20 materials.

A sweep holds the difference of the ranges of two frequencies at 200 positions. Model of material m:

    d1 - d2 = a_m + b_m x + e1(x + s1_m) - e2(x + s2_m)

e1 and e2 are common to all materials: Fourier series of the phase at their frequency (the basis of
`toftools.calib.wiggling`), of orders that are multiples of 3, as three taps make them. Where the
stage starts is not known, so phases count from its first position. Of the material are a line and,
in the wider model, a shift per frequency: light that enters a body comes back later, by a way that
depends on the frequency. Shifts are drawn to 0 as if known to `SHIFT_MM`.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from toftools.calib._basis import fourier
from toftools.calib._choice import smallest
from toftools.sensors import sensor
from toftools.units import ambiguity_m

STEP_MM = 3.0
SHIFT_MM = 15.0
HUBER = 2.0
ROUNDS = 25
FOLDS, BLOCK = 5, 5
ORDERS = ((3,), (3, 6), (3, 6, 9), (3, 6, 9, 12), (3, 6, 9, 12, 15))
F80, F16, F120 = sensor("kinect2").modulation.freqs_hz
ROWS = {"d80 - d120": (1, (F80, F120)), "d16 - d120": (0, (F16, F120))}


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Differences (M, N) in mm of two frequencies, NaN where not measured."""

    names: tuple[str, ...]
    values: np.ndarray
    turns_mm: tuple[float, float]

    @property
    def position(self):
        return STEP_MM * np.arange(self.values.shape[1])


@dataclass(frozen=True, eq=False)
class Model:
    """Common coefficients, and shifts (M, 2) and lines (M, 2) per material."""

    orders: tuple[int, ...]
    theta: np.ndarray
    shift: np.ndarray
    line: np.ndarray


def read(folder, row):
    """Sweeps of all materials of one row of the files."""
    index, freqs = ROWS[row]
    files = sorted(folder.glob("*_3mm.npy"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # headers of Python 2
        values = np.stack([np.load(file)[index] for file in files]).astype(float)
    values[values == 0] = np.nan
    names = tuple(file.name.removesuffix("_3mm.npy") for file in files)
    return Sweeps(names, values, tuple(1e3 * float(ambiguity_m(freq)) for freq in freqs))


def columns(sweeps, orders, shift):
    """Columns of e1 and of -e2 for one material."""
    parts = []
    for sign, turn, moved in zip((1, -1), sweeps.turns_mm, shift, strict=True):
        phase = 2 * np.pi * (sweeps.position + moved) / turn
        parts += [sign * fourier(order * phase, 1) for order in orders]
    return np.hstack(parts)


def rates(sweeps, orders, shift, theta):
    """How the model of one material changes with its two shifts, 1/mm."""
    half = np.eye(2) / 2
    up, down = ([columns(sweeps, orders, shift + s * h) @ theta for h in half] for s in (1, -1))
    return np.stack(up, axis=1) - np.stack(down, axis=1)


def lines(sweeps):
    """Columns of a line."""
    x = sweeps.position
    return np.stack([np.ones_like(x), x / x[-1]], axis=1)


def fit(sweeps, orders, *, shifts, train):
    """Model of the positions where `train` holds, by turns: common curves, then materials."""
    known = np.isfinite(sweeps.values) & train
    values = np.where(known, sweeps.values, 0)
    weight, straight = known.astype(float), lines(sweeps)
    shift = np.zeros((len(values), 2))
    for _ in range(ROUNDS):
        theta = _common(sweeps, orders, shift, values, weight)
        rest, line = np.empty_like(values), np.empty((len(values), 2))
        for m, (y, w) in enumerate(zip(values, np.sqrt(weight), strict=True)):
            left = y - columns(sweeps, orders, shift[m]) @ theta
            if shifts:
                shift[m] += _step(
                    w, straight, rates(sweeps, orders, shift[m], theta), left, shift[m]
                )
                left = y - columns(sweeps, orders, shift[m]) @ theta
            line[m] = np.linalg.lstsq(w[:, None] * straight, w * left, rcond=None)[0]
            rest[m] = left - straight @ line[m]
        usual = 1.4826 * np.median(np.abs(rest[known]))
        weight = known * np.minimum(1, HUBER * usual / np.maximum(np.abs(rest), 1e-9))
    return Model(orders, theta, shift, line)


def _common(sweeps, orders, shift, values, weight):
    """Coefficients of the common curves, every material less its own line."""
    blocks, targets = [], []
    for s, y, w in zip(shift, values, np.sqrt(weight), strict=True):
        q, _ = np.linalg.qr(w[:, None] * lines(sweeps))
        block = w[:, None] * columns(sweeps, orders, s)
        blocks.append(block - q @ (q.T @ block))
        targets.append(w * y - q @ (q.T @ (w * y)))
    a, b = np.concatenate(blocks), np.concatenate(targets)
    return np.linalg.solve(a.T @ a + 1e-3 * len(b) * np.eye(a.shape[1]), a.T @ b)


def _step(w, straight, rate, left, shift):
    """Step of the two shifts of one material, at most 6 mm."""
    a = np.concatenate([w[:, None] * np.hstack([straight, rate]), np.eye(4)[2:] / SHIFT_MM])
    b = np.concatenate([w * left, -shift / SHIFT_MM])
    return np.clip(np.linalg.lstsq(a, b, rcond=None)[0][2:], -6, 6)


def residual(sweeps, model):
    """Measured minus model (M, N), mm."""
    curves = [columns(sweeps, model.orders, s) @ model.theta for s in model.shift]
    return sweeps.values - np.stack(curves) - model.line @ lines(sweeps).T


def straight(sweeps):
    """Measured minus a line per material (M, N), mm: what is there before."""
    out = np.empty_like(sweeps.values)
    for m, y in enumerate(sweeps.values):
        ok = np.isfinite(y)
        line = np.linalg.lstsq(lines(sweeps)[ok], y[ok], rcond=None)[0]
        out[m] = y - lines(sweeps) @ line
    return out


def held_out(sweeps, orders, *, shifts, block=BLOCK):
    """Residuals (M, N) of positions that the fit did not see: every fifth block of positions."""
    fold = np.arange(sweeps.values.shape[1]) // block % FOLDS
    out = np.empty_like(sweeps.values)
    for k in range(FOLDS):
        model = fit(sweeps, orders, shifts=shifts, train=fold != k)
        out[:, fold == k] = residual(sweeps, model)[:, fold == k]
    return out


def chosen(sweeps, *, shifts):
    """Orders by held-out blocks and the rule of one standard error, and all their errors."""
    place = np.arange(sweeps.values.shape[1]) // BLOCK
    losses, errors = [], {}
    for orders in ORDERS:
        rest = held_out(sweeps, orders, shifts=shifts)
        square = np.nansum(rest**2, axis=0)
        losses.append(np.bincount(place, square))
        errors[orders] = rest
    shares = np.bincount(place, np.isfinite(sweeps.values).sum(axis=0))
    return ORDERS[smallest(np.array(losses), shares)], errors


def spread(rest):
    """Standard deviation per material, mm."""
    return np.nanstd(rest, axis=1)


def offsets(sweeps, model):
    """Line of every material at the middle of the stage, against the median material, mm."""
    middle = model.line @ [1, 0.5]
    return middle - np.median(middle)


def noise(sweeps):
    """Noise per material from first differences, mm."""
    return np.nanstd(np.diff(sweeps.values, axis=1), axis=1) / np.sqrt(2)
