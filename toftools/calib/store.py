"""A chain on disk: JSON that a person can read, and beside it an .npz with the maps.

``cal.json`` holds what the camera is, every stage with its numbers, and the residuals of all
stages; arrays of more than `INLINE` numbers lie in ``cal.<hash>.npz``, named after its own content.
So a new pair of files never mixes with an old one: the archive is written first, then the JSON,
which appears whole or not at all, and only then the archive of the file it replaced goes. Nothing
is unpickled; only classes of `toftools.calib`, and of modules that the caller trusts, are made.
"""

import contextlib
import hashlib
import importlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.calib.chain import Chain
from toftools.calib.stage import Residual, Stage
from toftools.io.atomic import atomic_path
from toftools.io.stored import ERRORS, stored_arrays
from toftools.types import Camera

FORMAT, VERSION = "toftools-calibration", 1
UNITS = "SI: m, rad, Hz, degrees Celsius; errors are measured minus true"
INLINE = 64
"""Arrays of at most as many numbers stand in the JSON itself."""
HOME = "toftools.calib."
MAX_JSON = 1 << 26
SPECIAL = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
KINDS = {"f": np.float64, "i": np.int64, "b": np.bool_}


def save_chain(path: Path | str, chain: Chain) -> None:
    """Write a chain, whole or not at all.

    Parameters
    ----------
    path : path
        Target, ``*.json``; its arrays go beside it.
    chain : Chain
        What to write.

    Raises
    ------
    ValueError
        If the target is no ``.json``, cannot be written, or a stage holds what cannot be saved.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        msg = f"got {path.name}; a calibration is written as .json"
        raise ValueError(msg)
    arrays: dict[str, NDArray[Any]] = {}
    stages = [_packed(stage, f"{n}_{stage.slot}", arrays) for n, stage in enumerate(chain.stages)]
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "units": UNITS,
        "sensor": {
            "name": chain.sensor,
            "width": chain.width,
            "height": chain.height,
            "freqs_hz": chain.freqs_hz.tolist(),
        },
        "residuals": residual_table(chain),
        "notes": dict(chain.notes),
        "stages": stages,
    }
    old = _archive_of(path)
    if arrays:
        document["arrays"] = _write_arrays(path, arrays)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if old is not None and old != document.get("arrays", {}).get("file"):
        with contextlib.suppress(OSError):
            path.with_name(old).unlink()


def residual_table(chain: Chain) -> list[dict[str, Any]]:
    """Residuals of all stages, as plain JSON values.

    Parameters
    ----------
    chain : Chain
        Any chain.

    Returns
    -------
    list of dict
        A row per stage: stage, unit, before, after, held_out, noise, n, notes; None if unknown.
    """
    rows = []
    for stage in chain.stages:
        row = {"stage": stage.slot, **asdict(stage.residual)}
        unknown = (k for k, v in row.items() if isinstance(v, float) and not math.isfinite(v))
        rows.append({**row, **dict.fromkeys(unknown)})
    return rows


def _write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    image = io.BytesIO()
    np.savez_compressed(image, **arrays)  # type: ignore[arg-type]  # its stub takes a bool for one
    digest = hashlib.sha256(image.getbuffer()).hexdigest()
    name = f"{path.stem}.{digest[:12]}.npz"
    with atomic_path(path.with_name(name)) as temporary:
        temporary.write_bytes(image.getbuffer())
    return {"file": name, "sha256": digest}


def _archive_of(path: Path) -> str | None:
    """Name of the archive beside an existing calibration of ours."""
    try:
        name = _document(path).get("arrays", {}).get("file")
    except ValueError:
        return None
    own = isinstance(name, str) and name.startswith(f"{path.stem}.") and Path(name).name == name
    return name if own else None


def _packed(value: Any, place: str, arrays: dict[str, NDArray[Any]]) -> Any:  # noqa: ANN401
    """Plain JSON of a stage or one of its values; large arrays move to `arrays`."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | np.floating | np.integer):
        number = float(value)
        return number if math.isfinite(number) else {"number": repr(number)}
    if isinstance(value, tuple):
        return [_packed(item, f"{place}.{n}", arrays) for n, item in enumerate(value)]
    if isinstance(value, np.ndarray):
        return _packed_array(value, place, arrays)
    if is_dataclass(value) and not isinstance(value, type):
        named = {f.name: getattr(value, f.name) for f in fields(value)}
        content = {key: _packed(item, f"{place}.{key}", arrays) for key, item in named.items()}
        cls = type(value)
        return {"class": f"{cls.__module__}:{cls.__qualname__}".removeprefix(HOME), **content}
    msg = f"a stage holds a {type(value).__name__} at {place}, which cannot be saved"
    raise ValueError(msg)


def _packed_array(
    value: NDArray[Any], place: str, arrays: dict[str, NDArray[Any]]
) -> dict[str, Any]:
    kind = KINDS.get(value.dtype.kind)
    plain = kind is not None and value.dtype == kind and bool(np.isfinite(value).all())
    if plain and value.size <= INLINE:
        return {"array": value.tolist(), "shape": list(value.shape), "kind": value.dtype.kind}
    arrays[place] = value
    return {"stored": place}


