"""The benchmark of radiosity counts right: times to an error, intervals, files; no peer needed."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def bench(monkeypatch):
    """The scripts and their files, importable as when they are run."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    names = ("radiosity", "radiosity_seeds", "radiosity_throughput", "peers.measure",
             "peers.reach", "peers.references", "peers.seeded", "peers.views",
             "peers.radiosity_page")  # fmt: skip
    return {name.split(".")[-1]: importlib.import_module(name) for name in names}


def points(measure, pairs, floor_mm=0.0):
    """(seconds, error in mm) as points."""
    return [
        measure.Point(n, [s, 2 * s], [1e-6 * e * e] * 2, [0.0], 0.0, 0.0, 1e-6 * floor_mm**2)
        for n, (s, e) in enumerate(pairs, start=1)
    ]


def test_time_to_an_error_is_interpolated_or_extrapolated(bench):
    measure, reach = bench["measure"], bench["reach"]
    found = reach.reach(points(measure, [(1, 8), (4, 4), (16, 2)]), 1e-3)
    assert (found.how, found.seconds) == (reach.BEYOND, pytest.approx(64))
    found = reach.reach(points(measure, [(1, 4), (16, 0.25)]), 1e-3)
    assert (found.how, found.seconds) == (reach.MEASURED, pytest.approx(4))
    found = reach.reach(points(measure, [(3, 0.5), (16, 0.25)]), 1e-3)
    assert (found.how, found.seconds) == (reach.BEFORE, pytest.approx(3))
    lost = points(measure, [(1, 8), (4, 1.0)], floor_mm=0.6)
    assert reach.reach(lost, 1e-3).seconds == pytest.approx(64)  # only the first is known
    assert reach.reach(lost[1:], 1e-3) is None


def test_wilson_interval_holds_what_it_says(bench):
    wilson = bench["seeded"].wilson
    low, high = wilson(195, 200)
    assert (low, high) == pytest.approx((0.9428, 0.9893), abs=1e-4)
    assert (wilson(0, 20)[0], wilson(20, 20)[1]) == pytest.approx((0, 1))
    rng, share, count = np.random.default_rng(0), 0.95, 200
    ends = np.array([wilson(hits, count) for hits in rng.binomial(count, share, 2000)])
    inside = (ends[:, 0] <= share) & (share <= ends[:, 1])
    assert 0.93 < np.mean(inside) < 0.975


def test_exponent_of_a_power_law(bench):
    pixels = np.array([4800, 19200, 76800])
    assert bench["seeded"].exponent(pixels, 1e-3 * pixels**0.4) == pytest.approx(0.4)


def test_seeded_scenes_are_many_and_always_the_same(bench):
    seeded = bench["seeded"]
    found = seeded.samples(200)
    assert found == seeded.samples(200) and found[:20] == seeded.samples(20)
    assert len({(s.scene, s.sensor) for s in found}) == 200
    for family, (many, _, _) in seeded.FAMILIES.items():
        assert sum(s.family == family for s in found) == many


def test_images_are_made_once_and_go_on_where_they_were(bench, tmp_path):
    images, made = bench["references"].images, []

    def image(number):
        made.append(number)
        if number == 2:
            raise KeyboardInterrupt
        return np.full((2, 3), number + 1j)

    with pytest.raises(KeyboardInterrupt):
        images(tmp_path / "a.npz", 4, image)
    found, _ = images(tmp_path / "a.npz", 2, image)
    assert made == [0, 1, 2] and found.shape == (2, 2, 3) and found[1, 0, 0] == 1 + 1j


def row(number, rms_mm):
    return {"number": number, "family": "cavity", "against": "closed form", "rms_mm": rms_mm,
            "bias_mm": 0.0, "seconds": 1.0, "se_mm": 0.0, "told_mm": 0.5,
            "scene": f"cavity:radius={number}", "sensor": "deeptof"}  # fmt: skip


def test_share_within_the_tolerance(bench):
    rows = [row(n, error) for n, error in enumerate([0.2, 0.9, 1.1, 3.0])]
    found = bench["seeded"].summary(rows, 1.0)
    assert (found["share"], found["families"][0]["within"]) == (0.5, 2)
    assert [w["rms_mm"] for w in found["worst"]] == [3.0, 1.1]


