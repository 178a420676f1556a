"""HDF5 files opened for reading only after a look at what makes the library itself run forever.

HDF5 2.0.0 walks the objects of a global heap, which holds text attributes, by their stored sizes;
free space (object 0) of size 0 is walked on the spot without end. Layout: HDF5 File Format
Specification, III.E "Disk Format: Level 1E - Global Heap" (number recalled): ``GCOL``, version 1,
3 bytes, length of the collection, then objects of index, references, 4 bytes, size and data padded
to 8 bytes, where the size of object 0 counts its own 16 bytes.
"""

import contextlib
import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAGIC = b"\x89HDF\r\n\x1a\n"
_MARK = b"GCOL\x01"
_OBJECT = struct.Struct("<HHIQ")


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """An HDF5 file to read.

    Parameters
    ----------
    path : Path
        File.

    Yields
    ------
    h5py.File
        The open file.

    Raises
    ------
    ValueError
        If its heaps are damaged.
    OSError
        If it is no HDF5 file.
    """
    import h5py

    with path.open("rb") as raw:
        if raw.read(1):  # an empty file cannot be mapped
            with mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as content:
                _check_heaps(content)
    with h5py.File(path, "r") as file:
        if file.id.get_create_plist().get_sizes() != (8, 8):
            msg = "wanted HDF5 with 8-byte sizes"  # those that _check_heaps has looked for
            raise ValueError(msg)
        yield file


def is_cut_off(path: Path) -> bool:
    """Whether a file begins as HDF5 and cannot be opened as such.

    Parameters
    ----------
    path : Path
        File.

    Returns
    -------
    bool
        True if it was damaged, or cut off while it was copied.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
    try:
        with opened(path):
            return False
    except (OSError, ValueError, RuntimeError):
        return True


def _check_heaps(content: mmap.mmap) -> None:
    """Refuse a global heap that holds free space smaller than its own header."""
    # Collections do not overlap, so that all objects together cannot outnumber this.
    left = len(content) // _OBJECT.size + 1
    at = content.find(_MARK)
    while at >= 0:
        size = struct.unpack("<Q", content[at + 8 : at + 16].ljust(8, b"\0"))[0]
        place, end = at + 16, min(at + size, len(content))
        while place + _OBJECT.size <= end and left > 0:
            index, _, _, length = _OBJECT.unpack_from(content, place)
            if index == 0 and length < _OBJECT.size:
                left = 0
            place += length if index == 0 else _OBJECT.size + -(-length // 8) * 8
            left -= 1
        if left <= 0:
            msg = f"its heap at byte {at} is damaged"
            raise ValueError(msg)
        at = content.find(_MARK, at + 1)
