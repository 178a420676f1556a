"""``toftools bench [run|score|report]``; without a stage it does all three."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click


class _AllByDefault(click.Group):
    """Group that takes ``bench SUITE`` as ``bench all SUITE``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "-h", "--help"):
            args = ["all", *args]
        return super().parse_args(ctx, args)


@click.group(cls=_AllByDefault, context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Run, score and report methods over captures: ``toftools bench SUITE --out DIR``."""


_RUN_OPTIONS: list[Callable[[Any], Any]] = [
    click.argument("suite", default="quick"),
    click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False),
                 help="Folder; a second run finishes what the first left."),
    click.option("--method", "methods", multiple=True, metavar="NAME|mypkg.mine:make",
                 help="A method on top of the suite's."),
    click.option("--threads", type=click.IntRange(min=1), default=os.cpu_count() or 1,
                 show_default="all cores", help="Threads each method may use."),
    click.option("--timeout", "timeout_s", type=float, default=900.0, show_default=True,
                 help="Seconds one point may take."),
]  # fmt: skip


def _with_run_options(function: Any) -> Any:  # noqa: ANN401 - click decorates anything
    for option in reversed(_RUN_OPTIONS):
        function = option(function)
    return function


def _folder() -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    kind = click.Path(path_type=Path, exists=True, file_okay=False)
    return click.argument("folder", type=kind, metavar="DIR")


@command.command("run")
@_with_run_options
def run_stage(
    suite: str, out: Path, methods: tuple[str, ...], threads: int, timeout_s: float
) -> int:
    """Run the points of SUITE that are not finished."""
    return _run(suite, out, methods, threads, timeout_s)


@command.command("score")
@_folder()
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON lines.")
def score_stage(folder: Path, *, as_json: bool) -> None:
    """Score the stored answers in DIR; nothing is run again."""
    _score(folder, as_json=as_json)


@command.command("report")
@_folder()
def report_stage(folder: Path) -> None:
    """Write DIR/report.html from DIR/results.jsonl."""
    _report(folder)


@command.command("all", hidden=True)
@_with_run_options
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON lines.")
def all_stages(
    suite: str,
    out: Path,
    methods: tuple[str, ...],
    threads: int,
    timeout_s: float,
    *,
    as_json: bool,
) -> int:
    """Run SUITE, score it and write the report."""
    status = _run(suite, out, methods, threads, timeout_s)
    _score(out, as_json=as_json)
    _report(out)
    return status


def _run(suite: str, out: Path, methods: tuple[str, ...], threads: int, timeout_s: float) -> int:
    from toftools.bench.plan import Point, make_plan
    from toftools.bench.run import run_points
    from toftools.bench.suite import load_suite
    from toftools.bench.table import label_of

    loaded = load_suite(suite)
    click.echo(f"suite {loaded.name}: reading captures", err=True)
    plan = make_plan(loaded, out, methods)
    with click.progressbar(
        length=len(plan), label="points", file=sys.stderr, width=24,
        item_show_func=str,
    ) as bar:  # fmt: skip

        def progress(_done: int, _total: int, point: Point, status: str) -> None:
            label = label_of({"method": point.method, "params": point.params})
            bar.update(1, f"{label} {status}")

        bad = run_points(
            plan, out, repeats=loaded.repeats, threads=threads, timeout_s=timeout_s,
            progress=progress,
        )  # fmt: skip
    return 1 if bad else 0


def _score(out: Path, *, as_json: bool) -> None:
    from toftools.bench.render import text_table
    from toftools.bench.score import score
    from toftools.bench.table import groups, summarise, unsuited

    rows = score(out)
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
        return
    for name, mine in groups(rows).items():
        against = {"truth": "", "camera": ", against the camera's own distance"}
        click.echo(f"\n{name}{against.get(mine[0]['against'], ', nothing to compare with')}")
        click.echo(text_table(summarise(mine)))
        for sentence in unsuited(mine):
            click.echo(f"({sentence})")


def _report(out: Path) -> None:
    from toftools.bench.report import report

    click.echo("drawing the report", err=True)
    click.echo(f"\nreport: {report(out)}", err=True)
