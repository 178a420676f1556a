"""``toftools rig --sensor NAME --out DIR``."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from toftools.sim.rig import RigTruth, Take, Unit

LOG = logging.getLogger("toftools.sim.rig")
TRUTH = "truth"
"""Folder of the answers inside the output, which no calibration reads."""
EPILOG = """\b
What is planted by default, and may be changed by --errors (none plants only what is named):
  lens         focal=0.015+0.012  centre=0.012+-0.009  dist=-0.12+0.05+8e-4+-6e-4+0
  wiggling     waveform=square (or sine, trapezoid, the file of a measured correlation)
  common phase delay_s=3e-10  offset_rad=0.05
  pattern      fppn_rad=0.03
  temperature  sensor_rad_per_k=1e-3  light_rad_per_k=2.5e-3  reference_sensor_c=40
               reference_light_c=45  room_c=22  sensor_tau_s=600  light_tau_s=120
  amplitude    amplitude_rad=0.012  amplitude_bend_rad=1e-3  amplitude_wave_rad=3e-3
  response     prnu=0.01  dsnu_e=10  dark_e=100  ab_gain=0.01  bad_share=5e-4
  unit=0       serial number, seed of the patterns
A phase that is one number is that of the highest frequency; several, joined by +, one of each.

\b
Examples:
  toftools rig --sensor opt8241:width=64,height=48 --out rig/
  toftools rig --sensor kinect2 --plan full --frames 4 --errors waveform=trapezoid,unit=7 --out k2/
  toftools calibrate all rig/ --out cal.json --report report.html
