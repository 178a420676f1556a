"""``toftools correct C.h5 [--calib CAL.json] --method NAME[:k=v,...] --out D.npz|...``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from toftools.registry import CORRECTIONS, FILTERS, READERS

if TYPE_CHECKING:
    from toftools.types import Capture

SUFFIXES = (".npz", ".png", ".ply", ".h5")


def _filters(place: str) -> str:
    return ", ".join(name for name, spec in FILTERS.items() if spec.place == place)


EPILOG = f"""Methods: {", ".join(CORRECTIONS)}, or your own function as module:function,
found in the current folder too. Filters before a method:
{_filters("before")}; after it: {_filters("after")}. Formats: {", ".join(READERS)}. docs/methods.md
lists the keys of each, and so does the error about a wrong one.

Examples: toftools correct c.h5 --method crt:max_range_m=5 --out answer.npz
toftools correct c.h5 --before smooth --after flying_pixels --out clean.ply
toftools correct c.h5 --method "smooth:radius_px=2 > crt" --out answer.npz
toftools correct c.h5 --calib cal.json --sensor-c 41 --light-c 45 --out answer.npz
"""


@click.command(epilog=EPILOG)
@click.argument("capture_file", type=click.Path(path_type=Path))
@click.option("--calib", default=None, type=click.Path(path_type=Path),
              help="Calibration (toftools calibrate) to apply before anything else.")  # fmt: skip
@click.option("--skip", multiple=True, metavar="STAGE",
              help="Stage of the calibration to leave out; repeat for several.")  # fmt: skip
@click.option("--sensor-c", type=float, default=None,
              help="Temperature of the sensor, Celsius, if not that of the file.")  # fmt: skip
@click.option("--light-c", type=float, default=None,
              help="Temperature of the light source likewise.")  # fmt: skip
@click.option("--trust", multiple=True, metavar="MODULE",
              help="Module of stages of your own that the calibration may import.")  # fmt: skip
@click.option("--method", default="crt", show_default=True, metavar="NAME[:k=v,...]",
              help="A registered method, mypkg.mine:make, or a chain: 'smooth > crt'.")  # fmt: skip
@click.option("--before", multiple=True, metavar="NAME[:k=v,...]",
              help="Filter of the phasors; repeat for several, in this order.")  # fmt: skip
@click.option("--after", multiple=True, metavar="NAME[:k=v,...]",
              help="Filter of the depth map; repeat for several, in this order.")  # fmt: skip
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="Answer; the suffix chooses: .npz .png (z in mm) .ply .h5")  # fmt: skip
@click.option("--format", "format_text", default=None, metavar="NAME[:k=v,...]",
              help="Force a foreign input format.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
def command(
    *,
    capture_file: Path,
    calib: Path | None,
    skip: tuple[str, ...],
    sensor_c: float | None,
    light_c: float | None,
    trust: tuple[str, ...],
    method: str,
    before: tuple[str, ...],
    after: tuple[str, ...],
    out: Path,
    format_text: str | None,
    as_json: bool,
) -> None:
    """Turn the capture in CAPTURE_FILE into a depth map."""
    import numpy as np

    from toftools.io.answer import answered
    from toftools.io.export import write_answer
    from toftools.io.open import open_capture

    if out.suffix.lower() not in SUFFIXES:
        msg = f"got --out {out.name}; the suffix must be one of {', '.join(SUFFIXES)}"
        raise ValueError(msg)
    if out.exists() and capture_file.exists() and out.samefile(capture_file):
        msg = f"got --out {out.name}, which is the input; choose another name"
        raise ValueError(msg)
    capture = open_capture(capture_file, format_text)
    stages: list[str] = []
    if calib is not None:
        told = {"sensor_c": sensor_c, "light_c": light_c}
        capture, stages = _calibrated(capture, capture_file.name, calib, skip, trust, told)
    elif skip or trust or sensor_c is not None or light_c is not None:
        msg = "--skip, --trust, --sensor-c and --light-c belong to a calibration; give --calib too"
        raise ValueError(msg)
    depth = answered(capture, method, before=before, after=after)
    write_answer(out, depth, capture)
    known = np.isfinite(depth.range_m)
    summary: dict[str, Any] = {
        "out": str(out),
        "method": " > ".join([*before, method, *after]),
        "valid_share": float(known.mean()),
        "median_range_m": float(np.median(depth.range_m[known])) if known.any() else None,
        "median_sigma_m": _median(depth.sigma_m),
    }
    if calib is not None:
        summary["calibration"] = {"file": str(calib), "stages": stages}
    if "shares" in depth.info:
        summary["models"] = dict(depth.info["shares"])
        summary["why"] = dict(depth.info.get("why", {}))
    click.echo(json.dumps(summary) if as_json else "\n".join(_lines(summary)))


def _lines(summary: dict[str, Any]) -> list[str]:
    """A summary for people."""
    lines = [_sentence(summary)]
    if "calibration" in summary:
        used = summary["calibration"]
        lines.append(f"  calibrated by {used['file']}: {', '.join(used['stages']) or 'no stage'}")
    for model, share in summary.get("models", {}).items():
        reason = summary["why"].get(model)
        if share or reason:
            lines.append(f"  {model:<14}{share:6.1%} of pixels{': ' + reason if reason else ''}")
    return lines


def _calibrated(
    capture: Capture,
    name: str,
    calib: Path,
    skip: tuple[str, ...],
    trust: tuple[str, ...],
    told: dict[str, float | None],
) -> tuple[Capture, list[str]]:
    """The capture after a calibration, and the stages that were applied."""
    from dataclasses import replace

    from toftools.calib.chain import applied, skipping
    from toftools.calib.fit import refuse_calibrated
    from toftools.calib.store import load_chain

    chain = skipping(load_chain(calib, trusted=trust), skip)
    given = {key: value for key, value in told.items() if value is not None}
    conditions = {**capture.provenance.get("conditions", {}), **given}
    known = {**capture.provenance, "file": name, **({"conditions": conditions} if given else {})}
    capture = replace(capture, provenance=known)
    refuse_calibrated(capture)
    if capture.sensor.name != chain.sensor:
        click.echo(
            f"warning: {name} is of the camera {capture.sensor.name!r}, {calib.name} of "
            f"{chain.sensor!r}; use the calibration of the same unit",
            err=True,
        )
    return applied(chain, capture), [stage.slot for stage in chain.stages]


def _median(values: object) -> float | None:
    import numpy as np

    if values is None:
        return None
    finite = np.asarray(values)[np.isfinite(np.asarray(values))]
    return float(np.median(finite)) if finite.size else None


def _sentence(summary: dict[str, Any]) -> str:
    text = f"wrote {summary['out']}: {summary['method']}, {summary['valid_share']:.1%} of pixels"
    if summary["median_range_m"] is not None:
        text += f", median range {summary['median_range_m']:.3f} m"
    if summary["median_sigma_m"] is not None:
        text += f", median sigma {1e3 * float(str(summary['median_sigma_m'])):.2f} mm"
    return text
