"""Spectral radius of the light transport that a scene model believes in.

Diffuse patches of albedo a send each other light, ``b = a L + R T b`` with R the albedos and T the
form factors of `_transfer` at zero frequency. The spectral radius of ``R T`` is the factor by which
light shrinks from bounce to bounce in the end: 0 where nothing lights anything, the albedo itself
in a closed room of one albedo, 1 or more where the model has no stationary light. The phases of a
modulated frequency turn the entries and make none larger, so that the radius at any frequency is
at most this one (A. Berman, R. J. Plemmons, "Nonnegative matrices in the mathematical sciences",
SIAM 1994, chapter 2; textbook). It is what multiplies an error of the geometry that comes back
through the transport.

By power iteration, the radius being the growth over two bounces: two walls that light only each
other have the eigenvalues r and -r, between which single bounces swing. The norm has weights of
area over albedo, in which ``R T`` is self-adjoint but for the areas in the denominators of
`_transfer`: that growth is then the root of a Rayleigh quotient and converges at twice the rate of
the vector. Inputs: a range,
albedos, patches. Fails as the transport does: nothing stands between patches, and what is out of
view is not there; and where noise hides a crease, as the methods themselves then do.
"""

from dataclasses import replace

import numpy as np

from toftools._transfer import Patches, gather
from toftools.correct import kernel_input
from toftools.correct._interreflection import MOST_ALBEDO, reach_px
from toftools.correct._patches import AREA, LIGHT, NORMAL, PLACE, merged
from toftools.correct._scene import optics, surface
from toftools.correct._wraps import Candidates
from toftools.types import F32, DepthMap, Sensor

MOST_BLOCKS = 2048
"""Larger frames are merged into as many. Corners of 60 to 120 degrees in 160 x 120 pixels have
radii within 8 % of each other for 512 to 8192 blocks. One core: 11 ms for 64 x 48 pixels, 0.1 s for
320 x 240."""
TOLERANCE, MOST_STEPS = 1e-4, 200
"""Relative change of the radius over a bounce that ends the iteration; most bounces."""


def spectral_radius(sensor: Sensor, depth: DepthMap) -> float:
    """Spectral radius of the transport at an answered range.

    Parameters
    ----------
    sensor : Sensor
        Camera that the method was told of.
    depth : DepthMap
        An answer with ``info["albedo"]`` (H, W), the albedo of every pixel, as `fuchs2010`,
        `fuchs2010_all_pairs`, `fuchs2013` and `jimenez2014` give it; NaN reflects nothing, and
        above `MOST_ALBEDO`, where those methods stop to believe it, it counts as that.

    Returns
    -------
    float
        0 or more; NaN where no pixel has a range.

    Raises
    ------
    ValueError
        If the answer has no albedos of its own shape.
    """
    albedo = np.asarray(depth.info.get("albedo"))
    if albedo.shape != depth.range_m.shape or albedo.dtype.kind != "f":
        msg = f"wanted info['albedo'] {depth.range_m.shape} of numbers, got {albedo.dtype} "
        msg += f"{albedo.shape}; take a method that models the transport"
        raise ValueError(msg)
    known = np.isfinite(depth.range_m) & (depth.range_m > 0)
    if not known.any():
        return float("nan")
    range_m = np.where(known, depth.range_m, np.float32(np.nan))
    view = replace(optics(sensor, range_m.shape), freqs_hz=np.zeros(1))
    noise_m, reach = np.zeros_like(range_m), 1
    if depth.sigma_m is not None:
        noise_m = np.where(known & np.isfinite(depth.sigma_m), depth.sigma_m, noise_m)
        with np.errstate(divide="ignore"):
            known_to = (1 / noise_m**2).astype(np.float32)
        told = Candidates(range_m[None], noise_m[None], known_to, view.freqs_hz.size)
        reach = reach_px(view, told, known, known=True)
    seen = surface(view, range_m, noise_m=noise_m, reach_px=reach)
    block = max(1, int(np.ceil(np.sqrt(range_m.size / MOST_BLOCKS))))
    reflects = np.clip(np.nan_to_num(albedo, nan=0.0, posinf=MOST_ALBEDO), 0, MOST_ALBEDO)
    table = merged(view, seen, kernel_input(reflects[None].astype(np.complex64)), block)
    used = table[table[..., AREA] > 0].T  # (8 + 2, N)
    return radius_of(
        Patches(used[PLACE:NORMAL], used[NORMAL : NORMAL + 3], used[AREA]), used[LIGHT]
    )


def radius_of(patches: Patches, albedo: F32) -> float:
    """Spectral radius of the transport between patches.

    Parameters
    ----------
    patches : Patches
        Places, normals, areas.
    albedo : ndarray, (N,)
        Share of the light that each sends back.

    Returns
    -------
    float
        0 or more.

    Examples
    --------
    Two discs that face each other share a form factor of ``A / (pi r^2 + A)``.

    >>> at = np.array([[0, 0], [0, 0], [0, 2]], np.float32)
    >>> facing = np.array([[0, 0], [0, 0], [1, -1]], np.float32)
    >>> two = Patches(at, facing, np.full(2, np.pi, np.float32))
    >>> round(radius_of(two, np.array([0.5, 0.5], np.float32)), 4)
    0.1
    """
    if not (albedo > 0).any():
        return 0.0
    still = np.zeros(1)  # Hz: light without phases
    weight = np.where(albedo > 0, patches.area_m2 / np.where(albedo > 0, albedo, 1), 0)
    light = (albedo > 0).astype(np.complex64)[None]
    radius, growth = 0.0, np.zeros(2)  # of the last bounce and of the one before
    for step in range(MOST_STEPS):
        before = radius
        light = (albedo * gather(patches, patches, light, still)).astype(np.complex64)
        size = float(np.sqrt(np.sum(weight * np.abs(light[0]) ** 2, dtype=np.float64)))
        if size == 0:
            return 0.0
        light /= np.float32(size)
        growth[:] = size, growth[0]
        radius = float(np.sqrt(growth.prod()))
        if step > 2 and abs(radius - before) <= TOLERANCE * radius:
            break
    return radius
