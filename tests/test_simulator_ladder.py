"""The ladder of the simulator counts right: bounces and samples that suffice, files of a run."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from toftools.sensors import sensor


@pytest.fixture(scope="module")
def ladder():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
        yield importlib.import_module("simulator_ladder")


def test_enough_is_where_the_error_stays_below(ladder):
    assert ladder.enough([0, 1, 2, 3], [9e-3, 4e-4, 2e-3, 1e-4]) == 3  # the dip at 1 does not count
    assert ladder.enough([0, 1, 2], [9e-4, 4e-4, 2e-4]) == 0
    assert ladder.enough([0, 1], [9e-3, 2e-3]) is None


def test_a_goal_is_reached_between_counts_or_beyond_them(ladder):
    counts = (4, 16, 64)
    found, how = ladder.reached(counts, [4e-3, 2e-3, 0.5e-3], counts)
    assert (found, how) == (pytest.approx(32), "measured")
    assert ladder.reached(counts, [8e-3, 4e-3, 2e-3], counts) == (pytest.approx(256), "beyond")
    assert ladder.reached(counts, [9e-4, 4e-4, 2e-4], counts) == (4, "below")
    assert ladder.reached(counts, [8e-3, 4e-3, 2e-3], [1, 2, 3])[0] == pytest.approx(12)  # seconds


def test_moved_range_is_the_phase_over_all_frequencies(ladder):
    freqs_hz = np.array([20e6, 80e6])
    truth = np.ones((2, 1, 2), complex)
    truth[:, 0, 1] = 0
    shift_m = 2e-3
    turned = truth * np.exp(1j * 4 * np.pi * freqs_hz * shift_m / 299_792_458.0)[:, None, None]
    moved = ladder.moved_m(turned, truth, freqs_hz)
    assert moved[0, 0] == pytest.approx(shift_m) and np.isnan(moved[0, 1])


@pytest.fixture(scope="module")
def run(ladder):
    camera = sensor("opt8241:width=8,height=6,beam_deg=100")
    return ladder.measured(
        "vshape:range=1.5,angle=60,albedo=0.8", camera, bounces=(0, 1, 12), paths=16,
        counts={"path": (8, 32), "radiosity": (16,)},
        truths={"path": (256, 2), "radiosity": (32, 2)},
    )  # fmt: skip


def test_later_bounces_move_less_and_more_samples_are_better(run):
    assert run["left_m"][0] > 0.05 > run["left_m"][1] > 0.02 and run["left_m"][2] < 1e-4
    assert run["needed_bounces"] == 12
    path = run["engines"]["path"]
    assert path["rms_m"][1] < path["rms_m"][0] and path["needed"] > 0
    # Two engines that share nothing but the scene agree.
    assert run["truths_differ_m"] < 3e-3
    assert run["truth_error_m"] < 1e-3


def test_a_run_leaves_its_files(ladder, run, tmp_path):
    about = {"width": 8, "height": 6, "cpu": "one", "threads": 2, "counts": "few"}
    ladder.publish(tmp_path, {"V": run}, about)
    page = (tmp_path / "simulator_ladder.md").read_text(encoding="utf-8")
    assert "| V | 12 | " in page and "{" not in page
    told = json.loads((tmp_path / "simulator_ladder.json").read_text(encoding="utf-8"))
    assert told["scenes"]["V"]["bounces"] == [0, 1, 12]
    assert "V, 12 bounces" in (tmp_path / "simulator_ladder.svg").read_text(encoding="utf-8")


def test_unknown_scenes_are_refused(ladder, capsys):
    with pytest.raises(SystemExit):
        ladder.main(["--only", "moon"])
    assert "unknown scenes ['moon']" in capsys.readouterr().err


def test_the_page_of_the_docs_is_that_of_its_figures(ladder):
    docs = Path(__file__).parents[1] / "docs"
    told = json.loads((docs / "simulator_ladder.json").read_text(encoding="utf-8"))
    page = (docs / "simulator_ladder.md").read_text(encoding="utf-8")
    assert page == ladder.page(told["scenes"], told["about"])
    assert set(told["scenes"]) == set(ladder.SCENES)
