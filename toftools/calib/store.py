"""A chain on disk: JSON that a person can read, and beside it an .npz with the maps.

``cal.json`` holds what the camera is, every stage with its numbers, and the residuals of all
stages; arrays of more than `INLINE` numbers lie in ``cal.<hash>.npz``, named after its own content.
So a new pair of files never mixes with an old one: the archive is written first, then the JSON,
which appears whole or not at all, and only then the archive of the file it replaced goes, if no
other calibration in the folder names it. Nothing is unpickled; only classes of `toftools.calib`,
and of modules that the caller trusts, are made.
"""

import contextlib
import hashlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.calib._packing import packed, stored_names, unpacked
from toftools.calib.chain import Chain
from toftools.calib.stage import PhaseStage, Stage
from toftools.io.atomic import atomic_path
from toftools.io.stored import ERRORS, stored_arrays
from toftools.types import Phasors

FORMAT, VERSION = "toftools-calibration", 1
UNITS = "SI: m, rad, Hz, degrees Celsius; errors are measured minus true"
MAX_JSON = 1 << 26
MOST_RAD = 1e4
"""No stage takes off more phase than this."""


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
    path = Path(path).resolve()  # a link keeps pointing at what is replaced
    if path.suffix.lower() != ".json":
        msg = f"got {path.name}; a calibration is written as .json"
        raise ValueError(msg)
    refuse_foreign(path)
    arrays: dict[str, NDArray[Any]] = {}
    stages = [packed(stage, f"{n}_{stage.slot}", arrays) for n, stage in enumerate(chain.stages)]
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
    image = io.BytesIO()
    if arrays:
        np.savez_compressed(image, **arrays)  # type: ignore[arg-type]  # its stub takes a bool for one
        digest = hashlib.sha256(image.getbuffer()).hexdigest()
        document["arrays"] = {"file": f"{path.stem}.{digest[:12]}.npz", "sha256": digest}
    text = _text(document)
    old = _archive_of(path)
    if arrays:
        with atomic_path(path.with_name(document["arrays"]["file"])) as temporary:
            temporary.write_bytes(image.getbuffer())
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if old is not None and not _named_elsewhere(path, old):
        with contextlib.suppress(OSError):
            path.with_name(old).unlink()


def refuse_foreign(path: Path) -> None:
    """Refuse to replace a file that is no calibration.

    Parameters
    ----------
    path : Path
        Target.

    Raises
    ------
    ValueError
        If something else stands there.
    """
    if not path.is_file():
        return
    try:
        _document(path)
    except ValueError as error:
        msg = f"{path.name} is there already and no calibration of this version; choose another"
        raise ValueError(f"{msg} name, or remove it") from error


def _text(document: Mapping[str, Any]) -> str:
    try:
        return json.dumps(document, indent=1, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        msg = f"the calibration holds what JSON cannot: {error}; nothing was written"
        raise ValueError(msg) from error


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


def _archive_of(path: Path) -> str | None:
    """Name of the archive that the calibration at a path wrote, and nothing else."""
    try:
        told = _document(path).get("arrays")
    except ValueError:
        return None
    if not isinstance(told, dict):
        return None
    name, digest = told.get("file"), told.get("sha256")
    if name != f"{path.stem}.{str(digest)[:12]}.npz" or not path.with_name(name).is_file():
        return None
    content = path.with_name(name).read_bytes()
    return name if hashlib.sha256(content).hexdigest() == digest else None


def _named_elsewhere(path: Path, archive: str) -> bool:
    """Whether a calibration in the folder names an archive: the new one, or a copy of the old."""
    for other in path.parent.glob("*.json"):
        try:
            told = _document(other).get("arrays")
        except ValueError:
            continue
        if isinstance(told, dict) and told.get("file") == archive:
            return True
    return False


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
        stages = [unpacked(item, arrays, tuple(trusted)) for item in document["stages"]]
        for stage in stages:
            if not isinstance(stage, Stage):
                msg = f"it holds a {type(stage).__name__}, which is no stage"
                raise ValueError(msg)
        chain = Chain(
            str(sensor["name"]),
            int(sensor["width"]),
            int(sensor["height"]),
            np.asarray(sensor["freqs_hz"], dtype=np.float64),
            tuple(stages),
            dict(document.get("notes", {})),
        )
        for stage in stages:
            _check_stage(stage, chain)
        return chain
    except (ValueError, *ERRORS) as error:
        told = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        detail = " ".join(told.split())[:400] or type(error).__name__
        msg = f"{path.name} is not a readable calibration: {detail}"
        raise ValueError(msg) from error


def _document(path: Path) -> dict[str, Any]:
    """The JSON of a calibration, format and version checked."""
    try:
        if path.stat().st_size > MAX_JSON:
            msg = f"of {path.stat().st_size} bytes"
            raise ValueError(msg)
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        msg = f"cannot read the calibration {path}: {error.strerror or error}"
        raise ValueError(msg) from error
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        msg = (
            f"{path.name} is no calibration: it is not JSON ({' '.join(str(error).split())[:200]})"
        )
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
    return stored_arrays(file, stored_names(document["stages"]))


def _check_stage(stage: Stage, chain: Chain) -> None:
    """Refuse a stage that is not of the camera of its chain."""
    shape, freqs = (chain.height, chain.width), chain.freqs_hz
    told = getattr(stage, "freqs_hz", freqs)
    camera = getattr(stage, "camera", None)
    if np.shape(told) != freqs.shape or not np.allclose(told, freqs, rtol=1e-6):
        msg = f"its {stage.slot} is of {np.asarray(told).tolist()} Hz, wanted {freqs.tolist()}"
        raise ValueError(msg)
    if stage.slot == "lens" and camera is not None and camera.shape != shape:
        msg = f"its lens is of {camera.width} x {camera.height} px, wanted {shape[1]} x {shape[0]}"
        raise ValueError(msg)
    if stage.slot == "response":
        stage(Phasors(np.ones((freqs.size, *shape), np.complex64)))
    if isinstance(stage, PhaseStage) and stage.slot != "temperature":
        grid = np.zeros((freqs.size, 1, 1))
        error = np.asarray(stage.error_rad(grid, grid + 1))
        whole = (freqs.size, *shape)
        fits = error.ndim == 3 and all(a in (1, b) for a, b in zip(error.shape, whole, strict=True))
        if not fits or np.nanmax(np.abs(error), initial=0.0) > MOST_RAD:
            msg = f"its {stage.slot} is of shape {error.shape}, or takes off absurd phases"
            raise ValueError(msg)
