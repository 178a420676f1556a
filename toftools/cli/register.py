"""``toftools register CAPTURE --calib CAL.json --image RGB.png --out X.ply|X.npz|X.png``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from toftools.registry import READERS

if TYPE_CHECKING:
    from toftools.calib.chain import Chain
    from toftools.calib.extrinsics import Extrinsics
    from toftools.types import Camera, Capture, DepthMap

SUFFIXES = (".ply", ".npz", ".png")

EPILOG = f"""Formats: {", ".join(READERS)}.

Examples: toftools calibrate extrinsics:colour=rgb,intrinsics=rgb.yaml board/*.h5 --out cal.json
toftools correct c.h5 --calib cal.json --out answer.npz
toftools register answer.npz --calib cal.json --image c.png --out coloured.ply
"""


@click.command(epilog=EPILOG)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--calib", required=True, type=click.Path(path_type=Path),
              help="Calibration with a stage extrinsics (toftools calibrate).")  # fmt: skip
@click.option("--image", default=None, type=click.Path(path_type=Path),
              help="Picture of the colour camera, for .ply and .npz.")  # fmt: skip
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Coloured cloud (.ply), z in the picture's pixels in mm (.png), or both (.npz).",
)
@click.option("--skip", multiple=True, metavar="STAGE",
              help="Stage of the calibration to leave out; repeat for several.")  # fmt: skip
@click.option("--format", "format_text", default=None, metavar="NAME[:k=v,...]",
              help="Force a foreign input format.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
def command(
    *,
    source: Path,
    calib: Path,
    image: Path | None,
    out: Path,
    skip: tuple[str, ...],
    format_text: str | None,
    as_json: bool,
) -> None:
    """Bring the ranges in SOURCE and a picture of a second camera together.

    SOURCE is an answer (toftools correct) or a capture; a capture without a depth of its own is
    calibrated and unwrapped (crt; single for one frequency). Pixels that the second camera cannot
    see get no colour and are left out of a cloud.
    """
    from toftools.calib.chain import skipping
    from toftools.calib.store import load_chain
    from toftools.io.answer import depth_of

    suffix = out.suffix.lower()
    if suffix not in SUFFIXES:
        msg = f"got the suffix {out.suffix or 'none'!r} in {out.name}; wanted {', '.join(SUFFIXES)}"
        raise ValueError(msg)
    if image is None and suffix != ".png":
        msg = f"{out.name} needs colours; give --image, or --out z.png for ranges alone"
        raise ValueError(msg)
    chain = skipping(load_chain(calib), skip)
    stage: Any = chain.stage("extrinsics")
    if stage is None:
        msg = f"{calib.name} has no stage extrinsics; toftools calibrate extrinsics adds it"
        raise ValueError(msg)
    capture = _calibrated(source, chain, format_text)
    depth, _ = depth_of(capture)
    maps = _registered(stage, capture.sensor.camera, depth, image, with_z=suffix != ".ply")
    _write(out, maps, depth, capture.sensor.camera)
    summary = {"out": str(out), "image": str(image) if image else None, **_shares(maps)}
    click.echo(json.dumps(summary) if as_json else _sentence(summary))


def _calibrated(source: Path, chain: Chain, format_text: str | None) -> Capture:
    """The capture with its optics; what holds no depth yet is corrected by the whole chain."""
    from dataclasses import replace

    from toftools.calib.chain import applied, check_fits
    from toftools.io.open import open_capture

    capture = open_capture(source, format_text)
    capture = replace(capture, provenance={**capture.provenance, "file": source.name})
    if capture.depth is None and "calibrated" not in capture.provenance:
        return applied(chain, capture)
    if capture.sensor.camera.shape != (chain.height, chain.width):
        check_fits(chain, capture)  # says what is wrong
    lens: Any = chain.stage("lens")
    if lens is None:
        return capture
    return replace(capture, sensor=replace(capture.sensor, camera=lens.camera))


def _registered(
    stage: Extrinsics, camera: Camera, depth: DepthMap, image: Path | None, *, with_z: bool
) -> dict[str, Any]:
    """Maps of the two cameras brought together."""
    import numpy as np

    from toftools.calib.register import colours_of, register_depth
    from toftools.io.picture import read_picture

    noise = 0.0 if depth.sigma_m is None else depth.sigma_m
    maps: dict[str, Any] = {"range_m": depth.range_m}
    if image is not None:
        picture = read_picture(image)
        if picture.shape[:2] != stage.colour.shape:
            msg = (
                f"{image.name} has {picture.shape[1]} x {picture.shape[0]} px and the calibrated "
                f"colour camera {stage.colour.width} x {stage.colour.height}; give its own picture"
            )
            raise ValueError(msg)
        colours, status = colours_of(stage, camera, depth.range_m, picture, sigma_m=noise)
        maps["colours"] = np.round(np.nan_to_num(colours)).astype(np.uint8)
        maps["status"] = status
    if with_z:
        maps["z_m"] = register_depth(stage, camera, depth.range_m, sigma_m=noise)
    return maps


def _write(out: Path, maps: dict[str, Any], depth: DepthMap, camera: Camera) -> None:
    from dataclasses import replace

    import numpy as np

    from toftools.io.atomic import atomic_path
    from toftools.io.export import write_ply, write_z16

    suffix = out.suffix.lower()
    if suffix == ".ply":
        seen = np.where(maps["status"] == 0, depth.range_m, np.float32(np.nan))
        write_ply(out, replace(depth, range_m=seen), camera, colours=maps["colours"])
    elif suffix == ".png":
        write_z16(out, maps["z_m"])
    else:
        with atomic_path(out) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **maps)


def _shares(maps: dict[str, Any]) -> dict[str, float]:
    """Shares of ToF pixels by what became of them, and of the picture that has a range."""
    import numpy as np

    from toftools.calib.register import COLOURED, HIDDEN, NO_RANGE, OUTSIDE

    words = {"coloured": COLOURED, "hidden": HIDDEN, "outside": OUTSIDE, "no_range": NO_RANGE}
    found = {}
    if "status" in maps:
        found = {word: float((maps["status"] == code).mean()) for word, code in words.items()}
    if "z_m" in maps:
        found["picture_with_z"] = float(np.isfinite(maps["z_m"]).mean())
    return found


def _sentence(summary: dict[str, Any]) -> str:
    words = {
        "coloured": "of the ToF pixels coloured",
        "hidden": "hidden from the colour camera",
        "outside": "outside its picture",
        "picture_with_z": "of the picture with a range",
    }
    parts = [f"{summary[key]:.1%} {text}" for key, text in words.items() if key in summary]
    return f"wrote {summary['out']}: {', '.join(parts)}"
