"""Phase offsets of a Texas Instruments CDK: ``<camera>PhaseOffset.bin`` of its VoxelSDK.

Layout: width and height as uint16, then a row-major int16 image, little endian; 4096 is a turn. The
SDK computes ``corrected = phase - offset`` in whole codes and cuts the result to 0..4095 instead of
wrapping it; here it wraps. The file does not say at which frequency it was taken: `freq` does.
Source: 3dtof/voxelsdk (BSD-3).
"""

import struct
from pathlib import Path

import numpy as np

from toftools.calib.chain import Chain
from toftools.calib.factory._stages import chain_of, check_sign, phase_stages, sensor_with
from toftools.io.readers._file import MAX_PIXELS, existing_file, parsing, read_bytes
from toftools.sensors import sensor as make_sensor
from toftools.types import F64
from toftools.units import TWO_PI

TURN = 4096
HEAD = struct.Struct("<HH")


def load(path: Path | str, *, freq: float = 40e6, sign: int = 1, sensor: str = "opt8241") -> Chain:
    """Read a phase-offset file as common phase and fixed pattern.

    Parameters
    ----------
    path : path
        ``*PhaseOffset.bin``.
    freq : float
        Modulation frequency that the offsets belong to, Hz; the file does not say.
    sign : {1, -1}
        1 where the phase of the captures grows with range as that of the SDK.
    sensor : str
        Preset that gives optics and taps; its size must be that of the file.

    Returns
    -------
    Chain
        For one frequency.

    Raises
    ------
    ValueError
        If the file is no such table, or of another size than the sensor.
    """
    check_sign(sign)
    path = existing_file(path)
    with parsing(path, "TI phase offsets", OSError, struct.error):
        codes = _codes(read_bytes(path, limit=HEAD.size + 2 * MAX_PIXELS))
    camera = make_sensor(sensor).camera
    if codes.shape != camera.shape:
        msg = (
            f"{path.name} is of {codes.shape[1]} x {codes.shape[0]} px, the sensor {sensor} of "
            f"{camera.width} x {camera.height}; name the sensor that it belongs to"
        )
        raise ValueError(msg)
    note = (
        f"Offsets of the factory, taken to be at {freq / 1e6:g} MHz: the file does not say. "
        "Their accuracy is unknown beyond their step of 1/4096 turn."
    )
    quantum = TWO_PI / TURN
    stages = phase_stages(
        sign * quantum * codes[None], np.ones(codes.shape, bool), quantum, (note,)
    )
    notes = {
        "source": "Texas Instruments CDK phase offsets",
        "file": path.name,
        "convention": {"sign": sign, "codes_per_turn": TURN, "freq_hz": freq},
    }
    return chain_of(sensor_with(sensor, camera, np.array([freq])), list(stages), notes)


def _codes(data: bytes) -> F64:
    width, height = HEAD.unpack_from(data)
    wanted = HEAD.size + 2 * width * height
    if min(width, height) == 0 or len(data) != wanted:
        msg = f"its head says {width} x {height} px, which makes {wanted} bytes, got {len(data)}"
        raise ValueError(msg)
    codes = np.frombuffer(data, "<i2", offset=HEAD.size).reshape(height, width)
    if np.abs(codes.astype(np.int32)).max() >= TURN:
        msg = f"its offsets reach {np.abs(codes.astype(np.int32)).max()} codes, a turn has {TURN}"
        raise ValueError(msg)
    return codes.astype(np.float64)
