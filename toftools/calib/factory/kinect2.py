"""Factory tables of a Kinect v2, as libfreenect2 keeps them.

``p0tables*.dat``: uint16 (3, 424, 512), a phase offset per frequency and pixel. libfreenect2 turns
its reference by ``p0 = -0.000031 pi count`` (read in its source), so its measured phase lies p0
above the true one; ``sign`` is 1 for phasors whose phase runs as its own, and -1 for their
conjugates. Rows alternate by 32768 counts and swap parity in the middle of the image, where the two
halves of the sensor meet; whether raw frames alternate likewise depends on how they were read:
`rows`. None of this can be verified without raw frames of the same unit, nor the unit of counts: at
0.000031 pi, rows differ by 0.050 rad from half a turn (10 mm at 120 MHz), at 65536 to a turn by
none: `counts_per_turn`. Planes are in the order 80, 16, 120 MHz: modulo 32768 counts they spread by
0.078, 0.021 and 0.115 rad, much as delays would make them.

``xTable.bin`` and ``zTable.bin``: float32 (424, 512), 8192 x / z of a pixel's ray, and 6250 / 3
times the cosine of its angle from the axis (read there). y follows up to its sign, taken positive
below the row where it vanishes. One camera with five coefficients of distortion is fitted to the
rays; no pixel centre offset remains, since that is fitted too.

``11to16.bin``: int16, 2048 numbers: signed number of each 11-bit code, code 1024 means saturated.
All files are little endian. Source: OpenKinect/libfreenect2 (Apache-2.0 or GPL-2).
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.calib.chain import Chain
from toftools.calib.factory._stages import chain_of, check_sign, phase_stages, sensor_with
from toftools.calib.factory.lens import FactoryLens, fit_camera, projected, rms_px
from toftools.calib.response import Response
from toftools.calib.stage import Residual, Stage
from toftools.io.readers._file import existing_file, parsing, read_bytes
from toftools.sensors import sensor as make_sensor
from toftools.types import F64, Bool
from toftools.units import TWO_PI

SHAPE = (424, 512)
COUNTS_PER_TURN = 2 / 0.000031
HALF_TURN = 32768
"""Counts by which rows alternate."""
X_SCALE, Z_SCALE = 8192.0, 6250.0 / 3
SATURATED = 1024
LEAST_Y = 0.02
"""Rays with less |y / z| do not say their row: y comes as the root of a small difference."""
GRID = 8
"""Every so many rows and columns are fitted; all others are held out."""


def load(
    path: Path | str,
    *,
    sign: int = 1,
    rows: str = "alternate",
    counts_per_turn: float = COUNTS_PER_TURN,
    taps: str = "codes",
    sensor: str = "kinect2",
) -> Chain:
    """Read the factory tables of a Kinect v2.

    Parameters
    ----------
    path : path
        Folder with at least one of ``p0tables*.dat``, ``xTable.bin`` with ``zTable.bin``, and
        ``11to16.bin``; or the P0 file alone.
    sign : {1, -1}
        1 where phase runs as in libfreenect2.
    rows : {"alternate", "even"}
        Whether raw phases alternate by half a turn from row to row, as the P0 table does, or have
        been brought in step, so that only the rest of the table is to be taken off; the common
        phase is then known up to half a turn.
    counts_per_turn : float
        Unit of the P0 table; libfreenect2 has 64516, a full uint16 would be 65536.
    taps : {"codes", "numbers"}
        Whether taps are raw 11-bit codes, which the companding table turns into numbers, or numbers
        already, which then stay as they are.
    sensor : str
        Preset that gives frequencies and taps.

    Returns
    -------
    Chain
        Lens, response, common phase and fixed pattern, as far as the files go.

    Raises
    ------
    ValueError
        If no table is found, one is damaged, or a convention is unknown.
    """
    check_sign(sign)
    for name, got, wanted in (
        ("rows", rows, ("alternate", "even")),
        ("taps", taps, ("codes", "numbers")),
    ):
        if got not in wanted:
            msg = f"{name} must be {' or '.join(wanted)}, got {got!r}"
            raise ValueError(msg)
    if not 60_000 < counts_per_turn < 70_000:
        msg = f"counts_per_turn must be near 65536, got {counts_per_turn}"
        raise ValueError(msg)
    files = _files(Path(path))
    preset = make_sensor(sensor)
    camera, stages, usable = preset.camera, list[Stage](), np.ones(SHAPE, bool)
    if "x" in files:
        lens, usable = _lens(files["x"], files["z"])
        camera, stages = lens.camera, [lens]
    if camera.shape != SHAPE or preset.modulation.n_freqs != 3:
        msg = f"these tables are of 512 x 424 px and 3 frequencies, the sensor {sensor} is not"
        raise ValueError(msg)
    if "lut" in files and taps == "codes":
        stages.append(_response(files["lut"]))
    if "p0" in files:
        counts = _array(files["p0"], "<u2", (3, *SHAPE)).astype(np.float64)
        stages += _phases(counts, usable, -sign * TWO_PI / counts_per_turn, rows)
    notes = {
        "source": "Kinect v2 factory tables as of libfreenect2",
        "files": {key: file.name for key, file in files.items()},
        "convention": {
            "sign": sign,
            "rows": rows,
            "counts_per_turn": counts_per_turn,
            "taps": taps,
        },
    }
    return chain_of(sensor_with(sensor, camera), stages, notes)


def _files(path: Path) -> dict[str, Path]:
    """Tables by what they are."""
    if not path.is_dir():
        return {"p0": existing_file(path)}
    found = {"p0": sorted(path.glob("p0tables*.dat"))}
    for key, name in (("x", "xTable.bin"), ("z", "zTable.bin"), ("lut", "11to16.bin")):
        found[key] = [path / name] if (path / name).is_file() else []
    if len(found["p0"]) > 1 or not any(found.values()) or bool(found["x"]) != bool(found["z"]):
        got = ", ".join(sorted(p.name for files in found.values() for p in files)) or "none of them"
        msg = (
            f"{path} must hold one p0tables*.dat, xTable.bin with zTable.bin, or 11to16.bin; "
            f"got {got}"
        )
        raise ValueError(msg)
    return {key: existing_file(files[0]) for key, files in found.items() if files}


def _array(path: Path, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    wanted = int(np.prod(shape)) * np.dtype(dtype).itemsize
    with parsing(path, "a Kinect v2 table", OSError):
        data = read_bytes(path, limit=wanted)
        if len(data) != wanted:
            msg = f"it has {len(data)} bytes, wanted {wanted} for {shape} {np.dtype(dtype).name}"
            raise ValueError(msg)
    return np.frombuffer(data, dtype).reshape(shape)


def _phases(counts: F64, usable: Bool, unit_rad: float, rows: str) -> tuple[Stage, Stage]:
    note = (
        "Offsets of the factory. Their sign and unit, and whether raw rows alternate by half a "
        f"turn, cannot be verified without raw frames of the same unit: taken as {unit_rad:.4g} "
        f"rad per count, rows={rows}."
    )
    share = 0.5
    if rows == "even":
        share, turns = 1.0, np.exp(1j * TWO_PI / HALF_TURN * counts)
        middle = np.angle(turns.mean(axis=(1, 2), keepdims=True)) * HALF_TURN / TWO_PI % HALF_TURN
        counts = middle + (counts - middle + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2
        note += " The common phase may be off by half a turn."
    return phase_stages(unit_rad * counts, usable, abs(unit_rad), (note,), turn=share)


def _lens(x_path: Path, z_path: Path) -> tuple[FactoryLens, Bool]:
    """Camera fitted to the rays, and the pixels that have one."""
    x, cosine = (_array(p, "<f4", SHAPE).astype(np.float64) for p in (x_path, z_path))
    x, cosine = x / X_SCALE, cosine / Z_SCALE
    usable = np.isfinite(x) & np.isfinite(cosine) & (cosine > 0)
    if usable.mean() < 0.5 or np.abs(x[usable]).max() > 10 or cosine[usable].max() > 1.001:
        msg = (
            f"{x_path.name} and {z_path.name} are no ray tables: wanted x / z below 10 and cosines "
            "up to 1"
        )
        raise ValueError(msg)
    y = np.sqrt(np.maximum(1 / np.where(usable, cosine, 1.0) ** 2 - 1 - x**2, 0))
    axis = np.argmin(np.where(usable, y, np.inf), axis=0)  # (W,) row where y vanishes
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    xy = np.stack([x, np.where(v < axis, -y, y)], axis=-1)
    weight = np.stack([usable, usable & (y > LEAST_Y)], axis=-1).astype(np.float64)
    seen = (u % GRID == 0) & (v % GRID == 0) & usable
    rest = (u % GRID == GRID // 2) & (v % GRID == GRID // 2) & usable
    uv = np.stack([u, v], axis=-1).astype(np.float64)
    camera, missed = fit_camera(SHAPE[::-1], xy[seen], uv[seen], weight[seen], n_dist=5)
    held_out = rms_px(projected(camera, xy[rest]) - uv[rest], weight[rest])
    note = "Camera of the factory's ray tables, which are of one unit of the model."
    after = rms_px(missed, weight[seen])
    residual = Residual("px", after=after, held_out=held_out, n=int(seen.sum()), notes=(note,))
    return FactoryLens(camera, residual), usable


def _response(path: Path) -> Response:
    table = _array(path, "<i2", (2048,)).astype(np.float64)
    half = table[:SATURATED]
    if half[0] != 0 or not (np.diff(half) > 0).all() or (table[SATURATED + 1 :] != -half[1:]).any():
        msg = f"{path.name} is no companding table: wanted numbers rising from 0, then negated"
        raise ValueError(msg)
    table[SATURATED] = half[-1]
    flat = np.zeros((1, *SHAPE), np.float32)
    note = (
        "Turns raw 11-bit codes (0..2047) into signed numbers; taps that are numbers already "
        "must not pass it (taps=numbers)."
    )
    return Response(
        offset=flat,
        gain=flat + 1,
        bad=np.zeros(SHAPE, np.int64),
        curve=table,
        step=1.0,
        offset_sd=flat,
        gain_sd=flat,
        terms=np.zeros(1),
        terms_sd=np.zeros(1),
        saturation=2048.0,
        lowest=0.0,
        lost=float(SATURATED),
        residual=Residual("%", notes=(note,)),
    )
