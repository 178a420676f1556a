"""``toftools convert IN --out C.h5 [--format NAME[:k=v,...]]``."""

from pathlib import Path

import click

from toftools.registry import READERS

EPILOG = f"""Formats: {", ".join(READERS)}; docs/methods.md lists the keys of each, and so does the
error about a wrong one.

Example: toftools convert scene.png --format depth_png:scale=5000,hfov_deg=57 --out c.h5
"""


@click.command(epilog=EPILOG)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="Capture file, *.h5.")  # fmt: skip
@click.option("--format", "format_text", default=None, metavar="NAME[:k=v,...]",
              help="Force a format and its convention; detected by default.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
def command(*, source: Path, out: Path, format_text: str | None, as_json: bool) -> None:
    """Turn the foreign recording SOURCE into a capture file."""
    import json

    from toftools.io.inspect import holds
    from toftools.io.native import write_capture
    from toftools.io.open import open_capture

    if out.suffix.lower() not in (".h5", ".hdf5"):
        msg = f"got --out {out.name}; a capture file is HDF5, so name it *.h5"
        raise ValueError(msg)
    capture = open_capture(source, format_text)
    write_capture(out, capture)
    if as_json:
        found = {"out": str(out), "holds": holds(capture), **capture.provenance}
        click.echo(json.dumps(found, default=str))
        return
    height, width = capture.sensor.camera.shape
    freqs = " + ".join(f"{freq / 1e6:g}" for freq in capture.sensor.modulation.freqs_hz)
    parts = ", ".join(holds(capture))
    click.echo(f"wrote {out}: {width} x {height} px, {freqs} MHz, {parts}")
