"""SRA: kernels against their twins, table against linear program, and what it is good for."""

import functools
import os
from pathlib import Path

import numpy as np
import pytest
import reference_sra as slow

from toftools.correct import INVALID, OK, REJECTED
from toftools.correct import _sra_pricing as pricing
from toftools.correct import _sra_simplex as simplex
from toftools.correct._sra_fit import Bounds, fit_returns
from toftools.correct._sra_grid import MAX_CELLS, group_returns, range_grid
from toftools.correct._sra_lookup import look_up
from toftools.correct._sra_pixels import make_plan, solve_pixels
from toftools.correct._sra_pricing import make_grid
from toftools.correct._sra_small import join, sort_strong
from toftools.correct._sra_table import make_table
from toftools.correct.crt import crt
from toftools.correct.sra import sra
from toftools.correct.sra_lp import smallest_sum, sra_lp
from toftools.crlb import crlb_returns_m
from toftools.io.readers.su2018 import read
from toftools.sensors import sensor
from toftools.types import Phasors
from toftools.units import joint_ambiguity_m, range_to_phase

CAMERA = sensor("opt8241")  # 40 and 70 MHz
FREQS = CAMERA.modulation.freqs_hz
R = joint_ambiguity_m(FREQS)
THREE = sensor("deeptof:freqs=20e6+50e6+70e6")
KINECT = sensor("kinect2_nominal")  # 80, 16 and 120 MHz


@functools.cache
def table(max_range_m=0.0, text="opt8241", grid_m=0.02):
    return sra(sensor(text), grid_m=grid_m, max_range_m=max_range_m)


def frame(z):
    """Phasors (F, P) as an image of one row."""
    return Phasors(np.asarray(z, np.complex64)[:, None, :])


def returns(ranges_m, amplitudes, freqs=FREQS):
    """Phasors (F, P) of returns (L, P)."""
    turn = np.exp(1j * range_to_phase(np.asarray(ranges_m), np.reshape(freqs, (-1, 1, 1))))
    return (amplitudes * turn).sum(axis=1)


def two(n, *, near=(0.5, 4.0), noise=0.0, seed=0, freqs=FREQS):
    """Two returns 0.3..2 m apart with ratios 0.05..0.8, and the range of the first."""
    rng = np.random.default_rng(seed)
    first, apart, ratio = rng.uniform(*near, n), rng.uniform(0.3, 2, n), rng.uniform(0.05, 0.8, n)
    z = returns([first, first + apart], np.stack([np.ones(n), ratio]), freqs)
    return z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape)), first


def off(range_m, truth, period=R):
    return np.mod(range_m - truth + period / 2, period) - period / 2


# the kernels against their twins


