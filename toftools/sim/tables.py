"""Two-column tables of a user: measured correlation functions and beam profiles.

Text with numbers separated by commas, semicolons or blanks, ``#`` comments and at most one line of
names on top; or a .npy array (N, 2). Nothing is believed about size or content.
"""

from pathlib import Path

import numpy as np

from toftools.io.readers._npy import MAGIC, read_npy
from toftools.types import F64

MAX_BYTES = 1 << 20


def two_columns(path: Path | str, what: str) -> F64:
    """A table of two columns.

    Parameters
    ----------
    path : path
        Text or .npy file.
    what : str
        What it should hold, for the message.

    Returns
    -------
    ndarray, (N, 2)
        Finite numbers, N at least 2.

    Raises
    ------
    ValueError
        If the file is missing, too large, or not such a table.
    """
    path = Path(path)
    try:
        table = _read(path)
    except (ValueError, OSError, OverflowError, MemoryError) as error:
        detail = " ".join(str(error).split())[:200]
        msg = f"{path.name} is no table of {what} in two columns: {detail}"
        raise ValueError(msg) from error
    return table


def _read(path: Path) -> F64:
    if not path.is_file():
        msg = "no such file"
        raise ValueError(msg)
    size = path.stat().st_size
    if size > MAX_BYTES:
        msg = f"got {size} bytes, wanted at most {MAX_BYTES}"
        raise ValueError(msg)
    with path.open("rb") as file:
        binary = file.read(len(MAGIC)) == MAGIC
        file.seek(0)
        array = read_npy(file, size) if binary else _parse(file.read().decode("utf-8"))
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < 2 or array.dtype.kind not in "iuf":
        msg = f"got {array.dtype.name} of shape {array.shape}, wanted (N, 2) real numbers, N >= 2"
        raise ValueError(msg)
    table = array.astype(np.float64)
    if not np.isfinite(table).all():
        msg = "it holds numbers that are not finite"
        raise ValueError(msg)
    return table


def _parse(text: str) -> F64:
    rows: list[list[float]] = []
    lines = [
        line.partition("#")[0].replace(",", " ").replace(";", " ") for line in text.split("\n")
    ]
    words = [line.split() for line in lines if line.strip()]
    for n, row in enumerate(words):
        if len(row) != 2:
            msg = f"row {n + 1} has {len(row)} columns"
            raise ValueError(msg)
        try:
            rows.append([float(word) for word in row])
        except ValueError as error:
            if n > 0:  # the first may name the columns
                msg = f"row {n + 1} holds {' '.join(row)[:40]!r}"
                raise ValueError(msg) from error
    return np.array(rows, dtype=np.float64).reshape(-1, 2)
