"""What the report says of virtual lights, by the provenance alone."""

import pytest

from toftools import Scene, Shot
from toftools.cli._report import told
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.sim.radiosity import SOLVED
from toftools.types import Capture

FACTS = {
    "engine": "radiosity", "engine_why": "cornell has no closed form",
    "max_bounces": SOLVED.bounces, "max_bounces_why": SOLVED.why,
    "samples": 0, "samples_mean": 0.0, "standard_error_mm": 7.5,
    "virtual_lights": 4100, "viewpoints": 4, "gathered": 2118, "scatter_mm": 3.0,
    "interpolation_mm": 4.0, "left_to_path": 0.0, "tolerance_mm": 6.0, "tolerance_met": True,
}  # fmt: skip


@pytest.fixture(scope="module")
def capture():
    return analytic(Scene("wall"))(Shot(sensor("deeptof:width=4,height=3"), seed=1))


def report(capture, **facts):
    made = Capture(capture.sensor, taps=capture.taps, truth=capture.truth, provenance=FACTS | facts)
    return {line[:16].strip(): line[16:] for line in told(made, wall_s=1.0, peak_mb=9.0)}


def test_virtual_lights_are_told_with_both_errors(capture):
    lines = report(capture)
    assert lines["bounces"] == SOLVED.why
    assert lines["lights"] == "4100 virtual ones as seen from 4 viewpoints, gathered at 2118 points"
    assert lines["error"] == "3 mm rms of range by scatter, 4 mm by interpolation"
    assert lines["tolerance"] == "6 mm met over the image"
    assert not {"paths", "left to path"} & set(lines)
    assert "1 viewpoint," in report(capture, viewpoints=1)["lights"]


def test_a_number_of_bounces_stays_a_number(capture):
    lines = report(capture, max_bounces=2, max_bounces_why="2 bounces were asked for")
    assert lines["bounces"] == "2: 2 bounces were asked for"


def test_a_number_of_virtual_lights_is_held_against_no_tolerance(capture):
    assert "tolerance" not in report(capture, tolerance_mm=None, tolerance_met=None)


def test_lights_that_missed_say_what_the_image_has_and_what_helps(capture):
    text = report(capture, tolerance_mm=2.0, tolerance_met=False)["tolerance"]
    assert text.startswith("2 mm NOT MET, the image has 5 mm rms; take paths (--engine path)")
    assert text.endswith("(--tol-mm 5)")


def test_pixels_left_to_path_are_told_with_their_paths(capture):
    left = {"left_to_path": 0.047, "left_why": "their surfaces are not diffuse", "samples": 64}
    lines = report(capture, **left)
    assert lines["left to path"] == "4.7% of the pixels: their surfaces are not diffuse"
    assert lines["paths"] == "up to 64 a pixel of those left to them"
    assert lines["tolerance"] == "6 mm met over the image and in every tile of paths"
    missed = report(capture, **left, tolerance_met=False)["tolerance"]
    assert missed.startswith("6 mm NOT MET, not in every tile of paths; allow more")
    assert "--engine radiosity:max_samples=256" in missed


def test_a_scene_left_to_path_is_told_as_path_tells_it(capture):
    bare = {k: v for k, v in FACTS.items() if k not in ("virtual_lights", "viewpoints", "gathered")}
    left = {"left_to_path": 1.0, "left_why": "surfaces have holes or veils", "samples": 64}
    made = Capture(capture.sensor, taps=capture.taps, truth=capture.truth, provenance=bare | left)
    text = "\n".join(told(made, wall_s=1.0, peak_mb=9.0))
    assert "100.0% of the pixels: surfaces have holes or veils" in text
    assert "6 mm met in every tile" in text
