"""Rays between two surfaces that neither start nor end on them."""

from typing import Any

from toftools.sim._task import Jit

CLEAR = 1e-4
"""Rays between places start and end this much above the surfaces, relative to coordinates."""


def above(p: Jit, n: Jit) -> Jit:
    """Places a little above their surfaces.

    Parameters
    ----------
    p, n : Point3f, Normal3f
        Places and normals.

    Returns
    -------
    Point3f
        Moved places.
    """
    import drjit as dr

    return p + n * (CLEAR * (1 + dr.max(dr.abs(p))))


def segment(mi: Any, start: Jit, end: Jit) -> Jit:  # noqa: ANN401 - the module mitsuba
    """Ray from one place to another.

    Parameters
    ----------
    mi : module
        Mitsuba with a Dr.Jit variant set.
    start, end : Point3f
        Ends.

    Returns
    -------
    Ray3f
        Ray whose length 1 is the way.
    """
    return mi.Ray3f(start, end - start, mi.Float(1.0), mi.Float(0.0), mi.Color0f())
