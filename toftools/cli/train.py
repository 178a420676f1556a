"""``toftools train``: a data set and a recipe become an ONNX file."""

import importlib.util
import json
from pathlib import Path

import click


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("recipe")
@click.option("--data", type=click.Path(path_type=Path, file_okay=False), default=None,
              show_default="that of the recipe",
              help="Data set, made by toftools dataset make.")  # fmt: skip
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="ONNX file.")  # fmt: skip
@click.option("--work", type=click.Path(path_type=Path, file_okay=False), default=None,
              show_default="OUT without its ending",
              help="Folder of checkpoints and learning curves; a run goes on there.")  # fmt: skip
@click.option("--int8", type=click.Path(path_type=Path, dir_okay=False), default=None,
              help="ONNX file of the same network in eight bits.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print figures of the validation as JSON.")
def command(
    *,
    recipe: str,
    data: Path | None,
    out: Path,
    work: Path | None,
    int8: Path | None,
    as_json: bool,
) -> int:
    """Train the network of RECIPE: a TOML file, or one that comes with the package.

    OUT is an ONNX file for toftools correct -m network:model=OUT. Stopped or killed, the same
    command goes on from the last checkpoint and ends with the same weights.
    """
    for package in ("torch", "onnx"):
        if importlib.util.find_spec(package) is None:
            msg = f"training needs {package}, which is not installed: pip install 'toftools[train]'"
            raise ValueError(msg)
    from toftools.io.atomic import check_target
    from toftools.train.recipe import read_train_recipe
    from toftools.train.run import run

    for target in (out, int8):
        if target is None:
            continue
        if target.suffix != ".onnx":
            msg = f"got the file {target}, wanted one that ends in .onnx"
            raise ValueError(msg)
        check_target(target)
    found = read_train_recipe(recipe)
    folder = work or out.with_suffix("")
    if data is None and not found.data:
        msg = f"the recipe {recipe} names no data set; give --data DIR (toftools dataset make)"
        raise ValueError(msg)
    last = run(
        found, data or Path(found.data), out, folder, int8, lambda text: click.echo(text, err=True)
    )
    if as_json:
        click.echo(json.dumps(last))
        return 0
    click.echo(
        f"{out}: mean absolute error {last['mae_cm']:.2f} cm on validation frames, "
        f"{last['raw_cm']:.2f} cm before"
    )
    return 0
