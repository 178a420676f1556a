"""Refining all phase stages together: against scipy, against what was planted, and its limits."""

from dataclasses import replace

import numpy as np
import pytest

from toftools.calib._refine_data import pools, usable_captures
from toftools.calib._refine_spread import widened
from toftools.calib._refine_terms import term_of
from toftools.calib.amplitude import Amplitude
from toftools.calib.chain import applied, chain_for, extended
from toftools.calib.fit import fit_stage
from toftools.calib.refine import F_SCALE, WEAK_RAD, _covariance, refine, soft_l1
from toftools.calib.residuals import range_error_m
from toftools.conditions import conditions_of, with_conditions
from toftools.sensors import sensor
from toftools.sim.rig import PLANS, Errors, rig, truth_of

DEVICE = sensor("opt8241:width=24,height=18")
PLAN = replace(
    PLANS["small"], rail=24, delay=0, boards=0, dark=0, flats=0, warmup=10, check=6,
    gray_m=(0.7, 1.2, 1.7, 2.2, 2.8, 3.4),
)  # fmt: skip
# One temperature only: ten frames of a warm-up do not tell two apart.
ERRORS = Errors(sensor_rad_per_k=0.0, amplitude_wave_rad=0.0, prnu=0.0, dsnu_e=0.0, bad_share=0.0)
SLOTS = ("wiggling", "common_phase", "fixed_pattern", "amplitude", "temperature")


@pytest.fixture(scope="module")
def captures():
    """Of a camera whose lens is known."""
    truth = truth_of(ERRORS, DEVICE)
    found = [
        with_conditions(capture, conditions_of(capture), file=name)
        for name, capture in rig(DEVICE, ERRORS, plan=PLAN, frames=20)
    ]
    known = [replace(c, sensor=replace(c.sensor, camera=truth.camera)) for c in found]
    return [cooler(c, truth) if conditions_of(c).kind == "rail" else c for c in known]


def cooler(capture, truth):
    """The same capture, taken while the lamp was still warming up, the farther the later."""
    told = conditions_of(capture)
    cold_k = 2.0 * (told.distance_m - 5.0)
    turn = np.exp(1j * truth.light_rad_per_k * cold_k)[:, None, None]
    values = (capture.phasors.values * turn).astype(np.complex64)
    done = replace(capture, phasors=replace(capture.phasors, values=values), taps=None)
    return with_conditions(done, replace(told, light_c=told.light_c + cold_k))


@pytest.fixture(scope="module")
def chain(captures):
    """Stages one after another."""
    found, seen = chain_for(captures[0].sensor), unchecked(captures)
    for slot in SLOTS:
        found = extended(found, fit_stage(found, slot, slot, seen))
    return found


@pytest.fixture(scope="module")
def refined(chain, captures):
    return refine(chain, unchecked(captures))


def unchecked(captures):
    return [capture for capture in captures if conditions_of(capture).kind != "check"]


def errors_mm(chain, captures):
    """Mean error of every capture and frequency."""
    return np.array(
        [1e3 * np.nanmedian(range_error_m(applied(chain, c)), (1, 2)) for c in captures]
    )


def test_soft_l1_is_that_of_scipy():
    from scipy.optimize import least_squares

    rng = np.random.default_rng(1)
    rows, truth = rng.normal(size=(400, 5)), np.array([1.0, -2.0, 0.5, 0.0, 3.0])
    values = rows @ truth + 0.1 * rng.normal(size=400)
    values[:40] += 3
    start = truth + 0.3
    scale = 1.4826 * np.median(np.abs(values - rows @ start))

    def residuals(theta):
        return (rows @ theta - values) / scale

    twin = least_squares(residuals, start, loss="soft_l1", f_scale=F_SCALE, xtol=1e-12)
    found = soft_l1(rows, values, start)
    spread = scale / np.sqrt(400)
    np.testing.assert_allclose(found, twin.x, atol=0.03 * spread + scale**2 / WEAK_RAD**2 / 400)
    plain = np.linalg.lstsq(rows, values, rcond=None)[0]
    assert np.abs(found - truth).max() < np.abs(plain - truth).max()


def test_jackknife_of_independent_errors_is_the_textbook_one():
    rng = np.random.default_rng(2)
    design, weight = rng.normal(size=(300, 7, 2)), np.full((300, 7), 25.0)
    rest = 0.2 * rng.normal(size=(300, 7))
    found = _covariance(design, rest, weight)
    flat = design.reshape(-1, 2)
    np.testing.assert_allclose(found, 0.04 * np.linalg.inv(flat.T @ flat), rtol=0.3, atol=2e-6)


def test_errors_that_hang_together_widen_it():
    rng = np.random.default_rng(3)
    design, weight = np.ones((40, 50, 1)), np.ones((40, 50))
    shared = np.repeat(rng.normal(size=(40, 1)), 50, axis=1)
    found = float(_covariance(design, shared, weight)[0, 0])
    assert 0.5 / 40 < found < 2 / 40


