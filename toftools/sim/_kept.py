"""Which shots see the same light: those that differ in electronics and seed of noise alone.

Light is traced, electronics are computed; a family of captures with other noise, other wells or
another contrast needs the light once. Input: shots that name a `light_seed`. Fails to save where
each shot has light of its own, of course.
"""

import hashlib
from dataclasses import fields, is_dataclass

import numpy as np

from toftools.sim.noise import light_freqs_hz
from toftools.types import Shot


def light_seed(shot: Shot) -> int:
    """Seed of sampled light.

    Parameters
    ----------
    shot : Shot
        The exposure.

    Returns
    -------
    int
        `Shot.light_seed`, or the seed of everything.
    """
    return shot.seed if shot.light_seed is None else shot.light_seed


def light_key(shot: Shot) -> str | None:
    """What the light of a scene at rest depends on.

    Parameters
    ----------
    shot : Shot
        The exposure.

    Returns
    -------
    str or None
        A digest, equal for shots with the same light; None where the shot names no `light_seed`.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> dim, bright = (sensor(f"opt8241:signal_e={e}") for e in (100, 1000))
    >>> light_key(Shot(dim, seed=1, light_seed=0)) == light_key(Shot(bright, light_seed=0))
    True
    """
    if shot.light_seed is None:
        return None
    camera, modulation = shot.sensor.camera, shot.sensor.modulation
    wish = (shot.light_seed, shot.max_bounces, shot.samples, shot.tol_m)
    sha = hashlib.sha256()
    # Frequencies of the modulation decide how many bounces count, harmonics what is asked for.
    for part in (
        wish,
        camera,
        shot.sensor.sources,
        modulation.freqs_hz,
        light_freqs_hz(shot.sensor),
    ):
        _add(sha, part)
    return sha.hexdigest()


def _add(sha: "hashlib._Hash", part: object) -> None:
    """Feed a value and all its fields, with their types, into a digest."""
    if is_dataclass(part):
        for field in fields(part):
            _add(sha, (field.name, getattr(part, field.name)))
    elif isinstance(part, np.ndarray):
        sha.update(repr((part.dtype.str, part.shape)).encode() + part.tobytes())
    elif isinstance(part, tuple | list):
        sha.update(b"(")
        for item in part:
            _add(sha, item)
        sha.update(b")")
    else:
        sha.update(repr(part).encode() + b";")
