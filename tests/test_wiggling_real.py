"""Wiggling of two real cameras: the figures of docs/calibration/real.md hold."""

import importlib
import os
from pathlib import Path

import numpy as np
import pytest

from toftools.calib.wiggling import wiggling
from toftools.calib.wiggling_spline import wiggling_spline
from toftools.conditions import Conditions, with_conditions
from toftools.io.readers.melexis_npy import read
from toftools.units import phase_to_range

FOLDER = Path(os.environ.get("TOFTOOLS_DATA", "missing"))


def folder(name):
    path = FOLDER / name
    if not path.is_dir():
        pytest.skip("TOFTOOLS_DATA holds no such capture")
    return path


@pytest.fixture
def sweeps(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    return importlib.import_module("calibration_sweeps")


@pytest.mark.parametrize(
    ("make", "sizes"), [(wiggling, {}), (wiggling_spline, {"knots": 24})], ids=["fourier", "spline"]
)
def test_vendor_wiggling_of_a_melexis_comes_back(make, sizes):
    taken = read(folder("snapshot_lidar_mlx75027_60MHz"))
    stage = make([with_conditions(taken, Conditions("wall", reference="depth"))], **sizes)
    residual = stage.residual
    assert residual.before == pytest.approx(10.97, abs=0.02)
    assert residual.n == 245_042
    assert residual.after < 3.65  # orders 1, 2, 4 by least squares; any function of phase: 3.52
    assert residual.held_out < 3.77  # the same orders on the same blocks: 3.79
    phase = np.angle(taken.phasors.values[:, taken.phasors.valid]).astype(float)
    error = np.asarray(1e3 * phase_to_range(stage.error_rad(phase), 60e6))
    assert 25 < np.ptp(error) < 45  # +-15 mm where there are data
    everywhere = stage.error_rad(np.linspace(-np.pi, np.pi, 500)[None])
    assert np.abs(1e3 * phase_to_range(everywhere, 60e6)).max() < 30  # and no more elsewhere
    assert any("trust the curve" in note for note in residual.notes)
    assert any("cannot be told apart" in note for note in residual.notes)


def test_one_cyclic_error_serves_twenty_materials(sweeps):
    data = sweeps.read(folder("tanaka_kinect2_distortion"), "d80 - d120")
    before = sweeps.spread(sweeps.straight(data))
    assert before.size == 20
    assert (before.min(), before.max()) == pytest.approx((3.28, 4.39), abs=0.02)
    blocks = sweeps.held_out(data, (3, 6, 9), shifts=True)
    each = sweeps.spread(blocks)
    assert np.median(each) < 1.0
    assert np.sqrt(np.nanmean(blocks**2)) < 1.0
    assert each.max() < 1.35
    plain = sweeps.spread(sweeps.held_out(data, (3, 6, 9, 12, 15), shifts=False, block=1))
    assert np.median(plain) < 1.0
    assert plain.max() < 2.4  # acryl


def test_shift_of_a_material_is_told_apart_from_wiggling(sweeps):
    data = sweeps.read(folder("tanaka_kinect2_distortion"), "d16 - d120")
    model = sweeps.fit(data, (3, 6, 9), shifts=False, train=np.ones(200, bool))
    shift = dict(zip(data.names, sweeps.offsets(data, model), strict=True))
    assert shift["acryl"] == pytest.approx(36, abs=2)
    assert shift["silicone"] == pytest.approx(20, abs=2)
    assert abs(shift["wood"]) < 1
