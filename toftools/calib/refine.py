"""All phase stages once more, together: what one stage left in the others comes out.

Stages are fitted one after another, each on captures that differ in one thing only, as far as a
bench allows: on a rail brightness falls with distance, walls vignette, and a warm camera measured
them all. Here one linear model explains all captures at once, per frequency f:

    measured - expected = wiggling(psi) + amplitude(log A, psi') + drift (T - T0) + c[pixel]

by least squares with the soft L1 loss of `scipy.optimize.least_squares` (its twin in tests), the
constants of the pixels eliminated by centring (R. Frisch, F. Waugh, "Partial time regressions as
compared with individual trends",
Econometrica 1 (1933) 387-401), phases taken where they would be without noise, sizes of all models
kept. Standard deviations come from leaving out one capture after another, since errors within one
may hang together; 1.96 of them are the 95 % interval, Student's factor included. Common phase and
fixed pattern are then fitted again, on walls without the other three. It needs captures that tell
the terms apart; what they leave open stays as the first fit had it.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from toftools.calib._refine_data import Pool, centred, kept, pools, usable_captures
from toftools.calib._refine_spread import widened
from toftools.calib._refine_terms import WEAK_RAD, Term, term_of
from toftools.calib.chain import Chain, applied
from toftools.calib.common_phase import CommonPhase, common_phase
from toftools.calib.fixed_pattern import FixedPattern, fixed_pattern
from toftools.calib.stage import Stage
from toftools.conditions import conditions_of
from toftools.phasor import phasors_of
from toftools.types import F64, Capture

LOG = logging.getLogger("toftools.calib")
ROUNDS = 2
CUT = 6.0
F_SCALE = 2.0
"""Residuals beyond so many deviations count less."""
MOST_STEPS, SETTLED = 30, 1e-2
"""Steps of the robust fit, and how far one may still move, standard deviations of the data."""
LEAST_CAPTURES = 5
LEAST_SHARE = 1e-9


def refine(chain: Chain, captures: Sequence[Capture]) -> Chain:
    """Fit all phase stages of a chain together.

    Parameters
    ----------
    chain : Chain
        Stages as fitted one after another.
    captures : sequence of Capture
        Raw captures with conditions: all that the stages were fitted from.

    Returns
    -------
    Chain
        The refined chain; the same one where fewer than two stages can be refined together, or
        fewer than five captures show them.
    """
    optics, phases = chain.before("wiggling"), _phase_part(chain)
    terms = [term for term in map(term_of, phases.stages) if term is not None]
    used = usable_captures(chain, captures)
    if not terms or len(used) < LEAST_CAPTURES or len(phases.stages) < 2:
        return chain
    bare = [replace(applied(optics, capture), taps=None) for capture in used]
    for number in range(ROUNDS):
        LOG.info("refining %d stages together, round %d of %d", len(terms), number + 1, ROUNDS)
        phases, covariances = _round(phases, terms, bare)
        phases = _with_patterns(phases, bare)
        terms = [term for term in map(term_of, phases.stages) if term is not None]
    walls = [capture for capture in bare if conditions_of(capture).kind == "wall"]
    phases = widened(phases, terms, covariances, walls)
    new = {stage.slot: stage for stage in phases.stages}
    return replace(chain, stages=tuple(new.get(s.slot, s) for s in chain.stages))


def _phase_part(chain: Chain) -> Chain:
    """The chain without optics and response, which are applied to the captures once."""
    return chain.without("lens").without("response").without("extrinsics")


def _round(
    chain: Chain, terms: Sequence[Term], captures: Sequence[Capture]
) -> tuple[Chain, list[F64]]:
    """The chain with the coefficients of all terms fitted at once, and their covariances."""
    fits = [_fitted(pool, terms, f) for f, pool in enumerate(pools(chain, captures))]
    stages: dict[str, Stage] = {}
    ends = [np.cumsum([0, *(term.start[f].size for term in terms)]) for f in range(len(fits))]
    for n, term in enumerate(terms):
        spans = [slice(end[n], end[n + 1]) for end in ends]
        values = [theta[span] for (theta, _), span in zip(fits, spans, strict=True)]
        spread = [cov[span, span] for (_, cov), span in zip(fits, spans, strict=True)]
        stages[term.slot] = term.rebuilt(values, spread, len(captures) - 1)
    refined = replace(chain, stages=tuple(stages.get(s.slot, s) for s in chain.stages))
    return refined, [covariance for _, covariance in fits]


def _fitted(pool: Pool, terms: Sequence[Term], f: int) -> tuple[F64, F64]:
    """Coefficients of all terms at one frequency, and their covariance."""
    theta = np.concatenate([term.start[f] for term in terms])
    error, start, still = pool.error_rad[..., None], theta, pool
    if not theta.size:
        return theta, np.zeros((0, 0))
    weight = pool.weight
    for _ in range(ROUNDS):
        # Phases without the noise that their own errors carry: else each coefficient is drawn
        # towards 0 by the square of noise times order.
        rows = np.concatenate([term.columns(still, f) for term in terms], axis=2)
        rest = centred(pool, error - rows @ theta[:, None], weight)[..., 0]
        weight = kept(pool.weight, rest, CUT)[0]
        design = centred(pool, rows, weight)
        target = centred(pool, error, weight)[..., 0]
        used, root = weight > 0, np.sqrt(weight)
        theta = soft_l1((design * root[..., None])[used], (target * root)[used], start)
        rest = np.where(weight > 0, target - design @ theta, 0.0)
        still = replace(
            pool, phase_rad=pool.phase_rad - rest, corrected_rad=pool.corrected_rad - rest
        )
    return theta, _covariance(design, rest, weight)


def soft_l1(rows: F64, values: F64, start: F64) -> F64:
    """Minimum of the soft L1 loss of ``rows x - values`` plus a weak prior at a start.

    The same minimum as that of ``scipy.optimize.least_squares(loss="soft_l1")``, which takes the
    singular values of all rows in every step; reweighted normal equations take the products only.

    Parameters
    ----------
    rows : ndarray, (N, K)
        Model over its standard deviation.
    values : ndarray, (N,)
        Data likewise.
    start : ndarray, (K,)
        First guess, and where the prior lies.

    Returns
    -------
    ndarray, (K,)
        Solution.
    """
    first = values - rows @ start
    limit = F_SCALE * (1.4826 * float(np.median(np.abs(first))) + 1e-12)
    prior = np.eye(start.size) * (limit / F_SCALE / WEAK_RAD) ** 2
    theta = start
    for _ in range(MOST_STEPS):
        away = (values - rows @ theta) / limit
        trust = 1 / np.sqrt(1 + away**2)  # derivative of 2 (sqrt(1 + z) - 1) at z = away^2
        heavy = rows * trust[:, None]
        gram = heavy.T @ rows + prior
        size = np.sqrt(np.diag(gram))
        right = heavy.T @ values + prior @ start
        new = np.linalg.solve(gram / np.outer(size, size), right / size) / size
        step, theta = float(np.abs((new - theta) * size).max()), np.asarray(new)
        if step < SETTLED * limit:
            break
    return theta


def _covariance(design: F64, rest: F64, weight: F64) -> F64:
    """Covariance by leaving out one capture after another: errors within one may hang together.

    References
    ----------
    B. Efron, C. Stein, "The jackknife estimate of variance", Annals of Statistics 9 (1981)
    586-596; for clusters of least squares one solution of normal equations each.
    """
    grams = np.einsum("cpi,cp,cpj->cij", design, weight, design)  # (C, K, K)
    scores = np.einsum("cpi,cp->ci", design, weight * rest)  # (C, K)
    total = grams.sum(axis=0)
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    held = LEAST_SHARE * np.eye(size.size)
    moved = [
        np.linalg.solve((total - gram) / np.outer(size, size) + held, score / size) / size
        for gram, score in zip(grams, scores, strict=True)
    ]
    steps = np.stack(moved)
    clusters = max(2, int((weight > 0).any(axis=1).sum()))
    wide = _student(steps)
    return np.asarray(np.outer(wide, wide) * (steps.T @ steps) * ((clusters - 1) / clusters))


def _student(steps: F64) -> F64:
    """95 % points of Student's distribution relative to the normal one, (K,).

    Degrees of freedom after F. Satterthwaite (Biometrics Bulletin 2 (1946) 110-114): a sum of
    squares of normal numbers of unequal size has ``(sum v)^2 / sum v^2``, and the fourth powers
    of such numbers are ``3 v^2`` on average.
    """
    from scipy.stats import t

    square, fourth = (steps**2).sum(axis=0), (steps**4).sum(axis=0)
    freedom = 3 * square**2 / np.maximum(fourth, np.finfo(np.float64).tiny)
    return np.asarray(t.ppf(0.975, np.maximum(freedom, 2.0)) / 1.96)


def _with_patterns(chain: Chain, captures: Sequence[Capture]) -> Chain:
    """The chain with common phase and fixed pattern fitted on walls without all other errors."""
    walls = [capture for capture in captures if conditions_of(capture).kind == "wall"]
    for slot, fit in (("common_phase", common_phase), ("fixed_pattern", fixed_pattern)):
        old = chain.stage(slot)
        if not walls or not isinstance(old, CommonPhase | FixedPattern):
            continue
        new = fit([_bare(chain, slot, capture) for capture in walls])
        stage = replace(new, residual=replace(new.residual, before=old.residual.before))
        chain = replace(chain, stages=tuple(stage if s is old else s for s in chain.stages))
    return chain


def _bare(chain: Chain, slot: str, capture: Capture) -> Capture:
    """A capture corrected by all that comes before a slot, and by amplitude error and drift."""
    done = applied(chain.before(slot), capture)
    seen = phasors_of(applied(chain.before("amplitude"), capture))
    later = phasors_of(applied(chain, capture))
    turn = np.where(later.valid & seen.valid, later.values * np.conj(seen.values), 1)
    unit = turn / np.maximum(np.abs(turn), np.finfo(np.float32).tiny)
    phasors = phasors_of(done)
    return replace(
        done, phasors=replace(phasors, values=(phasors.values * unit).astype(np.complex64))
    )
