"""Real number arrays out of MATLAB v5 files, without trusting any size the file claims.

Layout (MathWorks, "MAT-File Format", level 5): 128 bytes of header, then elements of an 8-byte
tag (type, size) and their data; type 15 is a zlib stream around one more element; type 14 is an
array made of flags, dimensions, name and numbers. Structs, cells, sparse and text are refused.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"MATLAB 5.0 MAT-file"
HEADER_BYTES = 128
MAX_INFLATED = 1 << 25  # 32 MiB; a frame of this family has 6 MB
_HEAD_BYTES = 512  # flags, dimensions and name of an array
_COMPRESSED, _MATRIX = 15, 14
_NUMERIC_CLASSES = range(6, 16)  # mxDOUBLE_CLASS .. mxUINT64_CLASS
_COMPLEX_FLAG = 0x0800
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8",
          13: "u8"}  # fmt: skip


def _order(data: bytes) -> str:
    """Byte order of the file, from the last two bytes of its header."""
    mark = data[126:HEADER_BYTES]
    if not data.startswith(b"MATLAB") or mark not in (b"IM", b"MI"):
        msg = "the MATLAB v5 header is missing or damaged"
        raise ValueError(msg)
    return "<" if mark == b"IM" else ">"


def _element(data: bytes, start: int, order: str) -> tuple[int, bytes, int]:
    """Type and content of the element at `start`, and where the next one starts."""
    if start + 8 > len(data):
        msg = "the file ends inside an element tag"
        raise ValueError(msg)
    kind, size = struct.unpack_from(order + "II", data, start)
    if kind >> 16:  # small element: size and type share the first word
        return kind & 0xFFFF, data[start + 4 : start + 4 + min(kind >> 16, 4)], start + 8
    end = start + 8 + size
    if end > len(data):
        msg = f"an element claims {size} bytes where {len(data) - start - 8} are left"
        raise ValueError(msg)
    padding = 0 if kind == _COMPRESSED else -size % 8
    return kind, data[start + 8 : end], end + padding


def _inflated(content: bytes, limit: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(content, limit)
    except zlib.error as error:
        msg = f"a compressed element is damaged ({error})"
        raise ValueError(msg) from error


def _matrices(data: bytes, order: str) -> Iterator[tuple[bytes, bytes]]:
    """The first bytes of each array's body, and the element that holds it all, still packed."""
    start = HEADER_BYTES
    while start < len(data):
        first = start
        kind, content, start = _element(data, start, order)
        if kind == _COMPRESSED:
            head = _inflated(content, _HEAD_BYTES)
            kind = int.from_bytes(head[:4], "little" if order == "<" else "big")
            content = head[8:]
        if kind == _MATRIX:
            yield content[:_HEAD_BYTES], data[first:start]


def _body(element: bytes, order: str) -> bytes:
    """Body of an array from its element, unpacked if need be."""
    kind, content, _ = _element(element, 0, order)
    if kind != _COMPRESSED:
        return content
    return _element(_inflated(content, MAX_INFLATED), 0, order)[1]


def _head(body: bytes, order: str) -> tuple[int, tuple[int, ...], str, int]:
    """Flags, dimensions and name of an array body, and where its numbers start."""
    _, flags, at = _element(body, 0, order)
    _, dims, at = _element(body, at, order)
    _, name, at = _element(body, at, order)
    if len(flags) < 4 or len(dims) % 4:
        msg = "an array header is damaged"
        raise ValueError(msg)
    (word,) = struct.unpack_from(order + "I", flags)
    shape = struct.unpack(f"{order}{len(dims) // 4}i", dims)
    return word, shape, name.decode("latin-1"), at


def first_name(head: bytes) -> str:
    """Name of the first array, from the first bytes of a file.

    Parameters
    ----------
    head : bytes
        At least 256 bytes from the start of the file.

    Returns
    -------
    str
        Name, or "" if this is no MATLAB v5 file or its first element is no array.
    """
    try:
        order = _order(head)
        kind, _ = struct.unpack_from(order + "II", head, HEADER_BYTES)
        body = head[HEADER_BYTES + 8 :]
        if kind == _COMPRESSED:
            body = _inflated(body, _HEAD_BYTES)
            kind, _ = struct.unpack_from(order + "II", body)
            body = body[8:]
        return _head(body, order)[2] if kind == _MATRIX else ""
    except (ValueError, struct.error):
        return ""


def read_array(data: bytes, *names: str) -> tuple[str, NDArray[Any]]:
    """The first array of a file that has one of the given names.

    Parameters
    ----------
    data : bytes
        The whole file.
    *names : str
        Wanted variable names.

    Returns
    -------
    tuple of str and ndarray
        Name and numbers, in the shape the file gives.

    Raises
    ------
    ValueError
        If the file is damaged or has no such real, numeric array.
    """
    found, order = [], _order(data)
    for head, element in _matrices(data, order):
        word, shape, name, at = _head(head, order)
        found.append(name)
        if name in names:
            return name, _numbers(_body(element, order), at, order, word, shape)
    msg = f"it holds {found or 'no arrays'}, wanted one named {' or '.join(names)}"
    raise ValueError(msg)


def _numbers(body: bytes, at: int, order: str, word: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """Real part of an array, after its claimed shape was held against the bytes present."""
    if word & 0xFF not in _NUMERIC_CLASSES or word & _COMPLEX_FLAG:
        msg = "the array is not one of real numbers"
        raise ValueError(msg)
    kind, content, _ = _element(body, at, order)
    if kind not in _TYPES or min(shape, default=0) < 1:
        msg = f"the array has storage type {kind} and shape {shape}, wanted numbers"
        raise ValueError(msg)
    dtype = np.dtype(order + _TYPES[kind])
    count = int(np.prod(shape, dtype=object))
    if count * dtype.itemsize != len(content):
        msg = f"the array claims shape {shape} of {dtype.name} but holds {len(content)} bytes"
        raise ValueError(msg)
    return np.frombuffer(content, dtype).reshape(shape, order="F")
