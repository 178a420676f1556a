"""What a stored point depends on: code, captures, threads and repeats, as short digests.

A point is kept only while its fingerprint is the current one, so that an edited method, an
updated toftools or another thread count never shows yesterday's figures.
"""

import functools
import hashlib
import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.types import Capture

PACKAGE = Path(__file__).parent.parent


def digest(*parts: object) -> str:
    """Short digest of bytes, files' contents or JSON values.

    Parameters
    ----------
    *parts : bytes or JSON value
        What to digest.

    Returns
    -------
    str
        12 hexadecimal digits.
    """
    sha = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode()
        sha.update(len(data).to_bytes(8, "little") + data)
    return sha.hexdigest()[:12]


@functools.cache
def package_digest() -> str:
    """Digest of the sources of toftools.

    Returns
    -------
    str
        Changes with any line of any module.
    """
    files = sorted(PACKAGE.rglob("*.py"))
    return digest(*(part for file in files for part in (file.name, file.read_bytes())))


def method_digest(target: str) -> str:
    """Digest of the module that holds a user's method; empty for those of toftools.

    Parameters
    ----------
    target : str
        ``module:function``.

    Returns
    -------
    str
        Digest of the module's file.
    """
    module = target.partition(":")[0]
    if module.partition(".")[0] == "toftools":
        return ""
    spec = importlib.util.find_spec(module)
    origin = Path(spec.origin) if spec is not None and spec.origin else None
    return digest(origin.read_bytes()) if origin is not None and origin.is_file() else ""


def capture_digest(capture: Capture) -> str:
    """Digest of all that a capture holds.

    Parameters
    ----------
    capture : Capture
        The capture.

    Returns
    -------
    str
        Changes with any value, whichever file it came from.
    """
    parts: list[Any] = [json.dumps(dict(capture.provenance), default=str)]
    sensor = capture.sensor
    if sensor.camera.model != "pinhole":
        parts.append(sensor.camera.model)
    camera, modulation = sensor.camera, sensor.modulation
    arrays: list[NDArray[Any]] = [camera.K, camera.dist, modulation.freqs_hz, modulation.steps_rad]
    for owner in (capture.taps, capture.phasors, capture.depth, capture.truth):
        for value in vars(owner).values() if owner is not None else ():
            if isinstance(value, np.ndarray):
                arrays.append(value)
    arrays.extend(value for _, value in capture.reported.items())
    return digest(*parts, *(np.ascontiguousarray(array).tobytes() for array in arrays))


def point_fingerprint(*targets: str, repeats: int, threads: int, company: Mapping[str, Any]) -> str:
    """What a point's stored result must match to be kept.

    Parameters
    ----------
    *targets : str
        ``module:function`` of the method, or of every step of a chain.
    repeats, threads : int
        Timed calls, and threads the method may use.
    company : mapping
        What runs beside the point or ran before it in its process: JSON values.

    Returns
    -------
    str
        Digest; the capture and the parameters are in the point's key.
    """
    return digest(package_digest(), *map(method_digest, targets), repeats, threads, dict(company))
