"""``toftools cloud D|C.h5 --out x.ply|x.png|x.html``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from toftools.registry import READERS

if TYPE_CHECKING:
    from toftools.types import F32, Camera, Capture, DepthMap

SUFFIXES = (".ply", ".png", ".html")


EPILOG = f"""Formats: {", ".join(READERS)}; docs/methods.md lists the keys of each, and so does the
error about a wrong one.

Example: toftools cloud answer.npz --colour amplitude --out cloud.html
"""


@click.command(epilog=EPILOG)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--out", default=None, type=click.Path(path_type=Path, dir_okay=False),
              help="Cloud (.ply), picture (.png), or page to turn and zoom (.html).")  # fmt: skip
@click.option("--view", is_flag=True, help="Open it in a window.")
@click.option("--truth", is_flag=True, help="Take the ground truth instead of the answer.")
@click.option("--colour", "--color", type=click.Choice(["range", "amplitude"]), default="range",
              show_default=True, help="What colours show.")  # fmt: skip
@click.option("--capture", "camera_file", default=None, type=click.Path(path_type=Path),
              help="Capture whose camera to use, for an answer without one.")  # fmt: skip
@click.option("--format", "format_text", default=None, metavar="NAME[:k=v,...]",
              help="Force a foreign input format.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
def command(
    *,
    source: Path,
    out: Path | None,
    view: bool,
    truth: bool,
    colour: str,
    camera_file: Path | None,
    format_text: str | None,
    as_json: bool,
) -> None:
    """Make a point cloud of an answer or a capture in SOURCE.

    A capture without a depth of its own is unwrapped (crt; single for one frequency). Taps and
    phasors need no --capture; an .npz of ranges alone does.
    """
    import numpy as np

    _check_wish(out, view)
    depth, camera, method = _load(source, format_text, camera_file, truth)
    if method is not None:
        click.echo(f"no depth in the file: unwrapped with {method}", err=True)
    if colour == "amplitude" and depth.amplitude is None:
        msg = f"{source.name} holds no amplitude to colour by; use --colour range"
        raise ValueError(msg)
    if out is not None:
        _write(out, depth, camera, colour, source.name)
        count = int(np.isfinite(depth.range_m).sum())
        summary = {"out": str(out), "points": count, "pixels": depth.range_m.size,
                   **({"unwrapped_with": method} if method else {})}  # fmt: skip
        text = f"wrote {out}: {count} points of {depth.range_m.size} pixels"
        click.echo(json.dumps(summary) if as_json else text)
    if view:
        from toftools.camera import points
        from toftools.viz.cloud import show

        show(points(camera, depth.range_m), _shades(depth)[colour], kind=colour)


def _check_wish(out: Path | None, view: bool) -> None:
    if out is None and not view:
        msg = "nothing to do; give --out x.ply, x.png or x.html, or --view"
        raise ValueError(msg)
    if out is not None and out.suffix.lower() not in SUFFIXES:
        msg = f"got the suffix {out.suffix or 'none'!r} in {out.name}; wanted {', '.join(SUFFIXES)}"
        raise ValueError(msg)


def _load(
    source: Path, format_text: str | None, camera_file: Path | None, truth: bool
) -> tuple[DepthMap, Camera, str | None]:
    """The ranges to show, the camera that saw them, and what unwrapped them if they were not."""
    from toftools.io.answer import depth_of
    from toftools.io.open import open_capture

    capture = open_capture(source, format_text)
    depth, method = (_truth(capture, source), None) if truth else depth_of(capture)
    if camera_file is not None:
        camera = open_capture(camera_file).sensor.camera
        if camera.shape != depth.range_m.shape:
            msg = (
                f"{camera_file.name} has {camera.shape} pixels, but {source.name} "
                f"{depth.range_m.shape}; give the capture it was made from"
            )
            raise ValueError(msg)
        return depth, camera, method
    if format_text is None and _without_camera(capture):
        msg = (
            f"{source.name} holds no camera; give the capture it was made from as --capture C.h5, "
            "or assume a field of view with --format npz:hfov_deg=60"
        )
        raise ValueError(msg)
    return depth, capture.sensor.camera, method


def _without_camera(capture: Capture) -> bool:
    """Whether an archive came without intrinsics, so that its reader had to assume some."""
    note = str(capture.provenance.get("camera", ""))
    return capture.provenance.get("format") == "npz" and note.endswith("assumed")


def _truth(capture: Capture, source: Path) -> DepthMap:
    from toftools.io.answer import measured_amplitude
    from toftools.types import DepthMap

    if capture.truth is None:
        msg = f"{source.name} holds no ground truth; leave out --truth"
        raise ValueError(msg)
    return DepthMap(capture.truth.range_m, amplitude=measured_amplitude(capture))


def _shades(depth: DepthMap) -> dict[str, F32]:
    """What colours can show."""
    shades = {"range": depth.range_m}
    return shades if depth.amplitude is None else {**shades, "amplitude": depth.amplitude}


def _write(out: Path, depth: DepthMap, camera: Camera, colour: str, title: str) -> None:
    from toftools.camera import points
    from toftools.io.atomic import atomic_path
    from toftools.io.export import write_ply
    from toftools.io.intrinsics import write_text

    suffix = out.suffix.lower()
    if suffix == ".ply":
        write_ply(out, depth, camera)
        return
    cloud, shades = points(camera, depth.range_m), _shades(depth)
    if suffix == ".png":
        from toftools.viz.cloud import cloud_png

        picture = cloud_png(cloud, shades[colour], title=title, kind=colour)
        with atomic_path(out) as temporary:
            temporary.write_bytes(picture)
        return
    from toftools.viz.web import cloud_html

    ordered = {colour: shades[colour], **shades}
    write_text(out, cloud_html(cloud, ordered, title=title))
