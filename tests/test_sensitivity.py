"""Local sensitivity, bound and spectral radius: planted methods are told for what they are."""

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

import toftools
from toftools.bench.bound import median_bound_m
from toftools.bench.perturb import aside, deeper, noisier
from toftools.bench.plan import Point, make_plan
from toftools.bench.report import report
from toftools.bench.run import Settings, run_points
from toftools.bench.score import score
from toftools.bench.sensitivity import local_measures
from toftools.bench.suite import load_suite
from toftools.correct.crt import crt
from toftools.registry import SIMULATORS
from toftools.sensors import sensor
from toftools.types import Capture, DepthMap, Phasors, Scene, Shot

SUITE = """name = "small"
methods = ["crt:max_range_m=0", "fuchs2010:tol_mm=1", "test_sensitivity:tires", "oracle_wrap"]
repeats = 1
batch = true
sensitivity = true

[[axis]]
name = "light"
values = [20000, 4000, 50]
scene = "corner:angle=90,range=2,albedo=0.6"
sensor = "opt8241:width=24,height=18,signal_e={value}"
seeds = 1
"""


@pytest.fixture(scope="module")
def capture():
    """A tilted wall, 64 x 48 pixels, with noise."""
    device = sensor("opt8241:width=64,height=48")
    return SIMULATORS["analytic"].build(Scene("tilted", {"range": 2, "tilt": 20}))(Shot(device))


def told(capture, run, **limits):
    return local_measures(run, capture, run(capture.phasors), **limits)


def range_of(capture, phasors):
    return crt(capture.sensor)(phasors).range_m


def tires(device):
    """A method that raises at its third call."""
    plain, calls = crt(device), []

    def run(phasors):
        calls.append(1)
        if len(calls) > 2:
            raise RuntimeError("planted in a perturbed run")
        return plain(phasors)

    return run


# Sensitivity


def test_crt_passes_noise_on_and_follows_the_scene(capture):
    found = told(capture, crt(capture.sensor))
    # 3072 pixels: the median of |x| has a standard error of 2 %.
    assert found["sensitivity"]["noise"] == pytest.approx(1, abs=0.07)
    assert found["sensitivity"]["scale"] < 1e-3
    assert found["sensitivity"]["shift_m"] == 0 and found["sensitivity"]["jumps"] == 0
    assert found["sensitivity_error"] is None and found["spectral_radius"] is None
    assert found == told(capture, crt(capture.sensor)), "the draws are the same every time"


def test_noise_amplified_by_three_is_told_as_three(capture):
    truth = capture.truth.range_m
    found = told(capture, lambda p: DepthMap(truth + 3 * (range_of(capture, p) - truth)))
    plain = told(capture, crt(capture.sensor))["sensitivity"]
    assert found["sensitivity"]["noise"] == pytest.approx(3 * plain["noise"], rel=1e-3)
    # Three times the way: too far by two ways.
    assert found["sensitivity"]["scale"] == pytest.approx(2, abs=1e-2)


def test_an_answer_that_ignores_the_input_is_told(capture):
    found = told(capture, lambda p: DepthMap(np.full(p.valid.shape, 2.0)))["sensitivity"]
    assert found == {"noise": 0.0, "jumps": 0.0, "scale": 1.0, "shift_m": 0.0}


def test_a_mean_over_rows_sees_a_pixel_leave(capture):
    def run(phasors):
        got = np.where(phasors.valid, range_of(capture, phasors), np.nan)
        mean = np.nanmean(got, axis=1, keepdims=True)
        return DepthMap(np.where(phasors.valid, np.broadcast_to(mean, got.shape), np.nan))

    plain = range_of(capture, capture.phasors).astype(np.float64)
    wanted = np.abs(plain[:, :-1].mean(axis=1) - plain.mean(axis=1)).mean()
    found = told(capture, run)["sensitivity"]
    assert wanted > 1e-3 and found["shift_m"] == pytest.approx(wanted, rel=1e-3)
    assert found["noise"] < 0.3, "a mean of 64 pixels has an eighth of the noise"


