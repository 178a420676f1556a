"""Numbers behind the figures of a calibration: errors of thinned pixels under a chain."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib.chain import Chain, applied, skipping
from toftools.calib.residuals import range_error_m
from toftools.phasor import phase, phasors_of
from toftools.types import F64, Capture
from toftools.units import TWO_PI, phase_to_range

MOST = 120_000
"""Pixels of all captures together."""
BINS = 24


@dataclass(frozen=True, eq=False)
class Sample:
    """Errors of some pixels of some captures.

    Parameters
    ----------
    phase_rad, amplitude : ndarray, (F, N)
        What the pixels measured, before any correction.
    error_mm : ndarray, (F, N)
        Range error under a chain about its median, mm; NaN where unusable.
    means_mm : ndarray, (F, C)
        Mean error of every capture about the mean of all, mm.
    mm_per_rad : ndarray, (F,)
        Range per phase.
    unit : str
        Unit of the amplitude.
    """

    phase_rad: F64
    amplitude: F64
    error_mm: F64
    means_mm: F64
    mm_per_rad: F64
    unit: str

    def binned(self, f: int, x: F64, other_mm: F64) -> tuple[F64, tuple[F64, F64]]:
        """Medians of the own and of other errors over bins of x that hold as many pixels."""
        own = self.error_mm[f]
        good = np.isfinite(x) & np.isfinite(own) & np.isfinite(other_mm)
        order = np.argsort(x[good])
        parts = [part for part in np.array_split(order, BINS) if part.size]
        middle = [[np.median(values[good][part]) for part in parts] for values in
                  (x, own, other_mm)]  # fmt: skip
        return np.asarray(middle[0]), (np.asarray(middle[1]), np.asarray(middle[2]))


def samples(chain: Chain, captures: Sequence[Capture]) -> Sample:
    """Errors of captures under a chain.

    Parameters
    ----------
    chain : Chain
        Calibration.
    captures : sequence of Capture
        Raw captures with known distances.

    Returns
    -------
    Sample
        Pixels on a grid; the same ones for any chain.
    """
    pixels = chain.width * chain.height
    step = max(1, len(captures) * pixels // MOST)
    step += step > 1 and chain.width % step == 0  # else the grid would be a few columns
    errors, phases, amplitudes, means = [], [], [], []
    for capture in captures:
        raw = phasors_of(capture).values.reshape(chain.freqs_hz.size, -1)[:, ::step]
        error = error_maps_mm(chain, capture).reshape(chain.freqs_hz.size, -1)
        errors.append(error[:, ::step])
        means.append([_mean(layer) for layer in error])
        phases.append(phase(raw))
        amplitudes.append(np.abs(raw).astype(np.float64))
    error, mean = np.concatenate(errors, axis=1), np.array(means).T
    centre = [np.nanmedian(row) if np.isfinite(row).any() else 0.0 for row in error]
    taps = captures[0].taps
    return Sample(
        phase_rad=np.concatenate(phases, axis=1),
        amplitude=np.concatenate(amplitudes, axis=1),
        error_mm=error - np.reshape(centre, (-1, 1)),
        means_mm=mean - np.nan_to_num(mean).mean(axis=1, keepdims=True),
        mm_per_rad=1e3
        * phase_to_range(np.full(chain.freqs_hz.size, TWO_PI), chain.freqs_hz)
        / TWO_PI,
        unit="any unit" if taps is None else taps.unit,
    )


def _mean(layer: F64) -> float:
    known = layer[np.isfinite(layer)]
    return float(known.mean()) if known.size else float("nan")


def error_maps_mm(chain: Chain, capture: Capture) -> F64:
    """Range errors of one capture under a chain.

    Parameters
    ----------
    chain : Chain
        Calibration; its temperature stage is left out where the capture says no temperature.
    capture : Capture
        Raw capture with a known distance.

    Returns
    -------
    ndarray, (F, H, W)
        Measured minus true range, mm; NaN where unusable.
    """
    needs = getattr(chain.stage("temperature"), "needs", ())
    if not set(needs) <= set(capture.provenance.get("conditions", {})):
        chain = skipping(chain, ["temperature"])
    return 1e3 * range_error_m(applied(chain, capture))
