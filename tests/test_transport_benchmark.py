"""The equal-time comparison counts right: known errors, known speeds, without the peer."""

import importlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toftools.sensors import sensor as preset
from toftools.sim.shapes import corner
from toftools.units import phase_to_range, range_to_phase

FREQ = 20e6
SEEN = np.ones((16, 16), bool)


@pytest.fixture
def bench(monkeypatch):
    """The script and its files, importable as when it is run."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    names = ("transport", "peers.measure", "peers.worker")
    return {name.split(".")[-1]: importlib.import_module(name) for name in names}


def images(n, error, seed, range_m=2.0):
    """Unit phasors of a wall with complex noise of standard deviation `error` per part."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(n, 16, 16, 2)) @ [1, 1j]
    return np.exp(1j * range_to_phase(range_m, FREQ)) + error * noise


def test_range_error_is_wrapped_and_signed(bench):
    one, other = (images(1, 0, 0, r)[0] for r in (2.05, 2.0))
    error = bench["measure"].range_error_m(one, other, FREQ)
    assert np.allclose(error, 0.05, atol=1e-9)
    far = images(1, 0, 0, 2.0 + 7.4948)[0]  # one ambiguity on, which nobody can tell
    assert np.abs(bench["measure"].range_error_m(far, other, FREQ)).max() < 1e-3


def test_mean_square_does_not_count_the_noise_of_the_reference(bench):
    measure = bench["measure"]

    def draw(seed):
        ref = measure.Reference(images(8, 0.05, seed), 8, 1.0)
        return measure.mean_square_m2(images(1, 0.02, 1000 + seed)[0], ref.halves, FREQ, SEEN)

    found = [draw(seed) for seed in range(100)]
    expected, spread = phase_to_range(0.02, FREQ) ** 2, np.std(found, ddof=1)
    assert abs(np.mean(found) - expected) < 4 * spread / 10
    counted = phase_to_range(np.hypot(0.02, 0.05 / np.sqrt(8)), FREQ) ** 2
    assert counted - expected > 8 * spread / 10  # what one reference alone would give
    ref = measure.Reference(images(8, 0.05, 1), 8, 1.0)
    bias = images(1, 0, 0, 2.03)[0]
    assert measure.mean_square_m2(bias, ref.halves, FREQ, SEEN) == pytest.approx(9e-4, rel=0.05)
    truth = images(1, 0, 0)[0]
    floors = [measure.mean_square_m2(truth, measure.Reference(images(8, 0.05, s), 8, 1.0).halves,
                                     FREQ, SEEN) for s in range(200, 300)]  # fmt: skip
    assert np.std(floors) == pytest.approx(measure.floor_m2(ref, FREQ, SEEN), rel=0.3)


def test_references_agree_or_not(bench):
    measure = bench["measure"]
    one, same = (measure.Reference(images(16, 0.05, s), 16, 1.0) for s in (2, 3))
    found = measure.agreement(one, same, SEEN)
    assert abs(found["chi2_per_pixel"] - 1) < 4 / np.sqrt(SEEN.sum())  # 2 of 256 dof pairs: 4 s.e.
    assert found["share_beyond"] == 0
    assert np.abs(found["mean_gap"]).max() < 4 * found["mean_gap_se"]
    moved = measure.Reference(images(16, 0.05, 4, range_m=2.03), 16, 1.0)
    found = measure.agreement(one, moved, SEEN)
    assert found["chi2_per_pixel"] > 1.5
    assert found["mean_gap"][1] ** 2 + found["mean_gap"][0] ** 2 > (10 * found["mean_gap_se"]) ** 2
    error_m = measure.standard_error_m(one, FREQ, SEEN)
    assert error_m == pytest.approx(float(phase_to_range(0.05 / 4, FREQ)), rel=0.1)
    with pytest.raises(ValueError, match="even number"):
        measure.Reference(images(3, 0.05, 1), 3, 1.0)


def curve(measure, cost_s, start_s, variance_m2, counts):
    def errors(n):
        return [0.9 * variance_m2 / n, 1.1 * variance_m2 / n]

    return [
        measure.Point(n, [start_s + cost_s * n], errors(n), [0.0], 0.0, 0.0, 0.0) for n in counts
    ]