@pytest.mark.parametrize(("off_m", "jumps"), [(1.12, 0.25), (1.0, 0.0)])
def test_pixels_that_jump_are_counted_and_hide_nothing(capture, off_m, jumps):
    before = capture.phasors.values
    pick = np.zeros(capture.phasors.valid.shape, bool)
    pick[::4] = True

    def run(phasors):
        away = pick & (phasors.values != before).any(axis=0)
        return DepthMap(range_of(capture, phasors) + off_m * away)

    found = told(capture, run)["sensitivity"]
    assert found["jumps"] == jumps, "a jump is more than half of 2.14 m"
    if jumps:
        assert found["noise"] == pytest.approx(1, abs=0.07) and found["scale"] < 1e-3
    else:
        assert found["noise"] > 1.2 and found["scale"] > 10


def test_lost_answers_are_no_change(capture):
    def run(phasors):
        got = range_of(capture, phasors)
        return DepthMap(np.where(phasors.values[0].real > 0, got, np.nan))

    found = told(capture, run)["sensitivity"]
    assert found["scale"] < 1e-3 and found["shift_m"] == 0
    nothing = told(capture, lambda p: DepthMap(np.full(p.valid.shape, np.nan)))["sensitivity"]
    assert set(nothing.values()) == {None}


def test_a_method_that_hands_out_one_array_is_not_taken_for_a_stable_one(capture):
    mine = np.empty(capture.phasors.valid.shape, np.float32)

    def run(phasors):
        mine[:] = range_of(capture, phasors)
        return DepthMap(mine)

    assert told(capture, run) == told(capture, crt(capture.sensor))


def test_without_sigma_noise_is_not_told(capture):
    bare = Capture(capture.sensor, phasors=Phasors(capture.phasors.values), truth=capture.truth)
    found = told(bare, crt(bare.sensor))["sensitivity"]
    assert found["noise"] is None and found["jumps"] is None
    assert found["scale"] < 1e-3 and found["shift_m"] == 0


@pytest.mark.parametrize("error", [RuntimeError("planted"), SystemExit(3)])
def test_what_raises_in_a_perturbed_run_keeps_its_point(capture, error):
    def run(phasors):
        if (phasors.values != capture.phasors.values).any():
            raise error
        return DepthMap(range_of(capture, phasors))

    found = told(capture, run)
    assert found["sensitivity"] is None
    assert found["sensitivity_error"] == f"{type(error).__name__}: {error}"


def test_a_wrong_answer_in_a_perturbed_run_is_told(capture):
    first = crt(capture.sensor)(capture.phasors)
    found = local_measures(lambda _: np.zeros(3), capture, first)
    assert found["sensitivity"] is None and "must return a DepthMap" in found["sensitivity_error"]


def test_no_run_is_begun_that_the_limit_would_end(capture):
    found = told(capture, crt(capture.sensor), call_s=4.0, left_s=20.0)
    assert found["sensitivity"] is None and "limit of time" in found["sensitivity_error"]
    assert told(capture, crt(capture.sensor), call_s=3.0, left_s=20.0)["sensitivity"]


# Perturbations


def test_perturbed_phasors_are_those_of_the_formulas(capture):
    phasors, freqs_hz = capture.phasors, capture.sensor.modulation.freqs_hz
    spoilt = np.array(phasors.values)
    spoilt[:, 5, 7] = np.nan
    holed = Phasors(spoilt, phasors.sigma)
    off = (noisier(phasors).values - phasors.values) / phasors.sigma
    assert off.real.std() == pytest.approx(1, abs=0.03)
    assert off.imag.std() == pytest.approx(1, abs=0.03)
    far = deeper(holed, np.full(phasors.valid.shape, 3.0), freqs_hz)
    turn = np.exp(1j * 4 * np.pi * freqs_hz * 0.03 / 299_792_458.0)
    np.testing.assert_allclose(far.values[:, 0, 0], spoilt[:, 0, 0] * turn, rtol=1e-5)
    for one in (far, noisier(holed)):
        assert not one.valid[5, 7] and one.valid.sum() == one.valid.size - 1
    moved = aside(holed)
    assert not moved.valid[:, 0].any() and not moved.valid[5, 8]
    np.testing.assert_array_equal(moved.values[:, :5, 1:], spoilt[:, :5, :-1])
    np.testing.assert_array_equal(moved.sigma[:, :, 1:], phasors.sigma[:, :, :-1])


