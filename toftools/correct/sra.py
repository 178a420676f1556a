"""Sparse reflections analysis fast enough for frames: the fewest returns, then their best fit.

Three and more frequencies: the linear program of sra_lp.py, solved exactly in every pixel by the
simplex method of _sra_simplex.py. Two: it has two invariances, a gain of the phasors is one of
the amplitudes, and moving all returns by d turns phasor f by ``exp(j k_f d)``. So every pixel is
moved by ``d = phase_0 / k_0``, which leaves two numbers, the amplitude ratio and the phase of the
second frequency, over which a table holds the returns. (Of three frequencies four numbers are
left: a table as fine would take 10^9 programs.) Reference: program, reduction and table are those
of Freedman et al., ECCV 2014 (below; recalled), the residual bound is that of sra_lp.py. Ours: the
answer is not that of the program but the least-squares fit that starts there (_sra_fit.py), which
gives sigma and takes away the bias that the allowed residual makes. Input: two or more
frequencies, with or without sigma.

The table. Without a range limit the grid is a circle, the joint ambiguity R = n U_0, and moving by
whole turns U_0 of the first frequency is free: it brings the second phase into [0, 2 pi / n), which
makes the table n times finer. With a limit the window [-d, max_range_m - d] of the moved grid
depends on d, and the table gets a third axis: d in steps of 12.5 cm, each with the windows of all
its d together. Returns outside the limits are dropped afterwards. It takes equal noise at both
frequencies for granted (the program weighs them by 1 / sigma, which would be one more axis), and
joint ambiguities for exact: where the phases meet only within a tolerance (80.17 and 120.44 MHz), a
return moved across the end is off by up to that tolerance, 0.02 turns.

Fails where sra_lp fails, and for the same reasons: see there for when the frequencies identify
two returns, with figures. From three frequencies on it is sra_lp: six sets of frequencies and
limits, 150 pixels each of two returns and of lone ones, sigma known or not, and none 2 cm apart.
The table: of 3000 pixels of two returns (40/70 MHz) 98 % agree within 2 cm, 96 % with a limit of
4 m, and of lone returns all. The others sit where a return has just about the threshold share or
two solutions cost nearly the same, so that the first return jumps, often by metres, and a cell
holds one side; or within 12.5 cm of the limit. Of 228,000 pixels of rendered rooms two disagree.

CPU time at 320x240, half of which passes on two free cores: 80/16/120 MHz 0.16 s for lone returns,
which need no program (_sra_lone.py), and 1.4 s where every pixel has two (measured on `kinect2`'s
frequencies: 79 and 714 ms passed); 40/70 MHz 0.10 and 0.25 s. Making takes a table of 0.5 s, with
a limit 3 s. Memory: at F frequencies 32 F + 30 bytes a pixel, most of them for `info`.
"""

from collections.abc import Callable

import numpy as np

from toftools.correct import kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._sra_fit import Bounds, fitted
from toftools.correct._sra_grid import check_parameters, range_grid, usable_pixels
from toftools.correct._sra_lone import lone_returns
from toftools.correct._sra_lookup import look_up
from toftools.correct._sra_pixels import make_plan, solve_pixels
from toftools.correct._sra_table import make_table
from toftools.types import F32, F64, Bool, DepthMap, Phasors, Sensor

Returns = Callable[[Phasors, Bool], tuple[F32, F32]]


