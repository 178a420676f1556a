"""16-bit grey PNG files, checked whole before they are decoded.

Decoders return half an image for a cut file; here every chunk checksum and the length of the
pixel stream are held against the header first (PNG specification, sections 5 and 11).
"""

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.io.readers._file import MAX_PIXELS

MAGIC = b"\x89PNG\r\n\x1a\n"


def is_png16(head: bytes) -> bool:
    """Whether the first bytes are those of a 16-bit grey PNG.

    Parameters
    ----------
    head : bytes
        At least 26 bytes.

    Returns
    -------
    bool
        True if so.
    """
    return head.startswith(MAGIC) and head[12:16] == b"IHDR" and head[24:26] == b"\x10\x00"


def read_png16(data: bytes) -> NDArray[Any]:
    """Pixels of a 16-bit grey PNG.

    Parameters
    ----------
    data : bytes
        The whole file.

    Returns
    -------
    ndarray, (H, W), uint16
        Pixels.

    Raises
    ------
    ValueError
        If it is of another kind, cut or damaged.
    """
    import cv2

    if not is_png16(data):
        msg = "wanted a 16-bit grey PNG, got another kind of image"
        raise ValueError(msg)
    width, height = struct.unpack_from(">II", data, 16)
    if not 0 < width * height <= MAX_PIXELS:
        msg = f"it claims {width} x {height} pixels"
        raise ValueError(msg)
    _check_stream(_pixel_stream(data), height * (1 + 2 * width), interlaced=data[28] != 0)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        msg = "its pixels cannot be decoded"
        raise ValueError(msg) from error
    if image is None or image.shape != (height, width) or image.dtype != np.uint16:
        msg = "its pixels cannot be decoded as 16-bit grey"
        raise ValueError(msg)
    return np.asarray(image)


def _pixel_stream(data: bytes) -> bytes:
    """Compressed pixels of all IDAT chunks, once every checksum up to IEND is right."""
    start, pixels = len(MAGIC), []
    while start + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, start)
        kind, end = data[start + 4 : start + 8], start + 8 + size
        if end + 4 > len(data):
            break
        if zlib.crc32(data[start + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            msg = f"its chunk {kind.decode('latin-1')!r} is damaged"
            raise ValueError(msg)
        if kind == b"IDAT":
            pixels.append(data[start + 8 : end])
        if kind == b"IEND":
            return b"".join(pixels)
        start = end + 4
    msg = "it ends before its last chunk"
    raise ValueError(msg)


def _check_stream(stream: bytes, wanted: int, *, interlaced: bool) -> None:
    inflater = zlib.decompressobj()
    try:
        # Interlacing adds a filter byte per row of each of seven passes: at most as much again.
        got = len(inflater.decompress(stream, 2 * wanted + 64))
    except zlib.error as error:
        msg = "its pixel data are damaged"
        raise ValueError(msg) from error
    if not inflater.eof or (got != wanted and not interlaced):
        msg = f"its pixel data have {got} bytes, the header claims {wanted}"
        raise ValueError(msg)
