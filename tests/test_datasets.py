"""The committed set of captures is what its recipe makes, and what its manifest says."""

import hashlib
import importlib.util
import tomllib
from pathlib import Path

import numpy as np
import pytest

from toftools.io.native import read_capture
from toftools.phasor import phasors_of
from toftools.sim._stop import range_errors_m

ROOT = Path(__file__).parent.parent
RECIPE = ROOT / "datasets" / "first.toml"
MANIFEST = tomllib.loads((ROOT / "datasets" / "MANIFEST.toml").read_text(encoding="utf-8"))
FOLDER = ROOT / MANIFEST["folder"]
FILES = [item["file"] for item in MANIFEST["capture"]]


def maker():
    spec = importlib.util.spec_from_file_location("make_set", ROOT / "datasets" / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def total(capture):
    truth = capture.truth
    return (truth.direct + truth.one_bounce + truth.rest).reshape(2, -1).astype(complex)


def test_manifest_files_and_recipe_agree():
    recipe = maker().read_recipe(RECIPE)
    wanted = {maker().file_name(item): item for item in recipe["scenes"]}
    assert len(wanted) == len(recipe["scenes"]), "two scenes have the same file name"
    assert set(FILES) == set(wanted) == {path.name for path in FOLDER.glob("*")}
    for item in MANIFEST["capture"]:
        whole = (FOLDER / item["file"]).read_bytes()
        assert hashlib.sha256(whole).hexdigest() == item["sha256"], item["file"]
        for key in ("scene", "sensor", "seed", "tol_mm"):
            assert item[key] == wanted[item["file"]][key], (item["file"], key)
        assert item["standard_error_mm"] <= item["tol_mm"]
    assert sum(item["bytes"] for item in MANIFEST["capture"]) < 2_000_000


@pytest.mark.parametrize("name", FILES)
def test_taps_are_the_light_of_the_truth_and_noise(name):
    capture = read_capture(FOLDER / name)
    phasors = phasors_of(capture)
    known = np.broadcast_to(phasors.valid & np.isfinite(capture.truth.range_m), (2, 48, 64))
    off = (phasors.values - total(capture).reshape(2, 48, 64))[known] / phasors.sigma[known]
    # 6,000 values at most of either part: unit variance within 5 standard errors, and no bias.
    for part in (off.real, off.imag):
        assert abs(part.mean()) < 5 / np.sqrt(part.size)
        assert abs(part.std() - 1) < 5 / np.sqrt(2 * part.size)
    bounced = np.abs(capture.truth.one_bounce).sum()
    assert bounced > 0.01 * np.abs(total(capture)).sum(), "a set of multipath without multipath"


@pytest.mark.parametrize("number", [0, 6])  # a corner and a Cornell box: seconds
def test_the_recipe_makes_the_committed_captures_again(number):
    make = maker()
    item = make.read_recipe(RECIPE)["scenes"][number]
    old = read_capture(FOLDER / make.file_name(item))
    new = make.make(item, seed=item["seed"] + 100)  # other paths, other noise
    assert np.allclose(new.truth.range_m, old.truth.range_m, atol=1e-4, equal_nan=True)
    assert np.allclose(new.truth.direct, old.truth.direct, rtol=1e-3, atol=1e-3)
    moved = range_errors_m(total(new) - total(old), total(old), old.sensor.modulation.freqs_hz)
    # Both have a standard error of at most tol_mm in every tile: their difference sqrt(2) of it.
    # Faint pixels do not count for a tile, so 99 % of the pixels are looked at.
    near = np.sort(np.abs(moved))[: int(0.99 * moved.size)]
    assert 1e3 * np.sqrt((near**2).mean()) < np.sqrt(2) * item["tol_mm"]
    assert not np.array_equal(new.taps.values, old.taps.values)
