"""Companded converters: few codes, spaced as far apart as shot noise allows.

A companded read-out stores a tap in a short code whose steps grow with the signal; the camera's
driver turns codes back into digital numbers by a table, and taps here hold these numbers. The
Kinect v2 stores 11 bits, sign included, and its table spans 16: its steps double every 128 codes.
Its pixel reads the difference of two nodes, so its codes are signed; here every tap is companded by
itself, which uses the half above zero. How its table came about is not published: that the steps
follow shot noise is inferred from the table.
"""

from pathlib import Path

import numpy as np

from toftools.types import F64, Noise

SEGMENT = 128
DOUBLINGS = 6


def kinect2_codes() -> tuple[float, ...]:
    """Digital number of each positive code of a Kinect v2.

    Returns
    -------
    tuple of float, (1024,)
        Steps of 1 over the first 256 codes, then 2, 4, ... 64 over 128 codes each; the next code
        after the last means saturated.

    Examples
    --------
    >>> codes = kinect2_codes()
    >>> len(codes), codes[255], codes[-1]
    (1024, 255.0, 16320.0)
    """
    steps = np.repeat([1, *2 ** np.arange(DOUBLINGS + 1)], SEGMENT)
    return (0.0, *np.cumsum(steps, dtype=np.float64)[:-1].tolist())


def codes_of_file(path: Path | str) -> tuple[float, ...]:
    """Positive half of a table as drivers of the Kinect v2 keep it.

    Parameters
    ----------
    path : path
        2048 int16, little endian: numbers rising from 0 by code, 32767 where saturated, then the
        same with the other sign.

    Returns
    -------
    tuple of float
        Digital number of each code below saturation.

    Raises
    ------
    ValueError
        If the file is no such table.
    """
    path = Path(path)
    if not path.is_file() or path.stat().st_size != 4096:
        size = f"{path.stat().st_size} bytes" if path.is_file() else "no such file"
        msg = f"{path.name} is no companding table: got {size}, wanted 2048 int16 (4096 bytes)"
        raise ValueError(msg)
    half = np.fromfile(path, dtype="<i2")[:1024].astype(np.float64)
    if half[0] != 0 or not (np.diff(half) > 0).all():
        msg = f"{path.name} is no companding table: its first 1024 numbers do not rise from 0"
        raise ValueError(msg)
    return tuple(half[half < np.iinfo(np.int16).max].tolist())


def companded(numbers: F64, noise: Noise) -> F64:
    """Nearest number that a companded converter has a code for.

    Parameters
    ----------
    numbers : ndarray
        Signal, DN.
    noise : Noise
        Its `codes_dn`.

    Returns
    -------
    ndarray
        Numbers out of the table, with the sign of the signal.

    Examples
    --------
    >>> companded(np.array([-300.2, 0.4, 300.9, 1e6]), Noise(dn_per_e=1, codes_dn=kinect2_codes()))
    array([ -300.,     0.,   300., 16320.])
    """
    codes = np.asarray(noise.codes_dn)
    nearest = codes[np.searchsorted((codes[1:] + codes[:-1]) / 2, np.abs(numbers))]
    return np.asarray(np.copysign(nearest, numbers) + 0.0)
