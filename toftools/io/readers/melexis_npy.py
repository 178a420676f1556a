"""Melexis MLX75027 phase images as .npy sets: ``<prefix>_phase{0,90,180,270}_avg.npy``.

Layout: one (H, W) float array per file. The phase files are signed two-tap differences, DN, with
a fixed-pattern offset that cancels in P0 - P180 and P90 - P270; beside them may lie
``<prefix>_dist_avg.npy`` (vendor distance, mm, radial) and ``<prefix>_amp_avg.npy`` (vendor
amplitude, DN; about twice the demodulated one). Any file of the set, its folder, or the prefix
names the set.
Convention: z = (P0 - P180) + j (P90 - P270), phase grows with range. The taps stay raw: ``sign``
and ``offset_m`` (measured minus true range, constant) go into the sensor's tap steps, so that
demodulation yields the calibrated phase. The default offset is 0; ``toftools inspect`` proposes
one against the vendor distance.
Invalid: amplitude not above ``min_amplitude``, non-finite taps.
Source: dartmouth-risc-lab/snapshot-lidar. No licence is stated there: do not redistribute.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.io.readers._file import (
    MAX_PIXELS,
    existing_file,
    metres,
    parsing,
    sensor_of_size,
    single,
)
from toftools.io.readers._npy import read_npy
from toftools.phasor import demodulate
from toftools.types import Capture, DepthMap, Modulation, Sensor, Taps
from toftools.units import range_to_phase

ANGLES_DEG = (0, 90, 180, 270)
_MEMBER = re.compile(r"(?P<prefix>.*)_(phase(0|90|180|270)|dist|amp)_avg\.npy")


def sniff(path: Path, head: bytes) -> bool:
    """Whether a path is a file, the folder or the prefix of one set.

    Parameters
    ----------
    path : Path
        File, folder or prefix.
    head : bytes
        First bytes of a file.

    Returns
    -------
    bool
        True if the names fit and the first phase image exists.
    """
    return len(_prefixes(path)) == 1


def _prefixes(path: Path) -> list[str]:
    """Prefixes of the complete sets that a path may mean."""
    if path.is_dir():
        found = sorted(path.glob("*_phase0_avg.npy"))
        return [str(first)[: -len("_phase0_avg.npy")] for first in found]
    member = _MEMBER.fullmatch(path.name)
    prefix = str(path.with_name(member["prefix"])) if member and member["prefix"] else str(path)
    return [prefix] if Path(f"{prefix}_phase0_avg.npy").is_file() else []


def read(
    path: Path | str,
    *,
    freq: float = 60e6,
    sign: int = 1,
    offset_m: float = 0.0,
    min_amplitude: float = 60.0,
) -> Capture:
    """Read a set of phase images with the vendor's answer, if it is there.

    Parameters
    ----------
    path : path
        Any file of the set, its folder, or the common prefix.
    freq : float
        Modulation frequency, Hz.
    sign : {1, -1}
        Direction in which phase grows with range.
    offset_m : float
        Constant error of the measured range that demodulation takes off, m.
    min_amplitude : float
        Pixels whose vendor amplitude is not above this are invalid, DN.

    Returns
    -------
    Capture
        Taps in the order 0, 90, 180, 270 degrees, phasors, and the vendor's depth.

    Raises
    ------
    ValueError
        If a file of the set is missing or damaged.
    """
    path = Path(path)
    prefixes = _prefixes(path)
    if len(prefixes) != 1:
        if not prefixes and not path.is_dir():
            existing_file(path)
        msg = f"{path} names {len(prefixes)} sets of phase images, wanted one; name one file of it"
        raise ValueError(msg)
    if sign not in (1, -1):
        msg = f"sign must be 1 or -1, got {sign}"
        raise ValueError(msg)
    taps = np.stack([_image(prefixes[0], f"phase{angle}") for angle in ANGLES_DEG])
    sensor, camera_note = _sensor(taps.shape[2], taps.shape[1], freq, sign, offset_m)
    dist, amp = (_optional(prefixes[0], name, taps.shape[1:]) for name in ("dist", "amp"))
    bright: NDArray[np.bool_] = np.asarray(np.isfinite(taps).all(axis=0))
    if amp is not None:
        bright &= np.nan_to_num(amp, nan=-np.inf) > min_amplitude
    raw = Taps(taps[None], "DN", bright)
    depth = None
    if dist is not None:
        range_m = np.where(bright, metres(dist, 1e-3, 0.0), np.float32(np.nan))
        depth = DepthMap(range_m, amplitude=amp)
    return Capture(
        sensor=sensor,
        taps=raw,
        phasors=demodulate(raw, sensor),
        depth=depth,
        provenance={
            "source": "Melexis MLX75027 phase images (dartmouth-risc-lab/snapshot-lidar)",
            "licence": "none stated; do not redistribute",
            "format": "melexis_npy",
            "file": Path(prefixes[0]).name,
            "camera": camera_note,
            "convention": {
                "taps": "0, 90, 180, 270 degrees; z = (P0 - P180) + j (P90 - P270)",
                "sign": sign,
                "offset_m": offset_m,
                "distance": "radial",
                "min_amplitude": min_amplitude,
            },
        },
    )


def _sensor(width: int, height: int, freq: float, sign: int, offset_m: float) -> tuple[Sensor, str]:
    """The preset with steps that hold the convention: measured phase = true phase + offset."""
    sensor, note = sensor_of_size("mlx75027", width, height)
    steps = sign * np.radians(ANGLES_DEG) - range_to_phase(offset_m, freq)
    modulation = Modulation(np.array([freq], dtype=np.float64), steps)
    return Sensor(sensor.camera, modulation, sensor.noise, name=sensor.name), note


def _image(prefix: str, member: str) -> NDArray[np.float32]:
    path = existing_file(f"{prefix}_{member}_avg.npy")
    with parsing(path, "melexis_npy", OSError):
        with path.open("rb") as file:
            image = read_npy(file, path.stat().st_size)
        if image.ndim != 2 or image.dtype.kind == "c" or not 0 < image.size <= MAX_PIXELS:
            msg = f"it must hold a real (H, W) image, got {image.dtype.name} {image.shape}"
            raise ValueError(msg)
        return single(image)


def _optional(prefix: str, member: str, shape: tuple[int, ...]) -> NDArray[Any] | None:
    if not Path(f"{prefix}_{member}_avg.npy").is_file():
        return None
    image = _image(prefix, member)
    if image.shape != shape:
        msg = f"{member} must have the shape {shape} of the phase images, got {image.shape}"
        raise ValueError(msg)
    return image
