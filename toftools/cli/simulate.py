"""``toftools simulate SCENE --sensor NAME --out C.h5``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from toftools.registry import SIMULATORS, parameters_of
from toftools.sensors import KEYS, PRESETS
from toftools.sim.analytic import SCENES
from toftools.sim.scenes import FILES, WORLDS

if TYPE_CHECKING:
    from toftools.types import Capture, Shot

SUFFIXES = (".h5", ".hdf5")
BESIDE = "beside"
"""Value of ``--preview`` without a file: the picture lies beside the capture."""


def _typed(value: object) -> str:
    """A default as one would type it."""
    if isinstance(value, tuple):
        return "+".join(map(_typed, value))
    return f"{value:g}" if isinstance(value, int | float) else str(value or "")


def _with_defaults(name: str, build: Callable[..., Any]) -> str:
    params = ",".join(f"{key}={_typed(value)}" for key, value in parameters_of(build).items())
    return f"{name}:{params}"


def _scene_lines() -> str:
    """Every scene with its defaults, a line each."""
    closed = {name: make for name, make in SCENES.items() if name not in WORLDS}
    lines = [
        f"{'*' if name in SCENES else ' '} {_with_defaults(name, build)}"
        for name, build in {**WORLDS, **closed}.items()
    ]
    files: dict[Callable[..., Any], list[str]] = {}
    for suffix, build in FILES.items():
        files.setdefault(build, []).append(suffix)
    lines += [
        f"  {_with_defaults(f'FILE{chr(124).join(suffixes)}', build)}"
        for build, suffixes in files.items()
    ]
    return "\n".join(lines)


EPILOG = f"""\b
Scenes with their defaults (m, degrees); those with * have a closed form:
{_scene_lines()}
Each takes ambient_e too: unmodulated electrons per tap.

Sensors: {", ".join(PRESETS)}; each takes {", ".join(KEYS)} (Hz, px, electrons; several values
joined by +).

Engines: {", ".join(SIMULATORS)}, with parameters such as path:antialias=3; or auto: the closed form
where one covers the scene, the sensor and the bounces, else virtual lights (radiosity), or path
where --spp counts paths. docs/simulator.md tells more.

\b
Examples:
  toftools simulate corner:angle=90 --sensor opt8241:width=64,height=48 --out c.h5
  toftools simulate room:seed=7 --sensor kinect2:width=128,height=106 --tol-mm 10 --preview --out r.h5
