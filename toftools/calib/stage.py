"""What every calibration stage is: a frozen, savable, callable model with a line of residuals.

Order of correction: lens, response, wiggling, common phase, fixed pattern, amplitude, temperature.
Wiggling belongs to the pixel and sees every phase that reaches it, so it is taken off first; the
others are phases that were added before. Each stage is fitted on captures that all stages before
it have corrected already.
"""

import math
from dataclasses import dataclass
from numbers import Real
from typing import ClassVar, Protocol, runtime_checkable

from toftools.types import F64, Phasors

SLOTS = (
    "lens",
    "response",
    "wiggling",
    "common_phase",
    "fixed_pattern",
    "amplitude",
    "temperature",
    "extrinsics",
)
"""Places of a chain, in the order in which stages are fitted and applied."""


@dataclass(frozen=True)
class Residual:
    """How much of an error a stage took away, and whether it stays away.

    Parameters
    ----------
    unit : str
        ``mm`` of range, ``px`` or ``%``.
    before, after : float
        Root mean square error of the data of the fit without and with the stage.
    held_out : float
        The same with the stage, for data that the fit did not see; NaN where nothing was held out.
    noise : float
        What the noise of these data alone would leave; NaN if unknown.
    n : int
        Number of data.
    notes : tuple of str
        What a user should know, a sentence each.
    """

    unit: str = "mm"
    before: float = math.nan
    after: float = math.nan
    held_out: float = math.nan
    noise: float = math.nan
    n: int = 0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        figures = (self.before, self.after, self.held_out, self.noise, self.n)
        real = all(isinstance(x, Real) and not isinstance(x, bool) for x in figures)
        words = isinstance(self.notes, tuple) and all(isinstance(x, str) for x in self.notes)
        if not (real and words and isinstance(self.unit, str)):
            msg = (
                f"a residual holds a unit, five numbers and sentences, got {self.unit!r}, {figures}"
            )
            raise ValueError(msg)


@runtime_checkable
class Stage(Protocol):
    """A fitted stage; a frozen dataclass of numbers, words and arrays."""

    slot: ClassVar[str]
    """Its place in the chain, one of `SLOTS`."""

    @property
    def residual(self) -> Residual:
        """What the fit left."""
        ...

    def __call__(self, phasors: Phasors, /) -> Phasors:
        """Phasors without the error that this stage describes."""
        ...


@runtime_checkable
class PhaseStage(Stage, Protocol):
    """A stage that takes a phase off: ``z exp(-j error)``."""

    def error_rad(self, phase_rad: F64, amplitude: F64) -> F64:
        """Measured minus true phase.

        Parameters
        ----------
        phase_rad : ndarray, (F, ...)
            Measured phase, rad.
        amplitude : ndarray, (F, ...)
            Measured amplitude, unit of the phasors.

        Returns
        -------
        ndarray, broadcasts to (F, ...)
            Phase to take off, rad; (F, H, W) for a pattern of pixels.
        """
        ...