def test_check_set_reads_better(chain, refined, captures):
    check = [capture for capture in captures if conditions_of(capture).kind == "check"]
    raw = np.abs(errors_mm(chain_for(captures[0].sensor), check)).mean()
    before, after = (np.abs(errors_mm(c, check)).mean() for c in (chain, refined))
    assert after < 0.7 * before
    assert before < 0.1 * raw


def test_planted_drift_is_found(refined):
    truth, stage = truth_of(ERRORS, DEVICE), refined.stage("temperature")
    off = stage.slope_rad_per_k[:, 1] - truth.light_rad_per_k
    assert stage.needs == ("light_c",)
    assert (np.abs(off) < 4 * stage.sigma_rad_per_k[:, 1]).all()


def test_constants_know_of_the_other_stages(chain, refined, captures):
    optics = [replace(c, taps=None) for c in unchecked(captures)]
    walls = [c for c in optics if conditions_of(c).kind == "wall"]
    terms = [t for t in map(term_of, refined.stages) if t is not None]
    sizes = [sum(t.start[f].size for t in terms) for f in range(2)]
    none = widened(refined, terms, [np.zeros((n, n)) for n in sizes], walls)
    wide = widened(refined, terms, [1e-4 * np.eye(n) for n in sizes], walls)
    for slot in ("common_phase", "fixed_pattern"):
        first, same, more = (c.stage(slot).sigma_rad for c in (refined, none, wide))
        np.testing.assert_allclose(same, first)
        assert (more >= first - 1e-15).all() and (more > first).any()


def test_surface_is_zero_at_its_reference_amplitude(refined):
    stage = refined.stage("amplitude")
    assert isinstance(stage, Amplitude)
    phase = np.tile(np.linspace(0, 6, 9), (2, 1))
    level = np.tile(stage.reference_amplitude[:, None], (1, 9))
    np.testing.assert_allclose(stage.error_rad(phase, level), 0, atol=1e-9)
    assert np.abs(stage.error_rad(phase, level * 2)).max() > 1e-3


def test_outlier_captures_do_not_count(chain, refined, captures):
    seen = unchecked(captures)
    bad = next(c for c in seen if conditions_of(c).kind == "rail")
    values = np.array(bad.phasors.values)
    values[:, :9] *= np.exp(0.5j)  # a person in the upper half of one of 24 captures
    broken = replace(bad, phasors=replace(bad.phasors, values=values), taps=None)
    again = refine(chain, [broken if c is bad else c for c in seen])
    curve, other = (c.stage("wiggling") for c in (refined, again))
    phase = np.tile(np.linspace(0, 6.3, 50), (2, 1))
    assert np.abs(curve.error_rad(phase) - other.error_rad(phase)).max() < 2e-3


def test_a_pixel_that_is_no_number_does_no_harm(chain, captures):
    def broken(capture):
        values = np.array(capture.phasors.values)
        values[:, 5, 5] = np.nan
        return replace(capture, phasors=replace(capture.phasors, values=values), taps=None)

    again = refine(chain, [broken(c) for c in unchecked(captures)])
    assert np.isfinite(again.stage("wiggling").cos_rad).all()
    assert np.isfinite(again.stage("amplitude").knot_rad).all()
    assert np.isfinite(again.stage("fixed_pattern").map_rad[:, 5, 5]).sum() == 0


def test_too_little_to_refine(chain, captures):
    assert refine(chain, unchecked(captures)[:3]) is chain
    empty = chain_for(captures[0].sensor)
    assert refine(empty, unchecked(captures)) is empty


def test_captures_without_a_needed_temperature_are_left_out(chain, captures):
    cold = [
        with_conditions(c, replace(conditions_of(c), light_c=float("nan"))) for c in captures[:4]
    ]
    assert usable_captures(chain, cold) == []
    assert len(usable_captures(chain.without("temperature"), cold)) == 4


def test_every_wiggling_model_has_a_term(chain, captures):
    rail = [c for c in captures if conditions_of(c).kind == "rail"]
    start = chain_for(captures[0].sensor)
    pool = pools(chain, rail)[0]
    for entry in ("wiggling", "wiggling_spline", "wiggling_lut"):
        stage = fit_stage(start, "wiggling", entry, rail)
        term = term_of(stage)
        model = term.columns(pool, 0) @ term.start[0]
        direct = stage.error_rad(np.stack([pool.phase_rad] * 2), None)[0]
        np.testing.assert_allclose(model, direct, atol=1e-9)
        sizes = [np.eye(x.size) * 1e-6 for x in term.start]
        again = term.rebuilt(term.start, sizes, 15)
        np.testing.assert_allclose(again.error_rad(np.stack([pool.phase_rad] * 2), None)[0], direct,
                                   atol=1e-9)  # fmt: skip
