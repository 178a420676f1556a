"""Transient files of our own, version 1, as .npz or .h5: whole, checked, without pickles.

Both hold ``values`` (T, H, W) float32, ``start_m`` () or (H, W), ``missed`` (H, W) where counted,
and the attributes format, version, bin_m, box_m (m of whole optical path), unit and info. In a
.npz they are the JSON member ``toftools-transient.json``, which comes first, so that no reader of
ordinary archives takes the file for one; ``numpy.load`` still opens it.
"""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toftools.io._hdf5 import opened
from toftools.io._untrusted import json_object, text, whole
from toftools.io.atomic import atomic_path
from toftools.io.readers._file import existing_file, parsing
from toftools.io.stored import ERRORS, HDF5_MAGIC, ZIP_MAGIC, stored_arrays
from toftools.transient import Transient

FORMAT, VERSION = "toftools-transient", 1
META = f"{FORMAT}.json"
_NAMES = ("values", "start_m", "missed")
_MAX_META = 1 << 20
_SUFFIXES = (".npz", ".h5", ".hdf5")


def write_transient(path: Path | str, transient: Transient) -> None:
    """Write a transient file atomically.

    Parameters
    ----------
    path : path
        Target, ``*.npz`` or ``*.h5``.
    transient : Transient
        What to store.

    Raises
    ------
    ValueError
        If the name has another ending or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        msg = f"got {path.name}; a transient file is named *.npz or *.h5"
        raise ValueError(msg)
    meta = {"format": FORMAT, "version": VERSION, "bin_m": transient.bin_m,
            "box_m": transient.box_m, "unit": transient.unit,
            "info": json.dumps(dict(transient.info), default=str)}  # fmt: skip
    arrays = {name: getattr(transient, name) for name in _NAMES}
    arrays = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    write = _write_npz if path.suffix.lower() == ".npz" else _write_h5
    image = io.BytesIO()  # in memory first: HDF5 crashes the process when the disk fills up
    write(image, meta, arrays)
    with atomic_path(path) as temporary:
        temporary.write_bytes(image.getbuffer())


_Arrays = Mapping[str, np.ndarray[Any, Any]]


def _write_npz(image: io.BytesIO, meta: Mapping[str, Any], arrays: _Arrays) -> None:
    with zipfile.ZipFile(image, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_member(META), json.dumps(meta))
        for name, array in arrays.items():
            with archive.open(_member(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _member(name: str) -> zipfile.ZipInfo:
    """A member without a date, so that the same transient makes the same file."""
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_DEFLATED
    return info


def _write_h5(image: io.BytesIO, meta: Mapping[str, Any], arrays: _Arrays) -> None:
    import h5py

    # Headers of version 1.8 carry checksums, as in capture files.
    with h5py.File(image, "w", libver=("v108", "v108")) as file:
        file.attrs.update(meta)
        for name, array in arrays.items():
            packed = {"compression": "gzip", "shuffle": True} if array.ndim else {}
            file.create_dataset(name, data=array, **packed)


def is_transient(path: Path, head: bytes) -> bool:
    """Whether a file is a transient file of our own.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes.

    Returns
    -------
    bool
        True if so, whatever its name.
    """
    if head.startswith(ZIP_MAGIC):
        return head[30 : 30 + len(META)] == META.encode()
    if not head.startswith(HDF5_MAGIC):
        return False
    try:
        with opened(path) as file:
            return text(file.attrs.get("format", "")) == FORMAT
    except (*ERRORS, ValueError):
        return False


def read_transient(path: Path | str) -> Transient:
    """Read a transient file of our own, trusting nothing in it.

    Parameters
    ----------
    path : path
        File written by `write_transient`.

    Returns
    -------
    Transient
        Its content.

    Raises
    ------
    ValueError
        If the file is missing, damaged, or of another format or version.
    """
    path = existing_file(path)
    with parsing(path, FORMAT, *ERRORS):
        meta = _meta(path)
        arrays = stored_arrays(path, _NAMES)
        if text(meta.get("format", "")) != FORMAT or whole(meta, "version") != VERSION:
            msg = f"wanted {FORMAT} version {VERSION}, got {text(meta.get('format', ''))!r}"
            raise ValueError(msg)
        missing = {"values", "start_m"} - set(arrays)
        if missing or any(array.dtype.kind not in "iuf" for array in arrays.values()):
            msg = f"wanted real numbers in {', '.join(_NAMES)}, got {sorted(arrays)}"
            raise ValueError(msg)
        return Transient(
            bin_m=_number(meta, "bin_m"),
            box_m=_number(meta, "box_m"),
            unit=text(meta.get("unit", "")),
            info=json_object(meta, "info"),
            **arrays,
        )


def _meta(path: Path) -> Mapping[str, Any]:
    with path.open("rb") as file:
        zipped = file.read(4) == ZIP_MAGIC
    if not zipped:
        with opened(path) as file_h5:
            return dict(file_h5.attrs)
    with zipfile.ZipFile(path) as archive:
        if archive.getinfo(META).file_size > _MAX_META:
            msg = f"{META} claims {archive.getinfo(META).file_size} bytes"
            raise ValueError(msg)
        found = json.loads(archive.read(META))
    if not isinstance(found, dict):
        msg = f"{META} must be a JSON object, got {type(found).__name__}"
        raise ValueError(msg)
    return found


def _number(meta: Mapping[str, Any], name: str) -> float:
    value = np.asarray(meta.get(name, "nothing"))
    if value.size != 1 or value.dtype.kind not in "iuf":
        msg = f"{name} must be a number of metres, got {str(meta.get(name))[:40]!r}"
        raise ValueError(msg)
    return float(value.item())
