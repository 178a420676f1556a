"""What `auto` has decided for every pixel, and how far that can be trusted.

Residuals beyond noise widen sigma by their root (Birge's ratio: R. T. Birge, Physical Review 40
(1932) 207), doubts add in quadrature. Inputs: answers of models. Fails as their residuals do.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toftools.correct._evidence import Explained, pooled
from toftools.types import F32, Bool

MODELS = ("one return", "bounced light", "two returns", "learned")
ONE, BOUNCED, TWO, LEARNED = range(4)


@dataclass(frozen=True, eq=False)
class Choice:
    """What has been decided so far.

    Parameters
    ----------
    range_m, sigma_m : ndarray, (H, W)
        Range and its standard deviation by the model chosen, m.
    chi2 : ndarray, (H, W)
        What that leaves unexplained.
    model : ndarray, (H, W)
        Index into `MODELS`.
    doubt_m : ndarray, (H, W)
        What a rejected or uncertain model would change, m.
    """

    range_m: F32
    sigma_m: F32
    chi2: F32
    model: NDArray[np.uint8]
    doubt_m: F32


def merged(choice: Choice, other: Explained, taken: Bool, model: int, doubt_m: F32) -> Choice:
    """Take another model's answer in some pixels.

    Parameters
    ----------
    choice : Choice
        What has been decided.
    other : Explained
        The other answer.
    taken : ndarray, (H, W), bool
        Where it is taken.
    model : int
        Its index.
    doubt_m : ndarray, (H, W)
        Doubt from now on, m.

    Returns
    -------
    Choice
        Both.
    """

    def pick(new: F32, old: F32) -> F32:
        return np.where(taken, new, old).astype(np.float32)

    return Choice(
        pick(other.range_m, choice.range_m),
        pick(other.sigma_m, choice.sigma_m),
        pick(other.chi2, choice.chi2),
        np.where(taken, np.uint8(model), choice.model),
        np.asarray(doubt_m, np.float32),
    )


def spread_of(choice: Choice, usable: Bool, dof: int) -> tuple[F32, F32]:
    """How far a choice can be trusted.

    Parameters
    ----------
    choice : Choice
        What has been decided.
    usable : ndarray, (H, W), bool
        Pixels with a signal.
    dof : int
        Degrees of freedom of `chi2`.

    Returns
    -------
    spread_m : ndarray, (H, W)
        Standard deviation with all doubts, m.
    left : ndarray, (H, W)
        Residual of the neighbourhood per degree of freedom.
    """
    left, count = pooled(choice.chi2, usable, dof)
    # Residuals beyond noise widen sigma by their root (Birge's ratio); a learned sigma knows them.
    beyond = (left > 1 + 3 * np.sqrt(2 / dof / np.maximum(count, 1))) & (choice.model != LEARNED)
    birge = np.where(beyond, np.sqrt(np.maximum(left, 1)), 1)
    return np.asarray(np.hypot(choice.sigma_m * birge, choice.doubt_m), np.float32), left