def test_equal_time_ratio_of_known_curves(bench):
    measure = bench["measure"]
    theirs = curve(measure, 1e-3, 0.0, 4.0, (4, 16, 64, 256))
    ours = curve(measure, 2e-3, 0.0, 0.2, (1, 4, 16, 64))
    found = measure.equal_time(theirs, ours)
    assert found.value == pytest.approx(10.0)  # 20 times the variance at twice the cost
    assert found.low < 10 < found.high
    assert [ratio for _, ratio in found.at] == pytest.approx([10.0] * 3)
    assert measure.slope(theirs) == pytest.approx(-1.0)
    assert measure.equal_time(theirs[:1], ours[-1:]) is None
    lost = [replace(point, floor_m2=1.0) for point in ours]
    assert measure.equal_time(theirs, lost) is None
    late = measure.equal_time(theirs, curve(measure, 2e-3, 5e-2, 0.2, (4, 16, 64)))
    assert late.at[0][1] < 5 < late.at[-1][1] < 10  # what is paid once counts less and less


def test_edges_are_left_out_and_planes_are_not(bench):
    camera = preset("deeptof:width=32,height=24").camera
    smooth = corner(camera).range_m
    found = bench["measure"].away_from_edges(camera, smooth)
    assert found[1:-1, 2:14].all() and found[1:-1, 18:-2].all()
    assert not (found[0].any() or found[:, -1].any())  # the rim has no neighbours
    step = np.where(np.arange(32) < 10, smooth, smooth + 0.3)
    found = bench["measure"].away_from_edges(camera, step)
    assert not found[:, 9:11].any() and found[5, 3:9].all()


ENGINE = """
import time
import numpy as np

def make(scene, sensor, *, max_bounces, noise=0.0, slow=0.0):
    def render(samples, seed):
        time.sleep(slow * samples)
        rng = np.random.default_rng([seed, int(1e6 * noise)])
        shape = (1, *sensor.camera.shape)
        error = rng.normal(size=(*shape, 2)) @ [1, 1j]
        return np.exp(1j) + noise / np.sqrt(samples) * error, np.full(shape[1:], 2.0)
    return render
"""


def test_comparison_runs_without_the_peer(bench, monkeypatch, tmp_path):
    (tmp_path / "pretended.py").write_text(ENGINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    transport = bench["transport"]
    noisy, clean = ({"noise": noise, "slow": 2e-3} for noise in (0.2, 0.05))
    own = dict(zip(transport.CONTESTANTS, (noisy, noisy, clean, clean), strict=True))
    pretended = {name: ("pretended", options) for name, options in own.items()}
    monkeypatch.setattr(transport, "CONTESTANTS", pretended)
    view = ("wall:range=2", "hfov_deg=20", (32, 32))
    case = transport.Case("test", *view, counts=(4, 16), limit_s=1.0, runs=12)
    told = []
    result = transport.run_case(case, {}, told.append)
    about = {"versions": {}, "machine": {"cpu": "any", "threads": 1}, "max_bounces": 8,
             "missing": [], "seconds": 0.0}  # fmt: skip
    transport.publish(tmp_path / "out", about, [result], [("near", 1.9, 2.0)])
    written = json.loads((tmp_path / "out/transport.json").read_text())
    for entries in written["cases"][0]["ratios"].values():
        for entry in entries:
            assert 8 < entry["ratio"]["value"] < 32  # 16 by construction; few pixels and runs
    assert len(told) == 6 and (tmp_path / "out/transport.md").stat().st_size > 500
    assert (tmp_path / "out/transport.png").stat().st_size > 10_000
    assert "<svg" in (tmp_path / "out/transport.svg").read_text()


def test_a_broken_engine_is_named(bench, monkeypatch, tmp_path):
    (tmp_path / "broken.py").write_text("def make():\n    raise ValueError('no film')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(RuntimeError, match="broken: ValueError: no film"):
        bench["worker"].start("any", "broken")
