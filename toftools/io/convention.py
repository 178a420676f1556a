"""What convention a recording follows, judged against a reference distance.

For a hypothesis h (sign of the phase, order of the taps) the phase error against the reference
is averaged as a unit vector: ``C_h = |mean exp(j (phi_h - phi_ref))|``, 1 when they agree up to a
constant, which the angle of the mean gives as a range offset. Orders that differ by a common
rotation only move that constant, and mirrored orders equal the other sign, so neither is tried
twice. Standard errors come from a delete-one-block jackknife over the image (B. Efron, "The
jackknife, the bootstrap and other resampling plans", 1982), because residuals of neighbours are
correlated and a per-pixel error would promise too much. It fails, and says so, where the
reference hardly varies in phase: then every sign fits.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.phasor import demodulation_weights, phasors_of
from toftools.types import F32, Capture
from toftools.units import TWO_PI, ambiguity_m, range_to_phase, wrap_phase

MIN_MARGIN = 0.05
"""Least lead in coherence over the runner-up for a decision."""

MIN_MARGIN_SE = 3.0
"""The same, in its own standard errors."""

MIN_COHERENCE = 0.5
"""Least coherence: below it, even the best hypothesis explains little."""

_BLOCKS = 8  # per image side
_MAX_TAPS = 5  # beyond it the orders are too many to try


@dataclass(frozen=True, eq=False)
class Proposal:
    """The best hypothesis, and how far to trust it.

    Parameters
    ----------
    sign : int
        1 if the measured phase grows with range, -1 if it falls.
    steps_rad : ndarray, (F, K), or None
        Tap steps in the order of the file, sign not included; None for phasors.
    coherence : ndarray, (F,)
        Agreement with the reference, 0..1.
    offset_m : ndarray, (F,)
        Measured (with `sign`) minus reference range, within half an ambiguity range of 0, m.
    offset_se_m : ndarray, (F,)
        Standard error of the offset, m.
    runner_up : str
        The second-best hypothesis in words.
    margin, margin_se : float
        Lead in mean coherence over the runner-up, and its standard error.
    decided : bool
        Whether the lead is large enough.
    reason : str
        Why, in one sentence.
    """

    sign: int
    steps_rad: NDArray[np.float64] | None
    coherence: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    offset_se_m: NDArray[np.float64]
    runner_up: str
    margin: float
    margin_se: float
    decided: bool
    reason: str


def propose(capture: Capture, reference_m: F32) -> Proposal:
    """Sign, tap order and constant offset that agree best with a reference.

    Parameters
    ----------
    capture : Capture
        Recording with taps or phasors.
    reference_m : ndarray, (H, W)
        Radial range from elsewhere, m; NaN where unknown.

    Returns
    -------
    Proposal
        The best hypothesis.

    Raises
    ------
    ValueError
        If the capture has neither taps nor phasors, the shapes differ, or fewer than 16 pixels
        have both a measurement and a reference.
    """
    if capture.taps is None and capture.phasors is None:
        msg = "the capture holds distances only; wanted taps or phasors to propose a convention"
        raise ValueError(msg)
    freqs = capture.sensor.modulation.freqs_hz
    measured = phasors_of(capture)
    if reference_m.shape != measured.values.shape[1:]:
        msg = f"the reference is {reference_m.shape}, the capture {measured.values.shape[1:]}"
        raise ValueError(msg)
    usable = measured.valid & np.isfinite(reference_m) & (np.abs(measured.values) > 0).all(axis=0)
    if usable.sum() < 16:
        msg = f"only {int(usable.sum())} pixels have a measurement and a reference; wanted 16"
        raise ValueError(msg)
    expected = range_to_phase(reference_m[usable], freqs[:, None])  # (F, N)
    blocks = _block_of(usable)
    tried = [
        (sign, steps, *_block_sums(np.where(sign > 0, z, z.conj()), expected, blocks))
        for steps, z in _orders(capture, usable)
        for sign in (1, -1)
    ]
    ranked = sorted(tried, key=lambda one: -float(_coherence(one[2].sum(1), one[3].sum(1)).mean()))
    return _judge(ranked, freqs, expected)


_Tried = tuple[int, NDArray[np.float64] | None, NDArray[np.complex128], NDArray[np.float64]]


def _orders(
    capture: Capture, usable: NDArray[np.bool_]
) -> Iterator[tuple[NDArray[np.float64] | None, NDArray[np.complex128]]]:
    """Steps (F, K) in file order and phasors (F, N) of every distinct tap order."""
    if capture.taps is None:
        yield None, np.asarray(phasors_of(capture).values[:, usable], dtype=np.complex128)
        return
    values = capture.taps.values[:, :, usable].astype(np.float64)  # (F, K, N)
    steps, n_taps = capture.sensor.modulation.steps_rad, values.shape[1]
    for order in permutations(range(1, n_taps)):
        as_given = order == tuple(range(1, n_taps))
        if order[0] > order[-1] or (n_taps > _MAX_TAPS and not as_given):
            continue
        permuted = steps[:, [0, *order]]
        weights = demodulation_weights(permuted)
        yield permuted, np.einsum("fk,fkn->fn", weights, values)
        if n_taps > _MAX_TAPS:
            return


def _block_of(usable: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Number of the image block of each usable pixel."""
    height, width = usable.shape
    row, column = np.nonzero(usable)
    blocks = (row * _BLOCKS // height) * _BLOCKS + column * _BLOCKS // width
    return np.unique(blocks, return_inverse=True)[1]


def _block_sums(
    z: NDArray[np.complex128], expected: NDArray[np.float64], blocks: NDArray[np.intp]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Sums of unit error vectors per frequency and block, and the pixels per block."""
    length = np.abs(z)
    unit = z / np.where(length > 0, length, 1.0) * np.exp(-1j * expected)  # (F, N)
    count = int(blocks.max()) + 1
    sums = np.stack(
        [
            np.bincount(blocks, row.real, count) + 1j * np.bincount(blocks, row.imag, count)
            for row in unit
        ]
    )
    pixels = np.bincount(blocks, minlength=count).astype(np.float64)
    return sums, np.broadcast_to(pixels, sums.shape)


def _coherence(sums: NDArray[np.complex128], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.abs(sums) / np.maximum(pixels, 1.0))


def _without_each(values: NDArray[Any]) -> NDArray[Any]:
    """Totals (F, B) with one block left out at a time."""
    return np.asarray(values.sum(axis=1, keepdims=True) - values)


def _jackknife(replicates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error from delete-one replicates along the last axis (Efron 1982)."""
    count = replicates.shape[-1]
    if count < 2:
        return np.full(replicates.shape[:-1], np.inf)
    spread = replicates - replicates.mean(axis=-1, keepdims=True)
    return np.asarray(np.sqrt((count - 1) / count * (spread**2).sum(axis=-1)))


def _judge(
    ranked: list[_Tried], freqs: NDArray[np.float64], expected: NDArray[np.float64]
) -> Proposal:
    (sign, steps, sums, pixels), second = ranked[0], ranked[1]
    total = sums.sum(axis=1)
    ambiguity = ambiguity_m(freqs)
    # Replicates of the offset as turns away from the whole mean, so that no wrap can intervene.
    turns = np.angle(_without_each(sums) * total[:, None].conj()) / TWO_PI
    lead = _mean_coherence_without_each(sums, pixels)
    lead -= _mean_coherence_without_each(second[2], second[3])
    coherence = _coherence(total, pixels.sum(axis=1))
    margin = float((coherence - _coherence(second[2].sum(1), second[3].sum(1))).mean())
    margin_se = float(_jackknife(lead))
    decided, reason = _verdict(float(coherence.mean()), margin, margin_se, expected)
    return Proposal(
        sign=sign,
        steps_rad=steps,
        coherence=coherence,
        offset_m=np.asarray(np.angle(total) / TWO_PI * ambiguity),
        offset_se_m=_jackknife(turns) * ambiguity,
        runner_up=_words(second[0], second[1]),
        margin=margin,
        margin_se=margin_se,
        decided=decided,
        reason=reason,
    )


def _mean_coherence_without_each(
    sums: NDArray[np.complex128], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(_coherence(_without_each(sums), _without_each(pixels)).mean(axis=0))


def _verdict(
    coherence: float, margin: float, margin_se: float, expected: NDArray[np.float64]
) -> tuple[bool, str]:
    # Circular standard deviation, sqrt(-2 ln R); abs() only turns -0 into 0.
    length = np.clip(np.abs(np.exp(1j * expected).mean(axis=1)), 1e-12, 1.0)
    spread = float(np.sqrt(np.abs(2 * np.log(length))).max())
    if margin >= MIN_MARGIN and margin >= MIN_MARGIN_SE * margin_se and coherence >= MIN_COHERENCE:
        return True, f"coherence {coherence:.4f}, ahead of the runner-up by {margin:.3f}"
    if coherence < MIN_COHERENCE:
        return False, f"no hypothesis fits: the best coherence is {coherence:.3f}"
    return False, (
        f"the reference spreads by only {spread:.2f} rad of phase and the runner-up comes within "
        f"{margin:.3f}: use a scene with more depth"
    )


def _words(sign: int, steps: NDArray[np.float64] | None) -> str:
    text = f"sign {'+' if sign > 0 else '-'}"
    return text if steps is None else f"{text}, taps {steps_text(steps[0])}"


def steps_text(steps_rad: NDArray[np.float64]) -> str:
    """Tap steps relative to the first, in whole degrees.

    Parameters
    ----------
    steps_rad : ndarray, (K,)
        Tap steps, rad.

    Returns
    -------
    str
        Such as ``0/90/180/270``.

    Examples
    --------
    >>> steps_text(np.array([0, np.pi, np.pi / 2, 3 * np.pi / 2]))
    '0/180/90/270'
    """
    degrees = np.degrees(wrap_phase(steps_rad - steps_rad[0] + 1e-9))
    return "/".join(f"{d:.0f}" for d in degrees)