def load_chain(path: Path | str, *, trusted: Sequence[str] = ()) -> Chain:
    """Read a chain, trusting nothing in it.

    Parameters
    ----------
    path : path
        ``*.json`` written by `save_chain`, with its ``.npz`` beside it.
    trusted : sequence of str
        Modules of a user's own stages that may be imported.

    Returns
    -------
    Chain
        What was saved, bit for bit.

    Raises
    ------
    ValueError
        If a file is missing, damaged, of another format or version, or holds what no stage takes.
    """
    path = Path(path)
    document = _document(path)
    try:
        arrays = _read_arrays(path, document)
        sensor = document["sensor"]
        stages = [_unpacked(item, arrays, tuple(trusted)) for item in document["stages"]]
        for stage in stages:
            if not isinstance(stage, Stage):
                msg = f"it holds a {type(stage).__name__}, which is no stage"
                raise ValueError(msg)
        return Chain(
            str(sensor["name"]),
            int(sensor["width"]),
            int(sensor["height"]),
            np.asarray(sensor["freqs_hz"], dtype=np.float64),
            tuple(stages),
            dict(document.get("notes", {})),
        )
    except (ValueError, *ERRORS) as error:
        detail = " ".join(str(error).strip("\"'").split())[:400] or type(error).__name__
        msg = f"{path.name} is not a readable calibration: {detail}"
        raise ValueError(msg) from error


def _document(path: Path) -> dict[str, Any]:
    """The JSON of a calibration, format and version checked."""
    try:
        if path.stat().st_size > MAX_JSON:
            msg = f"{path.name} is no calibration: it has {path.stat().st_size} bytes"
            raise ValueError(msg)
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        msg = f"cannot read the calibration {path}: {error.strerror or error}"
        raise ValueError(msg) from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        msg = f"{path.name} is no calibration: it is not JSON ({' '.join(str(error).split())})"
        raise ValueError(msg) from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        msg = f"{path.name} is no calibration: wanted a JSON object with format {FORMAT!r}"
        raise ValueError(msg)
    if document.get("version") != VERSION:
        msg = (
            f"{path.name} has version {document.get('version')!r} of the calibration format, this "
            f"toftools reads version {VERSION}"
        )
        raise ValueError(msg)
    return document


def _read_arrays(path: Path, document: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    told = document.get("arrays")
    if told is None:
        return {}
    name = told["file"]
    if not isinstance(name, str) or Path(name).name != name:
        msg = f"its arrays lie in {name!r}, wanted a file beside it"
        raise ValueError(msg)
    file = path.with_name(name)
    if not file.is_file():
        msg = f"the file {name} beside it is missing; copy both"
        raise ValueError(msg)
    if hashlib.sha256(file.read_bytes()).hexdigest() != told["sha256"]:
        msg = f"{name} is not the file that was saved with it; copy both again"
        raise ValueError(msg)
    return stored_arrays(file, _stored_names(document["stages"]))


def _stored_names(value: Any) -> list[str]:  # noqa: ANN401 - out of JSON
    if isinstance(value, list):
        return [name for item in value for name in _stored_names(item)]
    if isinstance(value, dict):
        if "stored" in value:
            return [str(value["stored"])]
        return [name for item in value.values() for name in _stored_names(item)]
    return []


def _unpacked(value: Any, arrays: Mapping[str, NDArray[Any]], trusted: tuple[str, ...]) -> Any:  # noqa: ANN401
    """The value that `_packed` made plain."""
    if isinstance(value, list):
        return tuple(_unpacked(item, arrays, trusted) for item in value)
    if not isinstance(value, dict):
        return value
    if "number" in value:
        return SPECIAL[value["number"]]
    if "stored" in value:
        return arrays[value["stored"]]
    if "array" in value:
        array: NDArray[Any] = np.asarray(value["array"], dtype=KINDS[value["kind"]])
        return array.reshape(value["shape"])
    content = {k: _unpacked(v, arrays, trusted) for k, v in value.items() if k != "class"}
    return _class(str(value.get("class")), trusted)(**content)


def _class(text: str, trusted: tuple[str, ...]) -> Any:  # noqa: ANN401 - a dataclass
    """A dataclass by name, out of toftools.calib, the types, or a trusted module."""
    for known in (Camera, Residual):
        if text == f"{known.__module__}:{known.__qualname__}".removeprefix(HOME):
            return known
    module, _, name = text.partition(":")
    own = not module.startswith(".") and all(part.isidentifier() for part in module.split("."))
    if module not in trusted:
        module = HOME + module
    if not own or not name.isidentifier():
        msg = f"it names the class {text!r}, which cannot be"
        raise ValueError(msg)
    try:
        found = getattr(importlib.import_module(module), name)
    except ImportError as error:
        msg = f"this toftools has no {text!r}; trust the module of a stage of your own by name"
        raise ValueError(msg) from error
    if not (isinstance(found, type) and is_dataclass(found)):
        msg = f"{text!r} is no stage"
        raise ValueError(msg)
    return found
