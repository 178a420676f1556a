"""Multipath interference compensation with few albedos: `fuchs2010` for scenes of materials.

With a(u) the albedo of the material at u and E(u) the irradiance from all other pixels, delayed
by the way to the camera, the measured phasor is ``m(u) = a(u) [L(u) + E(u)]``, L(u) > 0 the
flash. `fuchs2010` takes L from geometry and sensor, pixel by pixel; here a is known, a constant of
its material, and L follows from the brightness,

    L = sqrt(|m|^2 / a^2 - Im(E)^2) - Re(E),     direct = m L / (L + E).

So beam profile and cosine at the receiver matter only in their median over a material, and with
`albedos` given not even the scale of the amplitudes does. Geometry, and with it E, is iterated.

Reference: S. Fuchs, M. Suppa, O. Hellwich, "Compensation for multipath in ToF camera measurements
supported by photometric calibration and environment integration", ICVS 2013, LNCS 7963, 31-41
(recalled): several albedos, of regions that a user marks. Reconstructed: the regions come from
the brightness (`_segments`), or from a file; the paper's environment model, which brings in
surfaces out of view, is left out. The rest is that of `fuchs2010`: all bounces at once, coarse
transport, the return to the plain answer.

Input: as for `fuchs2010`, one frequency upwards; about 300 bytes a pixel. Time: 0.2 s for 320 x
240 at two frequencies on two cores. Fails as `fuchs2010` does, and where albedo is not
constant over a material. Mean absolute error in a 90 degree corner with all its bounces (48 x 36,
40/70 MHz, no noise; plain 26 to 28 mm): materials of 0.3 and 0.8 in halves or any checkerboard
down to single pixels 0.2 to 0.3 mm (`fuchs2010`: 0.3 to 0.4), a ramp of albedo from 0.2 to 0.9
2.9 mm (0.3), random albedos of pixels 4.4 mm (0.3), two materials taken for one (``segments=1``)
14 mm. At a quarter, a half, twice or four times the amplitudes ``albedos=0.3+0.8,albedo_gain=0``
keeps 0.3 mm; with a gain of 1 all methods lose: 12 mm at one half. Noise (2 % of the signal): the
correction varies by 4 to 10 % less than that of `fuchs2010_all_pairs`, 3.9 mm against 4.3, little
beside the 6 mm of the pixels: there albedo cancels, and what is left are the normals; `sigma_m` is
that of `fuchs2010`, too large in small frames of bright walls (error over sigma 0.7). First set
of captures (48 x 64, 40/70 MHz, noise of the sensor), mean absolute error before and after: corner
57 -> 13 mm, V of 60 degrees 36 -> 7, V of 90 16 -> 6, rooms 61 -> 48, 52 -> 37 and 29 -> 18,
prisms 47 -> 14 and 49 -> 37 mm; medians of Cornell boxes 77 -> 62 and 59 -> 55 mm (their means,
0.7 m, are wrong turns). Su frames 1-3 (`albedo_gain` 0, medians): 45 -> 33, 23 -> 10, 65 -> 47 mm.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from toftools.correct import refuse_emitter_offset, warm_up
from toftools.correct._albedo_gain import fitted_gain
from toftools.correct._interreflection import freed
from toftools.correct._scene import Optics, Surface, lit, optics, surface
from toftools.correct._segments import MOST_CLASSES, Labels, classes, labelled, read_labels
from toftools.correct._upsample import irradiance
from toftools.correct._wraps import Plan, search
from toftools.correct.fuchs2010_all_pairs import all_pairs, checked
from toftools.types import C64, F32, F64, Bool, DepthMap, Phasors, Sensor
from toftools.units import path_to_phase

LEAST_FLASH = 0.1
"""Direct light counts as at least this share of a pixel's brightness."""


@dataclass(frozen=True, eq=False)
class Materials:
    """What is known of the materials.

    Parameters
    ----------
    segments : int
        Most materials to look for.
    albedos : ndarray, (C,)
        Their albedos, rising; empty if unknown.
    labels : ndarray, (H, W), int8, or None
        Material of every pixel.
    tol_m : float
        Error of the transport, m.
    """

    segments: int
    albedos: F64
    labels: Labels | None
    tol_m: float


