"""Normal equations of a linear model of the phase error, part by part.

Leaving a part of the data out is then a subtraction, not a new fit. A constant per pixel is taken
off by centring every pixel on its own mean. A capture that is left out takes its share of that
mean along, which multiplies its distance from the mean by ``W / (W - w)``, W being the weight of
the pixel in all captures and w that in this one.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from toftools.calib._wiggling_data import Samples
from toftools.types import F64

Columns = Callable[[F64], F64]
"""``columns(phase (N,)) -> (N, K)``: functions of phase with zero mean over a turn."""


@dataclass(frozen=True, eq=False)
class Family:
    """Models of one kind in several sizes.

    Parameters
    ----------
    columns : callable
        ``columns(phase (N,), size) -> (N, K)``: functions of phase with zero mean over a turn.
    sizes : tuple of int
        Sizes to choose from, rising.
    nested : bool
        Whether the columns of a smaller model are the first of a larger one.
    """

    columns: Callable[[F64, int], F64]
    sizes: tuple[int, ...]
    nested: bool = False

    def sized(self, size: int) -> Columns:
        """The model of one size."""
        return lambda phase: self.columns(phase, size)


@dataclass(frozen=True, eq=False)
class Grams:
    """Products of columns, of a constant where all pixels share it, and of the error (last).

    Parameters
    ----------
    total : ndarray, (N, N)
        Of all data.
    fit, loss : ndarray, (G, N, N)
        What `total` loses with a part, and its products about the constants of the other parts.
    weight : ndarray, (G,)
        Weight of the parts in the held-out error.
    shared : bool
        Whether all pixels share one constant.
    """

    total: F64
    fit: F64
    loss: F64
    weight: F64
    shared: bool

    def cut(self, k: int) -> "Grams":
        """The same for the first k columns only; constant and error stay."""
        n = self.total.shape[0]
        keep = np.r_[:k, n - 1 - self.shared : n]
        pick = np.ix_(keep, keep)
        fit, loss = self.fit[:, pick[0], pick[1]], self.loss[:, pick[0], pick[1]]
        return replace(self, total=self.total[pick], fit=fit, loss=loss)


def products(samples: Samples, columns: Columns, weight: F64, loss_weight: F64) -> Grams:
    """Normal equations of the samples, and of their parts.

    Parameters
    ----------
    samples : Samples
        Measurements of one frequency.
    columns : callable
        Model.
    weight, loss_weight : ndarray, (C, P)
        Weights of the fit, and of the held-out error.

    Returns
    -------
    Grams
        Products.
    """
    sums = []
    for rows, w, lever, where in _centred(samples, columns, weight):
        v = np.where(lever > 0, loss_weight[where].ravel(), 0)
        loss = rows.T @ (rows * (v * lever**2)[:, None])
        total = rows.T @ (rows * w[:, None])
        fit = rows.T @ (rows * (w * lever)[:, None]) if samples.by_capture else total
        sums.append((total, fit, loss, v.sum()))
    total, fit, loss, weights = (np.stack(part) for part in zip(*sums, strict=True))
    return Grams(total.sum(axis=0), fit, loss, weights, not samples.per_pixel)


def total_only(samples: Samples, columns: Columns, weight: F64) -> F64:
    """Normal equations of all samples, as `Grams.total`.

    Parameters
    ----------
    samples : Samples
        Measurements of one frequency.
    columns : callable
        Model.
    weight : ndarray, (C, P)
        Weights of the fit.

    Returns
    -------
    ndarray, (N, N)
        Products.
    """
    parts = _centred(samples, columns, weight)
    return np.asarray(sum(rows.T @ (rows * w[:, None]) for rows, w, _, _ in parts))


def _centred(
    samples: Samples, columns: Columns, weight: F64
) -> Iterator[tuple[F64, F64, F64, tuple[int | slice, slice]]]:
    """Part by part: columns and error about the constants, weight, lever and where it lies."""
    return (_captures if samples.by_capture else _tiles)(samples, columns, weight)


def _captures(
    samples: Samples, columns: Columns, weight: F64
) -> Iterator[tuple[F64, F64, F64, tuple[int | slice, slice]]]:
    """One capture after the other, pixels centred on their means."""
    sums: F64 | float = 0.0
    for phase, error, w in zip(samples.phase_rad, samples.error_rad, weight, strict=True):
        sums = sums + _rows(columns, phase, error) * w[:, None]
    total = weight.sum(axis=0)
    mean = sums / np.maximum(total, 1e-300)[:, None]
    for c, w in enumerate(weight):
        rows = _rows(columns, samples.phase_rad[c], samples.error_rad[c]) - mean
        rest = total - w
        alone = rest <= 1e-9 * total  # a pixel that only this capture shows says nothing
        lever = np.where(alone, 0, total / np.where(alone, 1, rest))
        yield rows, w, lever, (c, slice(None))


def _tiles(
    samples: Samples, columns: Columns, weight: F64
) -> Iterator[tuple[F64, F64, F64, tuple[int | slice, slice]]]:
    """One block of pixels after the other."""
    captures = samples.phase_rad.shape[0]
    for _, place in samples.parts:
        w = weight[:, place]
        rows = _rows(columns, samples.phase_rad[:, place], samples.error_rad[:, place])
        if samples.per_pixel:
            pixels = rows.reshape(captures, -1, rows.shape[-1])
            total = np.maximum(w.sum(axis=0), 1e-300)[:, None]
            rows = (pixels - (pixels * w[..., None]).sum(axis=0) / total).reshape(rows.shape)
        else:
            rows = np.insert(rows, -1, 1.0, axis=1)
        yield rows, w.ravel(), np.ones(w.size), (slice(None), place)


def _rows(columns: Columns, phase: F64, error: F64) -> F64:
    """Columns and error side by side."""
    return np.column_stack([columns(phase.ravel()), error.ravel()])


def leftover(samples: Samples, weight: F64, model: F64) -> F64:
    """Errors less a model and less the weighted mean that belongs to the constants.

    Parameters
    ----------
    samples : Samples
        Measurements of one frequency.
    weight : ndarray, (C, P)
        Weights of the mean.
    model : ndarray, (C, P)
        Model at the phases, rad.

    Returns
    -------
    ndarray, (C, P)
        What is left, rad.
    """
    rest = samples.error_rad - model
    axis = 0 if samples.per_pixel else None
    total = np.maximum(weight.sum(axis=axis, keepdims=True), 1e-300)
    return np.asarray(rest - (rest * weight).sum(axis=axis, keepdims=True) / total)


def solved(gram: F64, pull: F64) -> F64:
    """Coefficients of the model, and the shared constant where there is one.

    Parameters
    ----------
    gram : ndarray, (N, N)
        Normal equations, the error last.
    pull : ndarray, (K, K)
        Penalty of the columns.

    Returns
    -------
    ndarray, (N - 1,)
        Solution, rad.
    """
    matrix = gram[:-1, :-1].copy()
    k = pull.shape[0]
    matrix[:k, :k] += pull
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    matrix = matrix / np.outer(size, size) + 1e-12 * np.eye(size.size)
    return np.asarray(np.linalg.solve(matrix, gram[:-1, -1] / size) / size)


def held_out(grams: Grams, pull: F64) -> F64:
    """Weighted square error of every part, fitted without it.

    Parameters
    ----------
    grams : Grams
        Normal equations.
    pull : ndarray, (K, K)
        Penalty of the columns.

    Returns
    -------
    ndarray, (G,)
        Sums of weighted squares, rad^2 times weight.
    """
    errors = []
    for part, loss in enumerate(grams.loss):
        probe = np.append(-solved(grams.total - grams.fit[part], pull), 1.0)
        errors.append(max(float(probe @ loss @ probe), 0.0))
    return np.array(errors)


def held_out_mean(grams: Grams, pull: F64) -> float:
    """Mean square error of all parts, each under a fit to the others.

    Parameters
    ----------
    grams : Grams
        Normal equations.
    pull : ndarray, (K, K)
        Penalty of the columns.

    Returns
    -------
    float
        rad^2; NaN where there is only one part.
    """
    if grams.weight.size < 2:
        return float("nan")
    return float(held_out(grams, pull).sum() / max(float(grams.weight.sum()), 1e-300))


def jackknife_sd(grams: Grams, pull: F64) -> F64:
    """Standard deviation of the solution, from leaving out one part after another.

    Parameters
    ----------
    grams : Grams
        Normal equations.
    pull : ndarray, (K, K)
        Penalty of the columns.

    Returns
    -------
    ndarray, (K,) or (K + 1,)
        Standard deviations, rad; NaN where there is only one part. Errors within a part may hang
        together. References: B. Efron, C. Stein, "The jackknife estimate of variance", Annals of
        Statistics 9 (1981) 586-596.
    """
    parts = grams.fit.shape[0]
    solutions = np.stack([solved(grams.total - fit, pull) for fit in grams.fit])
    if parts < 2:
        return np.full(solutions.shape[1], np.nan)
    return np.asarray(np.sqrt((parts - 1) * solutions.var(axis=0)))
