"""Diffuse places that rays met, whose indirect light is looked up in a cache."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.sim._task import Jit, Task
from toftools.types import F64


@dataclass(frozen=True, eq=False)
class Hits:
    """Diffuse places that rays met.

    Parameters
    ----------
    lane : ndarray of int, (K,)
        Point that the ray came from.
    p, n : ndarray, (3, K)
        Places in scene units, and normals.
    weight : ndarray, (K,)
        Share of the point's mean radiance.
    length_m : ndarray, (K,)
        Optical way from the point, m.
    guessed : ndarray of int, (K,)
        Row of `LightMap.light` that has been counted in its stead; -1 is dark.
    straight : ndarray of bool, (K,)
        Whether the way there led by no other surface.
    at : list of SurfaceInteraction3f
        The places, part by part.
    """

    lane: Any
    p: F64
    n: F64
    weight: F64
    length_m: F64
    guessed: Any
    straight: Any
    at: list[Jit]


def no_hits() -> Hits:
    """Hits of no ray."""
    none = np.zeros(0)
    return Hits(
        none.astype(np.int64),
        np.zeros((3, 0)),
        np.zeros((3, 0)),
        none,
        none,
        none.astype(np.int64),
        none.astype(bool),
        [],
    )


def joined(parts: list[Hits]) -> Hits:
    """Several sets of hits as one.

    Parameters
    ----------
    parts : list of Hits
        Sets; lanes must already count through.

    Returns
    -------
    Hits
        All of them.
    """
    names = ("lane", "p", "n", "weight", "length_m", "guessed", "straight")
    rows = {name: np.concatenate([getattr(part, name) for part in parts], -1) for name in names}
    return Hits(**rows, at=[si for part in parts for si in part.at])


def surfaces_of(task: Task, hits: Hits, number: Any) -> list[Jit]:  # noqa: ANN401 - ints
    """Surfaces of some hits, part by part.

    Parameters
    ----------
    task : Task
        Scene.
    hits : Hits
        What rays met.
    number : ndarray of int
        Which of them, rising.

    Returns
    -------
    list of SurfaceInteraction3f
        Their surfaces.
    """
    import drjit as dr

    mi, parts, start = task.mi, [], 0
    for at in hits.at:
        end = start + dr.width(at.t)
        mine = number[(number >= start) & (number < end)] - start
        if mine.size:
            index = mi.UInt32(mine.astype(np.uint32))
            parts.append(dr.gather(mi.SurfaceInteraction3f, at, index))
        start = end
    dr.eval(parts)
    return parts