def test_the_bound_is_the_sigma_of_crt(capture):
    sigma_m = crt(capture.sensor)(capture.phasors).sigma_m
    freqs_hz, everywhere = capture.sensor.modulation.freqs_hz, capture.phasors.valid
    found = median_bound_m(capture.phasors, freqs_hz, everywhere)
    assert found == pytest.approx(float(np.median(sigma_m)), rel=1e-4)
    assert median_bound_m(Phasors(capture.phasors.values), freqs_hz, everywhere) is None
    assert median_bound_m(capture.phasors, freqs_hz, np.zeros_like(everywhere)) is None


# In a suite


@pytest.mark.parametrize("value", ['"yes"', "1", "[true]"])
def test_the_flag_is_a_flag(tmp_path, value):
    text = SUITE.replace("sensitivity = true", f"sensitivity = {value}")
    (tmp_path / "wrong.toml").write_text(text)
    with pytest.raises(ValueError, match=r"sensitivity in wrong\.toml must be true or false"):
        load_suite(str(tmp_path / "wrong.toml"))


def test_the_flag_is_in_the_fingerprint_and_in_the_suite_of_the_package():
    assert load_suite("stress").sensitivity and not load_suite("quick").sensitivity
    point = Point("c", "crt", {})
    without, with_it = (Settings(3, 1, 60.0, sensitivity=on).fingerprint(point) for on in (0, 1))
    assert without != with_it


def test_a_suite_tells_sensitivities_in_rows_and_report(tmp_path, monkeypatch):
    # Workers shall run this very toftools, wherever another one is installed.
    here = Path(toftools.__file__).parent.parent
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(here), "tests"]))
    (tmp_path / "small.toml").write_text(SUITE)
    suite, out = load_suite(str(tmp_path / "small.toml")), tmp_path / "out"
    plan = make_plan(suite, out)
    settings = Settings(1, 1, 60.0, batch=True, sensitivity=suite.sensitivity)
    assert run_points(plan, out, settings, lambda *_: None) == 0
    score(out)
    text = (out / "results.jsonl").read_text(encoding="utf-8")
    assert "NaN" not in text and "Infinity" not in text
    rows = [json.loads(line) for line in text.splitlines()]
    assert all(row["status"] == "ok" and row["bound_m"] > 0 for row in rows)
    by = {(row["method"], row["value"]): row for row in rows}
    plain, fuchs = by["crt", 20000], by["fuchs2010", 20000]
    assert set(plain["sensitivity"]) == {"noise", "jumps", "scale", "shift_m"}
    assert plain["sensitivity"]["shift_m"] == 0 and plain["spectral_radius"] is None
    assert fuchs["sensitivity"]["shift_m"] > 0 and 0 < fuchs["spectral_radius"] < 0.3
    broken = by["test_sensitivity:tires", 4000]
    assert broken["sensitivity"] is None and broken["metrics"]["mae_m"] > 0
    assert broken["sensitivity_error"] == "RuntimeError: planted in a perturbed run"
    for row in rows:
        if row["method"] == "oracle_wrap":
            assert row["sensitivity"] is None and row["sensitivity_error"] is None
    assert by["crt", 50]["sensitivity"]["jumps"] > 0.1, "50 electrons leave the turn open"
    page = report(out).read_text(encoding="utf-8")
    assert 'id="local"' in page and "planted in a perturbed run" in page and "3 of 3" in page
    with (out / "sensitivity.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["place"] for line in lines[:3]].count("easiest") == 1
    assert lines[0]["label"] == "crt:max_range_m=0" and float(lines[0]["scale"]) < 1e-3
    assert lines[6]["errors"] == "1" and lines[6]["noise"] == ""
    assert len(json.loads((out / "sensitivity.json").read_text())) == 9
