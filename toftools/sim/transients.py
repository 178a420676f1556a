"""Transients from path samples: histograms, and kernel density with a shrinking bandwidth.

Path tracers give samples (pixel, path length, contribution) in passes, each pass an unbiased
estimate of the image by itself. `histogram` pools them; `progressive` spreads each over a kernel
whose bandwidth shrinks from pass to pass by ``T_{j+1} / T_j = (j + alpha) / (j + 1)`` and averages
the passes: variance falls as n^-alpha and squared bias as n^-4(1 - alpha), both n^-4/5 at
alpha = 4/5 (thesis section 5.4, eq. 5.7 and 5.8). The thesis sets n^-1/3 against it for
histograms, which is the rate of their root error (D. W. Scott 1979, recalled); squared error
against squared error it is n^-2/3. The rates hold for densities with two derivatives. Light that
jumps (direct returns, edges of what is seen) is smeared over a bandwidth: keep direct light out of
the kernel, it is known exactly. Kernels are symmetric, so they move no phase away from the ends of
the axis, but they shrink the phasor by `kernel_gain`: take them to look at transients, and
histograms for phasors.

References
----------
J. Marco, "Transient light transport" (thesis 2018), section 5.4, after A. Jarabo and others, "A
framework for transient rendering" (SIGGRAPH Asia 2014); C. Knaus and M. Zwicker, "Progressive
photon mapping: a probabilistic approach" (2011).
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.sim.bandwidth import ALPHA, bandwidths_m, rule_of_thumb_m
from toftools.sim.world import World
from toftools.transient import MOST_VALUES, Samples, Transient
from toftools.types import F64, Scene, Shot


def histogram(
    passes: Iterable[Samples],
    *,
    shape: tuple[int, int],
    bin_m: float,
    n_bins: int,
    start_m: float = 0.0,
) -> Transient:
    """Light per bin of path length, averaged over passes.

    Parameters
    ----------
    passes : iterable of Samples
        Passes, each an unbiased estimate of the whole image by itself.
    shape : tuple of int
        Image shape (height, width).
    bin_m : float
        Width of a bin, m of whole optical path.
    n_bins : int
        Number of bins.
    start_m : float
        Path at the start of the first bin, m.

    Returns
    -------
    Transient
        Relative light; ``missed`` holds the light outside the axis, ``info`` counts the samples
        ``before`` and ``beyond`` it.

    Raises
    ------
    ValueError
        If there is no pass, a sample makes no sense, or the bins do not fit into memory.

    Examples
    --------
    >>> one = Samples(np.array([0, 0]), np.array([0.26, 9.0]), np.array([2.0, 1.0]))
    >>> made = histogram([one], shape=(1, 1), bin_m=0.1, n_bins=4)
    >>> made.values.ravel().tolist(), made.missed.item(), made.info["beyond"]
    ([0.0, 0.0, 2.0, 0.0], 1.0, 1)
    """
    check_axis(shape, bin_m, n_bins, start_m)
    pairs = ((one, 0.0) for one in passes)
    return _averaged(pairs, shape, bin_m, n_bins, start_m, "histogram")


def progressive(
    passes: Iterable[Samples],
    *,
    shape: tuple[int, int],
    bin_m: float,
    n_bins: int,
    start_m: float = 0.0,
    bandwidth_m: float | None = None,
    alpha: float = ALPHA,
) -> Transient:
    """Kernel density of path length with a bandwidth that shrinks from pass to pass.

    Every sample on the axis leaves all its light there: what its kernel puts beyond an end is
    mirrored back. Samples outside leave none; for light that goes on smoothly the mirrored part
    stands for theirs.

    Parameters
    ----------
    passes, shape, bin_m, n_bins, start_m
        As for `histogram`.
    bandwidth_m : float or None
        Half width of the kernel in the first pass, m of whole optical path; None takes
        `rule_of_thumb_m` of the first pass.
    alpha : float
        Shrinking, 0..1: 1 keeps the bandwidth.

    Returns
    -------
    Transient
        As of `histogram`; ``info`` also holds the ``bandwidths_m`` of all passes.

    Raises
    ------
    ValueError
        As `histogram`, and if a bandwidth is not positive or wider than the axis.
    """
    if not 0 < alpha <= 1:
        msg = f"alpha must lie above 0 and not above 1, got {alpha}"
        raise ValueError(msg)
    check_axis(shape, bin_m, n_bins, start_m)
    rest = iter(passes)
    first = _checked(next(rest, None), shape)
    axis_m = n_bins * bin_m
    if bandwidth_m is None:
        bandwidth_m = min(rule_of_thumb_m(first, shape), axis_m)
    if not 0 < bandwidth_m <= axis_m:
        msg = f"bandwidth_m must be positive and at most the axis of {axis_m:g} m"
        raise ValueError(f"{msg}, got {bandwidth_m}")
    pairs = zip(chain([first], rest), bandwidths_m(bandwidth_m, alpha), strict=False)
    return _averaged(pairs, shape, bin_m, n_bins, start_m, "progressive")


def _averaged(
    passes: Iterable[tuple[Samples, float]],
    shape: tuple[int, int],
    bin_m: float,
    n_bins: int,
    start_m: float,
    method: str,
) -> Transient:
    """Mean over passes, each with its bandwidth."""
    values = np.zeros((shape[0] * shape[1], n_bins))
    missed = np.zeros((len(values), 2))
    used: list[float] = []
    counts = np.zeros(3, dtype=np.int64)  # samples, before, beyond
    for one, width in passes:
        samples = _checked(one, shape)
        counts += _add(values, missed, samples, (start_m, bin_m, width))
        used.append(float(width))
    if not used:
        _checked(None, shape)
    info: dict[str, Any] = {"method": method, "passes": len(used)}
    info |= dict(zip(("samples", "before", "beyond"), counts.tolist(), strict=True))
    if method == "progressive":
        info["bandwidths_m"] = used
    values /= len(used)
    return Transient(
        values.astype(np.float32).T.reshape(n_bins, *shape),  # a view: bins stay side by side
        bin_m,
        np.asarray(start_m),
        missed=(missed.sum(axis=1) / len(used)).reshape(shape).astype(np.float32),
        info=info,
    )


def check_axis(shape: tuple[int, int], bin_m: float, n_bins: int, start_m: float) -> None:
    """Refuse an axis without bins, or with more than anybody has room for."""
    if not (np.isfinite(bin_m) and bin_m > 0 and np.isfinite(start_m)):
        msg = f"bin_m must be positive and start_m finite metres, got {bin_m} and {start_m}"
        raise ValueError(msg)
    count = shape[0] * shape[1] * n_bins
    if min(*shape, n_bins) < 1 or count > MOST_VALUES:
        msg = (
            f"{n_bins} bins for {shape[1]} x {shape[0]} px make {count} values, wanted 1 to "
            f"{MOST_VALUES}; take wider bins or a smaller image"
        )
        raise ValueError(msg)


def _checked(samples: Samples | None, shape: tuple[int, int]) -> Samples:
    """One pass as contiguous arrays, refused if it makes no sense."""
    if samples is None:
        msg = "got no samples, wanted at least one pass"
        raise ValueError(msg)
    pixel = np.ascontiguousarray(samples.pixel, dtype=np.int64)
    path_m, weight = (np.ascontiguousarray(a, dtype=np.float64) for a in samples[1:])
    count = shape[0] * shape[1]
    if not (pixel.ndim == 1 and pixel.shape == path_m.shape == weight.shape):
        msg = f"pixel, path_m and weight must be (N,), got {pixel.shape}, {path_m.shape}"
        raise ValueError(f"{msg} and {weight.shape}")
    if pixel.size and not 0 <= pixel.min() <= pixel.max() < count:
        msg = f"pixels must lie in 0..{count - 1}, got {pixel.min()}..{pixel.max()}"
        raise ValueError(msg)
    if not (np.isfinite(path_m).all() and np.isfinite(weight).all()):
        msg = "path_m and weight must be finite, got nan or infinite ones; drop those paths"
        raise ValueError(msg)
    return Samples(pixel, path_m, weight)


def _add(
    values: F64, missed: F64, samples: Samples, axis: tuple[float, float, float]
) -> NDArray[np.int64]:
    """Scatter one pass; axis is start, bin and bandwidth, m. Counts all, before and beyond."""
    import numba

    from toftools.sim._density import scatter

    start_m, bin_m, width_m = axis
    position = (samples.path_m - start_m) / bin_m
    scatter(values, missed, samples.pixel, position, samples.weight, width_m / bin_m,
            numba.get_num_threads())  # fmt: skip
    beyond = np.count_nonzero(position >= values.shape[1])
    return np.array([position.size, np.count_nonzero(position < 0), beyond])


def transient(
    scene: Scene | World,
    shot: Shot,
    *,
    bin_m: float = 0.01,
    n_bins: int = 2048,
    start_m: float = 0.0,
    method: Callable[..., Transient] = progressive,
) -> Transient:
    """Transient of any scene, as a sensor's camera and light sources make it.

    Direct light is exact and goes into its bins as it is; the paths of the engine ``path``, through
    the centres of the pixels, give the rest. Light that is not modulated has no place on the axis,
    and motion is not seen.

    Parameters
    ----------
    scene : Scene or World
        Scene name or file with its parameters, or a world made by hand.
    shot : Shot
        Sensor, seed, bounces and paths per pixel (256 if not given).
    bin_m, n_bins, start_m
        Axis, m of whole optical path, as for `histogram`.
    method : callable
        `progressive` or `histogram`, for all but direct light; parameters by `functools.partial`.

    Returns
    -------
    Transient
        Relative light; `info` tells the method, bounces and paths, and counts samples of both
        kinds of light.

    Raises
    ------
    ValueError
        If the scene is broken or the axis makes no sense.
    """
    from toftools.sim._samples import traced

    axis: dict[str, Any] = {
        "shape": shot.sensor.camera.shape, "bin_m": bin_m, "n_bins": n_bins, "start_m": start_m
    }  # fmt: skip
    check_axis(**axis)
    paths = traced(scene, shot)
    first = next(paths.passes, None)
    if first is None:
        made = histogram([paths.direct], **axis)
    else:
        made = _with_direct(method(chain([first], paths.passes), **axis), paths.direct)
    return replace(made, info={**made.info, **paths.told})


def _with_direct(rest: Transient, direct: Samples) -> Transient:
    """A transient with further samples, each in its bin."""
    assert rest.missed is not None
    bins = np.floor((direct.path_m - rest.start_m) / rest.bin_m)
    before, beyond = bins < 0, bins >= rest.n_bins
    inside = ~(before | beyond)
    values, missed = np.array(rest.values), np.array(rest.missed)
    rows, columns = np.divmod(direct.pixel, rest.shape[1])
    place = (bins[inside].astype(np.int64), rows[inside], columns[inside])
    np.add.at(values, place, direct.weight[inside].astype(np.float32))
    outside = (rows[~inside], columns[~inside])
    np.add.at(missed, outside, direct.weight[~inside].astype(np.float32))
    counts = {"samples": bins.size, "before": before.sum(), "beyond": beyond.sum()}
    info = {**rest.info, **{name: rest.info[name] + int(n) for name, n in counts.items()}}
    return replace(rest, values=values, missed=missed, info=info)
