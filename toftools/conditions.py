"""Under what conditions a calibration capture was taken, and the range it should have read.

Conditions travel in the capture's provenance under ``conditions``, as plain JSON, so that the
capture file stays as it is and any tool can write them. A target is a plane: it meets the optical
axis at `distance_m` (axial z) and faces the camera along `normal`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from toftools._arrays import F64, set_fields
from toftools._params import checked_params
from toftools.camera import rays
from toftools.types import Capture
from toftools.units import time_to_path

MOST_M, MOST_DELAY_S = 100.0, 1e-6
"""No bench is longer, and no delay line; larger numbers are in other units."""
KINDS: Mapping[str, str] = {
    "board": "a chessboard or ChArUco board, for the lens",
    "dark": "no light at all, for the response",
    "flat": "an evenly lit surface at several exposures, for the response",
    "rail": "a plane at known distances, for wiggling",
    "delay": "a plane that stands still while an electronic delay moves the phase, for wiggling",
    "wall": "a flat wall at a known distance, for common phase and fixed pattern",
    "gray": "planes of several brightnesses at known distances, for the amplitude error",
    "warmup": "a plane at a known distance while the camera warms up, for temperature",
    "check": "planes at known distances that no stage may see, for the verdict",
}
"""What a capture is good for, and that in words."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """What the bench knew when a capture was taken.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    distance_m : float
        Axial distance z of the target plane where it meets the optical axis, m; NaN if unknown.
    normal : tuple of 3 floats
        Normal of that plane in the camera frame, towards the camera; need not be a unit vector.
    delay_s : float
        Electronic delay of the modulation that adds to the way of the light, s.
    sensor_c, light_c : float
        Temperature of the sensor and of the light source, degrees Celsius; NaN if unknown.
    exposure : float
        Charge collected relative to the other captures of its kind from the same light.
    reference : str
        Where the true range comes from: ``plane`` (the fields above) or ``depth`` (the range that
        the capture file holds as the camera's own).

    Examples
    --------
    >>> Conditions("wall", distance_m=2.0).known
    True
    """

    kind: str
    distance_m: float = math.nan
    normal: tuple[float, float, float] = (0.0, 0.0, -1.0)
    delay_s: float = 0.0
    sensor_c: float = math.nan
    light_c: float = math.nan
    exposure: float = 1.0
    reference: str = "plane"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            msg = f"got the kind {self.kind!r}; wanted one of {', '.join(KINDS)}"
            raise ValueError(msg)
        if self.reference not in ("plane", "depth"):
            msg = f"got the reference {self.reference!r}; wanted plane or depth"
            raise ValueError(msg)
        normal = tuple(float(x) for x in self.normal)
        if len(normal) != 3 or not np.isfinite(normal).all() or not normal[2] < 0:
            msg = f"normal must be three numbers with z < 0, towards the camera, got {self.normal}"
            raise ValueError(msg)
        set_fields(self, normal=normal)
        if self.distance_m <= 0 or math.isinf(self.distance_m) or not math.isfinite(self.delay_s):
            msg = (
                "distance_m must be positive metres and delay_s finite seconds, "
                f"got {self.distance_m} and {self.delay_s}"
            )
            raise ValueError(msg)
        if self.distance_m > MOST_M or abs(self.delay_s) > MOST_DELAY_S:
            msg = (
                f"distance_m is in metres and delay_s in seconds, at most {MOST_M:g} and "
                f"{MOST_DELAY_S:g}; got {self.distance_m:g} and {self.delay_s:g}: check the units"
            )
            raise ValueError(msg)
        for name in ("sensor_c", "light_c"):
            value = getattr(self, name)
            if not math.isnan(value) and not -100 <= value <= 250:
                msg = f"{name} must be degrees Celsius, got {value}"
                raise ValueError(msg)
        if not 0 < self.exposure < math.inf:
            msg = f"exposure must be a positive number, got {self.exposure}"
            raise ValueError(msg)

    @property
    def known(self) -> bool:
        """Whether the true range follows from these conditions alone."""
        return math.isfinite(self.distance_m)

    @property
    def warm(self) -> bool:
        """Whether both temperatures are known."""
        return math.isfinite(self.sensor_c) and math.isfinite(self.light_c)


DEFAULTS = {field.name: field.default for field in fields(Conditions) if field.name != "kind"}


def conditions_of(capture: Capture) -> Conditions:
    """Conditions that a capture carries.

    Parameters
    ----------
    capture : Capture
        Capture with ``provenance["conditions"]``.

    Returns
    -------
    Conditions
        Checked conditions.

    Raises
    ------
    ValueError
        If it carries none, or broken ones; the sentence names the capture.
    """
    told = capture.provenance.get("conditions")
    if not isinstance(told, Mapping) or "kind" not in told:
        msg = (
            f"{name_of(capture)} does not say under what conditions it was taken; "
            "wanted a line for it in conditions.csv"
        )
        raise ValueError(msg)
    try:
        given = {key: value for key, value in told.items() if key != "kind" and value is not None}
        return Conditions(str(told["kind"]), **checked_params("conditions", DEFAULTS, given))
    except ValueError as error:
        msg = f"{name_of(capture)}: {error}"
        raise ValueError(msg) from error


def with_conditions(capture: Capture, conditions: Conditions, *, file: str = "") -> Capture:
    """The same capture with conditions, and a name for messages.

    Parameters
    ----------
    capture : Capture
        Any capture.
    conditions : Conditions
        Conditions; unknown ones are left out.
    file : str
        Name of its file; empty keeps what it has.

    Returns
    -------
    Capture
        Copy whose provenance holds both.
    """
    told: dict[str, Any] = {}
    for key, value in asdict(conditions).items():
        if not (isinstance(value, float) and math.isnan(value)):
            told[key] = list(value) if isinstance(value, tuple) else value
    provenance = {**capture.provenance, "conditions": told}
    if file:
        provenance["file"] = file
    return replace(capture, provenance=provenance)


def name_of(capture: Capture) -> str:
    """File name of a capture, for messages.

    Parameters
    ----------
    capture : Capture
        Any capture.

    Returns
    -------
    str
        Name, or ``the capture`` where none is known.
    """
    return str(capture.provenance.get("file") or "the capture")


def expected_range_m(capture: Capture) -> F64:
    """The range that a faultless camera would have read: half the way of the light.

    Parameters
    ----------
    capture : Capture
        Capture with conditions.

    Returns
    -------
    ndarray, (H, W)
        Half of the way from the emitter over the target to the camera, electronic delay included,
        m; for an emitter at the camera centre this is the radial range. NaN where unknown.

    Raises
    ------
    ValueError
        If the conditions do not say the distance.
    """
    conditions, name = conditions_of(capture), name_of(capture)
    delay_m = float(time_to_path(conditions.delay_s)) / 2
    if conditions.reference == "depth":
        if capture.depth is None:
            msg = f"{name} holds no depth to serve as reference; give distance_m instead"
            raise ValueError(msg)
        return np.asarray(capture.depth.range_m + delay_m, dtype=np.float64)
    if not conditions.known:
        msg = f"{name} does not say how far its target was; add distance_m (metres, along the axis)"
        raise ValueError(msg)
    directions = rays(capture.sensor.camera)  # (H, W, 3)
    normal = np.asarray(conditions.normal)
    slope = directions @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.where(slope < 0, conditions.distance_m * normal[2] / slope, np.nan)
    offset = np.asarray(capture.sensor.emitter_offset_m)
    if offset.any():
        way = np.linalg.norm(directions * range_m[..., None] - offset, axis=-1)
        range_m = (range_m + way) / 2
    return np.asarray(range_m + delay_m)