def test_seeded_scenes_run_and_resume(bench, tmp_path, monkeypatch):
    seeds, seeded = bench["radiosity_seeds"], bench["seeded"]
    monkeypatch.setattr(seeds, "ENGINE", "analytic")  # exact: it is its own reference
    chosen = [s for s in seeded.samples(40) if s.family in ("wall", "cavity")][:4]
    file, told = tmp_path / "rows.jsonl", []
    rows = seeds.all_judged(chosen[:2], file, tmp_path, 60.0, told.append)
    assert max(r["rms_mm"] for r in rows) < 1e-3
    rows = seeds.all_judged(chosen, file, tmp_path, 60.0, told.append)
    assert len(told) == len(rows) == len(file.read_text().splitlines()) == 4
    assert seeds.all_judged(chosen, tmp_path / "none.jsonl", tmp_path, -1.0, told.append) == []


def result(bench, name):
    measure, reach, views = bench["measure"], bench["reach"], bench["views"]
    found = {
        "radiosity": points(measure, [(0.5, 4), (1, 1)]),
        "path": points(measure, [(1, 8), (4, 4)]),
        "mitransient, multijitter": points(measure, [(1, 20), (4, 10)]),
    }
    return {
        "view": views.View(name, f"{name}.xml:a=1", "hfov_deg=70", (32, 24), 8, 64, 4),
        "points": found,
        "reach": {n: reach.reach(p, 1e-3) for n, p in found.items()},
        "pixels": 700,
        "reference": {"samples": 256, "seconds": 1.0, "standard_error_mm": 0.5},
    }


def test_page_shows_what_is_there(bench, tmp_path):
    script, page, seeded = bench["radiosity"], bench["radiosity_page"], bench["seeded"]
    about = {"versions": {"toftools": "0"}, "machine": {"cpu": "any", "threads": 1},
             "missing": [], "seconds": 0.0}  # fmt: skip
    results = [result(bench, name) for name in ("/some/where/Cornell box", "Room 1", "Room 2")]
    assert script.speedups(results[0])["mitransient, multijitter"] == pytest.approx(400)
    script.publish(tmp_path, about, results)
    written = (tmp_path / "radiosity.md").read_text()
    assert "400" in written and "Room 2" in written and "holds" not in written
    assert "/some" not in json.loads((tmp_path / "radiosity_time.json").read_text())["views"][0][
        "view"]["scene"]  # fmt: skip
    rows = [row(n, error) for n, error in enumerate([0.2, 0.9])]
    cost = [{"scene": "cornell", "size": (8, 6), "seconds": 1.0, "lights": 9},
            {"scene": "cornell", "size": (80, 60), "seconds": 10.0, "lights": 9}]  # fmt: skip
    data = seeded.summary(rows, 1.0) | {"cost": cost,
            "exponents": bench["radiosity_seeds"].exponents(cost)}  # fmt: skip
    assert data["exponents"]["cornell"] == pytest.approx(0.5)
    page.save(tmp_path, "seeds", {"about": about | {"earlier": 1}, **data})
    seeded.draw(rows, cost, 1.0, tmp_path / "radiosity_seeds")
    page.write(tmp_path)
    written = (tmp_path / "radiosity.md").read_text()
    assert "100.0 %" in written and "1 of the scenes were judged before" in written
    assert "pixels^0.50" in written
    for name in ("radiosity_time.png", "radiosity_seeds.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_throughput_of_path_is_extrapolated_to_its_limit(bench, monkeypatch):
    script = bench["radiosity_throughput"]
    monkeypatch.setattr(script, "capture", lambda *_, **__: (1.0, {}))
    coarse = script.row("path", 5.0, [10.0], 5.0, within=True)
    found = script.path_at_fine(coarse, 1.0, None, lambda _: None)
    assert (found["seconds"], found["within"]) == (64.0, False)  # 4096 samples, not 250 s
    coarse = script.row("path", 5.0, [1.0], 5.0, within=True)
    found = script.path_at_fine(coarse, 1.0, None, lambda _: None)
    assert (found["seconds"], found["within"]) == (25.0, True)
