"""One self-contained HTML page about a calibration: verdict, residuals, figures."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from toftools.calib.chain import Chain
from toftools.calib.fit import Outcome
from toftools.calib.verdict import GOOD, Verdict
from toftools.calib.verdict import verdict as judge
from toftools.types import Capture
from toftools.viz._calibration_data import Sample, error_maps_mm, samples
from toftools.viz._numbers import figure
from toftools.viz.calibration import Course, Cyclic, course_png, cyclic_png, distance_png, lens_png
from toftools.viz.figures import maps_png

_TEMPLATE = Path(__file__).with_name("calibration.html.j2")
ABLATED = 4
"""Held-out captures on which every stage is left out in turn."""
NOT_JUDGED = (
    "NOT JUDGED: one stage was fitted; toftools calibrate all holds captures out and judges"
)


@dataclass(frozen=True)
class Picture:
    """A figure in the page: data URL, text for those who cannot see it, caption."""

    src: str
    alt: str
    caption: str


@dataclass(frozen=True)
class Section:
    """A heading with a paragraph and figures."""

    title: str
    text: str
    figures: tuple[Picture, ...]


def calibration_page(
    chain: Chain,
    outcomes: Sequence[Outcome],
    verdict: Verdict | None,
    held_out: Sequence[Capture] = (),
) -> str:
    """Report of a calibration.

    Parameters
    ----------
    chain : Chain
        The calibration.
    outcomes : sequence of Outcome
        What was fitted from what, and what was left out and why.
    verdict : Verdict or None
        Judgement on the held-out captures; None where nobody judged.
    held_out : sequence of Capture
        Those captures, raw.

    Returns
    -------
    str
        HTML without any reference to other files.
    """
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        _TEMPLATE.read_text(encoding="utf-8")
    )
    return template.render(
        sensor=chain.sensor,
        good=verdict is not None and verdict.good,
        sentence=NOT_JUDGED if verdict is None else verdict.sentence,
        advice=() if verdict is None else verdict.advice,
        facts=_facts(chain, outcomes, held_out),
        stages=[_row(stage.slot, stage.residual) for stage in chain.stages],
        left_out=[(o.step.slot, o.reason) for o in outcomes
                  if o.stage is None and chain.stage(o.step.slot) is None],
        held=_held(chain, verdict, held_out) if verdict and held_out else None,
        sections=_sections(chain, outcomes),
        version=str(chain.notes.get("toftools", "")),
        files=list(chain.notes.get("files", [])),
    )  # fmt: skip


def _facts(
    chain: Chain, outcomes: Sequence[Outcome], held_out: Sequence[Capture]
) -> list[tuple[str, str]]:
    used = {id(c) for o in outcomes if o.stage is not None for c in o.step.captures}
    freqs = " + ".join(f"{freq / 1e6:g}" for freq in chain.freqs_hz)
    return [
        (f"{chain.width} x {chain.height} px", "image"),
        (f"{freqs} MHz", "frequencies"),
        (str(len(chain.stages)), "stages"),
        (str(len(used)), "captures fitted"),
        (str(len(held_out)), "captures held out"),
    ]


def _row(slot: str, residual: Any) -> dict[str, Any]:  # noqa: ANN401 - a Residual
    figures = {k: figure(getattr(residual, k)) for k in ("before", "after", "held_out", "noise")}
    return {"slot": slot, "unit": residual.unit, "n": residual.n or "", "notes": residual.notes,
            **figures}  # fmt: skip


def _held(chain: Chain, verdict: Verdict, held_out: Sequence[Capture]) -> dict[str, Any]:
    scores = [
        [after.name, *map(figure, (before.rms_mm, after.rms_mm, after.bias_mm, after.spread_mm,
                                   after.p95_mm, after.noise_mm, after.ratio)), after.n]
        for before, after in zip(verdict.before, verdict.after, strict=True)
    ]  # fmt: skip
    spots = [
        [s.name, *map(figure, (s.distance_m, s.before_mm, s.rms_mm, s.bias_mm, s.noise_mm))]
        for s in verdict.spots
    ]
    causes = ", ".join(f"{name} {figure(mm)}" for name, mm in verdict.causes_mm.items())
    pictures = [*_distance(verdict), *_maps(chain, held_out)]
    return {
        "scores": scores,
        "spots": spots,
        "causes": "" if verdict.good else causes,
        "figures": pictures,
        "ablation": _ablation(chain, held_out),
    }


def _ablation(chain: Chain, held_out: Sequence[Capture]) -> list[tuple[str, str, str]]:
    """Error of some held-out captures with each stage left out in turn, the others as they are."""
    some = held_out[:: max(1, len(held_out) // ABLATED)][:ABLATED]
    whole = judge(chain, some).after[-1]
    rows = [("nothing", figure(whole.rms_mm), figure(whole.ratio))]
    for stage in chain.stages:
        if stage.slot != "extrinsics":
            left = judge(chain.without(stage.slot), some).after[-1]
            rows.append((stage.slot, figure(left.rms_mm), figure(left.ratio)))
    return rows


def _distance(verdict: Verdict) -> list[Picture]:
    table = np.array([[s.distance_m, s.before_mm, s.rms_mm, s.noise_mm] for s in verdict.spots])
    table = table[np.isfinite(table).all(axis=1)]
    if not len(table):
        return []
    png = distance_png(*table.T, good=GOOD)
    caption = "Each point is a capture. The band is the noise floor and what counts as good."
    return [_picture(png, "range error over distance of held-out captures", caption)]


def _maps(chain: Chain, captures: Sequence[Capture]) -> list[Picture]:
    """Errors over the image of one capture, before and after, each with a scale of its own."""
    chosen = sorted(captures, key=lambda c: c.provenance["conditions"].get("distance_m", 0))
    capture = chosen[len(chosen) // 2]
    names = [f"{freq / 1e6:g} MHz" for freq in chain.freqs_hz]
    found = []
    for what, used in (("before", Chain(chain.sensor, chain.width, chain.height, chain.freqs_hz)),
                       ("after", chain)):  # fmt: skip
        maps = error_maps_mm(used, capture) / 1e3
        panels = [(f"{name}, {what}", layer, "error") for name, layer in
                  zip(names, maps, strict=True)]  # fmt: skip
        png = maps_png(
            panels, columns=min(3, len(panels)), width_px=340 * min(3, len(panels)) + 120
        )
        caption = (
            f"Measured minus true range of {capture.provenance.get('file', 'a held-out capture')}, "
            f"{what} the calibration. Red reads too far."
        )
        found.append(_picture(png, f"range error over the image, {what}", caption))
    return found


def _sections(chain: Chain, outcomes: Sequence[Outcome]) -> list[Section]:
    drawn = {"lens": _lens, "wiggling": _wiggling, "fixed_pattern": _pattern,
             "amplitude": _amplitude, "temperature": _temperature}  # fmt: skip
    sections = []
    for outcome in outcomes:
        stage = chain.stage(outcome.step.slot)
        slot, captures = outcome.step.slot, outcome.step.captures
        if stage is not None and slot in drawn and (captures or slot == "lens"):
            section = drawn[slot](chain, captures)
            sections += [section] if section.figures else []
    return sections


def _without_and_with(
    chain: Chain, slot: str, captures: Sequence[Capture]
) -> tuple[Sample, Sample]:
    return samples(chain.without(slot), captures), samples(chain, captures)


def _lens(chain: Chain, captures: Sequence[Capture]) -> Section:
    stage: Any = chain.stage("lens")
    camera = stage.camera
    png = lens_png(stage.corners_px, stage.view_rms_px, (camera.width, camera.height))
    worst = int(np.argmax(stage.view_rms_px))
    names = zip(stage.names, [*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.dist], strict=False)
    numbers = [f"{name} {value:.5g} ± {sd:.2g}" for (name, value), sd in
               zip(names, stage.sigma, strict=False)]  # fmt: skip
    left_out = f" Left out: {', '.join(stage.rejected)}." if stage.rejected else ""
    text = f"{len(stage.views)} views. {', '.join(numbers)} (px for the first four).{left_out}"
    caption = f"The worst view is {worst + 1}, {stage.views[worst]}."
    return Section("Lens", text, (_picture(png, "coverage and errors of the lens", caption),))


def _wiggling(chain: Chain, captures: Sequence[Capture]) -> Section:
    stage: Any = chain.stage("wiggling")
    first, last = _without_and_with(chain, "wiggling", captures)
    nodes = np.linspace(0, 2 * np.pi, 361)
    curve = stage.error_rad(np.tile(nodes, (chain.freqs_hz.size, 1)), np.ones((1, 1)))
    curve_mm = np.broadcast_to(curve, (chain.freqs_hz.size, 361)) * first.mm_per_rad[:, None]
    told = np.asarray(getattr(stage, "covered", np.ones((chain.freqs_hz.size, 1), bool)))
    covered = told[:, np.minimum(np.arange(361) * told.shape[1] // 361, told.shape[1] - 1)]
    panels = [
        Cyclic(f"{freq / 1e6:g} MHz", first.phase_rad[f], first.error_mm[f], last.error_mm[f],
               curve_mm[f], covered[f])
        for f, freq in enumerate(chain.freqs_hz)
    ]  # fmt: skip
    text = (
        "Range error over the phase that the pixel measures, with all other stages applied: "
        "without wiggling (orange) and with it (green); lines are medians. What is fitted passes "
        "through the orange points, and the green ones lie flat; dotted where the fit had no data."
    )
    caption = f"{len(captures)} captures, the mean of each frequency taken off."
    return Section("Wiggling", text, (_picture(cyclic_png(panels), "cyclic error", caption),))


def _pattern(chain: Chain, captures: Sequence[Capture]) -> Section:
    stage: Any = chain.stage("fixed_pattern")
    sample = samples(chain, captures[:1])
    layers = np.asarray(stage.error_rad(np.zeros((1, 1, 1)), np.ones((1, 1, 1))))
    layers = layers * (sample.mm_per_rad / 1e3)[:, None, None]
    panels = [(f"{freq / 1e6:g} MHz", layers[f], "error") for f, freq in enumerate(chain.freqs_hz)]
    png = maps_png(panels, columns=min(3, len(panels)), width_px=340 * min(3, len(panels)) + 120)
    text = "Constant range error of every pixel about the mean, as the stage takes it off."
    return Section("Fixed pattern", text, (_picture(png, "fixed pattern", ""),))


def _amplitude(chain: Chain, captures: Sequence[Capture]) -> Section:
    first, last = _without_and_with(chain, "amplitude", captures)
    panels = []
    for f, freq in enumerate(chain.freqs_hz):
        x, (before, after) = first.binned(f, first.amplitude[f], last.error_mm[f])
        panels.append(Course(f"{freq / 1e6:g} MHz", x, before, after))
    text = "Range error over amplitude, medians of as many pixels each, all other stages applied."
    name = f"amplitude, {first.unit}"
    png = course_png(panels, name, error="median range error, mm", log=True)
    return Section("Amplitude", text, (_picture(png, "range error over amplitude", ""),))


def _temperature(chain: Chain, captures: Sequence[Capture]) -> Section:
    captures = [c for c in captures if c.provenance["conditions"]["kind"] == "warmup"]
    first, last = _without_and_with(chain, "temperature", captures)
    figures = []
    for name, words in (("sensor_c", "sensor"), ("light_c", "light")):
        degrees = np.array([c.provenance["conditions"].get(name, np.nan) for c in captures],
                           dtype=np.float64)  # fmt: skip
        if not np.isfinite(degrees).all() or np.ptp(degrees) < 0.5:
            continue
        panels = [
            Course(f"{freq / 1e6:g} MHz", degrees, first.means_mm[f], last.means_mm[f])
            for f, freq in enumerate(chain.freqs_hz)
        ]
        png = course_png(panels, f"temperature of the {words}, degrees Celsius")
        figures.append(_picture(png, f"drift with the temperature of the {words}", ""))
    text = "Mean range error of every capture, without and with the stage, all others applied."
    return Section("Temperature", text, tuple(figures))


def _picture(png: bytes, alt: str, caption: str) -> Picture:
    """A figure as a data URL; WebP, since clouds of points as PNG are four times as large."""
    from PIL import Image

    small = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").save(small, "WEBP", quality=88, method=4)
    url = "data:image/webp;base64," + base64.b64encode(small.getvalue()).decode("ascii")
    return Picture(url, alt, caption)
