"""The same calibration block as a MATLAB struct ``cal``.

A level-5 file is checked before scipy reads it: what its streams unpack to, how deep its structs
go, and that no array claims more elements than its bytes can hold. Nothing is unpickled.
"""

import io
import struct
import zlib
from typing import Any

import numpy as np

from toftools.calib.factory._ccb import Ccb, Geometry, Phases, phases_of

MOST_BYTES = 1 << 25
"""Of a file and of all it unpacks to."""
HEAD = 128
COMPRESSED, MATRIX = 15, 14
MOST_DEPTH = 8


def read_mat(data: bytes) -> Ccb:
    """Calibration out of a ``.mat`` file.

    Parameters
    ----------
    data : bytes
        The whole file.

    Returns
    -------
    Ccb
        As of `toftools.calib.factory._ccb.read_ccb`.

    Raises
    ------
    ValueError
        If the file is damaged, hostile, or holds no struct ``cal``.
    """
    from scipy.io import loadmat

    check(data)
    try:
        found = loadmat(
            io.BytesIO(data), squeeze_me=True, struct_as_record=False, variable_names=["cal"]
        )
        return _ccb(found["cal"])
    except (AttributeError, KeyError, TypeError, IndexError, NotImplementedError) as error:
        msg = f"it holds no readable struct cal ({type(error).__name__})"
        raise ValueError(msg) from error


def check(data: bytes) -> None:
    """Refuse a level-5 file whose claims do not fit its bytes.

    Parameters
    ----------
    data : bytes
        The whole file.

    Raises
    ------
    ValueError
        If they do not.
    """
    if data[126:HEAD] != b"IM" or not data.startswith(b"MATLAB 5.0"):
        msg = "it is no MATLAB level-5 file in little endian"
        raise ValueError(msg)
    left = MOST_BYTES
    for kind, content in _elements(data, HEAD, padded=False):
        body = content
        if kind == COMPRESSED:
            stream = zlib.decompressobj()
            body = stream.decompress(content, left)
            left -= len(body)
            if stream.unconsumed_tail or left <= 0:
                msg = f"it unpacks to more than {MOST_BYTES >> 20} MiB"
                raise ValueError(msg)
        for inner, part in _elements(body, 0) if kind == COMPRESSED else [(kind, body)]:
            if inner == MATRIX:
                _check_matrix(part, 0)


def _elements(data: bytes, at: int, *, padded: bool = True) -> list[tuple[int, bytes]]:
    """Type and content of the elements from a place on."""
    found = []
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind >> 16:  # small element: type and size share a word
            found.append((kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]))
            at += 8
            continue
        if at + 8 + size > len(data):
            msg = f"an element claims {size} bytes where {len(data) - at - 8} are left"
            raise ValueError(msg)
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size + (-size % 8 if padded or kind != COMPRESSED else 0)
    return found


def _check_matrix(body: bytes, depth: int) -> None:
    parts = _elements(body, 0)
    if depth > MOST_DEPTH or (parts and len(parts) < 2):
        msg = "a struct in it is damaged or too deep"
        raise ValueError(msg)
    if not parts:
        return
    dims = np.frombuffer(parts[1][1][: len(parts[1][1]) // 4 * 4], "<i4").astype(object)
    if (dims < 0).any() or int(np.prod(dims)) > len(body):
        msg = f"an array in it claims {list(dims)} elements in {len(body)} bytes"
        raise ValueError(msg)
    for kind, part in parts[2:]:
        if kind == MATRIX:
            _check_matrix(part, depth + 1)


def _listed(value: Any) -> list[Any]:  # noqa: ANN401 - what MATLAB holds
    return list(np.atleast_1d(np.asarray(value, dtype=object)).ravel())


def _all(cal: Any, name: str) -> list[Any]:  # noqa: ANN401
    """Blocks of one kind: MATLAB splits them by size into name, name_1, name_2 ..."""
    names = [n for n in cal._fieldnames if n == name or n.rpartition("_")[0] == name]
    return [block for n in names for block in _listed(getattr(cal, n))]


def _ccb(cal: Any) -> Ccb:  # noqa: ANN401
    geometry = None
    if "GeometricCalibration" in cal._fieldnames:
        g = cal.GeometricCalibration
        k = tuple(float(x) for x in np.ravel(g.k))
        if len(k) != 6:
            msg = f"its lens has {len(k)} radial terms, wanted 6"
            raise ValueError(msg)
        geometry = Geometry(
            (int(g.nCols), int(g.nRows)),
            (float(g.fx), float(g.fy)),
            (float(g.px), float(g.py)),
            (float(g.cx), float(g.cy)),
            k,
            (float(g.tx), float(g.ty)),
        )
    temperature: list[dict[str, object]] = [
        {
            "mode": int(t.mode),
            "frequency_index": int(t.freqIndex),
            "capture": int(t.captureNumber),
            "laser": int(t.laserIdentity),
            "calibration_phase": int(t.calibrationPhase),
            "amplitude": [float(x) for x in np.ravel(t.amplitudeCoefficients)],
            "phase": [float(x) for x in np.ravel(t.phaseCoefficients)],
        }
        for t in _all(cal, "TemperatureCorrection")
    ]
    temperature += [
        {
            "mode": int(t.mode),
            "frequency_index": int(t.freqIndex),
            "base_temperatures": [float(x) for x in np.ravel(t.baseCalTemperature)],
        }
        for t in _all(cal, "SpatialTemperatureCorrection")
    ]
    phases = tuple(_phases(block) for block in _all(cal, "ComplexDeprojection"))
    return Ccb(str(cal.header.serialNumber), geometry, phases, tuple(temperature))


def _phases(b: Any) -> Phases:  # noqa: ANN401
    sides = ("analogBin", "digitalBin", "subsampling", "softwareBin")
    bins = tuple(int(getattr(b, f"{s}{axis}")) for s in sides for axis in ("Rows", "Cols"))
    row = np.asarray(b.P0RowCoefs, np.float64).reshape(int(b.nRows), int(b.nRowCoefs))
    column = np.asarray(b.P0ColCoefs, np.float64).reshape(int(b.nCols), int(b.nColCoefs))
    told = (int(b.mode), int(b.freq), bins, int(b.offsetRows), int(b.offsetCols))
    return phases_of(told, row, column)
