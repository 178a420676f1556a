"""NumPy archives (.npz): answers of ``toftools correct`` and arrays that users put together.

Keys, any one of the three measurements and what goes with it:
- ``range_m`` or ``z_m`` (H, W), m, with ``sigma_m``, ``confidence``, ``amplitude`` (H, W);
- ``phasors`` (F, H, W) complex, ``freqs_hz`` (F,), and ``sigma`` (F, H, W);
- ``taps`` (F, K, H, W), ``freqs_hz``, ``steps_rad`` (K,) or (F, K);
and for all: ``valid`` (H, W), ``truth_range_m`` (H, W), ``K`` (3, 3) px, ``dist``, ``fisheye``.
Convention: z = A exp(+j phi), I_k = B + A cos(phi - step_k), SI units; `range_m` wins over `z_m`.
Invalid: NaN, infinite, zero or negative ranges; ``valid`` false. Without ``K`` the field of view
is assumed. Objects are never unpickled.
Source: this project.
"""

import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from toftools.camera import pinhole
from toftools.io.readers._file import existing_file, metres, parsing, radial, single
from toftools.io.readers._npy import read_npy
from toftools.phasor import demodulate
from toftools.types import Camera, Capture, DepthMap, Modulation, Phasors, Sensor, Taps, Truth

_KEYS = ("range_m", "z_m", "sigma_m", "confidence", "amplitude", "phasors", "sigma", "taps",
         "freqs_hz", "steps_rad", "valid", "truth_range_m", "K", "dist",
         "fisheye")  # fmt: skip
_LIMIT = 1 << 29
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, KeyError,
               NotImplementedError)  # fmt: skip


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a zip archive whose first member is a .npy array.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes.

    Returns
    -------
    bool
        True if so.
    """
    length = int.from_bytes(head[26:28], "little")
    return head.startswith(b"PK\x03\x04") and head[30 : 30 + length].endswith(b".npy")


def read(
    path: Path | str, *, unit: str = "DN", hfov_deg: float = 60.0, freq: float = 20e6
) -> Capture:
    """Read an archive.

    Parameters
    ----------
    path : path
        Archive.
    unit : {"DN", "e-"}
        Unit of the taps.
    hfov_deg : float
        Horizontal field of view, degrees, if there is no ``K``.
    freq : float
        Nominal modulation frequency, Hz, for depth without ``freqs_hz``.

    Returns
    -------
    Capture
        What the archive holds.

    Raises
    ------
    ValueError
        If it is damaged, lacks a measurement, or its arrays do not fit together.
    """
    path = existing_file(path)
    with parsing(path, "npz", *_ZIP_ERRORS):
        arrays = _arrays(path)
        shape = _frame_shape(arrays)
        camera, note = _camera(arrays, shape, hfov_deg)
        sensor = Sensor(camera, _modulation(arrays, freq), name="npz")
        taps, phasors = _taps(arrays, unit), _phasors(arrays)
        if taps is not None and phasors is None:
            phasors = demodulate(taps, sensor)
        truth = arrays.get("truth_range_m")
        return Capture(
            sensor=sensor,
            taps=taps,
            phasors=phasors,
            depth=_depth(arrays, camera),
            truth=None if truth is None else Truth(metres(truth, 1.0, 0.0)),
            provenance={
                "source": "NumPy archive",
                "format": "npz",
                "file": path.name,
                "keys": sorted(arrays),
                "camera": note,
                "convention": {
                    "phasor": "z = A exp(+j phi)",
                    "modulation": "from the file"
                    if "freqs_hz" in arrays
                    else "nominal; not in the file",
                },
            },
        )


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The known arrays, each claimed size checked before anything is inflated."""
    found = {}
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            key = info.filename.removesuffix(".npy")
            if key not in _KEYS:
                continue
            if info.file_size > _LIMIT:
                msg = f"{key} claims {info.file_size} bytes"
                raise ValueError(msg)
            with archive.open(info) as member:
                found[key] = read_npy(cast(BinaryIO, member), info.file_size)
    return found


def _frame_shape(arrays: dict[str, NDArray[Any]]) -> tuple[int, int]:
    wanted = {"taps": 4, "phasors": 3, "range_m": 2, "z_m": 2}
    for key, ndim in wanted.items():
        if key in arrays:
            if arrays[key].ndim != ndim:
                msg = f"{key} must have {ndim} dimensions, got shape {arrays[key].shape}"
                raise ValueError(msg)
            height, width = arrays[key].shape[-2:]
            return height, width
    msg = f"it holds {sorted(arrays) or 'no known keys'}, wanted one of {', '.join(wanted)}"
    raise ValueError(msg)


def _camera(
    arrays: dict[str, NDArray[Any]], shape: tuple[int, int], hfov_deg: float
) -> tuple[Camera, str]:
    height, width = shape
    if "K" in arrays:
        dist = _real(arrays.get("dist", np.zeros(0)))
        model = "fisheye" if np.any(arrays.get("fisheye", False)) else "pinhole"
        return Camera(width, height, _real(arrays["K"]), dist, model), "from the file"
    return pinhole(width, height, hfov_deg=hfov_deg), f"pinhole, {hfov_deg} degrees assumed"


def _modulation(arrays: dict[str, NDArray[Any]], freq: float) -> Modulation:
    measured = "taps" in arrays or "phasors" in arrays
    if measured and "freqs_hz" not in arrays:
        msg = "it holds no freqs_hz, which phasors and taps need (Hz)"
        raise ValueError(msg)
    if "taps" in arrays and "steps_rad" not in arrays:
        msg = "it holds no steps_rad, which taps need (rad)"
        raise ValueError(msg)
    freqs = _real(arrays.get("freqs_hz", np.array([freq])))
    if "steps_rad" not in arrays:
        return Modulation(freqs)
    return Modulation(freqs, _real(arrays["steps_rad"]))


def _real(array: NDArray[Any]) -> NDArray[np.float64]:
    if array.dtype.kind == "c":
        msg = f"real numbers were wanted, got {array.dtype.name}"
        raise ValueError(msg)
    return array.astype(np.float64)


def _valid(arrays: dict[str, NDArray[Any]], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    return np.asarray(arrays.get("valid", np.ones(shape)), dtype=np.bool_)


def _taps(arrays: dict[str, NDArray[Any]], unit: str) -> Taps | None:
    if "taps" not in arrays:
        return None
    values = single(_real(arrays["taps"]))
    return Taps(values, unit, _valid(arrays, values.shape[-2:]))


def _phasors(arrays: dict[str, NDArray[Any]]) -> Phasors | None:
    if "phasors" not in arrays:
        return None
    stored = arrays["phasors"]
    values = single(stored.real) + 1j * single(stored.imag)
    sigma = single(_real(arrays["sigma"])) if "sigma" in arrays else None
    return Phasors(values, sigma, _valid(arrays, values.shape[-2:]))


def _depth(arrays: dict[str, NDArray[Any]], camera: Camera) -> DepthMap | None:
    kind = next((key for key in ("range_m", "z_m") if key in arrays), None)
    if kind is None:
        return None
    distance = metres(_real(arrays[kind]), 1.0, 0.0)
    extras: dict[str, Any] = {
        key: single(_real(arrays[key]))
        for key in ("sigma_m", "confidence", "amplitude")
        if key in arrays and np.isfinite(arrays[key]).any()  # all NaN: the method had none
    }
    return DepthMap(radial(camera, distance, kind.removesuffix("_m")), **extras)
