"""The report of a calibration: figures that can be read, one page that stands alone."""

import io
import re
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest
from PIL import Image

from toftools.calib.chain import Chain, chain_for
from toftools.calib.fit import Outcome
from toftools.calib.plan import Step
from toftools.calib.stage import Residual
from toftools.calib.verdict import verdict
from toftools.conditions import Conditions, with_conditions
from toftools.registry import CALIBRATIONS
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Camera, Scene, Shot
from toftools.viz._calibration_data import samples
from toftools.viz.calibration import Course, Cyclic, course_png, cyclic_png, distance_png, lens_png
from toftools.viz.calibration_report import calibration_page

DEVICE = sensor("opt8241:width=24,height=18")
TURN = np.linspace(0, 2 * np.pi, 200, endpoint=False)


def wall(kind, distance_m, seed, name, device=DEVICE, **told):
    taken = analytic(Scene("wall", {"range": distance_m}))(Shot(device, seed=seed))
    return with_conditions(taken, Conditions(kind, distance_m=distance_m, **told), file=name)


def walls(kind, **told):
    return [wall(kind, 1.0 + 0.3 * n, n, f"{kind}{n}.h5", **told) for n in range(4)]


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def painted(png, rgb):
    """Share of the pixels that have a colour."""
    return float((np.abs(pixels(png) - rgb).max(axis=2) < 40).mean())


ORANGE, GREEN = (0xC2, 0x41, 0x0C), (0x0B, 0x6B, 0x50)


def test_figures_show_before_and_after():
    wave = 20 * np.cos(4 * TURN)
    both = [Cyclic(f"{f} MHz", TURN, wave, 0 * wave, wave) for f in (40, 70)]
    course = [Course("40 MHz", np.arange(6.0), np.arange(6.0), np.zeros(6))]
    made = {
        "cyclic": cyclic_png(both),
        "course": course_png(course, "temperature, degrees Celsius"),
        "distance": distance_png(np.arange(1.0, 5), np.full(4, 30.0), np.full(4, 3.1),
                                 np.full(4, 3.0), good=1.1),
    }  # fmt: skip
    for name, png in made.items():
        assert painted(png, ORANGE) > 5e-4, name
        assert painted(png, GREEN) > 5e-4, name
    one = cyclic_png(both[:1])
    assert pixels(made["cyclic"]).shape[1] > pixels(one).shape[1]


def test_figures_take_what_is_missing():
    nothing = np.full(200, np.nan)
    png = cyclic_png([Cyclic("40 MHz", TURN, nothing, nothing, 0 * TURN)])
    assert pixels(png).shape[0] > 200
    assert pixels(lens_png(np.zeros((0, 2)), np.array([0.1]), (64, 48))).shape[0] > 200


def test_samples_keep_the_error_in_millimetres():
    chain = chain_for(DEVICE)
    found = samples(chain, walls("rail"))
    assert found.error_mm.shape == found.phase_rad.shape
    assert np.abs(np.nanmedian(found.error_mm, axis=1)).max() < 1e-9
    assert found.mm_per_rad == pytest.approx([596.4, 340.8], rel=1e-3)
    assert found.means_mm.shape == (2, 4)


def page_of(captures, **changes):
    chain = chain_for(DEVICE)
    stages = []
    for name in ("wiggling", "common_phase", "fixed_pattern"):
        stages.append(CALIBRATIONS[name].build(captures))
    chain = replace(chain, stages=tuple(stages), notes={"files": ["a.h5"], **changes})
    outcomes = [Outcome(Step(s.slot, s.slot, tuple(captures)), s) for s in stages]
    outcomes.append(Outcome(Step("lens", "lens"), None, "no captures for it; take <b>boards</b>"))
    held = walls("check")
    return calibration_page(chain, outcomes, verdict(chain, held), held)


def test_the_page_tells_and_shows_everything_and_needs_no_other_file():
    page = page_of(walls("wall"))
    for text in ("held-out captures", "Wiggling", "Fixed pattern", "check3.h5", "robust spread",
                 "noise floor", "toftools", 'name="viewport"', "lens, not fitted"):  # fmt: skip
        assert text in page, text
    assert not re.findall(r'(?:src|href)="(?!data:image/webp;base64,|#)', page)
    assert "<script" not in page
    assert not re.search(r">\s*(nan|None|inf)\b", page)
    ablation = page.split("What each stage is worth")[1].split("</table>")[0]
    assert re.findall(r"<tr><td>(\w+)", ablation) == ["nothing", "wiggling", "common_phase",
                                                      "fixed_pattern"]  # fmt: skip
    headings = re.findall(r"<h2[^>]*>([^<]+)", page)
    assert headings[:2] == ["Stages", "Held-out captures"]


def test_names_of_files_are_text_not_markup():
    page = page_of(walls("wall"), files=["<script>alert(1)</script>.h5"])
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "take &lt;b&gt;boards" in page


@dataclass(frozen=True, eq=False)
class Lens:
    """As `toftools.calib.lens.Lens` says it, as far as the report asks."""

    slot: ClassVar[str] = "lens"
    camera: Camera
    residual: Residual = field(default_factory=Residual)
    corners_px: np.ndarray = field(default_factory=lambda: np.array([[3.0, 4.0], [9.0, 8.0]]))
    view_rms_px: np.ndarray = field(default_factory=lambda: np.array([0.2, 0.1]))
    sigma: np.ndarray = field(default_factory=lambda: np.array([0.1, 0.1, 0.2, 0.2]))
    names: tuple = ("fx", "fy", "cx", "cy")
    views: tuple = ("first.h5", "second.h5")
    rejected: tuple = ("bent.h5",)

    def __call__(self, phasors):
        return phasors


def test_the_lens_says_views_and_uncertainties():
    stage = Lens(DEVICE.camera)
    chain = Chain("camera", 24, 18, DEVICE.modulation.freqs_hz, (stage,))
    outcomes = [Outcome(Step("lens", "lens", tuple(walls("board"))), stage)]
    page = calibration_page(chain, outcomes, None)
    assert "fx 17.25 ± 0.1" in page
    assert "The worst view is 1, first.h5." in page
    assert "Left out: bent.h5." in page
    assert "NOT JUDGED" in page
