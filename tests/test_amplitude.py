"""Amplitude error: planted surfaces come back with honest sigma, no larger than needed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from phase_rig import pattern, true_phase_rad, wall

from toftools.calib._phase_surface import design, surface
from toftools.calib.amplitude import Amplitude, amplitude
from toftools.calib.residuals import phase_error_rad
from toftools.registry import CALIBRATIONS
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Phasors, Scene, Shot

SMALL = sensor("opt8241:width=12,height=9")
A0 = 1200.0
RATE = np.array([0.01, 0.02])[:, None, None]  # rad per e-fold of amplitude at 40 and 70 MHz
GRAY = tuple((z, albedo) for z in (0.7, 1.2, 1.9, 2.6, 3.3) for albedo in (0.1, 0.3, 0.9))
FEW = tuple((z, albedo) for z in (0.7, 1.6, 3.3) for albedo in (0.1, 0.3, 0.9))
ONE_PLACE = tuple((1.5, albedo) for albedo in (0.03, 0.06, 0.12, 0.25, 0.5, 1.0))


def nothing(amplitude, phase):
    return 0.0 * amplitude


def linear(amplitude, phase):
    return RATE * np.log(amplitude / A0)


def full(amplitude, phase):
    x = np.log(amplitude / A0)
    return RATE * x * (1 + 0.5 * np.sin(phase)) - 0.004 * x**2


@cache
def clean(z, albedo):
    shot = analytic(Scene("wall", {"range": z, "albedo": albedo}))(Shot(SMALL, noisy=False))
    return np.abs(shot.phasors.values).astype(float), true_phase_rad(shot)


def planted_rad(error, z, albedo):
    """Phase to add so that the error is a function of the phase that is measured."""
    level, phase = clean(z, albedo)
    added = np.zeros_like(phase)
    for _ in range(8):
        added = error(level, phase + added)
    return added


def targets(error, seed, places=GRAY, kind="gray", extra=0.0, **given):
    return [
        wall(z, albedo=albedo, phase_rad=planted_rad(error, z, albedo) + extra, kind=kind,
             seed=1000 * seed + i, nominal=SMALL, file=f"gray_{i:02d}.h5", **given)
        for i, (z, albedo) in enumerate(places)
    ]  # fmt: skip


def misses(stage, error, places=GRAY):
    """Surface less truth, and its sigma, at what was measured without noise."""
    off, sigma = [], []
    for place in places[::2]:
        level, phase = clean(*place)
        phase = phase + planted_rad(error, *place)
        inside = (level > stage.span[:, :1, None]) & (level < stage.span[:, 1:, None])
        off.append((stage.error_rad(phase, level) - error(level, phase))[inside])
        sigma.append(stage.sigma_rad(phase, level)[inside])
    return np.concatenate(off), np.concatenate(sigma)


@pytest.mark.parametrize(("error", "places", "largest"), [(linear, FEW, 3), (full, GRAY, 24)])
def test_planted_surface_lies_in_its_intervals(error, places, largest):
    inside, sizes = [], []
    for seed in range(40):
        stage = amplitude(targets(error, seed, places))
        off, sigma = misses(stage, error, places)
        inside.append(np.mean(np.abs(off) < 1.96 * sigma))
        sizes.append(stage.knot_rad[0].size)
    assert np.mean(inside) >= 0.9
    assert np.median(sizes) <= largest
    assert sigma.max() < 0.02, "the planted error spans 0.1 rad"


def test_no_amplitude_error_gives_a_stage_that_does_nothing():
    zero = [amplitude(targets(nothing, seed)) for seed in range(6)]
    assert sum(not stage.knot_rad.any() for stage in zero) >= 5
    stage = next(stage for stage in zero if not stage.knot_rad.any())
    assert "no amplitude error: the stage changes nothing" in stage.residual.notes[-1]
    z = Phasors(np.full((2, 3, 3), 500 + 100j))
    assert np.array_equal(stage(z).values, z.values)
    assert stage.residual.after == stage.residual.before


def test_measured_error_goes_away():
    stage = amplitude(targets(full, 1))
    before, after = [], []
    for seed in range(20):
        dark = wall(2.4, albedo=0.1, phase_rad=planted_rad(full, 2.4, 0.1), seed=seed,
                    nominal=SMALL)  # fmt: skip
        out = stage(dark.phasors)
        before.append(phase_error_rad(dark).mean(axis=(1, 2)))
        after.append(phase_error_rad(replace(dark, phasors=out)).mean(axis=(1, 2)))
    assert np.abs(np.mean(before, axis=0)).max() > 0.04
    assert np.abs(np.mean(after, axis=0)).max() < 0.4 * np.abs(np.mean(before, axis=0)).max()
    assert np.array_equal(out.sigma, dark.phasors.sigma)


@pytest.mark.parametrize("spread", [0.0, 0.03])
def test_leftover_pattern_of_pixels_does_no_harm(spread):
    inside, off = [], []
    for seed in range(12):
        extra = pattern(seed, spread, SMALL)
        stage = amplitude(targets(linear, seed, ONE_PLACE, extra=extra))
        miss, sigma = misses(stage, linear, ONE_PLACE)
        inside.append(np.mean(np.abs(miss) < 1.96 * sigma))
        off.append(np.sqrt(np.mean(miss**2)))
    assert np.mean(inside) >= 0.9
    assert np.mean(off) < 0.005


def test_a_random_pattern_widens_the_interval_of_the_constant():
    inside = []
    for seed in range(20):
        extra = 0.1 * np.random.default_rng(seed).normal(size=(2, 9, 12))  # mean not 0
        off, sigma = misses(
            amplitude(targets(linear, seed, ONE_PLACE, extra=extra)), linear, ONE_PLACE
        )
        inside.append(np.mean(np.abs(off) < 1.96 * sigma))
    assert np.mean(inside) >= 0.88


def test_surface_is_of_the_measured_phase():
    def steep(amplitude, phase):
        return 0.06 * np.log(amplitude / A0) * (1 + np.sin(phase))

    off, _ = misses(amplitude(targets(steep, 1)), steep)
    assert np.sqrt(np.mean(off**2)) < 0.006, "over the true phase it would be 0.013 rad"


def test_chance_correlation_of_pattern_and_light_is_no_amplitude_error():
    zero = []
    for seed in range(6):
        extra = pattern(seed, 0.05, SMALL)
        zero.append(not amplitude(targets(nothing, seed, FEW, extra=extra)).knot_rad.any())
    assert sum(zero) >= 5


def test_slope_is_that_within_pixels_where_the_pattern_follows_the_light():
    # A fixed pattern measured on a wall has taken the amplitude error of that wall along.
    level, phase = clean(1.5, 0.5)
    taken = linear(level, phase)
    extra = -(taken - taken.mean(axis=(1, 2), keepdims=True))
    low, high = np.full((2, 1, 1), 800.0), np.full((2, 1, 1), 5000.0)
    ratios = []
    for seed in range(12):
        stage = amplitude(targets(linear, seed, ONE_PLACE, extra=extra))
        rise = stage.error_rad(phase[:, :1, :1], high) - stage.error_rad(phase[:, :1, :1], low)
        ratios.append(rise / (RATE * np.log(5000 / 800)))
    assert np.mean(ratios) == pytest.approx(1, abs=0.05), "between pixels it would be 0.9"


def test_wrong_distances_widen_the_interval():
    rng = np.random.default_rng(2)
    inside, wide = [], []
    for seed in range(12):
        captures = [targets(linear, seed, (place,), off_m=2e-3 * rng.normal())[0] for place in GRAY]
        stage = amplitude(captures)
        off, sigma = misses(stage, linear)
        inside.append(np.mean(np.abs(off) < 1.96 * sigma))
        wide.append(sigma.mean())
    assert np.mean(inside) >= 0.85
    exact = misses(amplitude(targets(linear, 0)), linear)[1]
    assert np.mean(wide) > 1.5 * exact.mean()


def test_outliers_do_not_count():
    rng = np.random.default_rng(3)
    hit = [np.where(rng.random((2, 9, 12)) < 0.03, 1.0, 0.0) for _ in GRAY]
    captures = [
        targets(linear, 4, (place,), extra=extra)[0] for place, extra in zip(GRAY, hit, strict=True)
    ]
    off, _ = misses(amplitude(captures), linear)
    assert np.sqrt(np.mean(off**2)) < 0.008, "plain means would be off by 0.03 rad"


def test_walls_set_the_constant_and_the_reference():
    places = ((1.0, 0.5), (1.6, 0.5))
    walls = targets(linear, 50, places, kind="wall")
    stage = amplitude([*targets(linear, 5, extra=0.05), *walls])
    on_walls = []
    for capture in walls:
        z = capture.phasors.values.astype(np.complex128)
        on_walls.append(stage.error_rad(np.angle(z), np.abs(z)).mean(axis=(1, 2)))
    assert np.mean(on_walls, axis=0) == pytest.approx([0, 0], abs=2e-3)
    levels = [np.log(clean(*place)[0]) for place in places]
    wanted = np.exp(np.mean(levels, axis=(0, 2, 3)))
    assert stage.reference_amplitude == pytest.approx(wanted, rel=0.02)


def test_a_part_of_the_turn_allows_no_functions_of_phase():
    stage = amplitude(targets(linear, 6, ONE_PLACE))
    assert stage.knot_rad.shape[2] == 1
    assert "of the turn only" in stage.residual.notes[0]


def test_without_sigma_it_finds_the_same():
    told, untold = (amplitude(targets(linear, 7, sigma=sigma)) for sigma in (True, False))
    level, phase = clean(1.2, 0.3)
    one, other = told.error_rad(phase, level), untold.error_rad(phase, level)
    assert one == pytest.approx(other, abs=3e-3)
    assert np.isnan(untold.residual.noise)
    assert np.isfinite(told.residual.noise)


def test_residual_in_millimetres():
    left = amplitude(targets(full, 8)).residual
    assert left.unit == "mm"
    assert left.after < left.held_out < left.before
    assert left.after < 1.05 * left.noise
    assert left.n == len(GRAY) * 2 * 9 * 12


def test_level_outside_the_span_and_nan_is_no_trouble():
    stage = amplitude(targets(full, 9))
    phase = np.full((2, 3), 1.0)
    low, high = stage.span.T
    ends = np.stack([low, low / 100, 0 * low], axis=1)
    assert np.ptp(stage.error_rad(phase, ends), axis=1) == pytest.approx([0, 0], abs=1e-12)
    tops = np.stack([high, high * 100, 0 * high + np.inf], axis=1)
    assert np.ptp(stage.error_rad(phase, tops), axis=1)[:2] == pytest.approx([0, 0], abs=1e-12)
    values = np.full((2, 2, 2), 400 + 10j, np.complex64)
    values[0, 0, 0] = np.nan
    out = stage(Phasors(values))
    assert not out.valid[0, 0]
    assert out.valid.sum() == 3


def slow_surface(knots, level, phase, span):
    """Cox and de Boor's recursion, one point at a time."""
    count, turn = knots.shape
    degree = min(3, count - 1)

    def basis(i, d, t, x):
        if d == 0:
            return 1.0 if t[i] <= x < t[i + 1] else 0.0
        left = (x - t[i]) / (t[i + d] - t[i]) * basis(i, d - 1, t, x)
        right = (t[i + d + 1] - x) / (t[i + d + 1] - t[i + 1]) * basis(i + 1, d - 1, t, x)
        return left + right

    low, high = np.log(span)
    x = (min(max(np.log(level), low), high) - low) / (high - low) * (count - degree)
    x = min(x, count - degree - 1e-12)
    up = [basis(i, degree, np.arange(-degree, count + 1), x) for i in range(count)]
    if turn == 1:
        around = [1.0]
    else:
        place = (phase * turn / (2 * np.pi)) % turn
        around = [
            sum(
                basis(0, 3, np.arange(j + m * turn - 2, j + m * turn + 3), place)
                for m in (-1, 0, 1)
            )
            for j in range(turn)
        ]
    return float(np.array(up) @ knots @ np.array(around))


