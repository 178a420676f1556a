"""Train the network of a recipe on a data set."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from toftools.correct._net_coarse import COARSE, SHIFT_M
from toftools.correct._net_inputs import channels, n_candidates
from toftools.io.atomic import atomic_path
from toftools.train import deeptof2017, loop, phasornet
from toftools.train.frames import Frame, read_frames
from toftools.train.recipe import TrainRecipe
from toftools.train.samples import Batch, Samples
from toftools.types import F32

MOST_VALIDATION = 48
"""Frames that the learning curve looks at."""
CHECK_SNR = 200.0
MOST_SHOWN = 24
SETTLE = 100
"""Batches for the statistics of normalisation."""
LAYOUT = torch.channels_last
"""Channels beside each other in memory: steps took 0.36 s instead of 0.45."""
WRONG_CM = 50.0


def trained(
    recipe: TrainRecipe, data: Path, folder: Path, told: Callable[[str], None] = lambda _: None
) -> nn.Module:
    """Train, or go on with a training.

    Parameters
    ----------
    recipe : TrainRecipe
        What to train.
    data : Path
        Data set.
    folder : Path
        Of checkpoints and learning curves.
    told : callable
        Takes lines of progress.

    Returns
    -------
    Module
        In evaluation mode.

    Raises
    ------
    ValueError
        If the data set lacks what the recipe needs, or a checkpoint is damaged.
    """
    torch.manual_seed(recipe.seed)
    torch.use_deterministic_algorithms(mode=True)
    # Moments of weights that no input moves fade into denormal numbers, and those are slow.
    torch.set_flush_denormal(True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    wanted = sorted({freq * scale for freq in recipe.freqs_hz for scale in recipe.scales})
    lessons = Samples(read_frames(data, "train", wanted), recipe)
    told(f"{len(lessons.frames)} frames to learn from")
    check = _chosen(read_frames(data, "validation", wanted))
    usual = min(recipe.scales, key=lambda scale: abs(np.log(scale)))
    exam = [Samples(check, recipe).fixed(i, usual, CHECK_SNR) for i in range(len(check))]
    model = network(recipe).to(device, memory_format=LAYOUT)
    if recipe.model == "deeptof2017":
        _teach_range(model, recipe, lessons, exam, folder, told)
        return model

    def loss_of(step: int) -> Tensor:
        batch = lessons.drawn(step)
        full, coarse, candidates, truth, known = _tensors(batch, device)
        return phasornet.loss_of(model(full, coarse), candidates, truth, known)[0]

    def answer(batch: Batch) -> Tensor:
        full, coarse, candidates, truth, known = _tensors(batch, device)
        return phasornet.loss_of(model(full, coarse), candidates, truth, known)[1]

    stage = loop.Stage("network", recipe.steps, recipe.learning_rate)
    loop.run(model, stage, loss_of, lambda: measured(exam, answer), folder, told)
    _ended(stage, lambda: measured(exam, answer), folder, told)
    return model


def shown(recipe: TrainRecipe, data: Path, names: Sequence[str]) -> list[dict[str, F32]]:
    """Inputs of validation frames, which show the range of every activation.

    Parameters
    ----------
    recipe : TrainRecipe
        What was trained.
    data : Path
        Data set.
    names : sequence of str
        Of the network's inputs.

    Returns
    -------
    list of dict
        One per frame and scale, up to `MOST_SHOWN`.
    """
    wanted = sorted({freq * scale for freq in recipe.freqs_hz for scale in recipe.scales})
    frames = _chosen(read_frames(data, "validation", wanted))
    samples, found = Samples(frames, recipe), []
    for number in range(min(len(frames), MOST_SHOWN)):
        scale = recipe.scales[number % len(recipe.scales)]
        batch = samples.fixed(number, scale, CHECK_SNR)
        found.append(dict(zip(names, (batch.full, batch.coarse), strict=False)))
    return found


def network(recipe: TrainRecipe) -> nn.Module:
    """The untrained network of a recipe.

    Parameters
    ----------
    recipe : TrainRecipe
        The recipe.

    Returns
    -------
    Module
        With weights drawn from torch's generator.
    """
    if recipe.model == "deeptof2017":
        return deeptof2017.DeepToF(recipe.widths, recipe.skip)
    n_freqs = len(recipe.freqs_hz)
    full, coarse = channels(n_freqs)
    keep = torch.from_numpy(kept(n_freqs, recipe.without))
    return phasornet.PhasorNet(full, coarse, n_candidates(n_freqs), recipe.widths, keep)


def kept(n_freqs: int, without: Sequence[str]) -> np.ndarray:
    """Which channels an ablation leaves.

    Parameters
    ----------
    n_freqs : int
        Frequencies.
    without : sequence of str
        What is left out.

    Returns
    -------
    ndarray, (channels,), float32
        1 or 0.
    """
    full, coarse = channels(n_freqs)
    keep = np.ones(full + coarse, np.float32)
    more, first = n_candidates(n_freqs) - 1, 5
    if "reflectance" in without:
        keep[3] = 0
    if "residuals" in without:
        keep[first : first + n_freqs] = 0
    if "candidates" in without and more:
        keep[first + n_freqs : full] = 0
    if "bounce" in without:
        keep[full + COARSE :] = 0
    return keep


def _teach_range(
    model: nn.Module, recipe: TrainRecipe, lessons: Samples, exam: list[Batch], folder: Path,
    told: Callable[[str], None],
) -> None:  # fmt: skip
    """Both stages of deeptof2017."""
    assert isinstance(model, deeptof2017.DeepToF)
    device = next(model.parameters()).device
    metres = np.float32(SHIFT_M)

    def encoded(step: int) -> Tensor:
        full, _, _, _, known = _tensors(lessons.drawn(step, "unlabelled"), device)
        return deeptof2017.loss_of(model(full, coarse=True), full[:, 0], known)

    def corrected(step: int) -> Tensor:
        full, _, _, truth, known = _tensors(lessons.drawn(step), device)
        return deeptof2017.loss_of(model(full), truth * metres, known)

    def answer(batch: Batch) -> Tensor:
        return model(_tensors(batch, device)[0])[:, 0] / metres

    if recipe.pretrain_steps:
        stage = loop.Stage("autoencoder", recipe.pretrain_steps, recipe.learning_rate)
        loop.run(model, stage, encoded, dict, folder, told)
        model.freeze()
    stage = loop.Stage("network", recipe.steps, recipe.learning_rate)
    loop.run(model, stage, corrected, lambda: measured(exam, answer), folder, told)
    # Statistics of normalisation over many batches, not those of the last few.
    loop.settle(model, corrected, min(SETTLE, stage.steps))
    _ended(stage, lambda: measured(exam, answer), folder, told)


def _ended(
    stage: loop.Stage, measure: loop.Measure, folder: Path, told: Callable[[str], None]
) -> None:
    """The figures of what is then exported."""
    with torch.no_grad():
        point = dict(measure())
    with atomic_path(folder / "final.json") as path:
        path.write_text(json.dumps({"step": stage.steps, **point}), encoding="utf-8")
    told(", ".join(["at the end", *(f"{key} {value:.4g}" for key, value in point.items())]))


def measured(exam: Sequence[Batch], answer: Callable[[Batch], Tensor]) -> Mapping[str, float]:
    """Mean absolute errors on validation frames, cm.

    Parameters
    ----------
    exam : sequence of Batch
        Frames.
    answer : callable
        Ranges of a batch, in units of `SHIFT_M`.

    Returns
    -------
    mapping
        ``raw_cm`` of the first candidate, ``mae_cm`` of the answer, ``wrong_share`` of answers more
        than half a metre off.
    """
    raw, own = [], []
    for batch in exam:
        got = answer(batch).cpu().numpy()
        raw.append(np.abs(batch.candidates[:, 0] - batch.truth)[batch.known])
        own.append(np.abs(got - batch.truth)[batch.known])
    before, after = (100 * SHIFT_M * np.concatenate(e) for e in (raw, own))
    return {
        "raw_cm": float(before.mean()),
        "mae_cm": float(after.mean()),
        "median_cm": float(np.median(after)),
        "wrong_share": float((after > WRONG_CM).mean()),
    }


def _chosen(frames: list[Frame]) -> list[Frame]:
    """Evenly spread frames, no more than needed."""
    step = max(len(frames) // MOST_VALIDATION, 1)
    return frames[::step][:MOST_VALIDATION]


def _tensors(batch: Batch, device: torch.device) -> tuple[Tensor, ...]:
    found = [torch.from_numpy(getattr(batch, name)) for name in Batch.__dataclass_fields__]
    images = [t.to(device, memory_format=LAYOUT) if t.ndim == 4 else t.to(device) for t in found]
    return tuple(images)
