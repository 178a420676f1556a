"""Stages of one camera in their order, and their application to a capture.

Applied stage by stage here, which is the readable way; `toftools.calib.fused` does the same to
phasors in one pass.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from toftools._arrays import frozen, set_fields
from toftools.calib.stage import SLOTS, Stage
from toftools.conditions import name_of
from toftools.phasor import demodulate, phasors_of
from toftools.types import F64, Capture, Sensor
from toftools.units import check_freqs

MOST_PX = 65_536


@dataclass(frozen=True, eq=False)
class Chain:
    """Calibration of one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera.
    width, height : int
        Its image size, px.
    freqs_hz : ndarray, (F,)
        Its frequencies, Hz.
    stages : tuple of Stage
        At most one per slot, in the order of `SLOTS`.
    notes : mapping
        Where it comes from: files, versions, date (JSON values).
    """

    sensor: str
    width: int
    height: int
    freqs_hz: F64
    stages: tuple[Stage, ...] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        places = [SLOTS.index(stage.slot) for stage in self.stages]
        if any(later <= earlier for earlier, later in itertools.pairwise(places)):
            got = ", ".join(stage.slot for stage in self.stages)
            msg = f"stages must come once each in the order {', '.join(SLOTS)}; got {got}"
            raise ValueError(msg)
        freqs = frozen(check_freqs(self.freqs_hz), np.float64, "freqs_hz", 1)
        if not (0 < self.width <= MOST_PX and 0 < self.height <= MOST_PX):
            msg = f"a camera has 1..{MOST_PX} px a side, got {self.width} x {self.height}"
            raise ValueError(msg)
        set_fields(
            self,
            freqs_hz=freqs,
            stages=tuple(self.stages),
            notes=MappingProxyType(dict(self.notes)),
        )

    def stage(self, slot: str) -> Stage | None:
        """The stage in a slot, if there is one."""
        return next((stage for stage in self.stages if stage.slot == slot), None)

    def before(self, slot: str) -> "Chain":
        """The part of the chain that comes before a slot."""
        place = SLOTS.index(slot)
        kept = tuple(s for s in self.stages if SLOTS.index(s.slot) < place)
        return replace(self, stages=kept)

    def without(self, slot: str) -> "Chain":
        """The chain with one slot left out."""
        return replace(self, stages=tuple(s for s in self.stages if s.slot != slot))


def chain_for(sensor: Sensor) -> Chain:
    """A chain without stages for a camera.

    Parameters
    ----------
    sensor : Sensor
        The camera.

    Returns
    -------
    Chain
        Its name, size and frequencies.
    """
    camera = sensor.camera
    return Chain(sensor.name, camera.width, camera.height, sensor.modulation.freqs_hz)


def extended(chain: Chain, stage: Stage) -> Chain:
    """The chain with one more stage.

    Parameters
    ----------
    chain : Chain
        What has been calibrated so far.
    stage : Stage
        The next stage; it replaces one in the same slot.

    Returns
    -------
    Chain
        Longer chain.

    Raises
    ------
    ValueError
        If a later stage is there already: it was fitted without the new one.
    """
    check_order(chain, stage.slot)
    kept = [s for s in chain.stages if s.slot != stage.slot]
    stages = sorted([*kept, stage], key=lambda s: SLOTS.index(s.slot))
    return replace(chain, stages=tuple(stages))


def check_order(chain: Chain, slot: str) -> None:
    """Refuse a stage whose successors are there already, before any work is done for it.

    Parameters
    ----------
    chain : Chain
        What has been calibrated so far.
    slot : str
        Place of the new stage.

    Raises
    ------
    ValueError
        If a later stage was fitted without it.
    """
    place = SLOTS.index(slot)
    later = [s.slot for s in chain.stages if SLOTS.index(s.slot) > place and s.slot != "extrinsics"]
    if later:
        msg = (
            f"got {slot} after {later[0]}, which was fitted without it; calibrate in the order "
            f"{', '.join(SLOTS)}: start a new file, or fit {', '.join(later)} again after it"
        )
        raise ValueError(msg)


def applied(chain: Chain, capture: Capture) -> Capture:
    """A capture as a faultless camera would have taken it.

    Parameters
    ----------
    chain : Chain
        Calibration of its camera.
    capture : Capture
        Raw capture; its temperatures, if the chain needs them, lie in its conditions.

    Returns
    -------
    Capture
        Corrected phasors and optics; taps as the response stage leaves them. A depth of the
        camera's own stays as it is.

    Raises
    ------
    ValueError
        If the capture is of another camera, or does not say a temperature that the chain needs.
    """
    check_fits(chain, capture)
    sensor, taps = capture.sensor, capture.taps
    lens, response = chain.stage("lens"), chain.stage("response")
    if lens is not None:
        sensor = replace(sensor, camera=lens.camera)  # type: ignore[attr-defined]  # lens.Lens
    if response is not None and taps is not None:
        taps = response.on_taps(taps)  # type: ignore[attr-defined]  # response.Response
        phasors = demodulate(taps, sensor)
    else:
        phasors = phasors_of(capture)
    for stage in chain.stages:
        phasors = at_conditions(stage, capture)(phasors)
    told = [*capture.provenance.get("calibrated", ()), *(s.slot for s in chain.stages)]
    provenance = {**capture.provenance, "calibrated": told}
    return replace(capture, sensor=sensor, taps=taps, phasors=phasors, provenance=provenance)


def at_conditions(stage: Stage, capture: Capture) -> Stage:
    """A stage ready for one capture: temperature takes the temperatures of the capture.

    Parameters
    ----------
    stage : Stage
        Any stage.
    capture : Capture
        What it will correct.

    Returns
    -------
    Stage
        The stage itself, unless it depends on the conditions.

    Raises
    ------
    ValueError
        If the capture does not say a temperature that the stage needs.
    """
    if stage.slot != "temperature":
        return stage
    told = capture.provenance.get("conditions", {})
    found = {key: told.get(key) for key in ("sensor_c", "light_c")}
    missing = [k for k, v in found.items() if v is None or not math.isfinite(v)]
    needed = [key for key in missing if key in stage.needs]  # type: ignore[attr-defined]
    if needed:
        msg = (
            f"{name_of(capture)} does not say {' and '.join(needed)}, which the temperature stage "
            "needs; give --sensor-c and --light-c, or leave the stage out with --skip temperature"
        )
        raise ValueError(msg)
    given = {k: float(v) for k, v in found.items() if v is not None}
    return stage.at(**given)  # type: ignore[attr-defined,no-any-return]  # temperature.Temperature


def check_fits(chain: Chain, capture: Capture) -> None:
    """Refuse a capture of another camera.

    Parameters
    ----------
    chain : Chain
        Calibration.
    capture : Capture
        Capture.

    Raises
    ------
    ValueError
        If size or frequencies differ.
    """
    camera, freqs = capture.sensor.camera, capture.sensor.modulation.freqs_hz
    same = freqs.shape == chain.freqs_hz.shape and np.allclose(freqs, chain.freqs_hz, rtol=1e-6)
    if camera.shape != (chain.height, chain.width) or not same:
        msg = (
            f"{name_of(capture)} is of {camera.width} x {camera.height} px at {_mhz(freqs)} MHz, "
            f"the calibration of {chain.width} x {chain.height} px at {_mhz(chain.freqs_hz)}; "
            "use the calibration of this camera and mode"
        )
        raise ValueError(msg)


def skipping(chain: Chain, slots: Sequence[str]) -> Chain:
    """The chain without some of its slots.

    Parameters
    ----------
    chain : Chain
        Calibration.
    slots : sequence of str
        Names of slots.

    Returns
    -------
    Chain
        Shorter chain.

    Raises
    ------
    ValueError
        If a name is no slot.
    """
    for slot in slots:
        if slot not in SLOTS:
            msg = f"there is no stage {slot!r}; stages are {', '.join(SLOTS)}"
            raise ValueError(msg)
        chain = chain.without(slot)
    return chain


def _mhz(freqs_hz: F64) -> str:
    return " + ".join(f"{freq / 1e6:g}" for freq in freqs_hz)
