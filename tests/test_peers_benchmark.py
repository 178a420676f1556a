"""Side by side with peers: what is counted as an error, what is not installed, and the table."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from toftools.sensors import sensor
from toftools.units import ambiguity_m

ROOT = Path(__file__).parent.parent
FREQS = sensor("opt8241").modulation.freqs_hz  # 40 and 70 MHz
TURN_M = float(ambiguity_m(FREQS[1]))


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def test_spatial_errors_are_free_of_whole_turns_and_of_nothing_else(bench):
    error_m = bench("peers.unwrappers").error_m
    truth = np.linspace(1, 8, 200)
    noisy = truth + 0.01 * np.sin(np.arange(200))
    shifted = noisy + 3 * TURN_M
    assert np.allclose(error_m(shifted, truth, FREQS, free_turns=True), noisy - truth)
    assert np.allclose(error_m(shifted, truth, FREQS, free_turns=False), shifted - truth)
    half = noisy + 0.5
    assert np.allclose(error_m(half, truth, FREQS, free_turns=True), 0.5 + noisy - truth)
    part = np.where(np.arange(200) < 60, noisy - TURN_M, noisy)  # a region of its own turn
    left = np.abs(error_m(part, truth, FREQS, free_turns=True)) > 1
    assert left.sum() == 60


def test_what_answers_less_than_half_has_no_error(bench):
    figures = bench("unwrapping_peers").figures
    error = np.full((1, 2, 10), 0.1)
    error[0, 0] = np.nan
    lit = np.ones((2, 10), bool)
    told = figures(error, [2.0, 1.0], FREQS, lit)
    assert (told["mae_m"], told["wrong"], told["valid"], told["ms"]) == (0.1, 0, 0.5, 1.0)
    error[0, 1, 0] = np.nan
    assert np.isnan(figures(error, [1.0], FREQS, lit)["mae_m"])
    assert figures(np.full((1, 2, 10), 1.2), [1.0], FREQS, lit)["wrong"] == 1.0


def test_the_page_says_what_was_measured_and_what_is_missing(bench, monkeypatch, tmp_path):
    """Slopes suit everybody, a square beyond half a turn no spatial method; no peer is needed."""
    script, unwrappers = bench("unwrapping_peers"), bench("peers.unwrappers")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        unwrappers.importlib.util, "find_spec", lambda n: None if n == "skimage" else find(n)
    )
    monkeypatch.setattr(script, "NOISES", (100.0, 10.0))
    monkeypatch.setattr(script, "JUMPS_M", (0.0, 0.5, 1.5))
    script.main(["--out", str(tmp_path), "--quick"])
    told = json.loads((tmp_path / "unwrapping_peers.json").read_text())
    assert told["about"]["missing"] == [f"{unwrappers.SKIMAGE} is not installed and is left out"]
    slope, _, square, _ = told["scenes"].values()
    assert {row["wrong"] for row in slope.values()} == {0.0}
    peer, ours = square[unwrappers.OPENCV], square["crt"]
    assert peer["wrong"] == pytest.approx(0.25, abs=0.01) and ours["wrong"] == 0
    jump = np.array(told["jump"]["mae_m"][unwrappers.OPENCV]).mean(axis=1)
    assert jump[1] < 0.02 < 0.4 < jump[2]
    page = (tmp_path / "unwrapping_peers.md").read_text()
    assert "scikit-image unwrap_phase is not installed" in page
    assert f"| {unwrappers.OPENCV} | 25.0" in page
    for name in ("noise", "jump"):
        assert "<svg" in (tmp_path / f"unwrapping_{name}.svg").read_text()


def test_one_table_of_all_tasks(bench, monkeypatch, tmp_path):
    script, rows = bench("side_by_side"), bench("peers.rows")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        rows.importlib.util, "find_spec", lambda n: None if n == "mitransient" else find(n)
    )
    monkeypatch.setattr(script.unwrapping_peers, "NOISES", (100.0, 30.0))
    monkeypatch.setattr(script.unwrapping_peers, "JUMPS_M", (0.0, 0.5))
    script.main(["--out", str(tmp_path), "--quick"])
    kept = json.loads((tmp_path / "results.json").read_text())
    by_task = {row["task"].partition(",")[0] for row in kept["rows"]}
    assert {"unwrapping", "sparse reflections"} <= by_task
    assert "mitransient is not installed and is left out" in kept["about"]["missing"]
    program = next(row for row in kept["rows"] if row["peer"].startswith("scipy"))
    assert program["our_ms"] < program["peer_ms"] / 20
    plain = next(row for row in kept["rows"] if "gather" in row["ours"])
    assert plain["our_error"] < 10  # millionths: float32
    page = (tmp_path / "index.md").read_text()
    assert page.count("\n| unwrapping") == sum(r["task"].startswith("unwrap") for r in kept["rows"])
    assert f"| {program['peer_ms'] / program['our_ms']:.3g} |" in page
    assert (tmp_path / "unwrapping_peers.md").is_file()


def test_the_committed_pages_are_those_of_the_committed_figures(bench):
    folder = ROOT / "docs" / "peers"
    kept = json.loads((folder / "results.json").read_text())
    page = bench("side_by_side").page(kept["about"], kept["rows"])
    assert page == (folder / "index.md").read_text(encoding="utf-8")
    kept = json.loads((folder / "unwrapping_peers.json").read_text())
    page = bench("unwrapping_peers").page(kept)
    assert page == (folder / "unwrapping_peers.md").read_text(encoding="utf-8")


def test_kernels_stand_beside_their_twins(tmp_path):
    """The folder of kernels runs, and its table holds both times and their ratio."""
    file = tmp_path / "kernels.md"
    line = ["-m", "pytest", "benchmarks/kernels", "-o", "addopts=", "-p", "no:dash", "-q",
            "--benchmark-disable", "-k", "test_paths or test_ratio or test_clean_taps",
            "--table", str(file)]  # fmt: skip
    done = subprocess.run([sys.executable, *line], cwd=ROOT, capture_output=True, text=True,
                          check=False)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    table = [row.strip("| ").split(" | ") for row in file.read_text().splitlines()
             if row.startswith("| ")][1:]  # fmt: skip
    assert len(table) == 3 and "3 passed" in done.stdout
    for name, _, _, own, twin, slow, ratio in table:
        assert name in done.stdout
        if twin != "–":
            assert float(slow) / float(own) == pytest.approx(float(ratio.replace(",", "")), rel=0.3)
    assert sum(row[4] != "–" for row in table) == 2
