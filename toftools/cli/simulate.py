"""``toftools simulate SCENE --sensor NAME --out C.h5``."""

import json
from pathlib import Path

import click

from toftools.registry import SIMULATORS


@click.command()
@click.argument("scene")
@click.option("--sensor", "sensor_text", default="deeptof", show_default=True, metavar="NAME[:k=v]",
              help="Preset, with overrides such as deeptof:freqs=20e6+50e6,width=64.")  # fmt: skip
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False))
@click.option("--engine", type=click.Choice(["auto", *SIMULATORS]), default="auto")
@click.option("--max-bounces", type=click.IntRange(min=0), default=None,
              help="Indirect bounces to keep; all by default.")  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--no-noise", is_flag=True, help="Expected taps, without shot and read noise.")
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
def command(
    *,
    scene: str,
    sensor_text: str,
    out: Path,
    engine: str,
    max_bounces: int | None,
    seed: int,
    no_noise: bool,
    as_json: bool,
) -> None:
    """Simulate a capture of SCENE: ``name:key=val,...`` such as ``corner:angle=90,range=2``."""
    from toftools.io.native import write_capture
    from toftools.registry import parse_entry
    from toftools.sensors import sensor
    from toftools.types import Scene, Shot

    name, params = parse_entry(scene)
    # One engine so far: `auto` takes the exact one, which refuses scenes without a closed form.
    run = SIMULATORS["analytic" if engine == "auto" else engine].build(Scene(name, params))
    shot = Shot(sensor(sensor_text), seed=seed, noisy=not no_noise, max_bounces=max_bounces)
    capture = run(shot)
    write_capture(out, capture)
    if as_json:
        click.echo(json.dumps({"out": str(out), **capture.provenance}))
    else:
        height, width = capture.sensor.camera.shape
        freqs = ", ".join(f"{f / 1e6:g}" for f in capture.sensor.modulation.freqs_hz)
        click.echo(f"wrote {out}: {scene}, {width} x {height} px, {freqs} MHz")
