"""Dark and flat captures as the response fit needs them: checked, and reduced per node."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toftools.calib._response_offset import is_modulated, offset_weights
from toftools.calib.residuals import same_sensor
from toftools.conditions import conditions_of, name_of
from toftools.tap_noise import rounding_dn2
from toftools.types import F32, F64, Bool, Capture, Taps

ORDERS = 4
"""Powers of the taps that are kept: curves of up to this degree."""
USABLE_SHARE = 0.5
"""A flat needs as many pixels below saturation."""


@dataclass(frozen=True, eq=False)
class Level:
    """One capture reduced to the levels of its nodes.

    Parameters
    ----------
    name : str
        File.
    exposure : float
        Relative exposure; 0 in the dark.
    moments : ndarray, (ORDERS, N, H, W)
        Offset of the first powers of tap / top.
    ok : ndarray, (H, W), bool
        Pixels below saturation.
    modulated : bool
        Whether the light moves taps against each other.
    taps : Taps
        The taps themselves.
    rounding : ndarray or float
        Variance that rounding to numbers of the converter adds to each tap.
    """

    name: str
    exposure: float
    moments: F64
    ok: Bool
    modulated: bool
    taps: Taps
    rounding: F32 | np.float32

    @property
    def n_taps(self) -> int:
        """Taps of a pixel, F K."""
        return int(np.prod(self.taps.values.shape[:2]))


def levels_of(
    captures: Sequence[Capture], saturation: float
) -> tuple[list[Level], list[Level], float]:
    """Dark and flat levels of a set of captures.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with conditions; kinds other than dark and flat are passed over.
    saturation : float
        Raw level from which on taps are saturated.

    Returns
    -------
    tuple of list of Level, list of Level, and float
        Darks; flats by rising exposure; and the raw level `top` by which taps were divided.

    Raises
    ------
    ValueError
        If either kind is missing, or a capture is black, saturated, of another camera, or without
        taps; the sentence names it.
    """
    kinds = {
        kind: [c for c in captures if conditions_of(c).kind == kind] for kind in ("dark", "flat")
    }
    for kind, found in kinds.items():
        if not found:
            got = ", ".join(sorted({conditions_of(c).kind for c in captures})) or "none"
            msg = f"the response stage needs a capture of kind {kind}, got {got}; {_HOW[kind]}"
            raise ValueError(msg)
    same_sensor([*kinds["dark"], *kinds["flat"]])
    flats = sorted(kinds["flat"], key=lambda c: conditions_of(c).exposure)
    top = _top([taps_of(c) for c in flats], saturation)
    dark = [reduced(c, 0.0, top, saturation) for c in kinds["dark"]]
    lit = [reduced(c, conditions_of(c).exposure, top, saturation) for c in flats]
    for level in (*dark, *lit):
        _refuse_saturated(level)
    _refuse_black(dark, lit)
    return dark, lit, top


_HOW = {
    "dark": "cover the lens, switch the light off and take one",
    "flat": "take an evenly lit surface at several exposures",
}


def taps_of(capture: Capture) -> Taps:
    """Taps of a capture, refused by name where it holds none.

    Parameters
    ----------
    capture : Capture
        Dark or flat.

    Returns
    -------
    Taps
        Its taps.

    Raises
    ------
    ValueError
        If it holds phasors or a depth only.
    """
    if capture.taps is None:
        msg = f"{name_of(capture)} holds no taps, which the response stage needs; store raw taps"
        raise ValueError(msg)
    return capture.taps


def declared_saturation(captures: Sequence[Capture]) -> float:
    """Raw level from which on taps are saturated, as the sensor or the captures say.

    Parameters
    ----------
    captures : sequence of Capture
        Captures with taps.

    Returns
    -------
    float
        The least of: the converter's last number, the full well, and the least brightest tap of
        pixels that captures mark as saturated; infinite if none of them is known.
    """
    found = [np.inf]
    for capture in captures:
        noise, taps = capture.sensor.noise, taps_of(capture)
        gain = 1.0 if taps.unit == "e-" else noise.gain_dn_per_e
        found += [noise.top_dn] if taps.unit == "DN" else []
        found += [noise.full_well_e * gain] if gain is not None else []
        lost = ~taps.valid & np.isfinite(taps.values).all(axis=(0, 1))
        brightest = taps.values.max(axis=(0, 1))
        # A pixel lost for another reason lies anywhere: only the bright end tells of saturation.
        high = brightest[lost & (brightest >= 0.95 * brightest[taps.valid].max(initial=0))]
        found += [float(np.percentile(high, 1))] if high.size >= 20 else []
    return float(min(found))


def reduced(capture: Capture, exposure: float, top: float, saturation: float) -> Level:
    """Levels of the nodes of one capture.

    Parameters
    ----------
    capture : Capture
        Dark or flat.
    exposure : float
        Relative exposure.
    top : float
        Raw level that counts as 1.
    saturation : float
        Raw level from which on a tap is saturated.

    Returns
    -------
    Level
        Its levels.

    Raises
    ------
    ValueError
        If the light is modulated and the taps of a node do not determine its offset.
    """
    taps, sensor = taps_of(capture), capture.sensor
    nodes = sensor.timing.taps_per_exposure
    values = taps.values.astype(np.float64) / top
    finite = np.isfinite(values).all(axis=(0, 1))
    ok = taps.valid & finite & (taps.values < saturation).all(axis=(0, 1))
    values = np.where(finite, values, 0.0)
    modulated = exposure > 0 and is_modulated(values, ok, sensor)
    weights = offset_weights(sensor, name_of(capture), modulated=modulated)
    moments = np.empty((ORDERS, nodes, *ok.shape))
    power = values.copy()
    for order in range(ORDERS):
        for n in range(nodes):
            moments[order, n] = np.einsum("fk,fkhw->hw", weights[n], power[:, n::nodes])
        power *= values
    return Level(name_of(capture), exposure, moments, ok, modulated, taps, _rounding(capture))


def _rounding(capture: Capture) -> F32 | np.float32:
    """As of `Level`: averaged frames and electrons are not rounded."""
    taps = taps_of(capture)
    if taps.unit == "e-" or (taps.values != np.round(taps.values)).any():
        return np.float32(0)
    return rounding_dn2(taps.values, capture.sensor.noise)


def _top(taps: Sequence[Taps], saturation: float) -> float:
    """Brightest level that flats reach below saturation: the 99.9th percentile."""
    top = 0.0
    for one in taps:
        seen = one.values[:, :, one.valid]
        seen = seen[np.isfinite(seen) & (seen < saturation)]
        top = max(top, float(np.percentile(seen, 99.9)) if seen.size else 0.0)
    return top if top > 0 else 1.0


def _refuse_saturated(level: Level) -> None:
    share = float(level.ok.mean())
    if share < USABLE_SHARE:
        how = "shorten its exposure" if level.exposure else "keep all light away"
        msg = f"{level.name} is saturated in {1 - share:.0%} of its pixels; {how} or leave it out"
        raise ValueError(msg)


def _refuse_black(dark: Sequence[Level], lit: Sequence[Level]) -> None:
    """A dark frame that is lit, or a flat at the dark level or far below what its like show."""
    seen = [float(np.median(level.moments[0])) for level in dark]
    base, brightest = min(seen), float(np.median(lit[-1].moments[0][:, lit[-1].ok]))
    for level, here in zip(dark, seen, strict=True):
        if here - base > max(0.05 * (brightest - base), 1e-6):
            msg = f"{level.name} is not dark: cover the lens, switch the light off, take it again"
            raise ValueError(msg)
    image = dark[0].moments[0]
    spread = 1.4826 * float(np.median(np.abs(image - np.median(image))))
    signals = [float(np.median(level.moments[0][:, level.ok])) - base for level in lit]
    typical = float(np.median([s / x.exposure for s, x in zip(signals, lit, strict=True)]))
    for level, signal in zip(lit, signals, strict=True):
        least = max(10 * spread / np.sqrt(image.size), 1e-6, 0.1 * typical * level.exposure)
        if not signal > least:
            msg = (
                f"{level.name} is black: it lies {signal / brightest:.2%} of the brightest level "
                f"above the dark one, where its exposure asks for "
                f"{typical * level.exposure / brightest:.2%}; light it, or leave it out"
            )
            raise ValueError(msg)
