"""Rows that see what a method must not see: somebody's published output, or the true wrap count.

Their context is the whole capture instead of the sensor, they carry no timing, and they stand in
the tables to pin readers, conventions and metrics against figures that others can recompute.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from toftools.phasor import wrapped_range_m
from toftools.registry import Spec
from toftools.types import Capture, DepthMap, Phasors
from toftools.units import ambiguity_m

REFERENCES: Mapping[str, Spec] = MappingProxyType(
    {
        "reported": Spec("toftools.bench.references:reported", name="reported"),
        "oracle_wrap": Spec(
            "toftools.bench.references:oracle_wrap", grid={"freq_index": (0, 1)}, name="oracle_wrap"
        ),
    }
)
"""Reference rows by name."""


def reported(capture: Capture, *, name: str = "") -> Callable[[Phasors], DepthMap]:
    """Output that somebody published for this capture, as a method without timing.

    Parameters
    ----------
    capture : Capture
        Capture whose `reported` holds the output.
    name : str
        Which one; may be left out if there is only one.

    Returns
    -------
    callable
        ``run(phasors) -> DepthMap``, whatever the phasors.

    Raises
    ------
    ValueError
        If the capture carries no such output.
    """
    names = list(capture.reported)
    chosen = name or (names[0] if len(names) == 1 else "")
    if chosen not in capture.reported:
        msg = f"the capture carries the published outputs {names}, got name={name!r}"
        raise ValueError(msg)
    values = capture.reported[chosen]
    answer = np.where(np.isfinite(values) & (values >= 0), values, np.nan)
    return lambda _phasors: DepthMap(answer, info={"status": "reported"})


def oracle_wrap(capture: Capture, *, freq_index: int = 0) -> Callable[[Phasors], DepthMap]:
    """One frequency with the wrap count taken from the truth: its error is multipath alone.

    Parameters
    ----------
    capture : Capture
        Capture with truth.
    freq_index : int
        Which frequency.

    Returns
    -------
    callable
        ``run(phasors) -> DepthMap``.

    Raises
    ------
    ValueError
        If the capture has no truth or no such frequency.
    """
    freqs = capture.sensor.modulation.freqs_hz
    if capture.truth is None:
        msg = "oracle_wrap needs a capture with truth; this one has none"
        raise ValueError(msg)
    if not 0 <= freq_index < freqs.size:
        msg = f"freq_index must be 0..{freqs.size - 1}, got {freq_index}"
        raise ValueError(msg)
    truth, freq_hz = capture.truth.range_m, float(freqs[freq_index])
    period = float(ambiguity_m(freq_hz))

    def run(phasors: Phasors) -> DepthMap:
        wrapped = wrapped_range_m(phasors.values[freq_index][None], [freq_hz])[0]
        with np.errstate(invalid="ignore"):
            answer = wrapped + period * np.round((truth - wrapped) / period)
        keep = phasors.valid & np.isfinite(answer) & (answer >= 0)
        return DepthMap(np.where(keep, answer, np.nan).astype(np.float32))

    return run