def sra(
    sensor: Sensor,
    *,
    grid_m: float = 0.01,
    epsilon: float = 0.05,
    first_share: float = 0.05,
    max_range_m: float = 0.0,
) -> Callable[[Phasors], DepthMap]:
    """First of the fewest returns that explain each pixel, fitted to its phasors.

    Parameters
    ----------
    sensor : Sensor
        Gives the frequencies, two or more.
    grid_m : float
        Range grid of the linear program, m.
    epsilon : float
        Residual allowed, as a share of the summed amplitudes, 0..1.
    first_share : float
        Returns weaker than this share of the strongest are ignored.
    max_range_m : float
        Returns lie in [0, max_range_m]; 0 stands for the joint ambiguity. With two frequencies a
        limit near one turn of the lower one is what makes two returns identifiable.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``, as that of `sra_lp`.

    Raises
    ------
    ValueError
        If there is one frequency only, a parameter is out of range, or the emitter is not at the
        camera.

    References
    ----------
    D. Freedman, Y. Smolin, E. Krupka, I. Leichter, M. Schmidt, "SRA: Fast Removal of General
    Multipath for ToF Sensors", ECCV 2014, arXiv 1403.5919.

    Examples
    --------
    >>> from toftools.sensors import sensor
    >>> from toftools.units import range_to_phase
    >>> camera = sensor("opt8241:width=1,height=1")  # 40 and 70 MHz
    >>> turn = range_to_phase(1.0, camera.modulation.freqs_hz)
    >>> two = np.exp(2.0j * turn) + 0.4 * np.exp(3.0j * turn)  # at 2 m and, weaker, at 3 m
    >>> depth = sra(camera, epsilon=0.01, max_range_m=4.0)(Phasors(two[:, None, None]))
    >>> round(float(depth.range_m[0, 0]), 2), int(depth.info["returns"][0, 0])
    (2.0, 2)
    """
    refuse_emitter_offset(sensor)
    freqs = sensor.modulation.freqs_hz
    if freqs.size < 2:
        msg = f"sra needs at least two frequencies, got {freqs.size}; use 'single'"
        raise ValueError(msg)
    check_parameters(grid_m, epsilon, first_share)
    _, period_m = range_grid(freqs, grid_m, max_range_m)
    bounds = Bounds(epsilon, period_m, np.inf if period_m > 0 else max_range_m)
    find = _from_table if freqs.size == 2 else _by_program
    returns = find(freqs, grid_m, first_share, max_range_m, bounds)

    def run(phasors: Phasors) -> DepthMap:
        usable = usable_pixels(phasors, freqs.size)
        found = returns(phasors, usable.reshape(-1))
        return fitted(phasors, usable, freqs, bounds, *found)

    warm_up(run, freqs.size)
    return run


def _from_table(
    freqs: F64, grid_m: float, first_share: float, max_range_m: float, bounds: Bounds
) -> Returns:
    """Returns of two frequencies."""
    table = make_table(freqs, grid_m=grid_m, epsilon=bounds.epsilon, max_range_m=max_range_m)

    def returns(phasors: Phasors, usable: Bool) -> tuple[F32, F32]:
        values = kernel_input(phasors.values).reshape(2, -1)
        return look_up(values, usable, table, first_share)  # type: ignore[no-any-return]

    return returns


def _by_program(
    freqs: F64, grid_m: float, first_share: float, max_range_m: float, bounds: Bounds
) -> Returns:
    """Returns of three and more frequencies."""
    grid, plan = make_plan(
        freqs, grid_m=grid_m, epsilon=bounds.epsilon, first_share=first_share,
        max_range_m=max_range_m,
    )  # fmt: skip

    def returns(phasors: Phasors, usable: Bool) -> tuple[F32, F32]:
        known = phasors.sigma is not None
        values = kernel_input(phasors.values).reshape(freqs.size, -1)
        sigma = np.ones((freqs.size, 1), np.float32) if phasors.sigma is None else phasors.sigma
        sigma = kernel_input(sigma).reshape(freqs.size, -1)
        range_m, amplitude = lone_returns(values, sigma, known, usable, grid, plan, bounds)
        done = amplitude > 0
        ranges_m, amplitudes = solve_pixels(values, sigma, usable & ~done, grid, plan)
        ranges_m[0, done], amplitudes[0, done] = range_m[done], amplitude[done]
        return ranges_m, amplitudes

    return returns
