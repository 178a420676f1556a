"""The capture file, version 1: HDF5 that any HDF5 viewer and MATLAB can open.

Layout (docs/conventions.md): attributes format, version, provenance; /sensor; and any of /taps,
/phasors, /sigma, /valid, /depth, /truth, /reported. Written atomically; nothing is unpickled.
"""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toftools.io.atomic import atomic_path
from toftools.types import (
    Camera,
    Capture,
    DepthMap,
    Modulation,
    Noise,
    Phasors,
    Sensor,
    Taps,
    Truth,
)

FORMAT, VERSION = "toftools-capture", 1
MAX_ELEMENTS = 1 << 29  # 2 GiB of float32: more is a hostile header, not a frame
_COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


def write_capture(path: Path | str, capture: Capture) -> None:
    """Write a capture file atomically.

    Parameters
    ----------
    path : path
        Target, usually ``*.h5``.
    capture : Capture
        What to store.

    Raises
    ------
    ValueError
        If the file cannot be written.
    """
    import h5py

    # In memory first: HDF5 itself crashes the process when the disk fills up under it.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        file.attrs.update(format=FORMAT, version=VERSION, provenance=_dump(capture.provenance))
        _write_sensor(file.create_group("sensor"), capture.sensor)
        for name, array, attrs in _arrays(capture):
            compress = _COMPRESSION if array.ndim else {}
            dataset = file.create_dataset(name, data=array, **compress)
            dataset.attrs.update(attrs)
    with atomic_path(path) as temporary:
        temporary.write_bytes(image.getbuffer())


def _arrays(capture: Capture) -> list[tuple[str, np.ndarray[Any, Any], dict[str, str]]]:
    """Datasets of a capture: name, array, attributes."""
    taps, phasors, depth, truth = capture.taps, capture.phasors, capture.depth, capture.truth
    found: list[tuple[str, Any, dict[str, str]]] = []
    if taps is not None:
        whole = taps.unit == "DN" and _is_uint16(taps.values)
        found.append(
            ("taps", taps.values.astype(np.uint16) if whole else taps.values, {"unit": taps.unit})
        )
    if phasors is not None:
        found += [("phasors", phasors.values, {}), ("sigma", phasors.sigma, {})]
    source = phasors if phasors is not None else taps
    if source is not None and not source.valid.all():
        found.append(("valid", source.valid, {}))
    if depth is not None:
        metre = {"unit": "m"}
        found += [
            ("depth/range_m", depth.range_m, metre),
            ("depth/sigma_m", depth.sigma_m, metre),
            ("depth/confidence", depth.confidence, {}),
            ("depth/amplitude", depth.amplitude, {}),
        ]
    if truth is not None:
        found += [
            ("truth/range_m", truth.range_m, {"unit": "m"}),
            ("truth/direct", truth.direct, {}),
        ]
    found += [
        (f"reported/{name}", array, {"unit": "m"}) for name, array in capture.reported.items()
    ]
    return [(name, array, attrs) for name, array, attrs in found if array is not None]


def _is_uint16(values: np.ndarray[Any, Any]) -> bool:
    finite = bool(np.isfinite(values).all())
    return finite and bool(
        ((values >= 0) & (values <= 65_535) & (values == np.round(values))).all()
    )


def _dump(value: Mapping[str, Any]) -> str:
    return json.dumps(dict(value), default=str)


def _write_sensor(group: Any, sensor: Sensor) -> None:  # noqa: ANN401 - h5py has no types
    camera, mod, noise = sensor.camera, sensor.modulation, sensor.noise
    harmonics = mod.harmonics if mod.harmonics is not None else np.ones((mod.n_freqs, 1))
    extra = {
        "name": sensor.name,
        "emitter_offset_m": list(sensor.emitter_offset_m),
        # JSON has no infinity: a full well without limit is left out.
        "noise": {
            key: value
            for key in Noise.__dataclass_fields__
            if (value := getattr(noise, key)) != float("inf")
        },
        "harmonics_re": harmonics.real.tolist(),
        "harmonics_im": harmonics.imag.tolist(),
    }
    group.attrs.update(
        width=camera.width,
        height=camera.height,
        K=camera.K,
        dist=camera.dist,
        freqs_hz=mod.freqs_hz,
        steps_rad=mod.steps_rad,
        extra=json.dumps(extra),
    )


