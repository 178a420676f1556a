"""One door for every recording: our own capture files and all foreign formats.

A format is recognised from the first bytes, never from the name alone, and exactly one reader must
claim the file; conventions are the reader's explicit parameters (``--format name:key=val,...``).
"""

import importlib
from pathlib import Path

from toftools.io._hdf5 import is_cut_off
from toftools.io.native import is_capture, read_capture
from toftools.io.readers._file import existing_file
from toftools.registry import READERS, Spec, find
from toftools.types import Capture

HEAD_BYTES = 4096


def open_capture(path: Path | str, format: str | None = None) -> Capture:
    """Read a recording, whatever its format.

    Parameters
    ----------
    path : path
        Capture file, foreign file, or (for formats of several files) their folder or prefix.
    format : str or None
        ``name:key=val,...`` forces a reader and its convention; None detects it.

    Returns
    -------
    Capture
        What the file holds.

    Raises
    ------
    ValueError
        If the file is missing, damaged, or claimed by no reader or by several.
    """
    path = Path(path)
    if format is not None:
        spec = find(READERS, format)
        capture: object = spec.build(path)
        if not isinstance(capture, Capture):
            msg = f"the reader {format!r} gave {type(capture).__name__}, wanted a Capture"
            raise ValueError(msg)
        return capture
    if path.is_file() and is_capture(path):
        return read_capture(path)
    if path.is_file() and is_cut_off(path):
        msg = f"{path.name} is damaged or cut off: HDF5 cannot open it; copy it again"
        raise ValueError(msg)
    return open_capture(path, detect(path))


def detect(path: Path | str) -> str:
    """Name of the one reader that recognises a file.

    Parameters
    ----------
    path : path
        File, or folder or prefix of a format of several files.

    Returns
    -------
    str
        Reader name.

    Raises
    ------
    ValueError
        If no reader or more than one claims it.
    """
    path = Path(path)
    claims = [name for name, spec in READERS.items() if _sniff(spec, path, _head(path))]
    if len(claims) == 1:
        return claims[0]
    if not claims:
        existing_file(path)
    what = f"both {' and '.join(claims)} claim it" if claims else "no reader recognises it"
    msg = (
        f"cannot tell the format of {path.name}: {what}; "
        f"force one of {', '.join(READERS)} with --format NAME[:key=val,...]"
    )
    raise ValueError(msg)


def _head(path: Path) -> bytes:
    """First bytes of a file; none for a folder or a prefix."""
    if not path.is_file():
        return b""
    try:
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError as error:
        msg = f"cannot read {path}: {error.strerror or error}; check its permissions"
        raise ValueError(msg) from error


def _sniff(spec: Spec, path: Path, head: bytes) -> bool:
    """Ask the reader's module, which must be cheap and must not raise."""
    module = importlib.import_module(spec.target.partition(":")[0])
    return bool(module.sniff(path, head))
