"""Angles of phasors in turns, fast: a polynomial that compilers vectorise, where libm is a call.

Reference: argument reduction by octants is textbook; the coefficients were fitted for this file.
Inputs: float32 parts of a phasor. Zero has angle zero, NaN gives NaN. Fails below `LEAST`.
"""

import numpy as np
from numba import njit

LEAST = np.float32(1e-30)
"""Phasors whose parts are both smaller have no right angle."""
# Not the full set: NaN and infinity keep their meaning.
FAST = {"reassoc", "contract", "arcp", "nsz"}
# atan(x) / (2 pi x) as a polynomial in x^2 on [0, 1]; least maximum error, fitted for this file:
# 6e-9 turns before float32 rounding, checked against arctan2 in tests/test_unwrapping.py.
ATAN = (
    0.159154837, -0.053046121, 0.0317459452, -0.0221362713,
    0.0153460332, -0.00889872248, 0.00347959732, -0.000645304273,
)  # fmt: skip


@njit(cache=True, fastmath=FAST, inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def turns(re: np.float32, im: np.float32) -> np.float32:
    """Angle of re + j im in [0, 1] turns, float32, without a branch."""
    x, y = abs(re), abs(im)
    u = min(x, y) / max(max(x, y), LEAST)
    s = u * u
    a = np.float32(ATAN[7])
    a = a * s + np.float32(ATAN[6])
    a = a * s + np.float32(ATAN[5])
    a = a * s + np.float32(ATAN[4])
    a = a * s + np.float32(ATAN[3])
    a = a * s + np.float32(ATAN[2])
    a = a * s + np.float32(ATAN[1])
    a = (a * s + np.float32(ATAN[0])) * u
    a = np.float32(0.25) - a if y > x else a
    a = np.float32(0.5) - a if re < 0 else a
    a = np.float32(1.0) - a if im < 0 else a
    return a
