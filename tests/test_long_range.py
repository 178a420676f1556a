"""The long-range benchmark runs, and its scene is what it says."""

import importlib.util
from pathlib import Path

import numpy as np

from toftools.camera import points
from toftools.sensors import sensor as preset
from toftools.units import joint_ambiguity_m


def long_range():
    path = Path(__file__).parents[1] / "benchmarks" / "long_range.py"
    spec = importlib.util.spec_from_file_location("long_range", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_long_range_benchmark_runs(tmp_path, capsys):
    arguments = ["--width", "64", "--height", "48", "--frames", "1", "--signal-e", "20000"]
    long_range().main(["--out", str(tmp_path), *arguments])
    text = (tmp_path / "long_range.md").read_text(encoding="utf-8")
    assert text.strip() == capsys.readouterr().out.strip()
    assert (tmp_path / "long_range.png").stat().st_size > 10_000
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    cells = {(r[0].strip(), r[1].strip()): [float(c) for c in r[2:]] for r in rows[2:]}
    assert cells["crt", "valid"][0] == 100
    # Whatever the noise draws: voting drops most far pixels, and the neighbours bring many back.
    assert cells["residual_voting", "valid"][3] < 50
    assert cells["kde", "right, 1 % wrong"][3] > cells["crt", "right, 1 % wrong"][3]


def test_long_range_hall_is_a_hall():
    bench = long_range()
    camera = preset("kinect2_nominal:width=64,height=48").camera
    range_m, cosine, albedo = bench.hall(camera, n_pillars=0)
    at = np.abs(points(camera, range_m))
    gap = np.abs(at / bench.SHELL_M - 1)
    assert gap.min(axis=-1).max() < 1e-6  # every point lies on one of the planes, none outside
    assert (at <= bench.SHELL_M * (1 + 1e-6)).all()
    assert np.allclose(cosine, bench.SHELL_M[gap.argmin(axis=-1)] / range_m, rtol=1e-6)
    with_pillars = bench.hall(camera)
    assert (with_pillars[0] <= range_m + 1e-9).all()
    assert 0.02 < (with_pillars[0] < range_m - 0.1).mean() < 0.5
    assert with_pillars[0].max() < joint_ambiguity_m([80e6, 16e6, 120e6])
    assert ((albedo > 0) & (albedo < 1)).all()
    right = np.array([True, True, False, True])
    assert bench.right_at(right, ~right, np.array([4.0, 3.0, 2.0, 1.0]), 0.1) == 0.5
    assert bench.right_at(right, ~right, np.array([4.0, 3.0, 2.0, 1.0]), 0.3) == 0.75
