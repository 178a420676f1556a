"""A whole training: network, learning curves, ONNX file."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from toftools.bench.fingerprint import digest
from toftools.correct._net_file import NORMALISATION
from toftools.correct._net_inputs import channels
from toftools.dataset.manifest import present
from toftools.io.atomic import atomic_path
from toftools.train.export import card_of, example, export, quantised
from toftools.train.recipe import TrainRecipe
from toftools.train.train import shown, trained
from toftools.viz.learning import curves_png

STAGES = ("autoencoder", "network")


def run(
    recipe: TrainRecipe, data: Path, out: Path, work: Path, int8: Path | None = None,
    told: Callable[[str], None] = lambda _: None,
) -> Mapping[str, float]:  # fmt: skip
    """Train and export.

    Parameters
    ----------
    recipe : TrainRecipe
        What to train.
    data : Path
        Data set.
    out : Path
        ONNX file.
    work : Path
        Folder of checkpoints and curves.
    int8 : Path or None
        ONNX file of the network in eight bits; None for none.
    told : callable
        Takes lines of progress.

    Returns
    -------
    mapping
        Figures of what was exported, on validation frames.

    Raises
    ------
    ValueError
        If the folder belongs to another recipe, or the data set lacks what is needed.
    """
    shown_by = digest(sorted(present(data)))
    mark = {"recipe": recipe.digest, "data": shown_by, "input": dict(NORMALISATION)}
    path = work / "recipe.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else mark
    except ValueError:
        found = None
    if found != mark:
        msg = (
            f"{work} holds the training of another recipe, data set or version; give another "
            "--work, or delete it"
        )
        raise ValueError(msg)
    work.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as target:
        target.write_text(json.dumps(mark), encoding="utf-8")
    model = trained(recipe, data, work, told)
    card = card_of(recipe, shown_by)
    export(model, card, example(card, channels(len(recipe.freqs_hz))), out)
    if int8 is not None:
        quantised(out, shown(recipe, data, tuple(example(card, (1, 1)))), card, int8)
    stages = {name: _points(work / f"{name}.jsonl") for name in STAGES}
    with atomic_path(work / "curves.png") as target:
        target.write_bytes(curves_png(stages, title=recipe.name))
    last: Mapping[str, float] = json.loads((work / "final.json").read_text(encoding="utf-8"))
    return last


def _points(path: Path) -> list[Mapping[str, float]]:
    """A learning curve; none of a stage that was not run."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [json.loads(line) for line in lines]