@pytest.mark.parametrize("shape", [(2, 1), (3, 1), (6, 1), (2, 4), (3, 4), (6, 8)])
def test_surface_agrees_with_its_slow_twin(shape):
    rng = np.random.default_rng(sum(shape))
    knots, span = rng.normal(size=shape), np.array([50.0, 9000.0])
    level = np.exp(rng.uniform(np.log(20), np.log(20_000), 60))
    phase = rng.uniform(-7, 14, 60)
    slow = [slow_surface(knots, a, p, span) for a, p in zip(level, phase, strict=True)]
    assert surface(knots, level, phase, span) == pytest.approx(slow, abs=1e-9)
    rows = design(level, phase, span, shape)
    assert rows @ knots.ravel() == pytest.approx(slow, abs=1e-9)
    assert rows.sum(axis=1) == pytest.approx(1, abs=1e-12)


def test_refusals():
    with pytest.raises(ValueError, match="amplitude needs captures of kind gray or wall or rail"):
        amplitude(targets(linear, 0, kind="check"))
    with pytest.raises(ValueError, match=r"amplitude needs 3 captures .* got 2"):
        amplitude(targets(linear, 0)[:2])
    same = targets(linear, 0, ((1.5, 0.5),) * 4)
    with pytest.raises(ValueError, match=r"brightness by a factor of 1\.\d+ only"):
        amplitude(same)
    captures = targets(linear, 0)
    captures[3] = replace(captures[3], phasors=Phasors(captures[3].phasors.values * 0))
    with pytest.raises(ValueError, match=r"gray_03\.h5 has 0 % usable pixels"):
        amplitude(captures)
    stage = amplitude(targets(linear, 1))
    with pytest.raises(ValueError, match="2 frequencies, got phasors of 3"):
        stage(Phasors(np.ones((3, 2, 2))))


GOOD = (np.zeros((1, 2, 4)), np.zeros((1, 8, 8)), [[1.0, 2.0]], [1.5])


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (0, np.full((1, 2, 4), np.nan)),
        (0, np.zeros((1, 2, 3))),
        (1, np.zeros((1, 6, 6))),
        (2, [[2.0, 1.0]]),
        (2, [[0.0, 1.0]]),
        (2, [[1.0, np.inf]]),
        (3, [1.0, 2.0]),
    ],
)
def test_hostile_fields_are_refused(place, value):
    fields = list(GOOD)
    assert Amplitude(*fields).amplitude_span == (1.0, 2.0)
    fields[place] = value
    with pytest.raises(ValueError, match=r"must|wanted"):
        Amplitude(*fields)


def test_it_is_registered():
    assert CALIBRATIONS["amplitude"].load() is amplitude
