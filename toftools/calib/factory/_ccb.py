"""Calibration blocks (CCB) of Analog Devices ADTF3175 modules: the binary file itself.

Layout, found by comparing a file with its MATLAB form and confirmed by the maker's own writer of
such blocks: 16 bytes (versions, size of the next header, size of the file at byte 8), then blocks.
Every block starts with 24 bytes: id, format, calibration version (uint16), size with this head
(uint32), checksum, reserved, and a date; all little endian. Of 100 blocks these are read: 255
(header), 71 (geometry), 80 (P0), 84 (temperature) and 83 (base temperatures).
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from toftools.types import F64

FILE_HEAD, BLOCK_HEAD = 16, 24
HEADER, GEOMETRY, P0, TEMPERATURE, SPATIAL = 255, 71, 80, 84, 83
MOST_BLOCKS = 4096
MOST_PX = 4096
FREQ_HZ = 10e3
"""Unit of stored frequencies."""


@dataclass(frozen=True)
class Phases:
    """P0 of one mode and frequency: ``row_rad[v] + column_rad[u]``."""

    mode: int
    freq_hz: float
    binning: int
    first_row: int
    first_column: int
    row_rad: F64
    column_rad: F64


@dataclass(frozen=True)
class Geometry:
    """Pinhole, centre of distortion at z = 1, rational and tangential terms, as stored."""

    size: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion_centre: tuple[float, float]
    k: tuple[float, ...]
    tangential: tuple[float, float]


@dataclass(frozen=True)
class Ccb:
    """What is read of a calibration block."""

    serial: str
    geometry: Geometry | None
    phases: tuple[Phases, ...]
    temperature: tuple[dict[str, object], ...]


def read_ccb(data: bytes) -> Ccb:
    """Blocks of a ``.ccb`` file.

    Parameters
    ----------
    data : bytes
        The whole file.

    Returns
    -------
    Ccb
        Serial number, geometry, P0, temperature coefficients.

    Raises
    ------
    ValueError
        If the file is damaged.
    struct.error
        If a block is shorter than its fields.
    """
    serial, geometry = "", None
    phases, temperature = [], []
    for kind, body in _blocks(data):
        if kind == HEADER:
            serial = body[136:168].split(b"\0")[0].decode("ascii", "replace")
        elif kind == GEOMETRY:
            geometry = _geometry(body)
        elif kind == P0:
            phases.append(_phases(body))
        elif kind == TEMPERATURE:
            temperature.append(_temperature(body))
        elif kind == SPATIAL:
            temperature.append(_base(body))
    return Ccb(serial, geometry, tuple(phases), tuple(temperature))


def _blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    (size,) = struct.unpack_from("<I", data, 8)
    if size != len(data):
        msg = f"its head says {size} bytes, got {len(data)}"
        raise ValueError(msg)
    at = FILE_HEAD
    for _ in range(MOST_BLOCKS):
        if at == len(data):
            return
        kind, _, _, size = struct.unpack_from("<BBHI", data, at)
        if not BLOCK_HEAD <= size <= len(data) - at:
            msg = f"a block of {size} bytes does not fit in the {len(data) - at} that are left"
            raise ValueError(msg)
        yield kind, data[at + BLOCK_HEAD : at + size]
        at += size
    msg = f"it has more than {MOST_BLOCKS} blocks"
    raise ValueError(msg)


def _geometry(body: bytes) -> Geometry:
    rows, columns = struct.unpack_from("<HH", body)
    numbers = struct.unpack_from("<14f", body, 16)
    return Geometry(
        (columns, rows), numbers[0:2], numbers[2:4], numbers[4:6], numbers[6:12], numbers[12:14]
    )


def _phases(body: bytes) -> Phases:
    mode, _, freq, _, n_row, n_column = struct.unpack_from("<BBHHBB", body)
    bins = struct.unpack_from("<8B", body, 8)
    rows, columns, first_row, first_column = struct.unpack_from("<4H", body, 16)
    count = rows * n_row + columns * n_column
    if not (0 < rows <= MOST_PX and 0 < columns <= MOST_PX) or len(body) != 24 + 4 * count:
        msg = f"a P0 block of {rows} x {columns} px has {len(body)} bytes, wanted {24 + 4 * count}"
        raise ValueError(msg)
    numbers = np.frombuffer(body, "<f4", count, 24)
    split = rows * n_row
    return phases_of(
        (mode, freq, bins, first_row, first_column),
        numbers[:split].reshape(rows, n_row),
        numbers[split:].reshape(columns, n_column),
    )


def phases_of(told: tuple[int, int, tuple[int, ...], int, int], row: F64, column: F64) -> Phases:
    """P0 out of its coefficients.

    Parameters
    ----------
    told : tuple
        Mode, frequency in 10 kHz, the eight binning and subsampling factors (analog, digital,
        subsampling, software; rows and columns of each), first row and column.
    row, column : ndarray, (rows, n) and (columns, m)
        Coefficients of every row and column, the constant last.

    Returns
    -------
    Phases
        The constants.

    Raises
    ------
    ValueError
        If other coefficients than the constant are used: what they multiply is not documented.
    """
    mode, freq, bins, first_row, first_column = told
    higher = np.abs(row[:, :-1]).sum() + np.abs(column[:, :-1]).sum()
    per_side = {int(np.prod(bins[0::2])), int(np.prod(bins[1::2]))}
    if higher or not (np.isfinite(row).all() and np.isfinite(column).all()) or len(per_side) != 1:
        msg = f"P0 of mode {mode} is not a finite constant per row and column of square pixels"
        raise ValueError(msg)
    return Phases(
        int(mode),
        float(freq) * FREQ_HZ,
        per_side.pop(),
        int(first_row),
        int(first_column),
        row[:, -1].astype(np.float64),
        column[:, -1].astype(np.float64),
    )


def _temperature(body: bytes) -> dict[str, object]:
    mode, freq, capture, laser = struct.unpack_from("<4B", body)
    (phase,) = struct.unpack_from("<H", body, 6)
    numbers = [float(x) for x in struct.unpack_from("<16f", body, 8)]
    return {
        "mode": mode,
        "frequency_index": freq,
        "capture": capture,
        "laser": laser,
        "calibration_phase": phase,
        "amplitude": numbers[:8],
        "phase": numbers[8:],
    }


def _base(body: bytes) -> dict[str, object]:
    mode, freq = struct.unpack_from("<2B", body)
    base = [float(x) for x in struct.unpack_from("<3f", body, 104)]
    return {"mode": mode, "frequency_index": freq, "base_temperatures": base}
