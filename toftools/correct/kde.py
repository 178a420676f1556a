"""Unwrapping by kernel density estimation: neighbours vote on each pixel's wrap hypotheses.

Per pixel the most likely wrap hypotheses d_h are kept, each with a weight
``w_h = exp(-J_h / (2 s1^2)) exp(-sum_i sigma_phi_i^2 / (2 s2^2))`` (equations 15 and 23), J_h the
weighted residual of the hypothesis. Over a window with spatial weights g,
``p(d) = sum_j g_j sum_h w_jh K((d - d_jh) / h) / sum_j g_j sum_h w_jh`` with Gaussian K
(equation 13); the pixel takes its own hypothesis of highest density, which is its confidence, and
no answer where that is below the threshold (equation 25).

Reference: F. Järemo Lawin, P.-E. Forssén, H. Ovrén, "Efficient multi-frequency phase unwrapping
using kernel density estimation", ECCV 2016 (arXiv 1608.05209); equation numbers and the parameter
values s1^2 = 2, s2^2 = 3, h^2 = 0.0239 (2.083 m)^2 as stated in the authors' decoder (read).
Different here: J is the chi-squared of the maximum-likelihood search, softened by a model error
(the decoder has fixed weights for 80/16/120 MHz), so any frequencies will do, and the phase noise
comes from the phasors' sigma (the paper fits it to the amplitude). Reconstructed: the width of
the spatial weights, a quarter of the window. Input: two or more frequencies, better with sigma.
Fails on structures smaller than half a window, across whose edges a wrong hypothesis can find
more neighbours than the right one, and where multipath moves a whole region to the same wrong
wrap.
"""

from collections.abc import Callable

import numpy as np
from numba import njit, prange

from toftools._turns import FAST
from toftools.correct import INVALID, OK, REJECTED, refuse_emitter_offset, warm_up
from toftools.correct._wraps import Candidates, Plan, plan, search
from toftools.types import F32, DepthMap, Phasors, Sensor

BLOCK = 2048
"""Pixels per block: the arrays of a block stay in the second-level cache."""
WIDEST_PHASE_RAD = np.float32(np.pi / 2)
"""Phase noise counts as no more than this (read in the authors' decoder)."""
LEAST_SHARE = np.float32(1e-6)
"""Hypotheses whose weight is less than this share of the pixel's best are none. It changes no
answer that was looked at, and keeps products out of the slow denormal numbers."""