def fuchs2013(
    sensor: Sensor,
    *,
    segments: int = 4,
    albedos: tuple[float, ...] = (),
    labels: str = "",
    tol_mm: float = 1.0,
    iterations: int = 3,
    albedo_gain: float = 1.0,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """Range without diffuse interreflection, one albedo per material.

    Parameters
    ----------
    sensor : Sensor
        Camera, flash, frequencies (one or more), and signal: as for `fuchs2010`.
    segments : int
        Most materials to look for, 1..8.
    albedos : tuple of float
        Albedos of the materials, such as ``0.2+0.5+0.8``, instead of looking for them; with
        `labels`, the first is that of label 0, and so on.
    labels : str
        File with the material of every pixel: ``.npy`` or one-channel ``.png`` of whole numbers
        from 0. Materials are then not looked for.
    tol_mm, iterations : float, int
        As for `fuchs2010`.
    albedo_gain : float
        Factor between the albedo that sensor and amplitude say and the true one; 0 fits it: so
        that brightness fits `albedos`, or that the corrected frequencies agree.
    max_range_m : float
        As for `crt`.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap`` as `fuchs2010` gives it. ``info["labels"]`` (H, W) int8 is
        the material of every pixel, ``info["albedos"]`` (C,) theirs.

    Raises
    ------
    ValueError
        If a parameter is out of range, the file of labels is not what it should be, or the
        emitter is not at the camera.

    References
    ----------
    S. Fuchs, M. Suppa, O. Hellwich, "Compensation for multipath in ToF camera measurements
    supported by photometric calibration and environment integration", ICVS 2013, LNCS 7963.
    """
    refuse_emitter_offset(sensor)
    if not (np.isfinite(tol_mm) and tol_mm > 0):
        msg = f"tol_mm must be a positive number of millimetres, got {tol_mm}"
        raise ValueError(msg)
    known = _materials(segments, albedos, labels, sensor.camera.shape, 1e-3 * tol_mm)
    usual = checked(
        sensor, all_pairs, iterations, albedo_gain, max_range_m, "fuchs2013", start="semi_global"
    )
    own = optics(sensor)

    def run(phasors: Phasors) -> DepthMap:
        shape = phasors.valid.shape
        view = own if shape == sensor.camera.shape else optics(sensor, shape)
        gain = albedo_gain or _fitted(phasors, view, usual.walk, known)
        view = replace(view, flash=view.flash / np.float32(gain))
        found: list[tuple[Labels, F64]] = []

        def transport(view: Optics, seen: Surface, values: C64) -> C64:
            arrived, label, albedo = _by_material(view, seen, values, known)
            found[:] = [(label, albedo)]
            return arrived

        depth = freed(phasors, view, replace(usual, irradiance=transport, albedo_gain=1.0))
        label, albedo = found[0]
        extra = {"labels": label, "albedos": albedo, "albedo_gain": gain}
        return replace(depth, info={**depth.info, **extra})

    warm_up(run, sensor.modulation.n_freqs)
    return run


def _materials(
    segments: int,
    albedos: tuple[float, ...] | float,
    labels: str,
    shape: tuple[int, int],
    tol_m: float,
) -> Materials:
    """The parameters, checked."""
    given = np.atleast_1d(np.asarray(albedos, np.float64))
    if not 1 <= segments <= MOST_CLASSES:
        msg = f"segments must be 1..{MOST_CLASSES}, got {segments}"
        raise ValueError(msg)
    if not ((given > 0) & (given <= 1)).all():
        msg = f"albedos must lie in (0, 1], got {given.tolist()}"
        raise ValueError(msg)
    if not labels:
        return Materials(segments, np.sort(given), None, tol_m)
    drawn = read_labels(labels, shape)
    if given.size and drawn.max() >= given.size:
        msg = f"got {given.size} albedos for labels up to {drawn.max()}; give one for every label"
        raise ValueError(msg)
    return Materials(segments, given, drawn, tol_m)


@np.errstate(all="ignore")  # pixels without light hold anything
def _by_material(
    view: Optics, seen: Surface, values: C64, known: Materials
) -> tuple[C64, Labels, F64]:
    """Irradiance as if the flash were what brightness and material say; labels, albedos."""
    arrived = irradiance(view, seen, values, known.tol_m)
    flash, delayed = lit(view, seen), _delayed(view, seen, arrived)
    strength = np.abs(values)
    usable = seen.known & (strength > 0).all(axis=0)
    albedo = _albedo(strength, flash + delayed)
    label, albedos = _segmented(albedo, usable & seen.flat, known)
    own = np.asarray(albedos, np.float32)[label] if albedos.size else np.ones_like(albedo)
    level = strength / own
    direct = np.sqrt(np.maximum(level**2 - delayed.imag**2, 0)) - delayed.real
    direct = np.maximum(direct, np.float32(LEAST_FLASH) * level)
    scaled = arrived * (flash / direct)
    lit_up = usable & (direct > 0) & np.isfinite(scaled)
    return np.where(lit_up, scaled, 0).astype(np.complex64), label, albedos


def _delayed(view: Optics, seen: Surface, arrived: C64) -> C64:
    """Irradiance as it would reach the camera."""
    range_m = np.sqrt(np.sum(seen.position * seen.position, axis=0))
    turn = np.exp(-1j * path_to_phase(range_m, view.freqs_hz[:, None, None]))
    return np.asarray(arrived * turn, np.complex64)


def _albedo(strength: F32, light: C64 | F32) -> F32:
    """Measured over arriving light, all frequencies together."""
    total = np.abs(light).sum(axis=0)
    return np.asarray(strength.sum(axis=0) / np.maximum(total, 1e-20), np.float32)


def _segmented(albedo: F32, usable: Bool, known: Materials) -> tuple[Labels, F64]:
    """Material of every pixel, and the albedo of each material."""
    if known.labels is not None:
        label = _resized(known.labels, albedo.shape)
        if known.albedos.size:
            return label, known.albedos
        mine = [albedo[usable & (label == c)] for c in range(int(label.max()) + 1)]
        whole = float(np.median(albedo[usable])) if usable.any() else 1.0
        return label, np.array([float(np.median(a)) if a.size else whole for a in mine])
    albedos = known.albedos if known.albedos.size else classes(albedo, usable, known.segments)
    if not albedos.size:
        return np.zeros(albedo.shape, np.int8), albedos
    label = labelled(albedo, usable, albedos)
    return label, albedos


def _resized(label: Labels, shape: tuple[int, ...]) -> Labels:
    """Labels on another grid of the same view."""
    rows, columns = (
        (np.arange(n) * m + m // 2) // n for n, m in zip(shape, label.shape, strict=True)
    )
    return np.ascontiguousarray(label[rows[:, None], columns])


def _fitted(phasors: Phasors, view: Optics, walk: Plan, known: Materials) -> float:
    """Gain at which the albedos of the plain answer are those given, or its frequencies agree."""
    plain = search(phasors, walk, top=1)
    valid = phasors.valid & (plain.information > 0)
    values = np.where(valid, phasors.values, np.complex64(0))
    range_m = np.where(valid, plain.range_m[0], np.float32(np.nan))
    seen = surface(view, range_m)
    flash, delayed = (
        lit(view, seen),
        _delayed(view, seen, irradiance(view, seen, values, known.tol_m)),
    )
    usable = valid & seen.flat
    if not (known.albedos.size and usable.any()):
        ratio = (delayed / np.maximum(flash, np.float32(1e-9))).astype(np.complex64)
        return fitted_gain(values, ratio, flash, range_m, view.freqs_hz)
    rough = np.log(_albedo(np.abs(values), flash)[usable])
    rough = rough[:: 1 + rough.size // 4096]
    wanted = np.log(known.albedos)
    tried = np.linspace(wanted[0] - rough.max(), wanted[-1] - rough.min(), 201)
    off = [np.abs(rough[:, None] + shift - wanted).min(axis=1).mean() for shift in tried]
    return float(np.exp(tried[int(np.argmin(off))]))
