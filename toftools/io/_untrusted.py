"""What a capture file claims, checked before anything of its size is read.

A header is cheap to forge: every dataset must have the shape that /sensor implies, lie in the file
itself, and not claim more bytes than a file of its length can hold (deflate packs at most 1032
to 1: J. Gailly and M. Adler, zlib technical details).
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from toftools._overrides import DEFECT_KEYS, NOISE_KEYS, TIMING_KEYS
from toftools._params import checked_params
from toftools.types import (
    F64,
    Camera,
    Defects,
    Emitter,
    Modulation,
    Noise,
    Sensor,
    Timing,
)

MAX_ELEMENTS = 1 << 29  # of all datasets: more is a hostile header, not a frame
MAX_RATIO = 1032
SMALL_BYTES = 1 << 20  # never too much, however short the file: unwritten chunks take no space


def text(value: Any) -> str:  # noqa: ANN401 - whatever an attribute holds
    """Text of an attribute."""
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def whole(attrs: Any, name: str) -> int:  # noqa: ANN401 - h5py has no types
    """A whole number out of an attribute."""
    if name not in attrs:
        msg = f"the attribute {name!r} is missing"
        raise ValueError(msg)
    value = np.asarray(attrs[name])
    if value.size != 1 or value.dtype.kind not in "iuf" or not float(value.item()).is_integer():
        msg = f"{name} must be a whole number, got {attrs[name]!r}"
        raise ValueError(msg)
    return int(value.item())


def json_object(attrs: Any, name: str) -> dict[str, Any]:  # noqa: ANN401
    """A JSON object out of an attribute; empty if there is none."""
    value = json.loads(text(attrs.get(name, "{}")))
    if not isinstance(value, dict):
        msg = f"{name} must be a JSON object, got {type(value).__name__}"
        raise ValueError(msg)
    return value


def _finite(value: Any, what: str) -> F64:  # noqa: ANN401 - out of JSON
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        msg = f"{what} must hold numbers: {error}"
        raise ValueError(msg) from error
    if not np.isfinite(numbers).all():
        msg = f"{what} must hold finite numbers"
        raise ValueError(msg)
    return numbers


MAX_EMITTERS = 64
PHASOR_TRUTHS = ("truth/direct", "truth/one_bounce", "truth/rest")


def _read_emitter(item: Any) -> Emitter:  # noqa: ANN401
    if not isinstance(item, dict):
        msg = f"emitters must be JSON objects, got {type(item).__name__}"
        raise ValueError(msg)
    known = {"strength": 1.0, "modulated": True, "delay_s": 0.0}
    offset = _finite(item.get("offset_m", (0.0, 0.0, 0.0)), "offset_m")
    beam = item.get("beam")
    return Emitter(
        offset_m=tuple(offset.ravel().tolist()),  # type: ignore[arg-type]  # it checks for three
        beam=None if beam is None else _finite(beam, "beam"),
        **checked_params("emitter", known, {key: item[key] for key in known if key in item}),
    )


def _known(extra: dict[str, Any], name: str, keys: Mapping[str, Any]) -> dict[str, Any]:
    """The known keys of a JSON object within `extra`, of the kind of their typical values."""
    found = extra.get(name, {})
    if not isinstance(found, dict):
        msg = f"{name} must be a JSON object, got {type(found).__name__}"
        raise ValueError(msg)
    return checked_params(name, keys, {k: found[k] for k in keys if found.get(k) is not None})


def _camera_model(extra: dict[str, Any]) -> str:
    """The lens model, which files of pinholes do not name."""
    model = extra.get("camera_model", "pinhole")
    if not isinstance(model, str):
        msg = f"camera_model must be a word, got {type(model).__name__}"
        raise ValueError(msg)
    return model


def read_sensor(attrs: Any) -> Sensor:  # noqa: ANN401
    """The sensor of a capture file.

    Parameters
    ----------
    attrs : mapping
        Attributes of /sensor.

    Returns
    -------
    Sensor
        Checked sensor.

    Raises
    ------
    ValueError
        If an attribute is missing or not what it should be.
    """
    extra = json_object(attrs, "extra")
    harmonics = None
    if "harmonics_re" in extra:
        parts = [_finite(extra.get(name), name) for name in ("harmonics_re", "harmonics_im")]
        harmonics = parts[0] + 1j * parts[1]
    offset = _finite(extra.get("emitter_offset_m", (0.0, 0.0, 0.0)), "emitter_offset_m")
    if offset.shape != (3,):
        msg = f"emitter_offset_m must be three metres, got shape {offset.shape}"
        raise ValueError(msg)
    emitters = extra.get("emitters", [])
    if not isinstance(emitters, list) or len(emitters) > MAX_EMITTERS:
        msg = f"emitters must be a list of at most {MAX_EMITTERS}, got {type(emitters).__name__}"
        raise ValueError(msg)
    missing = {"K", "freqs_hz", "steps_rad"} - set(attrs)
    if missing:
        msg = f"/sensor lacks the attribute {min(missing)}"
        raise ValueError(msg)
    dist = attrs.get("dist", np.zeros(0))
    return Sensor(
        camera=Camera(
            whole(attrs, "width"), whole(attrs, "height"), attrs["K"], dist, _camera_model(extra)
        ),
        modulation=Modulation(attrs["freqs_hz"], attrs["steps_rad"], harmonics),
        noise=Noise(**_known(extra, "noise", {**NOISE_KEYS, "codes_dn": (0.0,)})),
        defects=Defects(**_known(extra, "defects", DEFECT_KEYS)),
        timing=Timing(**_known(extra, "timing", TIMING_KEYS)),
        emitter_offset_m=(offset[0], offset[1], offset[2]),
        emitters=tuple(_read_emitter(item) for item in emitters),
        name=str(extra.get("name", "custom")),
    )


def check_datasets(file: Any, sensor: Sensor) -> None:  # noqa: ANN401
    """Refuse datasets of the wrong kind, shape or size; nothing of them is read.

    Parameters
    ----------
    file : h5py.File
        The open capture file.
    sensor : Sensor
        Its sensor, which says what shapes there can be.

    Raises
    ------
    ValueError
        If a dataset is not what the layout says, or claims more than the file can hold.
    """
    shape, mod = sensor.camera.shape, sensor.modulation
    layers = (mod.n_freqs, *shape)
    nodes = (sensor.timing.taps_per_exposure, *shape)
    expected = {
        **{"sensor/gain": nodes, "sensor/dark_e": nodes, "sensor/phase_rad": layers},
        "taps": (mod.n_freqs, mod.n_taps, *shape),
        **dict.fromkeys(("phasors", "sigma", *PHASOR_TRUTHS), layers),
        **{"truth/normals": (*shape, 3), "truth/albedo": shape},
        **dict.fromkeys(("valid", "truth/range_m", "depth/range_m", "depth/sigma_m"), shape),
        **dict.fromkeys(("depth/confidence", "depth/amplitude"), shape),
    }
    if "reported" in file:
        if not hasattr(file["reported"], "keys"):
            msg = "/reported must be a group, got a dataset"
            raise ValueError(msg)
        expected |= {f"reported/{name}": shape for name in file["reported"]}
    elements = claimed = stored = 0
    for name, wanted in expected.items():
        if name not in file:
            continue
        dataset = file[name]
        _check_dataset(dataset, name, wanted, file.filename)
        elements += int(np.prod(wanted, dtype=object))
        claimed += int(np.prod(wanted, dtype=object)) * dataset.dtype.itemsize
        stored += dataset.id.get_storage_size()
    size = file.id.get_filesize()
    # One dataset under many names is stored once, but counts under each.
    fits = stored <= size and claimed <= max(MAX_RATIO * stored, SMALL_BYTES)
    if elements > MAX_ELEMENTS or not fits:
        msg = f"its datasets claim {claimed} bytes, more than a file of {size} bytes can hold"
        raise ValueError(msg)


def _check_dataset(dataset: Any, name: str, wanted: tuple[int, ...], filename: str) -> None:  # noqa: ANN401
    found = getattr(dataset, "shape", None)
    if found is None:
        msg = f"/{name} must be a dataset with {len(wanted)} dimensions"
        raise ValueError(msg)
    if dataset.file.filename != filename or dataset.is_virtual or dataset.external:
        msg = f"/{name} must lie in the file itself, got a link to another"
        raise ValueError(msg)
    if found != wanted:
        msg = f"/{name} must have shape {wanted} after /sensor, got {found}"
        raise ValueError(msg)
    real = name not in ("phasors", *PHASOR_TRUTHS)
    if dataset.dtype.kind not in ("buif" if real else "buifc"):
        kind = "real numbers" if real else "numbers"
        msg = f"/{name} must hold {kind}, got {dataset.dtype}"
        raise ValueError(msg)
