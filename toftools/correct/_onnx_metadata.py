"""Metadata of an ONNX file, read without a library that would build the network.

References: the wire format of protocol buffers (field number and type, then a length or a number
of seven bits a byte) and the ONNX model (field 14: pairs of strings), their published
specifications. Input: the file. Fails, with a sentence, on all that is no protocol buffer.
"""

from collections.abc import Iterator

MODEL_METADATA = 14


def metadata(data: bytes) -> dict[str, str]:
    """Pairs of strings in a model's metadata.

    Parameters
    ----------
    data : bytes
        ONNX file.

    Returns
    -------
    dict of str to str
        What it says of itself.

    Raises
    ------
    ValueError
        If it is no ONNX file, or a cut one.
    """
    found = {}
    try:
        for number, value in _messages(memoryview(data)):
            if number == MODEL_METADATA:
                pair = {key: bytes(text).decode() for key, text in _messages(value)}
                found[pair.get(1, "")] = pair.get(2, "")
    except IndexError as error:
        msg = "a number ends beyond the file"
        raise ValueError(msg) from error
    return found


def _messages(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Fields with a length; all others are skipped."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == 0:
            _, at = _varint(data, at)
        elif kind == 2:
            size, at = _varint(data, at)
            if at + size > len(data):
                msg = "a field ends beyond the file"
                raise ValueError(msg)
            yield tag >> 3, data[at : at + size]
            at += size
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            msg = "no protocol buffer"
            raise ValueError(msg)


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
        if shift > 63:
            msg = "a number without end"
            raise ValueError(msg)
