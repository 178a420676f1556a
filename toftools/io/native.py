"""The capture file, version 1: HDF5 that any HDF5 viewer and MATLAB can open.

Layout (docs/conventions.md): attributes format, version, provenance; /sensor; and any of /taps,
/phasors, /sigma, /valid, /depth, /truth, /reported. Written atomically; nothing is unpickled.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from toftools.io._hdf5 import opened
from toftools.io._untrusted import check_datasets, json_object, read_sensor, text, whole
from toftools.io.atomic import atomic_path
from toftools.types import (
    F32,
    Capture,
    DepthMap,
    Phasors,
    PixelMaps,
    Sensor,
    Taps,
    Truth,
)

FORMAT, VERSION = "toftools-capture", 1
MAPS = ("gain", "dark_e", "phase_rad")
TRUTH_PARTS = {
    **dict.fromkeys(("direct", "one_bounce", "rest"), np.complex64),
    **dict.fromkeys(("normals", "albedo"), np.float32),
}
MESSAGE_LENGTH = 400  # an attribute may be as long as the file
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

    # In memory first: HDF5 itself crashes the process when the disk fills up under it. Headers of
    # version 1.8 carry checksums: HDF5 loops for ever on some flipped bits of the older ones.
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v108", "v108")) as file:
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
            *((f"truth/{name}", getattr(truth, name), {}) for name in TRUTH_PARTS),
        ]
    maps = capture.sensor.maps
    found += [(f"sensor/{name}", getattr(maps, name), {}) for name in MAPS if maps is not None]
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
        "emitters": [
            {**vars(item), "beam": None if item.beam is None else item.beam.tolist()}
            for item in sensor.emitters
        ],
        # JSON has no infinity: a full well without limit is left out.
        "noise": {key: value for key, value in vars(noise).items() if value != float("inf")},
        "defects": dict(vars(sensor.defects)),
        "timing": dict(vars(sensor.timing)),
        "harmonics_re": harmonics.real.tolist(),
        "harmonics_im": harmonics.imag.tolist(),
        # Files of pinholes stay as they were before there was a choice.
        **({} if camera.model == "pinhole" else {"camera_model": camera.model}),
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
    try:
        with opened(Path(path)) as file:
            return text(file.attrs.get("format", "")) == FORMAT
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
    path = Path(path)
    if not path.is_file():
        msg = f"no such file: {path}"
        raise ValueError(msg)
    try:
        with opened(path) as file:
            return _read(file)
    except (
        ValueError, OSError, RuntimeError, KeyError, TypeError, AttributeError, OverflowError,
        MemoryError,
    ) as error:  # fmt: skip
        detail = " ".join(str(error).strip("\"'").split())[:MESSAGE_LENGTH] or "damaged"
        msg = f"{path.name} is not a readable toftools capture: {detail}"
        raise ValueError(msg) from error


def _read(file: Any) -> Capture:  # noqa: ANN401 - h5py has no types
    if text(file.attrs.get("format", "")) != FORMAT:
        msg = f"wanted the attribute format={FORMAT!r}, got {file.attrs.get('format')!r}"
        raise ValueError(msg)
    if whole(file.attrs, "version") != VERSION:
        msg = f"got version {file.attrs['version']}, this toftools reads version {VERSION}"
        raise ValueError(msg)
    if "sensor" not in file:
        msg = "it has no group /sensor"
        raise ValueError(msg)
    provenance = json_object(file.attrs, "provenance")
    sensor = read_sensor(file["sensor"].attrs)
    check_datasets(file, sensor)
    if "gain" in file["sensor"]:
        maps = {name: _dataset(file, f"sensor/{name}", np.float64) for name in MAPS}
        sensor = replace(sensor, maps=PixelMaps(**maps))
    valid = _dataset(file, "valid", np.bool_)
    taps, phasors = _dataset(file, "taps", np.float32), _dataset(file, "phasors", np.complex64)
    unit = text(file["taps"].attrs.get("unit", "DN")) if taps is not None else "DN"
    truth = _dataset(file, "truth/range_m", np.float32)
    return Capture(
        sensor=sensor,
        taps=None if taps is None else Taps(taps, unit, valid),
        phasors=None
        if phasors is None
        else Phasors(phasors, _dataset(file, "sigma", np.float32), valid),
        depth=_read_depth(file),
        truth=None if truth is None else _read_truth(file, truth),
        reported={
            name: _dataset(file, f"reported/{name}", np.float32)
            for name in file.get("reported", ())
        },
        provenance=provenance,
    )


def _read_truth(file: Any, range_m: F32) -> Truth:  # noqa: ANN401
    parts = {name: _dataset(file, f"truth/{name}", kind) for name, kind in TRUTH_PARTS.items()}
    return Truth(range_m, **parts)


def _read_depth(file: Any) -> DepthMap | None:  # noqa: ANN401
    range_m = _dataset(file, "depth/range_m", np.float32)
    if range_m is None:
        return None
    extras = {
        name: _dataset(file, f"depth/{name}", np.float32)
        for name in ("sigma_m", "confidence", "amplitude")
    }
    return DepthMap(range_m, **extras)


def _dataset(file: Any, name: str, dtype: Any) -> Any:  # noqa: ANN401
    """One dataset as `dtype`, or None; `check_datasets` has looked at it."""
    if name not in file:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # 1e300 becomes infinite, so no answer
        return np.asarray(file[name][()], dtype=dtype)