"""


@click.command(epilog=EPILOG)
@click.option("--sensor", "sensor_text", default="opt8241", show_default=True,
              metavar="NAME[:k=v]", help="Preset, with overrides as for simulate.")  # fmt: skip
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False),
              help="Folder for captures, conditions.csv and truth/; resumes.")  # fmt: skip
@click.option("--plan", default="small", show_default=True, metavar="small|full",
              help="How many captures: some 60 or some 180.")  # fmt: skip
@click.option("--errors", "errors_text", default="", metavar="k=v,...",
              help="What to plant; see below.")  # fmt: skip
@click.option("--frames", type=click.IntRange(min=1), default=1, show_default=True,
              help="Exposures averaged into every capture.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True,
              help="Of noise, board poses and check set.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print what was planted as JSON.")
@click.pass_context
def command(
    ctx: click.Context,
    *,
    sensor_text: str,
    out: Path,
    plan: str,
    errors_text: str,
    frames: int,
    seed: int,
    as_json: bool,
) -> None:
    """Capture a whole calibration with a virtual rig, of a camera whose errors are known."""
    from toftools.cli._progress import progress
    from toftools.io.conditions import write_conditions
    from toftools.sensors import sensor
    from toftools.sim.rig import parse_errors, planned, truth_of, unit_of

    nominal, errors = sensor(sensor_text), parse_errors(errors_text)
    unit = unit_of(errors, nominal)
    takes = planned(unit, plan, seed=seed, frames=frames)
    settings = _digest(sensor_text, errors, plan, frames, seed)
    kept = _kept(out, takes, settings)
    truth = truth_of(errors, nominal)
    (out / TRUTH).mkdir(parents=True, exist_ok=True)
    _write_truth(out / TRUTH, truth)
    with progress(verbose=bool(ctx.find_root().params.get("verbose"))):
        _write(out, takes, kept, unit, frames=frames, seed=seed, settings=settings)
    write_conditions(out, {take.name: take.conditions for take in takes})
    _say(out, takes, kept, truth, sensor_text, as_json=as_json)


def _digest(*settings: object) -> str:
    """What tells captures of one rig from those of another, without saying what it is."""
    import hashlib

    text = json.dumps([vars(s) if hasattr(s, "__dict__") else s for s in settings])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _kept(out: Path, takes: Sequence[Take], settings: str) -> set[str]:
    """Captures that are there already; a folder with anything else in their place is refused."""
    from toftools.io.conditions import NAME, read_conditions
    from toftools.io.native import read_capture

    kept, names = set(), {take.name for take in takes}
    if (out / NAME).is_file() and not set(read_conditions(out)) <= names:
        msg = f"{out} holds {NAME} of other captures; choose a folder of its own"
        raise ValueError(msg)
    for name in sorted(names):
        if not (out / name).exists():
            continue
        if read_capture(out / name).provenance.get("rig") != settings:
            msg = f"{out / name} is a capture with other settings; choose another folder"
            raise ValueError(msg)
        kept.add(name)
    return kept


def _write(
    out: Path,
    takes: Sequence[Take],
    kept: set[str],
    unit: Unit,
    *,
    frames: int,
    seed: int,
    settings: str,
) -> None:
    """The captures that are missing, one after another."""
    from toftools.io.native import write_capture
    from toftools.sim.rig import exposed, noise_of

    for i, take in enumerate(takes):
        if take.name in kept:
            continue
        LOG.info("capture %d of %d: %s", i + 1, len(takes), take.name)
        capture = exposed(take, unit, noise_of(seed, i), frames)
        told = {**capture.provenance, "seed": seed, "rig": settings}
        write_capture(out / take.name, replace(capture, provenance=told))


def _write_truth(folder: Path, truth: RigTruth) -> None:
    """Maps and curves for programs, what was asked for for people."""
    import numpy as np

    from toftools.io.atomic import atomic_path

    with atomic_path(folder / "truth.npz") as temporary:
        np.savez_compressed(temporary, **truth.arrays())
    with atomic_path(folder / "errors.json") as temporary:
        temporary.write_text(json.dumps(truth.planted(), indent=1) + "\n", encoding="utf-8")


def _say(
    out: Path,
    takes: Sequence[Take],
    kept: set[str],
    truth: RigTruth,
    name: str,
    *,
    as_json: bool,
) -> None:
    from toftools.sim.rig import BOARD

    kinds = Counter(take.conditions.kind for take in takes)
    board = "chessboard:columns={},rows={},square_m={}".format(*BOARD)
    if as_json:
        what = {"out": str(out), "captures": dict(kinds), "kept": len(kept), "board": board}
        click.echo(json.dumps({**what, "planted": truth.planted()}))
        return
    told = ", ".join(f"{n} {kind}" for kind, n in kinds.items())
    there = f"; {len(kept)} were there already" if kept else ""
    click.echo(f"wrote {len(takes) - len(kept)} captures of {name} to {out}: {told}{there}")
    for line in _planted(truth):
        click.echo(f"  {line}")
    click.echo(f"board: {board}; answers: {out / TRUTH}, which no calibration reads")
    click.echo(f"next: toftools calibrate all {out} --out cal.json --report report.html")


def _planted(truth: RigTruth) -> list[str]:
    """What was planted, as range at each frequency."""
    import numpy as np

    from toftools.units import phase_to_range

    def mm(phase_rad: Any) -> str:  # noqa: ANN401 - numbers per frequency
        values = 1e3 * phase_to_range(np.asarray(phase_rad), truth.freqs_hz)
        return " / ".join(f"{value:.3g}" for value in values)

    K, pattern = truth.camera.K, truth.fixed_pattern_rad
    dist = " ".join(f"{x:g}" for x in truth.camera.dist) or "none"
    return [
        f"at {' / '.join(f'{f / 1e6:g}' for f in truth.freqs_hz)} MHz was planted:",
        f"lens           fx {K[0, 0]:.2f} fy {K[1, 1]:.2f} cx {K[0, 2]:.2f} cy {K[1, 2]:.2f} px, "
        f"distortion {dist}",
        f"wiggling       {mm(np.abs(truth.wiggling.error_rad).max(axis=1))} mm peak",
        f"common phase   {mm(truth.common_phase_rad)} mm",
        f"fixed pattern  {mm(pattern.std(axis=(1, 2)))} mm rms",
        f"temperature    {mm(truth.sensor_rad_per_k)} mm/K of the sensor, "
        f"{mm(truth.light_rad_per_k)} mm/K of the light",
        f"amplitude      {mm(truth.amplitude_rad[0])} mm per octave",
        f"response       gain {100 * truth.errors.prnu:.3g} % rms, {int(truth.bad.sum())} bad "
        "pixels",
    ]