def is_capture(path: Path | str) -> bool:
    """Whether a file is a toftools capture, whatever its name.

    Parameters
    ----------
    path : path
        File to look at.

    Returns
    -------
    bool
        True if it is HDF5 with our format attribute.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return _text(file.attrs.get("format", "")) == FORMAT
    except (OSError, RuntimeError, KeyError, ValueError, UnicodeDecodeError, TypeError):
        return False


def read_capture(path: Path | str) -> Capture:
    """Read a capture file, trusting nothing in it.

    Parameters
    ----------
    path : path
        File written by `write_capture` or by another program after docs/conventions.md.

    Returns
    -------
    Capture
        Its content.

    Raises
    ------
    ValueError
        If the file is missing, truncated, of another format or version, or inconsistent.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        msg = f"no such file: {path}"
        raise ValueError(msg)
    try:
        with h5py.File(path, "r") as file:
            return _read(file)
    except ValueError as error:
        msg = f"{path.name} is not a readable toftools capture: {error}"
        raise ValueError(msg) from error
    except (OSError, RuntimeError, KeyError, TypeError, AttributeError, MemoryError) as error:
        detail = str(error).strip("\"'").splitlines() or ["damaged"]
        msg = f"{path.name} is not a readable toftools capture: {detail[0]}"
        raise ValueError(msg) from error


def _read(file: Any) -> Capture:  # noqa: ANN401 - h5py has no types
    if _text(file.attrs.get("format", "")) != FORMAT:
        msg = f"wanted the attribute format={FORMAT!r}, got {file.attrs.get('format')!r}"
        raise ValueError(msg)
    if int(file.attrs.get("version", -1)) != VERSION:
        msg = f"got version {file.attrs.get('version')}, this toftools reads version {VERSION}"
        raise ValueError(msg)
    provenance = json.loads(_text(file.attrs.get("provenance", "{}")))
    if not isinstance(provenance, dict):
        msg = "provenance must be a JSON object"
        raise ValueError(msg)
    valid = _dataset(file, "valid", np.bool_)
    taps, phasors = _dataset(file, "taps", np.float32), _dataset(file, "phasors", np.complex64)
    unit = _text(file["taps"].attrs.get("unit", "DN")) if taps is not None else "DN"
    truth = _dataset(file, "truth/range_m", np.float32)
    reported = file.get("reported", {})
    return Capture(
        sensor=_read_sensor(file["sensor"].attrs),
        taps=None if taps is None else Taps(taps, unit, valid),
        phasors=None
        if phasors is None
        else Phasors(phasors, _dataset(file, "sigma", np.float32), valid),
        depth=_read_depth(file),
        truth=None if truth is None else Truth(truth, _dataset(file, "truth/direct", np.complex64)),
        reported={name: _dataset(reported, name, np.float32) for name in reported},
        provenance=provenance,
    )


def _read_depth(file: Any) -> DepthMap | None:  # noqa: ANN401
    range_m = _dataset(file, "depth/range_m", np.float32)
    if range_m is None:
        return None
    extras = {
        name: _dataset(file, f"depth/{name}", np.float32)
        for name in ("sigma_m", "confidence", "amplitude")
    }
    return DepthMap(range_m, **extras)


def _dataset(group: Any, name: str, dtype: Any) -> Any:  # noqa: ANN401
    """One dataset as `dtype`, or None; its declared size is checked before it is read."""
    if name not in group:
        return None
    dataset = group[name]
    shape = getattr(dataset, "shape", None)
    if shape is None:
        msg = f"/{name} must be a dataset, got a group"
        raise ValueError(msg)
    if int(np.prod(shape, dtype=object)) > MAX_ELEMENTS:
        msg = f"/{name} claims shape {shape}, more than {MAX_ELEMENTS} elements"
        raise ValueError(msg)
    if dataset.dtype.kind not in "buifc":
        msg = f"/{name} must hold numbers, got {dataset.dtype}"
        raise ValueError(msg)
    if dataset.dtype.kind == "c" and np.dtype(dtype).kind != "c":
        msg = f"/{name} must be real, got {dataset.dtype}"
        raise ValueError(msg)
    return np.asarray(dataset[()], dtype=dtype)


def _read_sensor(attrs: Any) -> Sensor:  # noqa: ANN401
    extra = json.loads(_text(attrs.get("extra", "{}")))
    harmonics = None
    if "harmonics_re" in extra:
        harmonics = np.asarray(extra["harmonics_re"]) + 1j * np.asarray(extra["harmonics_im"])
    noise = {key: val for key, val in extra.get("noise", {}).items()
             if key in Noise.__dataclass_fields__}  # fmt: skip
    return Sensor(
        camera=Camera(
            int(attrs["width"]), int(attrs["height"]), attrs["K"], attrs.get("dist", np.zeros(0))
        ),
        modulation=Modulation(attrs["freqs_hz"], attrs["steps_rad"], harmonics),
        noise=Noise(**noise),
        emitter_offset_m=tuple(extra.get("emitter_offset_m", (0.0, 0.0, 0.0))),
        name=str(extra.get("name", "custom")),
    )


def _text(value: Any) -> str:  # noqa: ANN401
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)
