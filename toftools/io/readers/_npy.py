"""Number arrays out of .npy bytes, without trusting the header.

Layout (NumPy enhancement proposal 1): magic, version, header length, a Python dictionary literal
with descr, fortran_order and shape, then the numbers. Only plain numbers are accepted: no
objects, no records, nothing is unpickled, nothing is allocated before the size is checked.
"""

import ast
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x93NUMPY"
_NUMBER = re.compile(r"[<>|=]?[biufc][0-9]{1,2}|[<>|=]?b1|\?")
_MAX_HEADER = 10_000


def read_npy(data: bytes) -> NDArray[Any]:
    """The array in the bytes of a .npy file.

    Parameters
    ----------
    data : bytes
        The whole file.

    Returns
    -------
    ndarray
        Read-only numbers.

    Raises
    ------
    ValueError
        If the bytes are not a whole .npy file of numbers.
    """
    header, start = _header(data)
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
    if len(shape) > 8 or count == 0 or count * dtype.itemsize > len(data) - start:
        msg = f"it claims shape {shape} of {dtype.name}, but {len(data) - start} bytes follow"
        raise ValueError(msg)
    flat = np.frombuffer(data, dtype, count, start)
    return flat.reshape(shape, order="F" if order else "C")


def _header(data: bytes) -> tuple[dict[str, Any], int]:
    """Header dictionary, and where the numbers start."""
    if not data.startswith(MAGIC) or len(data) < 12:
        msg = "it does not start like a .npy file"
        raise ValueError(msg)
    wide = data[6] >= 2
    (length,) = struct.unpack_from("<I" if wide else "<H", data, 8)
    start = 8 + (4 if wide else 2)
    if length > _MAX_HEADER or start + length > len(data):
        msg = f"its header claims {length} bytes"
        raise ValueError(msg)
    try:
        header = ast.literal_eval(data[start : start + length].decode("utf-8").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        msg = "its header is damaged"
        raise ValueError(msg) from error
    if not isinstance(header, dict) or not {"descr", "fortran_order", "shape"} <= set(header):
        msg = "its header lacks descr, fortran_order or shape"
        raise ValueError(msg)
    return header, start + length
