"""``toftools bench [run|score|report]``; without a stage it does all three."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from toftools.bench.settings import Settings
    from toftools.bench.suite import Suite


class _AllByDefault(click.Group):
    """Group that takes ``bench SUITE`` as ``bench all SUITE``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "-h", "--help"):
            args = ["all", *args]
        return super().parse_args(ctx, args)


@click.group(cls=_AllByDefault, context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Run, score and report methods over captures: toftools bench SUITE --out DIR.

    SUITE is a built-in name (quick, core, real, full, stress, parsimony) or a TOML file. Without a
    stage all three are done; `toftools bench all --help` lists the options.
    """


_RUN_OPTIONS: list[Callable[[Any], Any]] = [
    click.argument("suite", default="quick"),
    click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False),
                 help="Folder; a second run finishes what the first left."),
    click.option("--method", "methods", multiple=True, metavar="NAME|mypkg.mine:make",
                 help="A method on top of the suite's."),
    click.option("--threads", type=click.IntRange(min=1), default=os.cpu_count() or 1,
                 show_default="all cores", help="Threads each method may use."),
    click.option("--timeout", "timeout_s", type=click.FloatRange(0.1, 1e6), default=900.0,
                 show_default=True, help="Seconds one point may take."),
    click.option("--memory-mb", type=click.FloatRange(1), default=None,
                 show_default="nine tenths of the machine",
                 help="Memory the process of a method may hold."),
    click.option("--jobs", type=click.IntRange(min=1), default=None, show_default="1",
                 help="Points at once, each with --threads; more than one, and times are those of "
                 "a busy machine."),
    click.option("--dask", metavar="ADDRESS", default=None,
                 help="Run on the Dask cluster of this scheduler instead; its workers see DIR."),
]  # fmt: skip


_json_option = click.option("--json", "as_json", is_flag=True, help="Print results as JSON.")


def _with_run_options(function: Any) -> Any:  # noqa: ANN401 - click decorates anything
    for option in reversed(_RUN_OPTIONS):
        function = option(function)
    return function


def _folder() -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    kind = click.Path(path_type=Path, exists=True, file_okay=False)
    return click.argument("folder", type=kind, metavar="DIR")


@command.command("run")
@_with_run_options
@_json_option
def run_stage(*, as_json: bool, **options: Any) -> int:  # noqa: ANN401 - click passes options
    """Run the points of SUITE that are not finished."""
    counts = _run(**options)
    if as_json:
        click.echo(json.dumps(counts))
    return _status(counts)


@command.command("score")
@_folder()
@_json_option
def score_stage(folder: Path, *, as_json: bool) -> None:
    """Score the stored answers in DIR; nothing is run again."""
    _score(folder, as_json=as_json)


@command.command("report")
@_folder()
@_json_option
def report_stage(folder: Path, *, as_json: bool) -> None:
    """Write DIR/report.html from DIR/results.jsonl."""
    page = _report(folder)
    click.echo(json.dumps({"report": str(page)}) if as_json else f"report: {page}")


@command.command("all")
@_with_run_options
@_json_option
def all_stages(*, as_json: bool, **options: Any) -> int:  # noqa: ANN401 - click passes options
    """Run SUITE, score it and write the report; what `toftools bench SUITE` does."""
    counts = _run(**options)
    _score(options["out"], as_json=as_json)
    page = _report(options["out"])
    click.echo(f"\nreport: {page}", err=True)
    return _status(counts)


def _status(counts: dict[str, int]) -> int:
    """Exit code: 1 if a point failed, crashed or ran out of time."""
    return int(any(counts.get(status) for status in ("failed", "crashed", "timeout")))


def _run(
    suite: str,
    out: Path,
    methods: tuple[str, ...],
    **options: Any,  # noqa: ANN401
) -> dict[str, int]:
    """Run what is not finished; number of points by status."""
    from toftools.bench.plan import Point, make_folders, make_plan
    from toftools.bench.run import only_run, run_points
    from toftools.bench.suite import load_suite
    from toftools.bench.table import label_of
    from toftools.cli._progress import progress as shown

    loaded = load_suite(suite)
    settings = _settings(loaded, **options)
    counts: dict[str, int] = {}
    make_folders(out)
    with only_run(out):
        click.echo(f"suite {loaded.name}: reading captures", err=True)
        verbose = bool(click.get_current_context().find_root().params.get("verbose"))
        with shown(verbose=verbose):  # scenes may have to be rendered
            plan = make_plan(loaded, out, methods)
        with click.progressbar(
            length=len(plan), label="points", file=sys.stderr, width=24,
            item_show_func=str,
        ) as bar:  # fmt: skip

            def progress(point: Point, status: str) -> None:
                counts[status] = counts.get(status, 0) + 1
                label = label_of({"method": point.method, "params": point.params})
                bar.update(1, f"{label} {status}")

            run_points(plan, out, settings, progress)
    return counts


def _settings(
    suite: "Suite", *, threads: int, timeout_s: float, memory_mb: float | None, jobs: int | None,
    dask: str | None,
) -> "Settings":  # fmt: skip
    from toftools.bench.run import Settings

    if dask is not None and jobs is not None:
        msg = "got --jobs and --dask; a cluster has its own number of workers, leave --jobs out"
        raise ValueError(msg)
    return Settings(
        suite.repeats, threads, timeout_s, jobs=jobs or 1, batch=suite.batch,
        memory_mb=memory_mb, cluster=dask or "", sensitivity=suite.sensitivity,
    )  # fmt: skip


def _score(out: Path, *, as_json: bool) -> None:
    from toftools.bench.render import text_table
    from toftools.bench.score import score
    from toftools.bench.table import groups, summarise, unsuited

    rows = score(out)
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
        return
    ladders = dict.fromkeys(name for row in rows for name in row.get("ladders", ()))
    for name, mine in groups(row for row in rows if "ladders" not in row).items():
        click.echo(f"\n{name}")
        click.echo(text_table(summarise(mine)))
        for sentence in unsuited(mine):
            click.echo(f"({sentence})")
    if ladders:
        click.echo(f"\nladders, compared in the report: {', '.join(ladders)}")


def _report(out: Path) -> Path:
    from toftools.bench.report import report

    click.echo("drawing the report", err=True)
    return report(out)
