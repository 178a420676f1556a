"""The benchmark of the corrections: its figures are right, and it runs with any registry."""

import importlib
import json
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from toftools import registry
from toftools.registry import CORRECTIONS, Spec
from toftools.sensors import sensor as preset
from toftools.types import DepthMap, Phasors
from toftools.units import range_to_phase

FEW = ("single", "crt", "residual_voting")


@pytest.fixture
def bench(monkeypatch):
    """The parts of the benchmark, importable as when it is run."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    parts = ("methods", "planted", "real", "auto", "frames", "scenes", "diffuse")
    found = {part: importlib.import_module(f"correction_{part}") for part in parts}
    return {**found, "main": importlib.import_module("correction")}


def job_of(bench, tmp_path, **how):
    return bench["methods"].Job(tmp_path, tmp_path, lambda _: None, quick=True, **how)


# A method that takes a share of the light for indirect, one that answers noise of known sigma.
PRETENDED = '''
import numpy as np
from toftools.types import DepthMap

def half(sensor, *, tol_mm=1.0):
    """Single return, which says that half of the light was indirect; needs two frequencies."""
    if sensor.modulation.n_freqs < 2:
        raise ValueError("half needs two frequencies, got 1")
    def run(phasors):
        shape = phasors.valid.shape
        info = {"indirect": phasors.values / 2, "fallback": np.arange(shape[1]) < shape[1] / 4,
                "model": np.zeros(shape, np.uint8), "models": ("one",)}
        info["fallback"] = np.broadcast_to(info["fallback"], shape)
        return DepthMap(np.full(shape, 2.0), np.full(shape, 0.1), info=info)
    return run

def broken(sensor):
    """Fails when it runs."""
    def run(phasors):
        raise RuntimeError("no luck")
    return run
'''


@pytest.fixture
def pretended(monkeypatch, tmp_path):
    """A registry of three real methods and the pretended ones."""
    (tmp_path / "pretended.py").write_text(PRETENDED)
    monkeypatch.syspath_prepend(str(tmp_path))
    targets = {"auto": "half", "half": "half", "broken": "broken"}
    added = {name: Spec(f"pretended:{target}", name=name) for name, target in targets.items()}
    added["fuchs2010_all_pairs"] = Spec("pretended:half", name="fuchs2010_all_pairs")
    added["fuchs2010"] = Spec("pretended:half", {"tol_mm": (1.0,)}, name="fuchs2010")
    table = {name: CORRECTIONS[name] for name in FEW}
    monkeypatch.setattr(registry, "CORRECTIONS", MappingProxyType({**table, **added}))


def test_every_section_runs_and_an_earlier_one_stays(bench, pretended, tmp_path):
    out, cache = tmp_path / "out", tmp_path / "cache"
    where = ["--out", str(out), "--cache", str(cache), "--quick"]
    bench["main"].main([*where, "--only", "planted", "diffuse", "speed", "su", "real"])
    before = json.loads((out / "results.json").read_text())["sections"]
    bench["main"].main([*where, "--only", "auto"])
    after = json.loads((out / "results.json").read_text())["sections"]
    assert set(after) == set(bench["main"].SECTIONS)
    assert after["planted"] == before["planted"]
    page = (out / "index.md").read_text()
    for title in bench["main"].SECTIONS.values():
        assert f"## {title}" in page
    assert "half needs two frequencies, got 1" in page  # the single frequency of diffuse
    assert "failed with RuntimeError: no luck" in page
    assert "residual_voting needs three different frequencies" in page
    for picture in ("planted_opt8241.png", "albedo.svg", "speed.svg", "auto_models.png"):
        assert (out / picture).stat().st_size > 1000
        assert picture.rpartition(".")[0] in page
    near, far = ([r["change_m"] for r in after["auto"]["clean"] if f"{d} m" in r["scene"]]
                 for d in (2, 6))  # fmt: skip
    assert max(near) < 0.6 < 4 < min(far)  # the pretended one says 2 m; rims are farther
    brute, fast = after["diffuse"]["production"]["found"]["corner, 40 + 70 MHz"]
    assert (brute["label"], fast["label"]) == ("fuchs2010_all_pairs", "fuchs2010:tol_mm=1")
    assert fast["rms_m"] == 0 < fast["ms"]
    falls = [row["fallback"] for rows in after["diffuse"]["albedo"]["found"]["40 + 70 MHz"].values()
             for row in rows["half"]]  # fmt: skip
    assert falls == [0.25] * len(falls)


def test_planted_returns_are_what_they_say(bench):
    planted = bench["planted"]
    sensor = planted.camera_of("opt8241", (8, 12))
    truth, frame, charge = planted.shoot(sensor, 0.8, 0.4, seed=3)
    freqs = sensor.modulation.freqs_hz[:, None, None]
    light = np.exp(1j * range_to_phase(truth, freqs))
    light = light + 0.4 * np.exp(1j * range_to_phase(truth + 0.8, freqs))
    gap = (frame.values - 0.8 * charge * light) / frame.sigma
    assert np.std([gap.real, gap.imag]) == pytest.approx(1, abs=0.15)
    bound = planted.bound_m(sensor, frame, charge, 0.8, 0.4)
    assert bound > 3 * planted.bound_m(sensor, frame, charge, 0.8, 0.0)


def test_statistics_of_known_errors(bench):
    rng = np.random.default_rng(0)
    truth = np.full((100, 200), 2.0)
    answer = truth + 0.01 * rng.normal(size=truth.shape)
    answer[:10] += 1.0  # a tenth are outliers
    answer[10:20] = np.nan
    found = bench["planted"].statistics(truth, DepthMap(answer, np.full(truth.shape, 0.005)))
    assert found["outliers"] == pytest.approx(1 / 9)
    assert found["valid"] == pytest.approx(0.9)
    assert 0.01 < found["error_m"] < 0.0125  # outliers move a median little
    assert 2 < found["spread"] < 2.6


def test_breaking_point_counts_from_the_last_failure(bench):
    planted = bench["planted"]
    result = {"separations_m": [0.1, 0.2, 0.4, 0.8], "ratios": [0.3]}
    bound = np.full((2, 4), 0.01)
    maps = {"error_m": [[0.01] * 4, [0.01, 0.1, 0.01, 0.02]]}
    assert planted.breaking_m(result, bound, maps) == 0.4
    assert planted.share_at_bound(bound, maps) == 0.75
    worst = {"error_m": [[0.01] * 4, [0.01, 0.01, 0.01, 0.2]]}
    assert planted.breaking_m(result, bound, worst) is None


def test_a_decimated_camera_sees_the_same_scene(bench):
    from toftools.camera import rays

    sensor = preset("opt8241:width=32,height=24")
    values = np.arange(2 * 24 * 32).reshape(2, 24, 32) + 1j
    small, seen = bench["methods"].decimated(sensor, Phasors(values.astype(np.complex64)), 4)
    assert np.allclose(rays(small.camera), rays(sensor.camera)[::4, ::4])
    assert np.array_equal(seen.values, values[:, ::4, ::4].astype(np.complex64))


def test_pointwise_is_told_from_spatial(bench):
    sensor = preset("opt8241:width=5,height=4")
    told = {name: bench["methods"].pointwise(CORRECTIONS[name].build(sensor), 2)
            for name in ("crt", "kde")}  # fmt: skip
    assert told == {"crt": True, "kde": False}


def test_flatness_of_a_noisy_wall_and_agreement_of_frequencies(bench):
    from toftools.sim.shapes import tilted

    sensor = preset("opt8241:width=64,height=48")
    flat = tilted(sensor.camera, tilt=30.0).range_m
    noisy = flat + np.random.default_rng(1).normal(scale=0.004, size=flat.shape)
    everywhere = np.ones(flat.shape, np.int8)
    found = bench["real"].flatness_m(sensor.camera, noisy.astype(np.float32), everywhere)
    assert 0.002 < found < 0.004  # noise lies along the ray, and the worst 5 % are left out
    assert bench["real"].flatness_m(sensor.camera, flat.astype(np.float32), everywhere) < 1e-4
    labels = bench["real"].planes(sensor.camera, noisy)
    assert (labels == 1).mean() > 0.95
    freqs = sensor.modulation.freqs_hz[:, None, None]
    apart = np.stack([flat, flat + 0.03])
    z = np.exp(1j * range_to_phase(apart, freqs))
    assert bench["real"].disagreement_m(sensor, z, flat) == pytest.approx(0.03, abs=1e-6)


def test_verdict_takes_the_best_rival_that_answers(bench):
    def row(name, mae_m, valid=1.0):
        return {"capture": "a", "name": name, "method": name, "mae_m": mae_m, "valid": valid}

    rows = [row("crt", 0.04), row("auto", 0.023), row("lazy", 0.001, 0.2), row("good", 0.02)]
    (found,) = bench["auto"].verdicts(rows)
    assert (found["best"], found["best_m"], found["crt_m"]) == ("good", 0.02, 0.04)
    text = bench["auto"].verdict_table([found])
    assert "More than 15 % above the best: 0 of 1; above `crt`: 0 of 1." in text
    found["auto_m"] = 0.05
    assert "best: 1 of 1; above `crt`: 1 of 1." in bench["auto"].verdict_table([found])


def test_albedo_scales_direct_light_once_and_one_bounce_twice(bench, tmp_path):
    from toftools.sim.analytic import analytic
    from toftools.types import Scene, Shot

    job, size = job_of(bench, tmp_path), (12, 8)
    made = bench["scenes"].corner_once(job, size)(0.4)
    sensor = bench["scenes"].device("corner", size)
    wanted = analytic(Scene("corner", {"albedo": 0.4}))(Shot(sensor, noisy=False))
    assert np.allclose(made.phasors.values, wanted.phasors.values, rtol=1e-4)
    assert np.allclose(made.phasors.sigma, wanted.phasors.sigma, rtol=0.08)  # bounces cancel a bit
    one = bench["scenes"].seen_by(made, (1, 2))
    assert one.sensor.modulation.freqs_hz.tolist() == [40e6, 70e6]
    assert np.array_equal(one.phasors.values, made.phasors.values[1:])
