"""Arrays by name out of .npz, .npy and HDF5 files that nobody vouches for.

The kind is told from the first bytes. Every claimed size is held against what the file can hold
and against `MAX_BYTES` before anything is inflated; objects are never unpickled.
"""

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from toftools.io._hdf5 import opened
from toftools.io._untrusted import MAX_RATIO, SMALL_BYTES
from toftools.io.readers._npy import MAGIC as NPY_MAGIC
from toftools.io.readers._npy import read_npy

MAX_BYTES = 1 << 31
ZIP_MAGIC, HDF5_MAGIC = b"PK\x03\x04", b"\x89HDF\r\n\x1a\n"
ERRORS = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, KeyError, TypeError,
          AttributeError, OverflowError, NotImplementedError, MemoryError)  # fmt: skip
"""What the libraries raise on damaged files, besides ValueError."""


def stored_arrays(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """The arrays of these names that a file holds; a .npy file holds the first one.

    Parameters
    ----------
    path : Path
        File.
    names : iterable of str
        Array or dataset names; others are not looked at.

    Returns
    -------
    dict of str to ndarray
        Read-only numbers; names that the file does not have are left out.

    Raises
    ------
    ValueError
        If the file is of another kind, or an array is not plain numbers or too large. Damaged
        files raise any of `ERRORS`.
    """
    names = list(names)
    with path.open("rb") as file:
        head = file.read(8)
        if head.startswith(NPY_MAGIC):
            file.seek(0)
            return {names[0]: read_npy(file, path.stat().st_size)}
    if head.startswith(ZIP_MAGIC):
        return _from_zip(path, names)
    if head.startswith(HDF5_MAGIC):
        with opened(path) as file_h5:
            return {name: _dataset(file_h5, name) for name in names if name in file_h5}
    msg = "it is neither .npz nor .npy nor HDF5"
    raise ValueError(msg)


def _from_zip(path: Path, names: list[str]) -> dict[str, NDArray[Any]]:
    found = {}
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name not in names or not info.filename.endswith(".npy"):
                continue
            _check_size(name, info.file_size, info.compress_size)
            with archive.open(info) as member:
                found[name] = read_npy(cast(BinaryIO, member), info.file_size)
    return found


def _dataset(file: Any, name: str) -> NDArray[Any]:  # noqa: ANN401 - h5py has no types
    dataset = file[name]
    if not hasattr(dataset, "shape") or dataset.shape is None or dataset.dtype.kind not in "buifc":
        msg = f"/{name} must be a dataset of numbers"
        raise ValueError(msg)
    if dataset.file.filename != file.filename or dataset.is_virtual or dataset.external:
        msg = f"/{name} must lie in the file itself, got a link to another"
        raise ValueError(msg)
    claimed = int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    kept = min(dataset.id.get_storage_size(), file.id.get_filesize())
    _check_size(name, claimed, kept)
    return np.asarray(dataset[()])


def _check_size(name: str, claimed: int, kept: int) -> None:
    if claimed > MAX_BYTES or claimed > max(MAX_RATIO * kept, SMALL_BYTES):
        msg = f"{name} claims {claimed} bytes, stored in {kept}; at most {MAX_BYTES} are read"
        raise ValueError(msg)
