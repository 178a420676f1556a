"""Calibrations in words: their stages and residuals, a plan, a verdict."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toftools.viz._numbers import figure

if TYPE_CHECKING:
    from toftools.calib.chain import Chain
    from toftools.calib.fit import Outcome
    from toftools.calib.plan import Plan
    from toftools.calib.stage import Residual
    from toftools.calib.verdict import Verdict

WIDTH = 100
INDENT = " " * 17


def inspected(file: Path, intrinsics: str | None, *, as_json: bool) -> str:
    """What ``toftools inspect`` says about a calibration.

    Parameters
    ----------
    file : path
        Calibration.
    intrinsics : str or None
        Library whose file the lens should become instead: ros, opencv or open3d.
    as_json : bool
        JSON instead of lines.

    Returns
    -------
    str
        Text that ends with a line break.

    Raises
    ------
    ValueError
        If the file is no calibration, or has no lens where intrinsics are wanted.
    """
    from toftools.calib.store import load_chain

    chain = load_chain(file)
    if intrinsics is not None:
        from toftools.io.intrinsics import open3d_json, opencv_json, ros_yaml

        lens = chain.stage("lens")
        if lens is None:
            msg = f"{file.name} has no lens stage, so no intrinsics; toftools calibrate lens"
            raise ValueError(msg)
        write = {"ros": ros_yaml, "opencv": opencv_json, "open3d": open3d_json}[intrinsics]
        return write(lens.camera).rstrip("\n") + "\n"  # type: ignore[attr-defined]  # lens.Lens
    if as_json:
        return json.dumps(chain_data(chain)) + "\n"
    freqs = " + ".join(f"{freq / 1e6:g}" for freq in chain.freqs_hz)
    lines = [
        f"{file.name}: calibration of {chain.sensor}, {chain.width} x {chain.height} px at "
        f"{freqs} MHz",
        *stage_lines(chain),
    ]
    return "\n".join(lines) + "\n"


def chain_data(chain: Chain) -> dict[str, Any]:
    """A chain as plain JSON values, maps left out.

    Parameters
    ----------
    chain : Chain
        Calibration.

    Returns
    -------
    dict
        Camera, residual table, reference temperatures, notes.
    """
    from toftools.calib.store import residual_table

    return {
        "sensor": chain.sensor,
        "width": chain.width,
        "height": chain.height,
        "freqs_hz": chain.freqs_hz.tolist(),
        "stages": residual_table(chain),
        "reference": reference(chain),
        "notes": dict(chain.notes),
    }


def reference(chain: Chain) -> dict[str, float]:
    """Temperatures at which a calibration has no drift, as far as it says any.

    Parameters
    ----------
    chain : Chain
        Calibration.

    Returns
    -------
    dict of str to float
        ``sensor_c`` and ``light_c`` to degrees Celsius.
    """
    stage = chain.stage("temperature") or chain.stage("common_phase")
    told = getattr(stage, "reference_c", ())
    named = zip(("sensor_c", "light_c"), told, strict=False)
    return {key: float(value) for key, value in named if math.isfinite(value)}


def stage_lines(chain: Chain) -> list[str]:
    """Stages of a chain with their residuals and notes.

    Parameters
    ----------
    chain : Chain
        Calibration.

    Returns
    -------
    list of str
        Lines.
    """
    if not chain.stages:
        return ["  no stage"]
    lines = []
    for stage in chain.stages:
        lines.append(f"  {stage.slot:<15}{residual_text(stage.residual)}")
        lines += [row for note in stage.residual.notes for row in wrapped(note)]
    told = [f"{key} {value:.1f}" for key, value in reference(chain).items()]
    if told:
        lines.append(f"  {'reference':<15}{', '.join(told)} degrees Celsius")
    return lines


def residual_text(residual: Residual) -> str:
    """One line about a residual.

    Parameters
    ----------
    residual : Residual
        What a fit left.

    Returns
    -------
    str
        Before, after, held out, noise and number of data, as far as they are known.

    Examples
    --------
    >>> from toftools.calib.stage import Residual
    >>> residual_text(Residual("mm", 31.42, 2.04, n=4000))
    '31.4 -> 2.04 mm rms, 4000 data'
    """
    r, unit = residual, residual.unit
    known = [
        f"{figure(value)} {unit} {what}"
        for value, what in ((r.held_out, "held out"), (r.noise, "from noise alone"))
        if math.isfinite(value)
    ]
    course = f"{figure(r.before)} -> {figure(r.after)} {unit} rms"
    if not math.isfinite(r.before):
        course = f"{figure(r.after)} {unit} rms" if math.isfinite(r.after) else "no residual"
    return ", ".join([course, *known, *([f"{r.n} data"] if r.n else [])])


def plan_lines(plan: Plan, chain: Chain) -> list[str]:
    """A plan, a stage a line.

    Parameters
    ----------
    plan : Plan
        What will be fitted.
    chain : Chain
        What is there already.

    Returns
    -------
    list of str
        Lines.
    """
    from toftools.calib.needs import counted

    lines = ["plan"]
    for step in plan.steps:
        if step.reason and chain.stage(step.slot) is not None:
            lines.append(f"  {step.slot:<15}stays as it was")
            continue
        if step.reason:
            lines += wrapped(f"skipped: {step.reason}", f"  {step.slot:<15}")
            continue
        name = "" if step.entry == step.slot else f" by {step.entry}"
        lines.append(f"  {step.slot:<15}{counted(step.captures)}{name}")
    if plan.spare and not chain.stages:
        lines.append(f"  {'refinement':<15}{counted(plan.spare)} as well")
    return [*lines, *wrapped(plan.how, f"  {'held out':<15}")]


def outcome_lines(chain: Chain, outcomes: Sequence[Outcome]) -> list[str]:
    """Residuals of all stages, and what was planned and left out.

    Parameters
    ----------
    chain : Chain
        Calibration.
    outcomes : sequence of Outcome
        What became of the plan.

    Returns
    -------
    list of str
        Lines.
    """
    left = [o for o in outcomes if o.stage is None and not o.step.reason]
    lines = ["stages", *stage_lines(chain)]
    for outcome in left:
        lines += wrapped(f"left out: {outcome.reason}", f"  {outcome.step.slot:<15}")
    return lines


def verdict_lines(verdict: Verdict) -> list[str]:
    """A verdict: the table of held-out errors, the sentence, the advice.

    Parameters
    ----------
    verdict : Verdict
        Judgement.

    Returns
    -------
    list of str
        Lines, the sentence last but for the advice.
    """
    lines = []
    if verdict.after:
        lines = ["held out, mm  before rms    after rms    bias   noise floor   95 % below"]
        for first, last in zip(verdict.before, verdict.after, strict=True):
            lines.append(
                f"  {last.name:<12}{first.rms_mm:>10.2f}{last.rms_mm:>13.2f}"
                f"{last.bias_mm:>+8.2f}{last.noise_mm:>14.2f}{last.p95_mm:>13.2f}"
            )
    if not verdict.good and verdict.causes_mm:
        parts = [f"{name} {figure(mm)}" for name, mm in verdict.causes_mm.items()]
        lines += wrapped(f"each alone could explain, mm rms: {', '.join(parts)}", "  ")
    return [*lines, verdict.sentence, *(row for text in verdict.advice for row in
                                        wrapped(text, "  "))]  # fmt: skip


def wrapped(text: str, first: str = INDENT) -> list[str]:
    """A sentence over several lines, indented as the first.

    Parameters
    ----------
    text : str
        Sentence.
    first : str
        What the first line begins with.

    Returns
    -------
    list of str
        Lines.
    """
    return textwrap.wrap(text, WIDTH, initial_indent=first, subsequent_indent=" " * len(first))