"""  # noqa: E501 - an example must fit one line


def _bounces(text: str) -> int | None:
    """A number of bounces; None for ``auto``."""
    if text == "auto":
        return None
    if not text.isdecimal():
        msg = f"got {text!r}, wanted auto or a whole number of bounces such as 2"
        raise click.BadParameter(msg)
    return int(text)


@click.command(epilog=EPILOG)
@click.argument("scene")
@click.option("--sensor", "sensor_text", default="deeptof", show_default=True, metavar="NAME[:k=v]",
              help="Preset, with overrides such as deeptof:freqs=20e6+50e6,width=64.")  # fmt: skip
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="Capture file, *.h5, with taps, phasors and truth.")  # fmt: skip
@click.option("--engine", default="auto", show_default=True, metavar="NAME[:k=v]",
              help="What computes the light.")  # fmt: skip
@click.option("--tol-mm", type=float, default=1.0, show_default=True,
              help="Standard error of range: over the image; path: in every tile.")  # fmt: skip
@click.option("--spp", type=click.IntRange(min=1), default=None,
              help="Paths per pixel (radiosity: virtual lights), no tolerance.")  # fmt: skip
@click.option("--max-bounces", type=_bounces, default="auto", show_default=True,
              metavar="auto|N",
              help="Indirect bounces; auto: all that can move range by --tol-mm.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True,
              help="Seed of noise and paths.")  # fmt: skip
@click.option("--no-noise", is_flag=True, help="Expected taps, without shot and read noise.")
@click.option("--preview", is_flag=False, flag_value=BESIDE, default=None, metavar="[P.png]",
              help="Draw maps as well; without a file beside --out.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
@click.pass_context
def command(
    ctx: click.Context,
    *,
    scene: str,
    sensor_text: str,
    out: Path,
    engine: str,
    tol_mm: float,
    spp: int | None,
    max_bounces: int | None,
    seed: int,
    no_noise: bool,
    preview: str | None,
    as_json: bool,
) -> None:
    """Simulate a capture of SCENE, such as corner:angle=90,range=2 or a scene file."""
    from toftools.bench.memory import resident_mb
    from toftools.cli._progress import progress
    from toftools.io.native import write_capture
    from toftools.sensors import sensor
    from toftools.types import Shot

    if not 0 < tol_mm < float("inf"):
        msg = f"got --tol-mm {tol_mm:g}, wanted a positive number of millimetres"
        raise ValueError(msg)
    picture = _targets(out, preview)
    shot = Shot(
        sensor(sensor_text), seed=seed, noisy=not no_noise, max_bounces=max_bounces, samples=spp,
        tol_m=1e-3 * tol_mm,
    )  # fmt: skip
    start = time.perf_counter()
    with progress(verbose=bool(ctx.find_root().params.get("verbose"))):
        capture = _simulated(scene, engine, shot)
    write_capture(out, capture)
    cost = {"wall_s": time.perf_counter() - start, "peak_mb": resident_mb("VmHWM")}
    if picture is not None:
        _draw(picture, capture, scene)
    _say({"out": out, "preview": picture}, capture, scene, cost, as_json=as_json)


def _targets(out: Path, preview: str | None) -> Path | None:
    """Refuse what cannot be written before anything is computed; the file of the picture."""
    from toftools.io.atomic import check_target

    if out.suffix.lower() not in SUFFIXES:
        msg = f"got --out {out.name}; a capture file is HDF5, so name it *.h5"
        raise ValueError(msg)
    check_target(out)
    if preview is None:
        return None
    picture = out.with_suffix(".png") if preview == BESIDE else Path(preview)
    if picture.suffix.lower() != ".png":
        msg = f"got --preview {picture.name}; a preview is a picture, so name it *.png"
        raise ValueError(msg)
    check_target(picture)
    return picture


def _simulated(scene: str, engine: str, shot: Shot) -> Capture:
    """The capture, with why it was made this way in its provenance."""
    from dataclasses import replace

    from toftools.registry import find, parse_entry
    from toftools.sim.choice import choose
    from toftools.types import Capture, Scene

    name, params = parse_entry(scene)
    what, why = Scene(name, params), "it was asked for"
    if engine.partition(":")[0] == "auto" != engine:
        msg = f"got --engine {engine}: auto takes no parameters; name one, as path:antialias=3"
        raise ValueError(msg)
    if engine == "auto":
        engine, why = choose(what, shot.sensor, max_bounces=shot.max_bounces, samples=shot.samples)
    spec = find(SIMULATORS, engine)
    if spec.name == "analytic" and shot.samples is not None:
        msg = "--spp counts paths, of which a closed form has none; leave it out"
        raise ValueError(msg)
    capture: object = spec.build(what)(shot)
    if not isinstance(capture, Capture):
        msg = f"the engine {engine!r} gave {type(capture).__name__}, wanted a Capture"
        raise ValueError(msg)
    told = {"engine": spec.name, **capture.provenance, "engine_why": why}
    return replace(capture, provenance=told)


def _draw(picture: Path, capture: Capture, title: str) -> None:
    from toftools.io.atomic import atomic_path
    from toftools.viz.preview import preview_png

    drawn = preview_png(capture, title=title)
    with atomic_path(picture) as temporary:
        temporary.write_bytes(drawn)


def _say(
    files: Mapping[str, Path | None],
    capture: Capture,
    scene: str,
    cost: Mapping[str, float],
    *,
    as_json: bool,
) -> None:
    from toftools.cli._report import told

    written = {what: str(file) for what, file in files.items() if file is not None}
    if as_json:
        known = {key: value for key, value in cost.items() if value == value}  # no NaN in JSON
        click.echo(json.dumps({**written, **capture.provenance, **known}))
        return
    height, width = capture.sensor.camera.shape
    freqs = ", ".join(f"{f / 1e6:g}" for f in capture.sensor.modulation.freqs_hz)
    click.echo(f"wrote {written['out']}: {scene}, {width} x {height} px, {freqs} MHz")
    for line in told(capture, **cost):
        click.echo(line)
    if "preview" in written:
        click.echo(f"wrote {written['preview']}")
