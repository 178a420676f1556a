"""Radiometric optimisation: the range image whose simulated phasors are the measured ones.

A range image without multipath predicts, by direct light and interreflection between diffuse
patches, what the camera sees; the ranges are moved until prediction and measurement agree
(`_jimenez_fit`: the objective, equations and exact gradient). Here that is done on a coarse grid
of nodes by L-BFGS, and the light of the optimised nodes is gathered at every pixel, whose direct
light is then ``m / (1 + h)`` as in `fuchs2010`; normals are renewed between rounds.

Reference: D. Jimenez, D. Pizarro, M. Mazo, S. Palazuelos, "Modeling and correction of multipath
interference in time of flight cameras", Image and Vision Computing 32 (2014) 1-13 (abstract read,
the rest recalled): ranges are the unknowns of a radiometric model that is fitted to the
measurements by an iterative optimiser. Ours: analytic gradients, the coarse grid, all bounces by
taking the measured light of the emitters, albedo as a function of the ranges, smoothness of the
correction instead of the surface, the last step at full resolution, and the return to the plain
answer where the result is not credible (`fuchs2010`).

Input: as for `fuchs2010`, one frequency upwards. Time: 1.8 s of one core a frame of 320 x 240 at
two frequencies (1200 nodes, 30 steps), where the paper has minutes; about 300 bytes a pixel. Fails
as `fuchs2010` does: light from surfaces out of view, wrong turns at the start (another minimum),
mirrors; and where objects are smaller than a node. Its optimum solves the equations that the
iteration of `fuchs2010` solves: it is no more exact where that one has converged. Mean absolute
error before and after, first set of captures (48 x 64, 40/70 MHz, noise of the sensor): corner 57
-> 12 mm, V of 60 degrees 36 -> 9, V of 90 16 -> 7, rooms 61 -> 49, 52 -> 36 and 29 -> 16, prisms
47 -> 14 and 49 -> 41 mm; medians of Cornell boxes 77 -> 63 and 59 -> 54 mm (their means, 0.7 m,
are wrong turns). Su frames 1-3 (`albedo_gain` 0, medians): 45 -> 33, 23 -> 10, 65 -> 48 mm.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from toftools._transfer import gather
from toftools.correct import refuse_emitter_offset, warm_up
from toftools.correct._interreflection import Irradiance, freed
from toftools.correct._jimenez_fit import minimise, moved, problem, sent_light
from toftools.correct._jimenez_nodes import place
from toftools.correct._scene import Optics, Surface, optics, patches
from toftools.correct.fuchs2010_all_pairs import all_pairs, checked
from toftools.types import C64, F32, DepthMap, Phasors, Sensor

ROUNDS = 3
"""Times that normals are renewed."""
MOST_NODES = 20_000
"""400 million pairs: a second a step."""


def jimenez2014(
    sensor: Sensor,
    *,
    nodes: int = 1200,
    iterations: int = 10,
    slope: float = 0.02,
    albedo_gain: float = 1.0,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """Range at which simulated interreflection explains the phasors.

    Parameters
    ----------
    sensor : Sensor
        Camera, flash, frequencies and signal, as for `fuchs2010`.
    nodes : int
        About how many patches the frame is simulated with; time grows with their square.
    iterations : int
        Steps of the optimiser in each of three rounds, between which normals are renewed.
    slope : float
        By how much the error of the range may differ between neighbouring nodes, as a share of
        their distance (one standard deviation): less is smoother.
    albedo_gain, max_range_m : float
        As for `fuchs2010`.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap`` as `fuchs2010` gives it.

    Raises
    ------
    ValueError
        If a parameter is out of range or the emitter is not at the camera.

    References
    ----------
    D. Jimenez, D. Pizarro, M. Mazo, S. Palazuelos, "Modeling and correction of multipath
    interference in time of flight cameras", Image and Vision Computing 32 (2014) 1-13.
    """
    if not (1 <= nodes <= MOST_NODES and iterations >= 1 and 0 < slope < np.inf):
        msg = (
            f"got nodes={nodes}, iterations={iterations}, slope={slope}; wanted 1..{MOST_NODES} "
            "nodes, 1 iteration or more and a positive slope"
        )
        raise ValueError(msg)
    refuse_emitter_offset(sensor)
    usual = checked(
        sensor, all_pairs, ROUNDS, albedo_gain, max_range_m, "jimenez2014", start="semi_global"
    )
    own = optics(sensor)

    def run(phasors: Phasors) -> DepthMap:
        shape = phasors.values.shape[1:]
        view = own if shape == sensor.camera.shape else optics(sensor, shape)
        light = _optimised(phasors.sigma, nodes, iterations, slope, albedo_gain)
        return freed(phasors, view, replace(usual, irradiance=light))

    warm_up(run, sensor.modulation.n_freqs)
    return run


def _optimised(
    sigma: F32 | None, count: int, iterations: int, slope: float, albedo_gain: float
) -> Irradiance:
    """Transport from nodes at the ranges of least misfit."""

    def arrived(view: Optics, seen: Surface, values: C64) -> C64:
        out = np.zeros(values.shape, np.complex64)
        usable = seen.known & (np.abs(values) > 0).all(axis=0)
        here = place(view, seen, values, sigma, usable, count=count)
        if here.range_m.size:
            task = problem(here, view.freqs_hz, slope=slope, albedo_gain=albedo_gain)
            x_m = minimise(task, iterations=iterations)
            emitters, sent = moved(here, x_m), sent_light(task, x_m)
            out[:, usable] = gather(patches(seen, usable), emitters, sent, view.freqs_hz)
        return out

    return arrived