@pytest.mark.parametrize("freqs", [FREQS, KINECT.modulation.freqs_hz, [20e6, 50e6, 70e6, 90e6]])
@pytest.mark.parametrize("max_range_m", [0.0, 4.0])
def test_simplex_finds_the_optimum_of_highs(freqs, max_range_m):
    rng = np.random.default_rng(1)
    freqs = np.asarray(freqs)
    ranges_m, _ = range_grid(freqs, 0.02, max_range_m)
    atoms = np.exp(1j * range_to_phase(ranges_m, freqs[:, None]))
    grid, n = make_grid(freqs, ranges_m), ranges_m.size
    work = simplex.make_work(grid)
    for _ in range(15):
        window = int(rng.integers(0, n // 2)), n - int(rng.integers(0, n // 4))
        unit, weights = rng.uniform(0.1, 1, freqs.size), rng.uniform(0.5, 1.5, freqs.size)
        turn = np.exp(2j * np.pi * rng.uniform(size=freqs.size))
        epsilon = rng.uniform(0.005, 0.2)
        done = simplex.solve(grid, *window, unit, turn, weights, epsilon, work)
        cell, amount = np.empty(work.basis.size, np.int64), np.empty(work.basis.size)
        found = simplex.read(work, n, cell, amount) if done else 0
        expected = slow.solve(atoms, window, unit, turn, weights, epsilon)
        if expected is None:
            assert found == 0
            continue
        # The costs are the proof of optimality; 1e-7 is the feasibility tolerance of HiGHS, taken
        # by a few rows whose prices are about 1. The amplitudes agree where the optimum is unique.
        got = np.zeros(n)
        got[cell[:found]] = amount[:found]
        amounts, cost = expected
        assert window[0] <= cell[:found].min(initial=n)
        assert abs(cost @ (got - amounts)) < 1e-6
        assert slack(unit - (atoms @ got) * turn, weights, epsilon * weights @ unit) > -1e-9


def slack(residual, weights, bound):
    """What the 16-gons leave of the bound: the gauge is the largest edge projection."""
    edges = np.exp(1j * np.pi * (2 * np.arange(16) + 1) / 16)
    gauge = np.max((residual[:, None] * edges.conj()).real, axis=1) / np.cos(np.pi / 16)
    return bound - weights @ gauge


def test_pricing_misses_no_cell_between_those_it_looks_at():
    rng = np.random.default_rng(15)
    freqs = KINECT.modulation.freqs_hz
    ranges_m, _ = range_grid(freqs, 0.01, 0.0)
    grid, mean, hidden = make_grid(freqs, ranges_m), np.full(6, 1 / 6), 0
    costs = np.array([pricing.unit_cost(grid.cells, j, mean) for j in range(ranges_m.size)])
    gains = np.empty(grid.coarse.shape[1])
    for _ in range(300):
        price = rng.normal(size=6)
        # The best cell gains next to nothing: every 16th one mostly loses.
        price *= 1.0005 / (grid.cells @ price).max()
        first, last = int(rng.integers(0, 400)), ranges_m.size - int(rng.integers(0, 400))
        worth = (grid.cells @ price - costs)[first:last]
        coarse = costs[::16].copy()
        hidden += pricing.enter_coarse(grid.coarse, first, last, price, coarse, gains)[1] < 0
        least = pricing.least_gain(grid.rise, np.r_[price, 0.0])
        gain, cell = pricing.enter_all(grid.cells, first, last, price, mean, gains, least)
        if worth.max() > 1e-9:
            assert abs(gain - worth.max()) < 1e-12
            assert first <= cell < last
        else:
            assert cell < 0
    assert hidden > 200


def test_no_returns_where_the_window_cannot_explain_the_phases():
    ranges_m = np.array([0.0, 0.1])
    grid, unit, turn = make_grid(FREQS, ranges_m), np.full(2, 0.7), np.array([1, -1 + 0j])
    work = simplex.make_work(grid)
    simplex.solve(grid, 0, 2, unit, turn, np.ones(2), 0.05, work)
    assert simplex.read(work, 2, np.empty(5, np.int64), np.empty(5)) == 0
    atoms = np.exp(1j * range_to_phase(ranges_m, FREQS[:, None]))
    assert slow.solve(atoms, (0, 2), unit, turn, np.ones(2), 0.05) is None


@pytest.mark.parametrize("period", [0, 300])
def test_neighbouring_cells_are_joined_as_in_the_reference(period):
    rng = np.random.default_rng(2)
    for _ in range(200):
        cells = np.sort(rng.choice(np.r_[0:6, 100:106, 294:300], size=4, replace=False))
        amounts = np.zeros(300)
        amounts[cells] = rng.uniform(0.1, 1, 4)
        at, strength = np.empty(4), np.empty(4)
        order = rng.permutation(4)
        n = join(cells[order], amounts[cells[order]], period, at, strength)
        expected = group_returns(amounts, 1.0, cyclic=period > 0)
        np.testing.assert_allclose(at[:n], expected[0], atol=1e-9)
        np.testing.assert_allclose(strength[:n], expected[1], rtol=1e-12)


def test_strong_returns_come_first_and_in_order():
    at, strength = np.array([5.0, 3.0, 4.0, 1.0]), np.array([1.0, 0.2, 0.05, 0.1])
    assert sort_strong(at, strength, 4, 0.1) == 3
    assert at[:3].tolist() == [1.0, 3.0, 5.0]
    assert strength[:3].tolist() == [0.1, 0.2, 1.0]


@pytest.mark.parametrize("max_range_m", [0.0, 1.5])
def test_look_up_is_its_plain_twin(max_range_m):
    z, _ = two(400, near=(0.0, (max_range_m or 12.0)), noise=0.02)
    z = z.astype(np.complex64)
    made = make_table(FREQS, grid_m=0.04, epsilon=0.05, max_range_m=max_range_m)
    ranges_m, amplitudes = look_up(z, np.ones(400, bool), made, 0.01)
    for p in range(400):
        plain = slow.look_up(complex(z[0, p]), complex(z[1, p]), made, 0.01)
        n = len(plain)
        assert (amplitudes[n:, p] == 0).all()
        # Angles are of float32 numbers: 1e-6 rad is a micrometre, a thousandth of a cell.
        np.testing.assert_allclose(ranges_m[:n, p], [at for at, _ in plain], atol=2e-5)
        np.testing.assert_allclose(amplitudes[:n, p], [a for _, a in plain], rtol=1e-5)


@pytest.mark.parametrize("known", [True, False])
def test_fit_is_that_of_scipy_and_its_sigma_the_bound(known):
    freqs, n, noise = KINECT.modulation.freqs_hz, 30, np.array([0.005, 0.01, 0.02])
    rng = np.random.default_rng(8)
    truth = np.stack([rng.uniform(0.5, 4, n), rng.uniform(5, 7, n)])
    strength = np.stack([np.ones(n), rng.uniform(0.3, 0.8, n)])
    z = returns(truth, strength, freqs)
    z = z + noise[:, None] * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    z = z.astype(np.complex64)
    start_m, start = (truth + 0.03).astype(np.float32), (0.9 * strength).astype(np.float32)
    fit_m, fit = start_m.copy(), start.copy()
    sigma = np.repeat(noise[:, None], n, axis=1).astype(np.float32)
    k, bounds = np.asarray(range_to_phase(1.0, freqs)), Bounds(0.05, 18.74, np.inf)
    sigma_m = fit_returns(z, sigma, known, k, bounds, fit_m, fit)
    weigh = noise if known else np.ones(3)
    for p in range(n):
        expected = slow.fit(z[:, p], weigh, freqs, start_m[:, p], start[:, p])
        np.testing.assert_allclose(fit_m[:, p], expected, atol=1e-5)
        if known:
            bound = crlb_returns_m(freqs, fit_m[:, p], fit[:, p], noise)[0]
            assert abs(sigma_m[p] / bound - 1) < 1e-3


# the fast forms against the linear program of the reference


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("text", "max_range_m"),
    [("kinect2_nominal", 0.0), ("kinect2", 0.0), ("adtf3175", 0.0), ("kinect2_nominal", 4.0),
     ("deeptof:freqs=20e6+50e6+70e6+90e6", 0.0)],
)  # fmt: skip
def test_three_and_more_frequencies_are_the_linear_program(text, max_range_m, known):
    camera, n = sensor(text + ":width=1,height=1" if ":" not in text else text), 12
    freqs = camera.modulation.freqs_hz
    z, _ = two(n, near=(0.5, 2.0), freqs=freqs, noise=0.01, seed=9)
    noise = np.array([0.01, 0.02, 0.01, 0.03])[: freqs.size, None, None]
    sigma = np.broadcast_to(noise, (freqs.size, 1, n)).astype(np.float32) if known else None
    pixels = Phasors(z[:, None].astype(np.complex64), sigma)
    fast, reference = (
        make(camera, grid_m=0.02, max_range_m=max_range_m)(pixels) for make in (sra, sra_lp)
    )
    # The same vertex of the same program in each pixel, but for rounding of complex64.
    np.testing.assert_allclose(fast.range_m, reference.range_m, atol=1e-4)
    np.testing.assert_array_equal(fast.info["returns"], reference.info["returns"])
    if known:
        np.testing.assert_allclose(fast.sigma_m, reference.sigma_m, rtol=1e-3)


def program(max_range_m, grid_m=0.01):
    """The solver of three and more frequencies, for two: sra_lp in a thousandth of the time."""
    plan = make_plan(FREQS, grid_m=grid_m, epsilon=0.05, first_share=0.05, max_range_m=max_range_m)

    def nearest(z):
        z = np.asarray(z, np.complex64)
        found = solve_pixels(z, np.ones((2, 1), np.float32), np.ones(z.shape[1], bool), *plan)
        return found[0][0].astype(float)

    return nearest


def test_the_program_of_two_frequencies_is_the_reference():
    z, _ = two(12, noise=0.01, seed=10)
    ranges_m, period_m = range_grid(FREQS, 0.01, 0.0)
    atoms = np.exp(1j * range_to_phase(ranges_m, FREQS[:, None]))
    for pixel, found in zip(z.T, program(0.0)(z), strict=True):
        moved = np.angle(pixel[0]) % (2 * np.pi) / range_to_phase(1.0, FREQS[0])
        turned = pixel * np.exp(-1j * range_to_phase(moved, FREQS))
        amounts = smallest_sum(turned, np.ones(2), atoms, 0.05)
        at, strength = group_returns(amounts, ranges_m[1], cyclic=True)
        at = (at[strength >= 0.05 * strength.max()] + moved + 0.05) % period_m - 0.05
        assert abs(at.min() - found) < 1e-4


# Where both find the same return they differ by the cell of the table: below 2 cm, within which
# grid cells are joined. Elsewhere a return has just about the threshold share or the program has
# nearly equal optima, and the first return jumps between two answers of which a cell holds one;
# with a limit, returns up to 12.5 cm beyond it are tried too.
@pytest.mark.parametrize(
    ("max_range_m", "noise", "near", "measured"),
    [(0.0, 0.0, (0.5, 4.0), 0.0233), (0.0, 0.01, (0.5, 12.0), 0.0277),
     (4.0, 0.0, (0.5, 2.0), 0.0363), (4.0, 0.01, (0.5, 2.0), 0.0373)],
)  # fmt: skip
def test_table_is_the_linear_program_on_two_returns(max_range_m, noise, near, measured):
    n = 3000
    z, _ = two(n, near=near, noise=noise, seed=3)
    apart = disagreement(z, max_range_m=max_range_m)
    assert np.median(apart) < 1e-3
    # The shares were measured over as many other pixels: four standard errors of the difference.
    assert np.mean(apart > 0.02) <= measured + 4 * np.sqrt(2 * measured * (1 - measured) / n)


@pytest.mark.parametrize(("max_range_m", "noise"), [(0.0, 0.0), (0.0, 0.01), (4.0, 0.01)])
def test_table_is_the_linear_program_on_lone_returns(max_range_m, noise):
    rng = np.random.default_rng(14)
    # Near a limit, noise carries returns past it.
    z = returns([rng.uniform(0.0, max_range_m - 0.125 if max_range_m else R, 3000)], 1.0)
    z = z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    assert disagreement(z, max_range_m=max_range_m).max() < 0.02


@functools.cache
def nodes(max_range_m, grid_m=0.01):
    return make_table(FREQS, grid_m=grid_m, epsilon=0.05, max_range_m=max_range_m)


def disagreement(z, *, max_range_m=0.0):
    """Distance between table and linear program with default parameters, m, pixel by pixel."""
    z = np.asarray(z, np.complex64)
    fast = look_up(z, np.ones(z.shape[1], bool), nodes(max_range_m), 0.05)[0][0].astype(float)
    reference = program(max_range_m)(z)
    assert np.isfinite(reference).all()
    return np.abs(off(fast, np.maximum(reference, 0.0)))


@pytest.mark.parametrize("name", ["im_pair_000001.mat", "im_pair_000003.mat"])
def test_table_is_the_linear_program_on_rendered_frames(name):
    capture = rendered(name)
    rng = np.random.default_rng(4)
    pixels = rng.permutation(np.flatnonzero(capture.phasors.valid))[:3000]
    apart = disagreement(capture.phasors.values.reshape(2, -1)[:, pixels])
    assert np.median(apart) < 1e-3
    # Their multipath is far from the ties.
    assert np.mean(apart > 0.02) < 1e-3


def rendered(name):
    folder = os.environ.get("TOFTOOLS_DATA")
    path = Path(folder or ".", "su2018_synth_40_70MHz", name)
    if not folder or not path.exists():
        pytest.skip("needs the su2018 renderings: set TOFTOOLS_DATA")
    return read(path)


# sigma


@pytest.mark.parametrize(
    ("text", "max_range_m", "second_m"),
    [("opt8241", 0.0, None), ("opt8241", 4.0, 3.4), ("kinect2_nominal", 0.0, None),
     ("kinect2_nominal", 0.0, 2.9), ("deeptof:freqs=20e6+50e6+70e6", 0.0, 2.9)],
)  # fmt: skip
def test_sigma_is_honest(text, max_range_m, second_m):
    camera, n, noise = sensor(text), 4000, 0.01
    freqs = camera.modulation.freqs_hz
    rng = np.random.default_rng(11)
    truth = 1.4 + rng.uniform(-0.05, 0.05, n)
    z = returns([truth], 1.0, freqs)
    if second_m:
        z = z + returns([np.full(n, second_m)], 0.6, freqs)
    z = z + noise * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    sigma = np.full((freqs.size, 1, n), noise, np.float32)
    run = sra(camera, max_range_m=max_range_m)
    depth = run(Phasors(z[:, None].astype(np.complex64), sigma))
    assert (depth.info["returns"] == (2 if second_m else 1)).mean() > 0.99
    spread = ((depth.range_m - truth) / depth.sigma_m)[0]
    assert abs(spread.mean()) < 0.1
    assert 0.9 < spread.std() < 1.1


def test_sigma_grows_where_the_returns_cannot_be_fitted():
    # Equal returns 12 cm apart: the program takes them for one, and noise does not explain it.
    z = returns([[2.0], [2.12]], 1.0, KINECT.modulation.freqs_hz)[:, None].astype(np.complex64)
    sigma = np.full(z.shape, 0.001, np.float32)
    depth = sra(KINECT, epsilon=0.1)(Phasors(z, sigma))
    error = abs(depth.range_m[0, 0] - 2.0)
    bound = crlb_returns_m(KINECT.modulation.freqs_hz, [2.06], [2.0], 0.001)[0]
    assert error > 50 * bound
    assert depth.sigma_m[0, 0] > 5 * bound
    assert sra(KINECT)(Phasors(z)).sigma_m is None


# what it is for, and where it fails


def test_two_frequencies_within_a_turn_remove_multipath():
    z, truth = two(2000, near=(0.5, 2.0), noise=0.01)
    plain = np.abs(crt(CAMERA, max_range_m=4.0)(frame(z)).range_m[0] - truth)
    sparse = np.abs(table(4.0)(frame(z)).range_m[0] - truth)
    # Measured: 9.5 to 0.5 cm median, 23 to 7.5 cm at the 90th percentile.
    assert np.median(sparse) < np.median(plain) / 10
    assert np.percentile(sparse, 90) < np.percentile(plain, 90) / 2


def test_three_frequencies_remove_multipath_without_a_limit():
    z, truth = two(2000, freqs=THREE.modulation.freqs_hz, noise=0.01)
    plain = np.abs(crt(THREE)(frame(z)).range_m[0] - truth)
    sparse = np.abs(sra(THREE)(frame(z)).range_m[0] - truth)
    # Measured: 10 to 0.5 cm.
    assert np.median(sparse) < np.median(plain) / 10


def test_two_frequencies_over_the_joint_ambiguity_prefer_a_wrong_answer():
    # The failure is the method's, not the solver's: returns of a smaller total amplitude than the
    # true ones satisfy a residual bound of 0.1 %.
    ratio, n = 0.6, 30
    truth, apart = np.linspace(0.5, 4.0, n), np.linspace(0.3, 2.0, n)
    z = returns([truth, truth + apart], np.array([[1.0], [ratio]]))
    ranges_m, _ = range_grid(FREQS, 0.02, 0.0)
    atoms = np.exp(1j * range_to_phase(ranges_m, FREQS[:, None]))
    sums = [smallest_sum(pixel, np.ones(2), atoms, 1e-3).sum() for pixel in z.T]
    assert np.mean(np.array(sums) < 0.98 * (1 + ratio)) > 0.9
    assert np.median(np.abs(off(table()(frame(z)).range_m[0], truth))) > 0.05


def test_noise_breaks_lone_returns_at_a_low_threshold():
    rng = np.random.default_rng(5)
    truth = rng.uniform(0.5, 12, 5000)
    z = returns([truth], 1.0)
    z = z + 0.02 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    z = z.astype(np.complex64)
    answers = [look_up(z, np.ones(5000, bool), nodes(0.0), share)[0][0] for share in (0.01, 0.05)]
    wrong = [np.mean(np.abs(off(answer, truth)) > 0.5) for answer in answers]
    # Measured 9 % and 0.4 %.
    assert wrong[1] < 0.01 < 0.05 < wrong[0] < 0.12


# laws


@pytest.mark.parametrize("make", [sra, sra_lp])
@pytest.mark.parametrize("max_range_m", [0.0, 1.5])
def test_a_lone_return_comes_back_much_better_than_the_grid(make, max_range_m):
    truth = np.linspace(0.0, (max_range_m or R) - 0.06, 31)
    depth = make(CAMERA, grid_m=0.04, max_range_m=max_range_m)(frame(returns([truth], 300.0)))
    # Between two cells the mean is off by the curvature of the circle only: (2 pi 0.04 / 2.1)^2/2
    # of a cell is 0.3 mm.
    assert np.abs(depth.range_m[0] - truth).max() < 3e-4
    assert (depth.confidence[0] > 0.999).all()
    assert (depth.info["returns"] == 1).all()


@pytest.mark.parametrize(
    ("text", "grid_m", "max_range_m"),
    [
        ("pmd", 0.04, 0.0),
        ("opt8241:freqs=70e6+40e6", 0.04, 0.0),
        ("opt8241:freqs=100e6+20e6", 0.04, 1.5),
        ("opt8241:freqs=198e6+189e6", 0.01, 3.0),  # wrong by a wrap if lone returns miss the nodes
        ("opt8241:freqs=60e6+61e6", 0.1, 0.0),  # 61 turns, a circle of 150 m
    ],
)
def test_other_pairs_of_frequencies(text, grid_m, max_range_m):
    freqs = sensor(text).modulation.freqs_hz
    truth = np.linspace(0.0, 1.4, 500)
    depth = table(max_range_m, text=text, grid_m=grid_m)(frame(returns([truth], 1.0, freqs)))
    assert np.abs(depth.range_m[0] - truth).max() < 3e-4


def test_frequencies_that_meet_only_nearly_cost_the_tolerance_and_no_more():
    text = "opt8241:freqs=80.1675385e6+120.44403642e6"
    freqs = sensor(text).modulation.freqs_hz
    truth = np.linspace(0.0, 3.6, 500)
    depth = table(0.0, text=text, grid_m=0.04)(frame(returns([truth], 1.0, freqs)))
    # 0.02 turns of 120 MHz are 25 mm; the pair misses by 0.0096 turns of 80 MHz, 12 mm when moved
    # all around.
    assert np.abs(depth.range_m[0] - truth).max() < 0.025
    limited = table(3.0, text=text, grid_m=0.04)(frame(returns([truth[:400]], 1.0, freqs)))
    assert np.abs(limited.range_m[0] - truth[:400]).max() < 3e-4


def test_noise_below_zero_stays_at_zero():
    z = returns([np.array([-0.01, -0.04, 0.01])], 1.0)
    for make in (sra, sra_lp):
        depth = make(CAMERA, grid_m=0.04)(frame(z))
        np.testing.assert_allclose(depth.range_m[0], [0, 0, 0.01], atol=3e-4)


@pytest.mark.parametrize("make", [sra, sra_lp])
def test_gain_shift_and_order_of_pixels(make):
    rng = np.random.default_rng(6)
    z, _ = two(40, near=(1.0, 3.0), noise=0.005)
    run = make(CAMERA, grid_m=0.04)
    plain = run(frame(z)).range_m[0]
    order = rng.permutation(40)
    np.testing.assert_array_equal(run(frame(z[:, order])).range_m[0], plain[order])
    np.testing.assert_array_equal(run(frame(z)).range_m[0], plain)
    # Nine of ten: a gain that is no power of two rounds, and rounding decides ties.
    gained = np.abs(run(frame(700 * z)).range_m[0] - plain)
    assert np.mean(gained < 1e-4) > 0.9
    # Within the same turn: returns that cross the end of the circle may change which is first.
    moved = z * np.exp(1j * range_to_phase(0.3, FREQS))[:, None]
    apart = np.abs(off(run(frame(moved)).range_m[0], plain + 0.3))
    assert np.mean(apart < 1e-4) > 0.8


@pytest.mark.parametrize("make", [sra, sra_lp])
def test_a_lone_return_moves_with_the_surface(make):
    rng = np.random.default_rng(7)
    z = returns([np.full(30, 1.0)], 1.0)
    z = z + 0.005 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    run = make(CAMERA, grid_m=0.04)
    plain = run(frame(z)).range_m[0]
    for far in (0.33, 5.0, 12.5):
        moved = run(frame(z * np.exp(1j * range_to_phase(far, FREQS))[:, None])).range_m[0]
        # The grid moves with the pixel; what is left is the rounding of complex64 phasors.
        assert np.abs(off(moved, plain + far)).max() < 1e-5


@pytest.mark.parametrize("make", [sra, sra_lp])
def test_bad_pixels_are_nan_with_a_status(make):
    z = returns([np.full(6, 2.0)], 1.0)
    z[0, 1], z[:, 2], z[1, 3] = np.nan, 0, 0
    valid = np.ones((1, 6), bool)
    valid[0, 4] = False
    phasors = Phasors(z[:, None].astype(np.complex64), valid=valid)
    before = phasors.values.copy()
    depth = make(CAMERA, grid_m=0.04)(phasors)
    np.testing.assert_array_equal(phasors.values, before)
    expected = np.array([[OK, INVALID, INVALID, INVALID, INVALID, OK]])
    np.testing.assert_array_equal(depth.info["status"], expected)
    np.testing.assert_array_equal(np.isnan(depth.range_m), expected != OK)
    assert depth.range_m.dtype == np.float32
    assert depth.range_m.shape == (1, 6)


@pytest.mark.parametrize("make", [sra, sra_lp])
def test_nothing_within_the_limit_is_a_rejection(make):
    # Phases of a lone return at 1.5 m cannot come from anything within 20 cm.
    depth = make(CAMERA, grid_m=0.02, max_range_m=0.2)(frame(returns([np.array([1.5, 0.1])], 1.0)))
    assert depth.info["status"].tolist() == [[REJECTED, OK]]
    assert np.isnan(depth.range_m[0, 0])


def test_the_noisier_frequency_weighs_less():
    # Ranges 2.00 m at 40 MHz and 2.05 m at 70 MHz contradict each other.
    z = returns([[2.0]], 1.0)
    z[1] = returns([[2.05]], 1.0)[1]
    low, high = (
        sra_lp(CAMERA, max_range_m=4.0)(
            Phasors(z[:, None].astype(np.complex64), np.array(sigma, np.float32).reshape(2, 1, 1))
        ).range_m[0, 0]
        for sigma in ([0.001, 0.1], [0.1, 0.001])
    )
    assert abs(low - 2.0) < 2e-3
    assert abs(high - 2.05) < 2e-3


@pytest.mark.parametrize(
    ("make", "camera", "params", "words"),
    [
        (sra, sensor("deeptof"), {}, "at least two frequencies, got 1"),
        (sra_lp, sensor("deeptof"), {}, "at least two frequencies, got 1"),
        (sra, CAMERA, {"grid_m": 0.0}, "grid_m must be a positive"),
        (sra_lp, CAMERA, {"epsilon": 1.0}, "epsilon must lie in"),
        (sra_lp, CAMERA, {"first_share": -0.1}, "first_share in"),
        (sra, CAMERA, {"max_range_m": -1.0}, "max_range_m must be metres"),
        (sra, CAMERA, {"grid_m": 1e-4}, f"wanted 2..{MAX_CELLS}"),
    ],
)
def test_bad_parameters_are_refused(make, camera, params, words):
    with pytest.raises(ValueError, match=words):
        make(camera, **params)


def test_phasors_of_another_sensor_are_refused():
    with pytest.raises(ValueError, match="must have 2 frequencies, got 3"):
        table()(Phasors(np.ones((3, 2, 2), np.complex64)))
