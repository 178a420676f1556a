"""The benchmark of learned corrections: every part runs, and the page says what was measured."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from learning import planes


@pytest.fixture
def bench(monkeypatch):
    """Scripts of the benchmark, importable as when they are run."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    device = "deeptof:width=64,height=48,hfov_deg=70,freqs=20e6+40e6+70e6"
    return planes(tmp_path_factory.mktemp("learned") / "planes", device=device)


def test_held_out_frames_become_a_page(bench, data, tmp_path, capsys):
    line = ["--data", str(data), "--albedo", str(data), "--out", str(tmp_path)]
    bench("learned").main([*line, "--only", "held_out", "albedo"])
    kept = json.loads((tmp_path / "results.json").read_text())
    raw = kept["held_out"]["raw, 20 MHz"]
    # A quarter of the light comes 0.6 m later: arg(1 + exp(j k 0.6 / 2) / 4) / k, in closed form.
    k = 4 * np.pi * 20e6 / 299_792_458.0
    shift_m = np.angle(1 + 0.25 * np.exp(1j * k * 0.3)) / k
    assert raw["mae_m"] == pytest.approx(shift_m, rel=0.02)
    assert raw["captures"] == 1 and sum(raw["histogram"]) == raw["pixels"]
    assert list(kept["albedo"]["raw, 20 MHz"]["groups"]) == ["albedos 4"]
    page = (tmp_path / "index.md").read_text()
    assert f"{100 * raw['mae_m']:.2f}" in page and "phasornet_40_70" in page
    for name in ("errors.png", "albedo.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert "phasornet_20" in (tmp_path / "model_card.md").read_text()
    assert "held out" in capsys.readouterr().out


def test_parts_that_were_not_measured_are_not_told(bench, tmp_path):
    bench("learned_draw").write({}, tmp_path)
    assert "Held-out" not in (tmp_path / "index.md").read_text()


def test_weights_of_families_are_found_again(bench):
    """A mixture of known parts: the families' weights come back."""
    rng = np.random.default_rng(0)
    near = [1 + 0.1 * rng.random((40, 50)) for _ in range(4)]
    far = [4 + 2.0 * rng.random((40, 50)) for _ in range(4)]
    real = [*near[:3], far[0]]
    weights, told, _, _ = bench("likeness").weighed({"far": far, "near": near}, real)
    assert weights["near"] == pytest.approx(0.75, abs=0.05)
    assert told["weighed"]["range"]["js"] < told["as the recipe draws"]["range"]["js"]
