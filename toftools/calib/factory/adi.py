"""Factory calibration block (CCB) of Analog Devices ADTF3175 modules, ``.ccb`` or its ``.mat``.

Applied: the lens (focal lengths, principal point, centre of distortion, rational k1..k6, tangential
terms), binned and cut as the mode says; and P0, the phase offset of the mode per row and column.
P0 is in radians, which the block shows itself: in all 16 tables of one file its 16-bit column
offsets, a turn being 65536, are its negatives modulo half a turn, to half their step (4.8e-5 rad).
Its sign, and the order of the tangential terms, are not documented: `sign`, and x first (0.2 px at
the corner). Not applied, since their units are not documented: temperature coefficients of phase
and amplitude (kept in the notes of the chain), and gain per column, relative illumination, field
masks and illumination profiles (not read).

The distortion acts about its centre c in the plane z = 1, ``d(p - c) + c``, as in the camera model
of the Azure Kinect SDK, whose imager this is. OpenCV has no such centre, so a camera of eight
coefficients is fitted to it; the residual says what that costs. Source: analogdevicesinc/ToF (MIT).
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from toftools.calib.chain import Chain
from toftools.calib.factory._ccb import Ccb, Geometry, Phases, read_ccb
from toftools.calib.factory._mat import MOST_BYTES, read_mat
from toftools.calib.factory._stages import chain_of, check_sign, phase_stages, sensor_with
from toftools.calib.factory.lens import FactoryLens, fit_camera, rms_px
from toftools.calib.stage import Residual, Stage
from toftools.camera import rays_at
from toftools.io.readers._file import existing_file, parsing, read_bytes
from toftools.types import F64, Camera

ACROSS = 24
"""Rays across the image that are fitted."""
FAR = 3.0
"""Rays with x / z or y / z beyond are not asked for: 143 degrees across."""


def load(path: Path | str, *, mode: int = 7, sign: int = 1, sensor: str = "adtf3175") -> Chain:
    """Read the calibration of one mode of a module.

    Parameters
    ----------
    path : path
        ``*.ccb``, or the ``*.mat`` with its struct ``cal``.
    mode : int
        Mode of the block: 7 is 512 x 512 at 198, 189 and 54 MHz, 5 is 1024 x 1024, 4 is 640 x 576,
        1 is 320 x 288 at the same; 9, 2 and 0 are 512 x 512 at 142 or 177.5 MHz or both.
    sign : {1, -1}
        1 if P0 is measured minus true phase.
    sensor : str
        Preset that gives name and taps.

    Returns
    -------
    Chain
        Lens, common phase and fixed pattern.

    Raises
    ------
    ValueError
        If the file is damaged, or holds no lens or not that mode.
    """
    check_sign(sign)
    path = existing_file(path)
    with parsing(path, "an ADI calibration block", OSError, struct.error, zlib.error):
        data = read_bytes(path, limit=MOST_BYTES)
        block = read_mat(data) if data.startswith(b"MATLAB") else read_ccb(data)
        chosen, geometry = _chosen(block, mode)
    lens = _lens(geometry, chosen[0])
    freqs = np.array([p.freq_hz for p in chosen])
    offset = np.stack([p.row_rad[:, None] + p.column_rad for p in chosen])
    note = (
        f"P0 of the factory for mode {mode}. Its sign is not documented: taken as sign={sign}. It "
        "holds at the temperature of the factory; the temperature coefficients of the block are "
        "not applied, since their units are not documented."
    )
    usable = np.ones(offset.shape[1:], bool)
    stages: list[Stage] = [lens, *phase_stages(sign * offset, usable, 0.0, (note,))]
    notes = {
        "source": "Analog Devices factory calibration block",
        "file": path.name,
        "serial": block.serial,
        "convention": {"mode": mode, "sign": sign, "tangential": "x first"},
        "not_applied": {
            "temperature": [t for t in block.temperature if t["mode"] == mode],
            "why": "units and meaning are not documented",
        },
    }
    return chain_of(sensor_with(sensor, lens.camera, freqs), stages, notes)


def _chosen(block: Ccb, mode: int) -> tuple[list[Phases], Geometry]:
    chosen = [p for p in block.phases if p.mode == mode]
    if block.geometry is None or not chosen:
        lens = "no lens" if block.geometry is None else "a lens"
        modes = ", ".join(str(m) for m in sorted({p.mode for p in block.phases})) or "none"
        msg = f"it holds {lens} and P0 for the modes {modes}; wanted a lens and mode {mode}"
        raise ValueError(msg)
    size, freqs = {_frame(p) for p in chosen}, {p.freq_hz for p in chosen}
    if len(size) != 1 or len(freqs) != len(chosen):
        msg = f"mode {mode} holds blocks of different frames or of one frequency twice"
        raise ValueError(msg)
    return chosen, block.geometry


def _frame(p: Phases) -> tuple[int, ...]:
    return p.row_rad.size, p.column_rad.size, p.binning, p.first_row, p.first_column


def _lens(geometry: Geometry, frame: Phases) -> FactoryLens:
    """OpenCV camera on the pixels of a mode that stands for the camera of the block."""
    k, numbers = geometry.k, np.array([*geometry.focal_px, *geometry.centre_px])
    if not (np.isfinite([*numbers, *k, *geometry.tangential]).all() and (numbers[:2] > 0).all()):
        msg = f"the lens of the block holds no finite camera: {geometry}"
        raise ValueError(msg)
    first = np.array([frame.first_column, frame.first_row])
    focal = numbers[:2] / frame.binning
    centre = (numbers[2:] + 0.5) / frame.binning - 0.5 - first
    size = (frame.column_rad.size, frame.row_rad.size)
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    about = Camera(*size, K, np.array([k[0], k[1], 0, 0, *k[2:]]))
    u, v = np.meshgrid(*(np.linspace(0, n - 1, ACROSS) for n in size))
    seen = rays_at(about, u, v).reshape(-1, 3)
    xy = seen[:, :2] / seen[:, 2:]
    xy = xy[np.isfinite(xy).all(axis=1) & (np.abs(xy) < FAR).all(axis=1)]
    if len(xy) < 50:
        msg = f"the lens of the block sees {len(xy)} of the directions that it is asked for"
        raise ValueError(msg)
    uv = _distorted(xy, geometry) * focal + centre
    weight = np.ones_like(uv)
    camera, missed = fit_camera(size, xy, uv, weight, n_dist=8)
    plain = uv - (np.asarray(_distorted(xy, geometry, centred=False)) * focal + centre)
    note = (
        "Camera of the factory block; before: its centre of distortion and tangential terms, "
        "which have no place in an OpenCV camera as they are, left out."
    )
    residual = Residual(
        "px", rms_px(plain, weight), rms_px(missed, weight), n=len(xy), notes=(note,)
    )
    return FactoryLens(camera, residual)


def _distorted(xy: F64, geometry: Geometry, *, centred: bool = True) -> F64:
    """Directions as the lens bends them."""
    middle = np.array(geometry.distortion_centre) if centred else np.zeros(2)
    tx, ty = geometry.tangential if centred else (0.0, 0.0)
    x, y = (xy - middle).T
    k, s = geometry.k, x * x + y * y
    radial = (1 + s * (k[0] + s * (k[1] + s * k[2]))) / (1 + s * (k[3] + s * (k[4] + s * k[5])))
    bent_x = x * radial + tx * (s + 2 * x * x) + 2 * ty * x * y
    bent_y = y * radial + ty * (s + 2 * y * y) + 2 * tx * x * y
    return np.asarray(np.stack([bent_x, bent_y], axis=-1) + middle)
