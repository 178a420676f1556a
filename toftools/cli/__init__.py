"""The command line: one small file per verb, imported only when the verb is used."""

import importlib
import logging
import sys
from collections.abc import Sequence

import click

VERBS = {
    "doctor": "Check that every part of the installation works.",
    "simulate": "Simulate a capture of a scene.",
    "convert": "Turn a foreign file into a capture file.",
    "inspect": "Say what is in a file, and propose its convention.",
    "rig": "Capture a whole calibration with a virtual rig.",
    "board": "Write a calibration board to print at true size.",
    "calibrate": "Fit what is wrong with a camera, and say how good that is.",
    "correct": "Turn a capture into a depth map.",
    "cloud": "Make a point cloud or a picture of one.",
    "register": "Colour a cloud from a second camera, or bring ranges to its picture.",
    "dataset": "Make data sets of simulated captures by recipe.",
    "train": "Train a learned correction on a data set (extra [train]).",
    "bench": "Run, score and report methods over captures.",
}
"""Verb to its help line; the command itself is ``toftools.cli.<verb>:command``."""


class _Lazy(click.Group):
    """Group whose help needs no import of any verb."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in VERBS:
            return None
        module = importlib.import_module(f"toftools.cli.{cmd_name}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(VERBS.items()))


@click.command(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("-v", "--verbose", is_flag=True, help="More messages on stderr.")
@click.version_option(package_name="toftools", prog_name="toftools")
def cli(*, verbose: bool) -> None:
    """Simulate, correct and benchmark AMCW time-of-flight cameras."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(levelname)s: %(message)s",
        stream=sys.stderr,
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line; exit code 0 done, 1 failed, 2 bad input.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process by default.
    """
    # A user's own `mine:make` lies in the current folder. It comes last, so that no file of a
    # folder of recordings stands in for a library.
    if "" not in sys.path:
        sys.path.append("")
    try:
        status = cli.main(args=argv, prog_name="toftools", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(2)
    except (click.Abort, KeyboardInterrupt):
        click.echo("stopped", err=True)
        sys.exit(1)
    except ValueError as error:
        click.echo(f"error: {' '.join(str(error).split())}", err=True)
        sys.exit(2)
    except (OSError, RuntimeError, MemoryError) as error:
        detail = " ".join(str(error).split()) or type(error).__name__
        click.echo(f"failed: {detail}", err=True)
        sys.exit(1)
    except Exception as error:  # a user's method may raise anything; --verbose shows where
        logging.getLogger(__name__).info("details", exc_info=True)
        detail = f"{type(error).__name__}: {' '.join(str(error).split())}"
        click.echo(f"failed: {detail} (toftools --verbose shows where)", err=True)
        sys.exit(1)
    sys.exit(status if isinstance(status, int) else 0)
