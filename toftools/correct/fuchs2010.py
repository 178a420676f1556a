"""Multipath interference compensation of Fuchs: diffuse interreflection of the visible surfaces.

Every pixel is a diffuse patch that lights every other; the estimated geometry gives the indirect
light, which is subtracted, and the range that is left gives better geometry. Reference: S. Fuchs,
"Multipath interference compensation in time-of-flight camera images", ICPR 2010, 3583-3586
(model recalled; its time, about 10 minutes a frame, from table 7.1 of the thesis below).

Ours, beyond the paper: the measured phasors are the emitters, so that all bounces between visible
surfaces are removed, not one; the albedo is per pixel and drops out (`_interreflection`); emitters
and receivers are as coarse as a second-order bound allows (`_tiles`); all frequencies unwrap and
correct together; a pixel whose answer is not credible (energy diverges, albedo far above one, not
settled) falls back to the uncorrected range with a sigma that holds both.

Input: phasors of one frequency upwards, in the unit of the sensor's electronics: amplitudes are
absolute (`Noise.signal_e`, the emitter's beam), else fit `albedo_gain`. Memory: 300 bytes a pixel.

Fails where light comes from surfaces out of view, and in part where other surfaces stand between
(visibility is not looked at: `prism` in the first set puts 13 mm too little on the wall behind its
box); and where surfaces mirror.
Where the model holds (a right-angled corner, all bounces, all of it in view) 12 iterations leave
0.1 mm of 43 at an albedo of 0.8; three leave 1.4. Its sigma is then right within 6 % up to an
albedo of 0.5, and too small by 1.3 to 1.8 at 0.8, where noise of the geometry comes back through
the transport. Mean absolute error before and after, first set of captures (48 x 64, 40/70 MHz,
noise of the sensor): corner 57 -> 13 mm, V of 60 degrees 36 -> 8, of 90 degrees 16 -> 6, rooms
61 -> 23, 52 -> 25 and 29 -> 15, prisms 49 -> 35 and 47 -> 14, Cornell boxes 717 -> 67 and
735 -> 93 mm (wrong turns, which `semi_global` rights before it starts). `plates`, lit from out of
view, stay as they are.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import refuse_emitter_offset, warm_up
from toftools.correct._interreflection import freed
from toftools.correct._scene import Optics, Surface, optics
from toftools.correct._upsample import irradiance
from toftools.correct.fuchs2010_all_pairs import checked
from toftools.types import C64, DepthMap, Phasors, Sensor

PREVIEW_PX = 2
"""All iterations but the last see every second row and column."""


def fuchs2010(
    sensor: Sensor,
    *,
    tol_mm: float = 1.0,
    iterations: int = 3,
    albedo_gain: float = 1.0,
    max_range_m: float = 0.0,
    start: str = "semi_global",
) -> Callable[[Phasors], DepthMap]:
    """Range without diffuse interreflection.

    Parameters
    ----------
    sensor : Sensor
        Optics, frequencies, light sources and electronics. Frames of another size are taken for
        the same view on another grid.
    tol_mm : float
        Error of range that coarse patches and interpolation may leave, mm.
    iterations : int
        Times geometry is rebuilt.
    albedo_gain : float
        Factor of the radiometric albedo, for cameras whose `signal_e` is not known; 0 fits it:
        with several frequencies to their agreement, with one to an albedo of 0.8 at the 99th
        percentile.
    max_range_m : float
        Longest range that can occur, m; 0 stands for the joint ambiguity, as in `crt`.
    start : str
        With several frequencies, the correction whose range starts the iteration and fixes the
        counts of turns; multipath misleads `semi_global` least. Empty searches the most likely
        range anew at every step.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` is the Cramer-Rao bound of the corrected phasors;
        where the method fell back, that of the plain ones and the shift, in quadrature.
        `confidence` is the share of direct light. ``info``: `status`; `fallback` (H, W) bool;
        `indirect` (F, H, W) complex64, the light removed; `albedo` (H, W); `albedo_gain`;
        `iterations`.

    Raises
    ------
    ValueError
        If a parameter is out of range or the emitter is not at the camera.

    References
    ----------
    S. Fuchs, "Multipath interference compensation in time-of-flight camera images", ICPR 2010.
    J. Marco, "Transient light transport" (thesis, 2018), table 7.1 and chapter 2.

    Examples
    --------
    >>> from toftools.registry import SIMULATORS
    >>> from toftools.sensors import sensor
    >>> from toftools.types import Scene, Shot
    >>> camera = sensor("opt8241:width=40,height=30")
    >>> corner = SIMULATORS["analytic"].build(Scene("corner", {"size": 0.9, "height": 1.0}))
    >>> capture = corner(Shot(camera, noisy=False))
    >>> error = fuchs2010(camera)(capture.phasors).range_m - capture.truth.range_m
    >>> bool(np.nanmedian(np.abs(error)) < 5e-3)  # 26 mm before; the closed form has one bounce
    True
    """
    refuse_emitter_offset(sensor)
    if not (np.isfinite(tol_mm) and tol_mm > 0):
        msg = f"tol_mm must be a positive number of millimetres, got {tol_mm}"
        raise ValueError(msg)

    def sparse(view: Optics, seen: Surface, values: C64) -> C64:
        return irradiance(view, seen, values, 1e-3 * tol_mm)

    recipe = checked(
        sensor, sparse, iterations, albedo_gain, max_range_m, "fuchs2010", PREVIEW_PX, start
    )
    own = optics(sensor)

    def run(phasors: Phasors) -> DepthMap:
        shape = phasors.valid.shape
        return freed(
            phasors, own if shape == sensor.camera.shape else optics(sensor, shape), recipe
        )

    warm_up(run, sensor.modulation.n_freqs)
    return run
