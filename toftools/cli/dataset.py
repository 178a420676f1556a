"""``toftools dataset make``: captures by recipe, for training and for tests."""

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TextIO

import click

EVERY_S = 30.0


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Make data sets of simulated captures by recipe."""


@command.command("make")
@click.argument("recipe")
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False),
              help="Folder; a second run makes what the first left.")  # fmt: skip
@click.option("--jobs", type=click.IntRange(min=1), default=None, show_default="all cores",
              help="Captures at a time, in processes here.")  # fmt: skip
@click.option("--dask", metavar="ADDRESS", default=None,
              help="Run on the Dask cluster of this scheduler instead.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
def make_stage(*, recipe: str, out: Path, jobs: int | None, dask: str | None, as_json: bool) -> int:
    """Make the captures of RECIPE: a TOML file, or deeptof or broad.

    DIR/captures holds a file per capture, DIR/manifest.jsonl says what each shows and to which part
    (train, validation, test) its scene belongs. Stopped or killed, the same command goes on.
    """
    from toftools.dataset.make import make
    from toftools.dataset.pools import cores, local, over_cluster
    from toftools.dataset.recipe import read_recipe

    if dask is not None and jobs is not None:
        msg = "got --jobs and --dask; a cluster has its own number of workers, leave --jobs out"
        raise ValueError(msg)
    found = read_recipe(recipe)
    workers = min(jobs or cores(), len(found.jobs))
    line = _Line(sys.stderr)
    try:
        made = make(found, out, over_cluster(dask) if dask else local(workers), line.show)
    finally:
        line.end()
    parts = Counter(entry["split"] for entry in made.entries)
    if as_json:
        counts = {"recipe": found.name, "captures": len(made.entries), "made": made.fresh}
        click.echo(json.dumps({**counts, "parts": parts, "failed": dict(made.failed)}))
        return 1 if made.failed else 0
    said = ", ".join(f"{count} {part}" for part, count in parts.items())
    click.echo(f"{out}: {len(made.entries)} of {len(found.jobs)} captures ({said})")
    for name, why in list(made.failed.items())[:5]:
        click.echo(f"failed: {name}: {why}", err=True)
    if made.failed:
        click.echo(f"{len(made.failed)} failed ({out / 'failed.jsonl'}); run again", err=True)
    return 1 if made.failed else 0


class _Line:
    """Progress: one line that is written over on a terminal, a line now and then elsewhere."""

    def __init__(self, stream: TextIO) -> None:
        self.stream, self.last, self.alive = stream, time.monotonic(), stream.isatty()

    def show(self, text: str) -> None:
        if self.alive:
            self.stream.write(f"\r\x1b[K{text}")
            self.stream.flush()
        elif time.monotonic() - self.last > EVERY_S:
            self.last = time.monotonic()
            click.echo(text, err=True)

    def end(self) -> None:
        if self.alive:
            self.stream.write("\r\x1b[K")
            self.stream.flush()
