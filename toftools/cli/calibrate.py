"""``toftools calibrate STAGE CAPTURES... --out CAL.json [--report R.html]``."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import click

from toftools.conditions import KINDS
from toftools.registry import CALIBRATIONS, FACTORY

OVERRIDES = ("kind", "distance_m", "delay_s", "sensor_c", "light_c", "exposure", "reference")


NAMES = f"\n{' ' * 23}".join(textwrap.wrap(", ".join(CALIBRATIONS), 76))
EPILOG = f"""\b
STAGE is one of
  all DIR              every stage that the captures in DIR allow, and a verdict
  NAME[:key=val,...]   one stage, added to what --out or --from holds already:
                       {NAMES}
  mypkg.mine:make      a stage of your own
  factory:NAME PATH    the tables that a vendor stored: {", ".join(FACTORY)}

conditions.csv says what each capture shows, one line a file:
file,kind,distance_m,sensor_c,light_c,... Kinds: {", ".join(KINDS)}. For a few captures alike the
options above say the same. docs/calibration/directory.md tells how to take
each, docs/methods.md lists the keys of each stage.

\b
Examples:
  toftools calibrate all rig/ --out cal.json --report cal.html
  toftools calibrate lens boards/*.h5 --board chessboard:columns=8,rows=5,square_m=0.03 --out cal.json
  toftools calibrate fixed_pattern wall.h5 --kind wall --distance-m 2.0 --out cal.json
"""  # noqa: E501 - an example must fit one line


@click.command(epilog=EPILOG)
@click.argument("stage")
@click.argument("captures", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="Calibration, *.json; maps go beside it.")  # fmt: skip
@click.option("--report", default=None, type=click.Path(path_type=Path, dir_okay=False),
              help="Write what was done, and how good it is, as one HTML file.")  # fmt: skip
@click.option("--from", "start", default=None, type=click.Path(path_type=Path),
              help="Calibration to extend; a single stage extends --out if it exists.")  # fmt: skip
@click.option("--conditions", "table", default=None, type=click.Path(path_type=Path),
              help="Labels of the captures; by default conditions.csv beside them.")  # fmt: skip
@click.option("--board", default=None, metavar="KIND[:k=v,...]",
              help="Board of the lens stage: chessboard or charuco and its size.")  # fmt: skip
@click.option("--sensor", default=None, metavar="NAME[:k=v,...]",
              help="Camera of pictures (*.png) that are no captures, for the lens.")  # fmt: skip
@click.option("--stage", "entries", multiple=True, metavar="NAME[:k=v,...]",
              help="all: fit a stage this way, such as wiggling_spline; repeatable.")  # fmt: skip
@click.option("--skip", multiple=True, metavar="STAGE", help="all: leave a stage out; repeatable.")
@click.option("--kind", default=None, type=click.Choice(list(KINDS)),
              help="What all captures of this call show.")  # fmt: skip
@click.option("--distance-m", type=float, default=None,
              help="Distance of the target plane along the optical axis.")  # fmt: skip
@click.option("--delay-s", type=float, default=None, help="Electronic delay of the modulation.")
@click.option("--sensor-c", type=float, default=None, help="Temperature of the sensor, Celsius.")
@click.option("--light-c", type=float, default=None, help="Temperature of the light, Celsius.")
@click.option("--exposure", type=float, default=None, help="Relative exposure.")
@click.option("--reference", type=click.Choice(["plane", "depth"]), default=None,
              help="True range from the plane, or from the depth in the capture file.")  # fmt: skip
@click.option("--format", "format_text", default=None, metavar="NAME[:k=v,...]",
              help="Force a foreign input format.")  # fmt: skip
@click.option("--trust", multiple=True, metavar="MODULE",
              help="Module of your own stages that --from or --out may import.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
@click.pass_context
def command(ctx: click.Context, /, **told: Any) -> None:  # noqa: ANN401 - twenty options, by name
    """Fit a STAGE of a calibration, or all of them, from CAPTURES."""
    from toftools.cli._calibrate import calibrated
    from toftools.cli._calibrate_job import Job

    as_json = told.pop("as_json")
    conditions = {key: value for key in OVERRIDES if (value := told.pop(key)) is not None}
    verbose = bool(ctx.find_root().params.get("verbose"))
    quiet = (lambda _: None) if as_json else click.echo
    summary = calibrated(Job(**told, conditions=conditions, verbose=verbose, say=quiet))
    if as_json:
        click.echo(json.dumps(summary))
