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
    """Normal equations of the samples.

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
    if samples.by_capture:
        means = _means(samples, columns, weight)
        triples = list(_captures(samples, columns, weight, loss_weight, means))
    else:
        triples = list(_tiles(samples, columns, weight, loss_weight))
    total, fit, loss, weights = (np.stack(part) for part in zip(*triples, strict=True))
    return Grams(total.sum(axis=0), fit, loss, weights, not samples.per_pixel)


def _means(samples: Samples, columns: Columns, weight: F64) -> tuple[F64, F64]:
    """Weighted mean of columns and error of every pixel, (P, K + 1), and its weight (P,)."""
    sums: F64 | float = 0.0
    for phase, error, w in zip(samples.phase_rad, samples.error_rad, weight, strict=True):
        sums = sums + _rows(columns, phase, error) * w[:, None]
    total = weight.sum(axis=0)
    return np.asarray(sums / np.maximum(total, 1e-300)[:, None]), total


def _captures(
    samples: Samples, columns: Columns, weight: F64, loss_weight: F64, means: tuple[F64, F64]
) -> Iterator[tuple[F64, F64, F64, F64]]:
    """Products of one capture after the other, pixels centred on their means."""
    mean, total = means
    for phase, error, w, v in zip(
        samples.phase_rad, samples.error_rad, weight, loss_weight, strict=True
    ):
        rows = _rows(columns, phase, error) - mean
        rest = total - w
        alone = rest <= 1e-9 * total  # a pixel that only this capture shows says nothing
        lever = np.where(alone, 0, total / np.where(alone, 1, rest))
        used = np.where(alone, 0, v)
        yield (
            rows.T @ (rows * w[:, None]),
            rows.T @ (rows * (w * lever)[:, None]),
            rows.T @ (rows * (used * lever**2)[:, None]),
            used.sum(),
        )


def _tiles(
    samples: Samples, columns: Columns, weight: F64, loss_weight: F64
) -> Iterator[tuple[F64, F64, F64, F64]]:
    """Products of one block of pixels after the other."""
    captures = samples.phase_rad.shape[0]
    for _, place in samples.parts:
        w, v = weight[:, place], loss_weight[:, place].ravel()
        rows = _rows(columns, samples.phase_rad[:, place], samples.error_rad[:, place])
        if samples.per_pixel:
            pixels = rows.reshape(captures, -1, rows.shape[-1])
            total = np.maximum(w.sum(axis=0), 1e-300)[:, None]
            rows = (pixels - (pixels * w[..., None]).sum(axis=0) / total).reshape(rows.shape)
        else:
            rows = np.insert(rows, -1, 1.0, axis=1)
        fit = rows.T @ (rows * w.ravel()[:, None])
        yield fit, fit, rows.T @ (rows * v[:, None]), v.sum()


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


def solved(grams: Grams, pull: F64, left_out: int | None = None) -> F64:
    """Coefficients of the model, and the shared constant where there is one.

    Parameters
    ----------
    grams : Grams
        Normal equations.
    pull : ndarray, (K, K)
        Penalty of the columns.
    left_out : int or None
        A part not to use.

    Returns
    -------
    ndarray, (K,) or (K + 1,)
        Solution, rad.
    """
    gram = grams.total if left_out is None else grams.total - grams.fit[left_out]
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
        probe = np.append(-solved(grams, pull, part), 1.0)
        errors.append(max(float(probe @ loss @ probe), 0.0))
    return np.array(errors)


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
    solutions = np.stack([solved(grams, pull, part) for part in range(parts)])
    if parts < 2:
        return np.full(solutions.shape[1], np.nan)
    return np.asarray(np.sqrt((parts - 1) * solutions.var(axis=0)))
