"""``toftools inspect FILE [--json] [--reference D]``."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from toftools.registry import READERS

if TYPE_CHECKING:
    from toftools.types import Camera


EPILOG = f"""Formats: {", ".join(READERS)}; docs/methods.md lists the keys of each, and so does the
error about a wrong one.

Example: toftools inspect Scene_phase0_avg.npy --reference Scene_dist_avg.npy
"""


@click.command(epilog=EPILOG)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--reference", type=click.Path(path_type=Path), default=None,
              help="Distances of the same scene, to judge the convention by.")  # fmt: skip
@click.option("--format", "format_text", default=None, metavar="NAME[:k=v,...]",
              help="Force a format and its convention; detected by default.")  # fmt: skip
@click.option("--intrinsics", type=click.Choice(["ros", "opencv", "open3d"]), default=None,
              help="Print only the camera, as a file of that library.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def command(
    *,
    file: Path,
    reference: Path | None,
    format_text: str | None,
    intrinsics: str | None,
    as_json: bool,
) -> None:
    """Say what is in FILE, a recording or a calibration: units, convention, noise, wraps."""
    import json

    from toftools.io.inspect import reference_range, summary
    from toftools.io.open import open_capture

    if file.suffix.lower() == ".json" and format_text is None and reference is None:
        from toftools.cli._calibration import inspected

        click.echo(inspected(file, intrinsics, as_json=as_json), nl=False)
        return
    capture = open_capture(file, format_text)
    if intrinsics is not None:
        click.echo(_intrinsics(capture.sensor.camera, intrinsics), nl=False)
        return
    reference_m = None
    if reference is not None:
        reference_m = reference_range(open_capture(reference), reference.name)
    found = summary(capture, reference_m)
    click.echo(json.dumps(found, default=str) if as_json else _text(found, file))


def _intrinsics(camera: "Camera", library: str) -> str:
    from toftools.io.intrinsics import open3d_json, opencv_json, ros_yaml

    write = {"ros": ros_yaml, "opencv": opencv_json, "open3d": open3d_json}[library]
    return write(camera).rstrip("\n") + "\n"


def _text(found: dict[str, Any], path: Path) -> str:
    """A summary as lines for people."""
    lines = [
        f"{path.name}: {', '.join(found['holds'])}",
        f"  sensor      {found['sensor']}, {found['width']} x {found['height']} px, "
        f"focal length {found['focal_px'][0]:.1f} px"
        + (", with distortion" if found["distorted"] else ""),
        *_modulation_lines(found),
        f"  valid       {_join(found['valid_share'], '{:.1%}')}",
        *_percentile_lines(found),
        *_noise_lines(found["noise"]),
        *_wrap_lines(found),
        *_convention_lines(found["provenance"]),
        *_proposal_lines(found["proposal"]),
    ]
    return "\n".join(lines)


def _join(values: dict[str, Any], form: str) -> str:
    return ", ".join(f"{name} {form.format(value)}" for name, value in values.items())


def _mhz(freqs_hz: list[float]) -> str:
    return " + ".join(f"{freq / 1e6:g}" for freq in freqs_hz) + " MHz"


def _modulation_lines(found: dict[str, Any]) -> list[str]:
    wraps = " / ".join(f"{length:.3f}" for length in found["ambiguity_m"])
    convention = found["provenance"].get("convention")
    if isinstance(convention, dict) and str(convention.get("modulation", "")).startswith("nominal"):
        return [f"  modulation  not in the file; {_mhz(found['freqs_hz'])} taken"]
    joint = found["joint_ambiguity_m"]
    together = "none" if joint is None else f"{joint:.2f} m"
    several = f", together {together}" if len(found["freqs_hz"]) > 1 else ""
    lines = [f"  modulation  {_mhz(found['freqs_hz'])}, wraps at {wraps} m{several}"]
    if found["tap_unit"] is not None:
        steps = "; ".join(dict.fromkeys(found["steps_deg"]))
        lines.append(f"  taps        {found['tap_unit']}, steps {steps} degrees")
    return lines


def _percentile_lines(found: dict[str, Any]) -> list[str]:
    lines = [
        f"  amplitude   {name}: " + " / ".join(f"{value:.5g}" for value in values)
        for name, values in found["amplitude_percentiles"].items()
        if values is not None
    ]
    if found["range_m_percentiles"] is not None:
        ranges = " / ".join(f"{value:.3f}" for value in found["range_m_percentiles"])
        lines.append(f"  range       {ranges} m (1st, 50th, 99th percentile)")
    return lines


def _noise_lines(noise: dict[str, Any]) -> list[str]:
    lines = []
    for key, how in (("reported_m", "reported"), ("estimated_m", "from neighbours")):
        values = [value for value in noise[key] or [] if value is not None]
        if values:
            listed = " / ".join(f"{1e3 * value:.2f}" for value in values)
            lines.append(f"  noise       {listed} mm of {noise['of']}, {how}")
    return lines


def _wrap_lines(found: dict[str, Any]) -> list[str]:
    if found["wraps"] is None or not {"taps", "phasors"} & set(found["holds"]):
        return []
    shares = " / ".join(f"{share:.1%}" for share in found["wraps"]["share"])
    most = " / ".join(str(turns) for turns in found["wraps"]["most"])
    return [f"  wraps       {shares} of pixels lie beyond one turn, at most {most} turns"]


def _convention_lines(provenance: dict[str, Any]) -> list[str]:
    lines = [
        f"  {key:<12}{provenance[key]}"
        for key in ("source", "licence", "camera")
        if isinstance(provenance.get(key), str)
    ]
    if "clipped_share" in provenance:
        lines.append(
            f"  saturation  {provenance['clipped_share']:.1%} of pixels at the clip, "
            f"{provenance['zero_share']:.1%} zero"
        )
    convention = provenance.get("convention")
    if isinstance(convention, dict):
        lines += [f"  convention  {key}: {value}" for key, value in convention.items()]
    return lines


def _proposal_lines(proposal: dict[str, Any] | None) -> list[str]:
    if proposal is None:
        return []
    steps = proposal["steps_deg"]
    taps = "" if steps is None else f", taps {'; '.join(dict.fromkeys(steps))} degrees"
    offsets = ", ".join(
        f"{offset:+.4f} +- {'unknown' if error is None else f'{error:.4f}'} m"
        for offset, error in zip(proposal["offset_m"], proposal["offset_se_m"], strict=True)
    )
    sign = "grows" if proposal["sign"] > 0 else "falls"
    verdict = "decided" if proposal["decided"] else "NOT decided"
    return [
        f"  proposal    against {proposal['reference']}: phase {sign} with range{taps}",
        f"  offset      {offsets} (measured minus reference, per frequency)",
        f"  certainty   {verdict}: {proposal['reason']}; runner-up {proposal['runner_up']}",
        *([f"  to apply    --format {proposal['apply']}"] if proposal["apply"] else []),
    ]
