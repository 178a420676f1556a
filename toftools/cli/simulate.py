"""``toftools simulate SCENE --sensor NAME --out C.h5``."""

import json
from pathlib import Path

import click

from toftools.registry import SIMULATORS, parameters_of
from toftools.sensors import KEYS, PRESETS
from toftools.sim.analytic import SCENES


def _scene_lines() -> str:
    """Every scene with its defaults, a line each."""
    lines = [
        f"  {name}:" + ",".join(f"{key}={value:g}" for key, value in parameters_of(make).items())
        for name, make in SCENES.items()
    ]
    return "\n".join(lines)


EPILOG = f"""\b
Scenes with their defaults (m, degrees; each takes ambient_e, electrons, too):
{_scene_lines()}

Sensors: {", ".join(PRESETS)}; each takes {", ".join(KEYS)} (Hz, px, electrons; several values
joined by +).

Example: toftools simulate corner:angle=90 --sensor opt8241:width=64,height=48 --out c.h5
"""


@click.command(epilog=EPILOG)
@click.argument("scene")
@click.option("--sensor", "sensor_text", default="deeptof", show_default=True, metavar="NAME[:k=v]",
              help="Preset, with overrides such as deeptof:freqs=20e6+50e6,width=64.")  # fmt: skip
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="Capture file, *.h5, with taps, phasors and truth.")  # fmt: skip
@click.option("--engine", type=click.Choice(["auto", *SIMULATORS]), default="auto",
              show_default=True, help="What computes the light; auto: the exact one.")  # fmt: skip
@click.option("--max-bounces", type=click.IntRange(min=0), default=None,
              help="Indirect bounces to keep; all by default.")  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the noise.")
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
    """Simulate a capture of SCENE, such as corner:angle=90,range=2."""
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
