"""Corrections: one method per file, ``make(sensor, *, params) -> run(phasors) -> DepthMap``.

Every correction says per pixel why there is no answer, in ``info["status"]``: an (H, W) uint8
array of the codes below.
"""

OK = 0
"""The pixel has a range."""
INVALID = 1
"""The input was invalid or without signal: saturated, missing, zero amplitude."""
REJECTED = 2
"""The method looked at the pixel and trusts none of its answers."""
