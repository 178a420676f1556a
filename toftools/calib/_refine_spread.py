"""What the uncertainty of the other stages adds to that of common phase and fixed pattern.

The constant of a pixel is the mean error of the walls less the terms there, ``mean(error) -
mean(columns) theta``; so a covariance C of theta adds ``mean(columns) C mean(columns)'``, over the
pixels for the common phase, and over the difference to that mean for each pixel.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from toftools.calib._refine_data import pools
from toftools.calib._refine_terms import Term
from toftools.calib.chain import Chain
from toftools.calib.common_phase import CommonPhase
from toftools.calib.fixed_pattern import FixedPattern
from toftools.calib.stage import Stage
from toftools.types import F64, Capture


def widened(
    chain: Chain, terms: Sequence[Term], covariances: Sequence[F64], walls: Sequence[Capture]
) -> Chain:
    """The chain with standard deviations of the constants that know of the other stages.

    Parameters
    ----------
    chain : Chain
        Refined phase stages.
    terms : sequence of Term
        Their terms.
    covariances : sequence of ndarray, (K, K)
        Covariance of all coefficients, per frequency.
    walls : sequence of Capture
        Captures that common phase and fixed pattern were fitted on, corrected for optics.

    Returns
    -------
    Chain
        With wider standard deviations; values stay.
    """
    if not walls:
        return chain
    shape = (chain.freqs_hz.size, chain.height, chain.width)
    constant, pattern = np.zeros(shape[0]), np.zeros(shape)
    sums = [_summed(chain, terms, wall) for wall in walls]
    for f, covariance in enumerate(covariances):
        total = np.sum([weight[f] for _, weight in sums], axis=0)
        mean = np.sum([rows[f] for rows, _ in sums], axis=0)
        mean = mean / np.maximum(total, 1e-300)[:, None]
        mean = mean[:, : covariance.shape[0]]
        seen = total > 0
        if not mean.shape[1] or not seen.any():
            continue
        middle = mean[seen].mean(axis=0)
        constant[f] = max(float(middle @ covariance @ middle), 0.0)
        away = mean - middle
        variance = np.einsum("pi,ij,pj->p", away, covariance, away)
        pattern[f] = np.where(seen, np.maximum(variance, 0.0), 0.0).reshape(shape[1:])
    stages = tuple(_wider(stage, constant, pattern) for stage in chain.stages)
    return replace(chain, stages=stages)


def _summed(chain: Chain, terms: Sequence[Term], wall: Capture) -> tuple[list[F64], list[F64]]:
    """Weighted columns of every pixel of a wall, (P, K), and the weights, per frequency."""
    rows, weights = [], []
    for f, pool in enumerate(pools(chain, [wall], step=1)):
        columns = np.concatenate([term.columns(pool, f)[0] for term in terms], axis=1)
        weight = pool.weight[0]
        rows.append(columns * weight[:, None])
        weights.append(weight)
    return rows, weights


def _wider(stage: Stage, constant: F64, pattern: F64) -> Stage:
    if isinstance(stage, CommonPhase):
        return replace(stage, sigma_rad=np.sqrt(stage.sigma_rad**2 + constant))
    if isinstance(stage, FixedPattern):
        return replace(stage, sigma_rad=np.sqrt(stage.sigma_rad**2 + pattern))
    return stage
