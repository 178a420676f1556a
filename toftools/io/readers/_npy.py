"""Number arrays out of .npy files, without trusting the header.

Layout (NumPy enhancement proposal 1): magic, version, header length, a Python dictionary literal
with descr, fortran_order and shape, then the numbers. Only plain numbers are accepted: no
objects, no records, nothing is unpickled, nothing is allocated before the size is checked.
"""

import ast
import re
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x93NUMPY"
_NUMBER = re.compile(r"[<>|=]?[biufc][0-9]{1,2}|[<>|=]?b1|\?")
_MAX_HEADER = 10_000


def read_npy(file: BinaryIO, size: int) -> NDArray[Any]:
    """The array in a .npy file.

    Parameters
    ----------
    file : binary file
        At its start.
    size : int
        Its length, bytes.

    Returns
    -------
    ndarray
        Read-only numbers.

    Raises
    ------
    ValueError
        If it is not a whole .npy file of numbers.
    """
    header, start = _header(file)
    descr, order, shape = (header[key] for key in ("descr", "fortran_order", "shape"))
    if not isinstance(descr, str) or not _NUMBER.fullmatch(descr):
        msg = f"it holds {descr!r}, wanted plain numbers"
        raise ValueError(msg)
    whole = isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)
    if not whole or not isinstance(order, bool):
        msg = "its shape is not a tuple of sizes"
        raise ValueError(msg)
    try:
        dtype = np.dtype(descr)
    except TypeError as error:
        msg = f"its number type {descr!r} does not exist"
        raise ValueError(msg) from error
    count = int(np.prod(shape, dtype=object))
    if len(shape) > 8 or count * dtype.itemsize > size - start:
        msg = f"it claims shape {shape} of {dtype.name}, but {size - start} bytes follow"
        raise ValueError(msg)
    content = file.read(count * dtype.itemsize)
    if len(content) < count * dtype.itemsize:
        msg = f"it ends after {len(content)} bytes of numbers, shape {shape} has more"
        raise ValueError(msg)
    flat = np.frombuffer(content, dtype) if count else np.empty(0, dtype)
    return flat.reshape(shape, order="F" if order else "C")


def _header(file: BinaryIO) -> tuple[dict[str, Any], int]:
    """Header dictionary, and where the numbers start."""
    mark = file.read(8)
    if not mark.startswith(MAGIC) or len(mark) < 8:
        msg = "it does not start like a .npy file"
        raise ValueError(msg)
    width = 4 if mark[6] >= 2 else 2  # version 1 counts its header in two bytes
    length = int.from_bytes(file.read(width), "little")
    text = file.read(min(length, _MAX_HEADER))
    if length > _MAX_HEADER or len(text) < length:
        msg = f"its header claims {length} bytes"
        raise ValueError(msg)
    try:
        header = ast.literal_eval(text.decode("utf-8").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        msg = "its header is damaged"
        raise ValueError(msg) from error
    if not isinstance(header, dict) or not {"descr", "fortran_order", "shape"} <= set(header):
        msg = "its header lacks descr, fortran_order or shape"
        raise ValueError(msg)
    return header, 8 + width + length