def kde(
    sensor: Sensor,
    *,
    window_px: int = 7,
    hypotheses: int = 2,
    threshold: float = 0.5,
    bandwidth_m: float = 0.32,
    model_rad: float = 0.2,
    likelihood_scale: float = 2.0,
    phase_scale: float = 3.0,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """Range whose wraps have the most support among the neighbours.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more.
    window_px : int
        Side of the window, odd, px.
    hypotheses : int
        Wrap hypotheses kept per pixel.
    threshold : float
        Least density that counts as an answer, 0..1. The published 0.5 is cautious where sigma is
        right: 0.2 keeps a third more right pixels at long range for 0.4 % wrong ones
        (benchmarks/long_range.py at 20 ke-).
    bandwidth_m : float
        Standard deviation of the kernel along the range, m.
    model_rad : float
        Phase error that is not noise (multipath, calibration), rad: residuals of bright pixels
        are judged against this and not against their tiny noise. The only scale where sigma is
        unknown.
    likelihood_scale, phase_scale : float
        Scales s1^2 and s2^2 of the two weights.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``: `confidence` is the density, pixels below `threshold` are
        NaN with status REJECTED, `sigma_m` the Cramer-Rao bound where sigma is known.

    Raises
    ------
    ValueError
        If there is one frequency only, a parameter is out of range, or the emitter is not at the
        camera.

    References
    ----------
    F. Järemo Lawin, P.-E. Forssén, H. Ovrén, ECCV 2016, equations 13, 15, 23 and 25.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("opt8241:width=9,height=9")
    >>> phase = range_to_phase(9.0, camera.modulation.freqs_hz)[:, None, None]
    >>> frame = Phasors(np.exp(1j * np.broadcast_to(phase, (2, 9, 9))))
    >>> round(float(kde(camera)(frame).range_m[0, 0]), 4)
    9.0
    """
    refuse_emitter_offset(sensor)
    walk = plan(sensor, max_range_m, least_freqs=2, method="kde")
    _check(window_px, hypotheses, threshold, bandwidth_m, model_rad, likelihood_scale, phase_scale)
    spatial = _spatial_weights(window_px)
    scale = np.float32(1 / (2 * bandwidth_m**2))

    def run(phasors: Phasors) -> DepthMap:
        found = search(phasors, walk, top=hypotheses)
        cost = _softened(found, walk, model_rad, known=phasors.sigma is not None)
        weight = np.exp(cost * np.float32(-0.5 / likelihood_scale))
        valid = phasors.valid & (found.information > 0)
        heard = valid & (weight > LEAST_SHARE) & (weight > LEAST_SHARE * weight[0])
        weight = np.where(heard, weight * _phase_likelihood(phasors, phase_scale), np.float32(0))
        range_m = np.where(weight > 0, found.range_m, np.float32(0))
        density = np.where(weight > 0, _density(range_m, weight, spatial, scale), np.float32(0))
        best = density.argmax(axis=0)[None]
        confidence = np.take_along_axis(density, best, axis=0)[0]
        chosen = np.take_along_axis(range_m, best, axis=0)[0]
        kept = valid & (confidence > 0) & (confidence >= threshold)
        sigma_m = None
        if phasors.sigma is not None:
            sigma_m = np.full(kept.shape, np.nan, np.float32)
            sigma_m[kept] = 1 / np.sqrt(found.information[kept])
        status = np.where(
            kept, np.uint8(OK), np.where(valid, np.uint8(REJECTED), np.uint8(INVALID))
        )
        return DepthMap(
            range_m=np.where(kept, chosen, np.float32(np.nan)),
            sigma_m=sigma_m,
            confidence=np.where(valid, confidence, np.float32(0)),
            info={"status": status, "changed": kept & (best[0] > 0)},
        )

    warm_up(run, sensor.modulation.n_freqs)
    return run


def _check(window_px: int, hypotheses: int, threshold: float, *scales: float) -> None:
    if window_px < 1 or window_px % 2 == 0 or window_px != int(window_px):
        msg = f"window_px must be an odd number of pixels, got {window_px}"
        raise ValueError(msg)
    if not 1 <= hypotheses <= 8:
        msg = f"hypotheses must be 1..8, got {hypotheses}"
        raise ValueError(msg)
    if min(scales) <= 0 or not 0 <= threshold <= 1:
        msg = f"bandwidth and scales must be positive and threshold 0..1, got {scales}, {threshold}"
        raise ValueError(msg)


def _spatial_weights(window_px: int) -> F32:
    """Gaussian weights of one axis, standard deviation a quarter of the window."""
    offset = np.arange(window_px) - window_px // 2
    weight = np.exp(-0.5 * (offset / (window_px / 4)) ** 2)
    return np.asarray(weight / weight.sum(), dtype=np.float32)


def _softened(found: Candidates, walk: Plan, model_rad: float, *, known: bool) -> F32:
    """Residuals (T, H, W) as chi-squared of noise and model error together.

    A chi-squared of phase noise sigma divided by ``1 + model^2 / sigma^2`` is one of variance
    ``sigma^2 + model^2``; the mean of 1 / sigma^2 over the frequencies stands for each of them.
    """
    snr2 = found.information * np.float32(1 / walk.information.sum())
    dearer = np.float32(known) + np.float32(model_rad**2) * snr2
    # Pixels without signal have no information and no residual: any positive number will do.
    return np.asarray(found.cost / np.maximum(dearer, np.float32(1e-30)))


def _phase_likelihood(phasors: Phasors, phase_scale: float) -> F32:
    """Weight of a pixel (H, W) by its phase noise: equation 23."""
    if phasors.sigma is None:
        return np.ones(phasors.valid.shape, np.float32)
    amplitude = np.maximum(np.abs(phasors.values), np.float32(1e-30))
    noise = np.minimum(phasors.sigma / amplitude, WIDEST_PHASE_RAD)
    return np.asarray(np.exp((noise**2).sum(axis=0) * np.float32(-0.5 / phase_scale)))


def _density(range_m: F32, weight: F32, spatial: F32, scale: np.float32) -> F32:
    """Density at every hypothesis (T, H, W): equation 13."""
    n_hyp, height, width = range_m.shape
    half = spatial.size // 2
    # A border of weight zero: no neighbour needs a check for the edge of the image.
    border = ((0, 0), (half, half), (half, half))
    padded = np.pad(range_m, border).reshape(n_hyp, -1), np.pad(weight, border).reshape(n_hyp, -1)
    stride = width + 2 * half
    first = half * stride + half
    last = first + (height - 1) * stride + width
    density, mass = np.zeros_like(padded[0]), np.zeros_like(padded[0][0])
    _accumulate(first, last, stride, *padded, spatial, scale, density, mass)
    inner = (slice(half, half + height), slice(half, half + width))
    share = [np.convolve(np.ones(n), spatial)[half : half + n] for n in (height, width)]
    inside = np.outer(*share).astype(np.float32)  # spatial weight that fell inside the image
    # Too little likelihood around: the density stays low rather than be blown up.
    mass = np.maximum(mass.reshape(-1, stride)[inner], np.float32(0.5) * inside)
    return np.asarray(density.reshape(n_hyp, -1, stride)[:, *inner] / mass)


@njit(cache=True, fastmath=FAST, inline="always")  # type: ignore[untyped-decorator]  # numba has no types
def _exp_minus(x: np.float32) -> np.float32:
    """exp(-x) for x >= 0 without a branch: the sixteenth power of a Taylor series."""
    y = min(x, np.float32(20.0)) * np.float32(-1 / 16)
    e = np.float32(1 / 720) * y + np.float32(1 / 120)
    e = e * y + np.float32(1 / 24)
    e = e * y + np.float32(1 / 6)
    e = e * y + np.float32(0.5)
    e = e * y + np.float32(1.0)
    e = e * y + np.float32(1.0)
    e = e * e
    e = e * e
    e = e * e
    return e * e


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _gather(here: F32, there: F32, weight: F32, g: np.float32, scale: np.float32, out: F32) -> None:
    """Add one neighbour's kernel to every pixel of a run; all arrays are of equal length."""
    for x in range(out.size):
        gap = here[x] - there[x]
        out[x] += g * weight[x] * _exp_minus(gap * gap * scale)


@njit(cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _run(
    lo: int, hi: int, stride: int, range_m: F32, weight: F32, spatial: F32, scale: np.float32,
    density: F32, mass: F32,
) -> None:  # fmt: skip
    """Numerator and denominator of equation 13 for the pixels lo..hi of the flat, padded image."""
    n_hyp, half = range_m.shape[0], spatial.size // 2
    for dy in range(-half, half + 1):
        for dx in range(-half, half + 1):
            g = spatial[dy + half] * spatial[dx + half]
            a, b = lo + dy * stride + dx, hi + dy * stride + dx
            for h in range(n_hyp):
                there, w = range_m[h, a:b], weight[h, a:b]
                mass[lo:hi] += g * w
                for k in range(n_hyp):
                    _gather(range_m[k, lo:hi], there, w, g, scale, density[k, lo:hi])


@njit(parallel=True, cache=True, fastmath=FAST)  # type: ignore[untyped-decorator]  # numba has no types
def _accumulate(
    first: int, last: int, stride: int, range_m: F32, weight: F32, spatial: F32, scale: np.float32,
    density: F32, mass: F32,
) -> None:  # fmt: skip
    """Run over all pixels first..last in blocks; a flat image makes every neighbour an offset."""
    for block in prange((last - first + BLOCK - 1) // BLOCK):
        lo = first + np.int64(block) * BLOCK  # the index of prange is unsigned
        hi = min(lo + BLOCK, last)
        _run(lo, hi, stride, range_m, weight, spatial, scale, density, mass)
